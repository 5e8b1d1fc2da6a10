"""Does a rack of focus jump? Every method beside accumulation, frame by frame: the table of docs/focus.md.

    python -m bench racks                           # the first run draws references: an hour; later ones: minutes
    python -m bench racks --scenes fence --methods layered pyramid

Focus goes evenly in 1/distance through the 5th to the 95th percentile of what is seen, at 1.5 times the scene's
aperture. A step is the RMS difference between neighbouring frames of linear RGB clipped to [0, 1], and a sequence's
jump the largest of its steps. The reference takes the same lens points in each frame, so what is left of its noise
moves with the lens. Each method is compared with a reference of the aperture that it simulates, all shaded from the
lens centre.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cldof import Lens, Renderer
from cldof.auto import cache_folder
from cldof.camera import Camera
from cldof.capture.peel import DepthPeeler
from cldof.capture.reference_cache import ReferenceCache
from cldof.capture.scene import Scene
from cldof.capture.scenes import builtin_scenes
from cldof.errors import InputError
from cldof.focus import LensTrack, render_track
from cldof.frame import LayeredFrame
from cldof.methods import METHODS

__all__ = ["Steps", "measure", "rack_lenses", "report", "step_ratios"]

_PEELS = 4
_APERTURE_SCALE = 1.5
_REFERENCE_SEED = 1000
# Steps of a sequence's quiet places count as at least this share of its largest one.
_QUIET_SHARE = 0.25
_SCREEN_PEAK = 1.0


class Steps:
    """Differences between neighbouring frames: RMS and largest of a pixel, (frames - 1,)."""

    def __init__(self) -> None:
        self._before: NDArray[np.float64] | None = None
        self._rms: list[float] = []
        self._pixel: list[float] = []

    def add(self, image: NDArray[np.float32]) -> None:
        """The next frame, (H, W, 4)."""
        shown = np.clip(image[..., :3].astype(np.float64), 0.0, _SCREEN_PEAK)
        if self._before is not None:
            change = np.abs(shown - self._before)
            self._rms.append(math.sqrt(float((change**2).mean())))
            self._pixel.append(float(change.max()))
        self._before = shown

    @property
    def rms(self) -> NDArray[np.float64]:
        """Of all pixels and channels."""
        return np.array(self._rms)

    @property
    def pixel(self) -> NDArray[np.float64]:
        """Of the pixel and channel that changes most."""
        return np.array(self._pixel)


def step_ratios(steps: NDArray[np.float64], reference: NDArray[np.float64]) -> dict[str, float | int]:
    """A sequence's jump beside the reference's, and the worst step beside the reference's at the same place."""
    local = steps / np.maximum(reference, _QUIET_SHARE * reference.max())
    return {
        "jump": float(steps.max()),
        "reference_jump": float(reference.max()),
        "ratio": float(steps.max() / reference.max()),
        "at": int(steps.argmax()),
        "local_ratio": float(local.max()),
        "local_at": int(local.argmax()),
    }


def rack_lenses(scene: Scene, look: LayeredFrame, frames: int) -> list[Lens]:
    """A rack through 5 to 95 % of what is seen, near to far."""
    assert scene.aperture_radius_m is not None
    seen = 1.0 / look.depth[0][np.isfinite(look.depth[0])].astype(np.float64)
    near, far = (1.0 / float(np.quantile(seen, share)) for share in (0.95, 0.05))
    return LensTrack.rack(Lens(_APERTURE_SCALE * scene.aperture_radius_m, near), far, frames).lenses(frames)


def _capture(peeler: DepthPeeler, scene: Scene, camera: Camera, look: LayeredFrame, lenses: list[Lens]) -> LayeredFrame:
    """Layers with a guard band for the largest blur of all lenses."""
    ends = look.shown_inverse_depths
    coc = [abs(c1 * end + c0) for c1, c0 in (lens.coc_coefficients(camera) for lens in lenses) for end in ends]
    widest = max(lenses, key=lambda lens: lens.aperture_radius_m)
    return peeler.peel(scene, camera, layers=_PEELS, lens=widest, guard_px=math.ceil(max(coc)))


def measure(
    name: str, methods: list[str], device: str | None, frames: int, size: int, views: int, folder: Path
) -> list[dict[str, Any]]:
    """One row per method for a built-in scene."""
    scene = builtin_scenes()[name].make()
    camera = scene.camera_for(size, size)
    cache = ReferenceCache(folder)
    references: dict[str, tuple[Steps, list[NDArray[np.float32]]]] = {}
    rows = []
    with DepthPeeler() as peeler:
        look = peeler.peel(scene, camera, layers=2)
        lenses = rack_lenses(scene, look, frames)
        frame = _capture(peeler, scene, camera, look, lenses)
        for method in methods:
            with Renderer(method, device=device) as renderer:
                shape = METHODS[method].simulated_aperture or "disc"
                if shape not in references:
                    drawn = [
                        cache.accumulate(
                            peeler, scene, camera, lens, views, shape, False, _REFERENCE_SEED, None, False, False
                        ).image
                        for lens in lenses
                    ]
                    references[shape] = Steps(), drawn
                    for image in drawn:
                        references[shape][0].add(image)
                wanted, drawn = references[shape]
                got, errors = Steps(), []
                for result, exact in zip(render_track(renderer, frame, lenses), drawn, strict=True):
                    got.add(result.image)
                    error = np.clip(result.image[..., :3], 0, 1) - np.clip(exact[..., :3], 0, 1)
                    errors.append(float((error.astype(np.float64) ** 2).mean()))
            pixel = step_ratios(got.pixel, wanted.pixel)
            rows.append(
                {
                    "scene": name,
                    "method": method,
                    "aperture": shape,
                    "frames": frames,
                    "size": size,
                    "views": views,
                    **step_ratios(got.rms, wanted.rms),
                    "pixel_jump": pixel["jump"],
                    "pixel_ratio": pixel["ratio"],
                    "median_psnr_db": -10.0 * math.log10(max(float(np.median(errors)), 1e-12)),
                    "steps": [round(float(step), 6) for step in got.rms],
                    "reference_steps": [round(float(step), 6) for step in wanted.rms],
                }
            )
    return rows


def report(
    device: str | None,
    scenes: list[str],
    methods: list[str],
    frames: int,
    size: int,
    views: int,
    output: str | None,
) -> None:
    """Measure, print a line of the table for each scene as it is done, and keep the numbers.

    Raises
    ------
    InputError
        A scene or method that there is none of, or fewer than 3 frames.
    """
    for kind, asked, known in (("built-in scene", scenes, builtin_scenes()), ("method", methods, METHODS)):
        for one in asked:
            if one not in known:
                raise InputError(f"There is no {kind} {one!r}; there are {', '.join(known)}.")
    if frames < 3:
        raise InputError(f"frames is {frames}; a jump among steps needs at least 3.")
    rows: list[dict[str, Any]] = []
    print("Jump over the reference's (of single pixels); then the worst step over the reference's at the same place.")
    print(f"| scene | {' | '.join(methods)} |")
    print(f"|---{'|---' * len(methods)}|")
    for name in scenes:
        made = measure(name, methods, device, frames, size, views, cache_folder() / "references")
        cells = [f"{row['ratio']:.1f} ({row['pixel_ratio']:.1f}) {row['local_ratio']:.1f}" for row in made]
        print(f"| {name} | {' | '.join(cells)} |", flush=True)
        rows += made
        if output:
            lines = ",\n".join(json.dumps(row) for row in rows)
            Path(output).write_text(f"[\n{lines}\n]\n", encoding="utf-8")
