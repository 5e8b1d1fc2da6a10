"""A scene at a size, as the benchmark needs it: captured for the methods, with references and their noise floors."""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..camera import Camera
from ..capture.accumulate import Reference, accumulate
from ..capture.peel import DepthPeeler
from ..capture.reference_cache import ReferenceCache
from ..capture.scene import Scene
from ..frame import LayeredFrame
from ..lens import Lens
from .times import Times

__all__ = ["Case", "CaseKey"]

Image = NDArray[np.float32]

# The reference's lens points have nothing to do with those of the ladder that is compared with it.
_REFERENCE_SEED = 1000
# As `cldof render` chooses them.
_GUARD_SHARE = 0.10
_AUTO_COC_SHARE = 0.02


class CaseKey(NamedTuple):
    """Which case; ``scene`` is a built-in name or a file, ``unlit`` shows base colours only."""

    scene: str
    width: int
    height: int
    unlit: bool = False

    def __str__(self) -> str:
        name = Path(self.scene).name + (" unlit" if self.unlit else "")
        return f"{name} {self.width}x{self.height}"


class Case:
    """One scene at one size; makes what is asked for once and keeps it.

    Parameters
    ----------
    key : CaseKey
    peeler : DepthPeeler
    cache : ReferenceCache
    seed, reference_views, capture_runs : int
    """

    def __init__(
        self,
        key: CaseKey,
        peeler: DepthPeeler,
        cache: ReferenceCache,
        seed: int,
        reference_views: int,
        capture_runs: int,
    ) -> None:
        self.key, self._peeler, self._cache, self._seed = key, peeler, cache, seed
        self._views, self._capture_runs = reference_views, capture_runs
        self._frames: dict[tuple[int, int, bool], tuple[LayeredFrame, Times]] = {}
        self._references: dict[tuple[str, bool], tuple[Image, dict[str, Any]]] = {}

    @cached_property
    def scene(self) -> Scene:
        """The scene itself."""
        return build_scene(self.key)

    @cached_property
    def camera(self) -> Camera:
        """At the case's size."""
        return self.scene.camera_for(self.key.width, self.key.height)

    @cached_property
    def lens(self) -> Lens:
        """The scene's own, or one that blurs visibly."""
        return lens_for(self.scene, self._look, self.camera)

    @cached_property
    def _look(self) -> LayeredFrame:
        return self._peeler.peel(self.scene, self.camera, layers=2, surface=True)

    @cached_property
    def guard_px(self) -> int:
        """Guard band that holds the largest blur, up to a tenth of the image."""
        limit = math.ceil(_GUARD_SHARE * max(self.key.width, self.key.height))
        return min(math.ceil(self.largest_coc_px), limit)

    @cached_property
    def largest_coc_px(self) -> float:
        """Largest circle of confusion (radius) of anything in sight."""
        c1, c0 = self.lens.coc_coefficients(self.camera)
        return max(abs(c1 * inverse + c0) for inverse in self._look.inverse_depth_range)

    def frame(self, peels: int, supersample: int = 1, surface: bool = False) -> tuple[LayeredFrame, Times]:
        """The captured layers and how long a capture takes, uploads to OpenGL left out.

        With ``surface`` they have surface buffers, if the scene is glossy.
        """
        surface = surface and self._look.is_glossy_through(self.lens)
        key = peels, supersample, surface
        if key not in self._frames:
            camera = dataclasses.replace(
                self.camera, width=self.key.width * supersample, height=self.key.height * supersample
            )

            def capture() -> LayeredFrame:
                return self._peeler.peel(
                    self.scene,
                    camera,
                    layers=peels,
                    lens=self.lens,
                    guard_px=self.guard_px * supersample,
                    surface=surface,
                )

            capture()
            frame, times = timed(capture, self._capture_runs)
            self._frames[key] = frame, times
        return self._frames[key]

    def accumulated(self, views: int, aperture: str, jitter: bool, seed: int) -> Reference:
        """Accumulate views as one pattern, without a noise floor, as somebody would who wants the picture."""
        return accumulate(
            self._peeler, self.scene, self.camera, self.lens, views, aperture, jitter, seed, noise_floor=False
        )

    def reference(
        self, aperture: str, jitter: bool, progress: Callable[[int, int], None] | None = None
    ) -> tuple[Image, dict[str, Any]]:
        """The reference image, from disk where it is known, and what is known of it."""
        if (aperture, jitter) not in self._references:
            seed = _REFERENCE_SEED + self._seed
            made = self._cache.accumulate(
                self._peeler, self.scene, self.camera, self.lens, self._views, aperture, jitter, seed, progress
            )
            facts = {"aperture": aperture, "jitter": jitter, **made.to_dict()}
            self._references[aperture, jitter] = made.image, facts
        return self._references[aperture, jitter]

    def facts(self) -> dict[str, Any]:
        """For the record."""
        triangles = sum(len(node.mesh.faces) for node in self.scene.nodes)
        return {
            "scene": Path(self.key.scene).name,
            "unlit": self.key.unlit,
            "width": self.key.width,
            "height": self.key.height,
            "triangles": triangles,
            "guard_px": self.guard_px,
            "largest_coc_px": self.largest_coc_px,
            "lens": self.lens.to_dict(),
            "camera": self.camera.to_dict(),
        }


def build_scene(key: CaseKey) -> Scene:
    """Build or load the scene of a case.

    Raises
    ------
    SceneError
        Neither built in nor a file.
    """
    from ..capture.find import find_scene

    return find_scene(key.scene, unlit=key.unlit)


def lens_for(scene: Scene, look: LayeredFrame, camera: Camera) -> Lens:
    """The scene's lens; else focus on the middle and a largest blur radius of 2 % of the height."""
    focus = scene.focus_distance_m
    if focus is None:
        focus = look.depth_at(camera.width / 2, camera.height / 2)
        focus = focus if math.isfinite(focus) else float(look.depth.min())
    radius = scene.aperture_radius_m
    if radius is None:
        finite = look.depth[np.isfinite(look.depth)]
        spread = float(np.abs(1.0 / finite.astype(np.float64) - 1.0 / focus).max()) if finite.size else 0.0
        radius = _AUTO_COC_SHARE * camera.height / (camera.focal_px * spread) if spread else 0.01
    return Lens(radius, focus)


def timed(call: Callable[[], Any], runs: int) -> tuple[Any, Times]:
    """Call several times; the last result and the times."""
    ms, cpu_ms = [], []
    result = None
    for _ in range(runs):
        start, cpu_start = time.perf_counter(), time.process_time()
        result = call()
        ms.append((time.perf_counter() - start) * 1e3)
        cpu_ms.append((time.process_time() - cpu_start) * 1e3)
    return result, Times.of(ms, cpu_ms)
