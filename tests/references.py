"""Built-in scenes with their references, made once for all methods that are judged by them."""

from functools import cache
from typing import NamedTuple

import numpy as np

from cldof import LayeredFrame, Lens
from cldof.capture.scenes import builtin_scene
from tests.opengl import require_opengl

__all__ = ["SIZE", "Judged", "judged"]

SIZE = 192
_VIEWS = 128


class Judged(NamedTuple):
    """A frame of six peels with a guard band, the lens, and what it should look like."""

    frame: LayeredFrame
    lens: Lens
    reference: np.ndarray

    def with_peels(self, count: int) -> LayeredFrame:
        """The first peels of the frame."""
        frame = self.frame
        return LayeredFrame(frame.color[:count], frame.depth[:count], frame.camera, guard_px=frame.guard_px)


def judged(name: str, shape: str, view_dependent: bool = False) -> Judged:
    """A built-in scene and 128 views of it through a ``"disc"`` or ``"gaussian"`` lens; skips without OpenGL.

    With ``view_dependent`` views are shaded from their own points, and the frame has surface buffers. Without, they are
    shaded from the lens centre: then the blur alone is judged.
    """
    require_opengl()
    return _judged(name, shape, view_dependent)


@cache
def _judged(name: str, shape: str, view_dependent: bool) -> Judged:
    from cldof.capture.accumulate import accumulate
    from cldof.capture.peel import DepthPeeler

    scene = builtin_scene(name)
    camera = scene.camera_for(SIZE, SIZE)
    assert scene.aperture_radius_m is not None
    assert scene.focus_distance_m is not None
    lens = Lens(scene.aperture_radius_m, scene.focus_distance_m)
    with DepthPeeler(SIZE, SIZE) as peeler:
        frame = peeler.peel(scene, camera, layers=6, lens=lens, guard_px=12, surface=view_dependent)
        reference = accumulate(
            peeler, scene, camera, lens, _VIEWS, shape, noise_floor=False, view_dependent=view_dependent
        )
    return Judged(frame, lens, reference.image)
