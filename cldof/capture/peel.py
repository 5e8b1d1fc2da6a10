"""Depth peeling: a scene as M layers of colour and depth, front to back.

Everitt 2001, "Interactive Order-Independent Transparency": draw the scene M times, each time rejecting what lies no
deeper than the layer before. Here the test is relative and on inverse depth (shaders/peel.glsl).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import TracebackType
from typing import TYPE_CHECKING, Any

import numpy as np

from ..camera import Camera
from ..errors import CaptureError, InputError
from ..frame import LayeredFrame
from ..lens import Lens
from .gl_context import GLContext
from .scene import Scene

if TYPE_CHECKING:
    from .draw import PassOptions, Target, View

__all__ = ["DepthPeeler", "Progress"]

Progress = Callable[[int, int], None]
"""Called with (steps done, steps in all)."""


class DepthPeeler:
    """Captures layered frames of scenes; owns one OpenGL context.

    Use it as a context manager, from any thread. What a scene needs stays uploaded between calls: another camera, lens
    or number of layers costs no upload.

    Parameters
    ----------
    width, height : int
        Image size in pixels for scenes captured through their own camera; a camera that is given has its own size.

    Raises
    ------
    CaptureError
        If this machine has no usable OpenGL.

    Examples
    --------
    >>> with DepthPeeler(640, 480) as peeler:                               # doctest: +SKIP
    ...     frame = peeler.peel(scene, layers=4, guard_px=16)
    """

    def __init__(self, width: int = 512, height: int = 512) -> None:
        self._size = (width, height)
        self._targets: list[Target] = []
        self._target_kind: tuple[int, int, bool] | None = None
        self._context = GLContext()
        try:
            with self._context.current():
                from .draw import SceneRenderer

                self._renderer = SceneRenderer(self._context.clip_depth_zero_to_one())
        except BaseException:
            self._context.close()
            raise

    @property
    def device(self) -> str:
        """The OpenGL renderer and version, for reports."""
        return f"{self._context.renderer}, OpenGL {self._context.version}"

    def peel(
        self,
        scene: Scene,
        camera: Camera | None = None,
        layers: int = 4,
        lens: Lens | None = None,
        guard_px: int = 0,
        surface: bool = False,
        progress: Progress | None = None,
        lod_bias: float = 0.0,
    ) -> LayeredFrame:
        """Capture up to ``layers`` layers of ``scene``.

        Parameters
        ----------
        scene : Scene
        camera : Camera, optional
            The scene's own at this peeler's size by default.
        layers : int
            The most layers to peel. Peeling stops when nothing is left, so the frame may have fewer (at least 1).
        lens : Lens, optional
            The lens that the frame is for: back faces of single-sided materials whose front no point within two
            aperture radii sees are dropped, which about halves the useful layers. Without one all back faces stay.
        guard_px : int
            Pixels to capture beyond the image on each side.
        surface : bool
            Fill the frame's surface buffers and lighting, with which methods shade from the points of the lens.
        progress : callable, optional
            Called with (layers done, layers at most).
        lod_bias : float
            Mip levels that textures are coarser by. ``log2(n)`` gives a frame captured n times larger the textures of
            the image that it is for.

        Returns
        -------
        LayeredFrame
            A background fills the first empty slot of each pixel as sky: depth ``inf``, alpha 1.

        Raises
        ------
        InputError, SceneError
            For arguments or a scene that cannot be drawn.
        CaptureError
            If OpenGL fails or the peeler is closed.
        """
        if isinstance(layers, bool) or layers != int(layers) or layers < 1:
            raise InputError(f"layers is {layers!r}; it must be a whole number, at least 1.")
        if isinstance(guard_px, bool) or guard_px != int(guard_px) or guard_px < 0:
            raise InputError(f"guard_px is {guard_px!r}; it must be a whole number of pixels, at least 0.")
        if not math.isfinite(lod_bias):
            raise InputError(f"lod_bias is {lod_bias!r}; it must be a finite number of mip levels.")
        layers, guard_px = int(layers), int(guard_px)
        from .draw import PassOptions, View

        camera = camera or scene.camera_for(*self._size)
        view = View(camera.with_guard(guard_px))
        options = PassOptions.for_layers(lens, surface, lod_bias)
        shape = (layers, view.camera.height, view.camera.width)
        color, depth = np.empty((*shape, 4), np.float32), np.empty(shape, np.float32)
        extra = np.empty((3, *shape, 4), np.float32) if surface else None
        count = 0
        with self._context.current():
            for target in self.passes(scene, view, layers, options):
                target.read(0, color[count])
                inverse = target.read(1, depth[count])
                with np.errstate(divide="ignore"):
                    np.divide(np.float32(1.0), inverse, out=inverse)
                if extra is not None:
                    for index in range(3):
                        target.read(2 + index, extra[index, count])
                count += 1
                if progress is not None:
                    progress(count, layers)
        if count == 0:  # a scene with nothing in sight: one layer of nothing
            color[0], depth[0], count = 0.0, np.inf, 1
            if extra is not None:
                extra[:, 0] = 0.0
        buffers: dict[str, Any] = {}
        if extra is not None:
            normal, albedo, specular = extra[:, :count]
            buffers = {"normal": normal[..., :3], "shininess": normal[..., 3]}
            buffers |= {"albedo": albedo[..., :3], "specular": specular[..., :3], "lighting": scene.lighting}
        return LayeredFrame(color[:count], depth[:count], camera, guard_px=guard_px, **buffers)

    @contextmanager
    def current(self) -> Iterator[None]:
        """Hold the OpenGL context, as :meth:`passes` needs it."""
        with self._context.current():
            yield

    def passes(self, scene: Scene, view: View, layers: int, options: PassOptions) -> Iterator[Target]:
        """Draw layer after layer, front to back, and yield each target until nothing is left.

        For :mod:`cldof.capture` itself, inside :meth:`current`. A target is overwritten two passes later.
        """
        if not self._context.is_open:
            raise CaptureError("This DepthPeeler is closed; make a new one.")
        self._renderer.load(scene)
        targets = self._targets_for(view.camera.width, view.camera.height, options.surface)
        previous = None
        for layer in range(layers):
            target = targets[layer % 2]
            if not self._renderer.draw(view, target, previous, options):
                return
            yield target
            previous = target

    def _targets_for(self, width: int, height: int, surface: bool) -> list[Target]:
        from .draw import Target, opengl_errors

        wanted = (width, height, surface)
        if self._target_kind == wanted:
            return self._targets
        limit = self._renderer.max_side_px
        if max(width, height) > limit:
            raise CaptureError(f"A capture of {width}x{height} px is too large: OpenGL here draws up to {limit} px.")
        self._free_targets()
        with opengl_errors(f"making framebuffers of {width}x{height} px"):
            self._targets = [Target(*wanted), Target(*wanted)]
        self._target_kind = wanted
        return self._targets

    def _free_targets(self) -> None:
        for target in self._targets:
            target.delete()
        self._targets, self._target_kind = [], None

    def close(self) -> None:
        """Free the context and everything in it; again is harmless."""
        if self._context.is_open:
            with self._context.current():
                self._free_targets()
                self._renderer.delete()
            self._context.close()

    def __enter__(self) -> DepthPeeler:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
