"""The accumulation reference: the scene drawn from many points on the lens, and averaged.

Haeberli & Akeley 1990, "The Accumulation Buffer". Each view's frustum is sheared so that the plane in focus stays where
it is, to the last bit (shaders/projection.glsl). It is drawn by the passes that also make the layers, so a method that
is compared with it differs by its blur alone.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..camera import Camera
from ..errors import InputError
from ..lens import Lens, lens_samples
from .peel import DepthPeeler, Progress
from .scene import Scene

__all__ = ["accumulate"]

# Where alpha is coverage, this many surfaces one behind the other count; an opaque one ends the pixel earlier.
_MAX_BLENDED = 16


def accumulate(
    peeler: DepthPeeler,
    scene: Scene,
    camera: Camera,
    lens: Lens,
    views: int = 256,
    shape: str = "gaussian",
    jitter: bool = False,
    seed: int = 0,
    progress: Progress | None = None,
) -> NDArray[np.float32]:
    """Depth of field by brute force.

    Parameters
    ----------
    peeler : DepthPeeler
        Its context, uploads and framebuffers are used.
    scene : Scene
    camera : Camera
        No guard band is needed: each view draws what it sees.
    lens : Lens
    views : int
        Points on the lens; the error falls about with their number. A pinhole without jitter needs one, and gets one.
    shape : {"gaussian", "disc"}
        See :func:`cldof.lens_samples`.
    jitter : bool
        Also move each view inside the pixel (seeded), which smooths edges. Layers have hard edges: leave it off to
        compare with them.
    seed : int
    progress : callable, optional
        Called with (views done, views).

    Returns
    -------
    ndarray, (H, W, 4), float32
        Linear light, premultiplied; the mean over all views, summed in float64.

    Raises
    ------
    InputError, SceneError, CaptureError
    """
    if isinstance(views, bool) or views != int(views) or views < 1:
        raise InputError(f"views is {views!r}; it must be a whole number, at least 1.")
    points = lens_samples(int(views), shape, seed) * lens.aperture_radius_m
    if lens.aperture_radius_m == 0.0 and not jitter:
        points = points[:1]
    shifts = _pixel_shifts(len(points), seed) if jitter else np.zeros((len(points), 2))

    from .draw import PassOptions, View

    # Each view culls what it sees from behind itself; a surface is blended only where alpha says so.
    options = PassOptions(lens_reach_m=0.0, stop_at_opaque=scene.has_blending)
    layers = _MAX_BLENDED if scene.has_blending else 1
    shape_px = (camera.height, camera.width, 4)
    total = np.zeros(shape_px)
    image, layer = np.empty(shape_px, np.float32), np.empty(shape_px, np.float32)
    with peeler.current():
        for index, (point, shift) in enumerate(zip(points, shifts, strict=True)):
            view = View(camera, (point[0], point[1]), lens.focus_distance_m, (shift[0], shift[1]))
            image.fill(0.0)
            for number, target in enumerate(peeler.passes(scene, view, layers, options)):
                if number == 0:
                    target.read(0, image)
                else:
                    image += (1.0 - image[..., 3:]) * target.read(0, layer)
            total += image
            if progress is not None:
                progress(index + 1, len(points))
    mean: NDArray[np.float32] = (total / len(points)).astype(np.float32)
    return mean


def _pixel_shifts(count: int, seed: int) -> NDArray[np.float64]:
    """Points spread evenly over a pixel, in [-1/2, 1/2): Roberts' R2 sequence, unrelated to the spiral of the lens."""
    root = 1.32471795724474602596  # of x**3 = x + 1
    start = np.random.default_rng(seed).random(2)
    shifts: NDArray[np.float64] = (start + np.arange(count)[:, None] / (root, root * root)) % 1.0 - 0.5
    return shifts
