"""``cldof tune``: measure what settings cost on a device, and how far they err, for ``method="auto"``.

How far a setting errs does not depend on the device, so as a rule only times are measured, in some six minutes;
errors are those that come with cldof. :func:`measure_errors` measures them anew, against accumulated references.

Times are kept as ratios to a copy of 16 MB in the same run, so that they hold roughly for similar devices too.
"""

from __future__ import annotations

import hashlib
import json
import math
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from .auto import FEATURES, Curves, ErrorModel, Setting, cache_folder, curves_name, features, shipped_curves
from .camera import Camera
from .errors import InputError
from .files import atomic_write
from .frame import FINER, LayeredFrame
from .host.device import Device
from .host.profile import copy_baseline
from .lens import Aperture, Lens
from .metrics import psnr
from .renderer import Renderer

if TYPE_CHECKING:
    from .capture.accumulate import Reference
    from .capture.peel import DepthPeeler
    from .capture.reference_cache import ReferenceCache
    from .capture.scene import Scene

__all__ = [
    "LADDER",
    "ErrorRow",
    "TimeRow",
    "fit_curves",
    "frame_cases",
    "measure_errors",
    "measure_times",
    "save_curves",
    "scene_lenses",
    "with_times",
]

Progress = Callable[[int, int], None]
Vector = NDArray[np.float64]

LADDER = (
    Setting("gather", {"samples": 16}),
    Setting("pyramid"),
    Setting("layered", {"sigma_step": 2.0}),
    Setting("layered", {"layers": 6}),
    Setting("layered", {"sigma_step": 0.5}),
    Setting("layered"),
    Setting("multiview", {"rays": 8}),
    Setting("multiview", {"rays": 16}),
    Setting("multiview", {"rays": 32}),
    Setting("multiview", {"rays": 64}),
    Setting("multiview", {"rays": 256, "centred": True}),
    Setting("lightfield", {"views": 24}),
    Setting("lightfield", {"views": 64}),
    Setting("lightfield", {"views": 160}),
    Setting("layered", samples=FINER),
    Setting("multiview", {"rays": 64}, samples=FINER),
    Setting("lightfield", {"views": 64}, samples=FINER),
)
"""What ``method="auto"`` chooses from."""

# Beyond this PSNR an image is as good as its reference.
_BEST_DB = 50.0
# Strength of the ridge, and runs of rows that are left out in turn.
_TIME_RIDGE, _TIME_PARTS = 3.0, 14
# Features that times depend on; the others describe what is seen, not what is computed.
_TIME_FEATURES = (
    "one", "pixels", "peels", "blur", "blur_rms", "sharp", "near_coc", "far_coc", "light_tiles", "void",
    "gloss",
)  # fmt: skip

# Image sizes and lenses per scene: errors at small sizes, where references are quick, times also at a large one.
_ERROR_SIZES, _LENSES = (160, 320), 12
_TIME_SIZES = (160, 320, 512)
_PEELS = 4
# A reference is drawn with more views until its own noise, which is known and taken off, lies below this.
_NOISE_DB, _FEWEST_VIEWS, _MOST_VIEWS = 38.0, 48, 512
_GUARD_SHARE, _GUARD_STEP_PX = 0.10, 8
# Scenes in which lens points see other highlights; users of such scenes capture surface buffers.
_MIRRORING = ("floor", "mirrors")
_RUNS = 3
# Frames that take so long are timed fewer times.
_LONG_MS = 200.0


@dataclass(frozen=True)
class ErrorRow:
    """PSNR of each setting of the ladder for one scene, size and lens, with the features that it has."""

    scene: str
    feature: Vector
    db: Vector


@dataclass(frozen=True)
class TimeRow:
    """Time of each setting in copies, with the features of frame and lens."""

    feature: Vector
    copies: Vector


def save_curves(curves: Curves, device: Device) -> Path:
    """Keep curves where :func:`cldof.auto.load_curves` finds them; returns the file.

    Raises
    ------
    OutputError
        The folder cannot be written to.
    """
    path = cache_folder() / curves_name(device.info.name, device.info.driver_version)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"Cannot make {path.parent} ({error.strerror or error}); set CLDOF_CACHE.") from error
    with atomic_write(path) as stream:
        stream.write(curves.to_json().encode())
    return path


def save_rows(rows: Sequence[ErrorRow], path: Path) -> None:
    """Write what was measured, one case a line.

    Raises
    ------
    OutputError
    """
    lines = [
        json.dumps(
            {"scene": row.scene, "feature": row.feature.round(4).tolist(), "db": row.db.round(2).tolist()},
        )
        for row in rows
    ]
    head = json.dumps([str(setting) for setting in LADDER])
    with atomic_write(path) as stream:
        stream.write(f'{{"settings": {head},\n"rows": [\n'.encode() + ",\n".join(lines).encode() + b"\n]}\n")


def scene_lenses(scene: Scene, look: LayeredFrame, count: int, seed: int) -> list[Lens]:
    """Lenses that suit a scene: focus and aperture at random around what it suggests, in turn disc and Gaussian.

    Every fourth has the scene's own focus; the others lie between a little before the nearest tenth of what is seen
    and a little behind the farthest, evenly in inverse depth. Apertures go from 0.3 to 2 times the scene's own.
    """
    focus, radius = scene.focus_distance_m, scene.aperture_radius_m
    assert focus is not None and radius is not None, scene.name
    name = int.from_bytes(hashlib.sha256(scene.name.encode()).digest()[:4], "little")
    random = np.random.default_rng([name, seed])
    seen = look.depth[0][np.isfinite(look.depth[0])].astype(np.float64)
    lowest, highest = np.quantile(1.0 / seen, (0.1, 0.9))
    low, high = min(lowest, 0.8 / focus), max(highest, 1.25 / focus)
    lenses = []
    for index in range(count):
        distance = 1.0 / random.uniform(0.8 * low, 1.2 * high)
        scale = 0.3 * (2.0 / 0.3) ** random.random()
        shape = Aperture.of(("disc", "gaussian")[index // 2 % 2])
        lenses.append(Lens(radius * scale, focus if index % 4 == 0 else distance, aperture=shape))
    return lenses


def capture(
    peeler: DepthPeeler, scene: Scene, camera: Camera, lens: Lens, look: LayeredFrame, peels: int = _PEELS
) -> LayeredFrame:
    """A frame with a guard band for the lens's largest blur, up to a tenth of the image, and a finer one."""
    c1, c0 = lens.coc_coefficients(camera)
    largest = max(abs(c1 * inverse + c0) for inverse in look.inverse_depth_range)
    # Few different widths: OpenCL programs are compiled for each.
    wanted = min(largest, _GUARD_SHARE * max(camera.width, camera.height))
    guard = math.ceil(wanted / _GUARD_STEP_PX) * _GUARD_STEP_PX
    surface = scene.name in _MIRRORING

    def taken(factor: int = 1) -> LayeredFrame:
        return peeler.peel(
            scene, camera.supersampled(factor), layers=peels, lens=lens, guard_px=factor * guard, surface=surface,
            lod_bias=math.log2(factor),
        )  # fmt: skip

    return taken().with_finer(lambda: taken(FINER))


def reference_for(
    cache: ReferenceCache, peeler: DepthPeeler, scene: Scene, camera: Camera, lens: Lens, seed: int = 0
) -> Reference:
    """An accumulated image whose own noise is below what is to be measured, as far as so many views can."""
    views = _FEWEST_VIEWS
    limit = math.pow(10.0, -_NOISE_DB / 20.0)
    while True:
        made = cache.accumulate(peeler, scene, camera, lens, views, seed=seed)
        noise = made.noise_rms or 0.0
        if views >= _MOST_VIEWS or noise <= limit:
            return made
        # Noise falls with views ** -0.75.
        needed = views * (noise / limit) ** (1.0 / 0.75)
        views = min(_MOST_VIEWS, max(math.ceil(1.5 * views), math.ceil(needed)))


def judged_db(image: NDArray[np.float32], reference: Reference) -> float:
    """PSNR against what the reference would be without its noise.

    The noise of its lens points is independent of what a method does wrong, so that mean squares add. What remains is
    taken to be a quarter of the noise at least.
    """
    noise = (reference.noise_rms or 0.0) ** 2
    square = math.pow(10.0, -psnr(image, reference.image) / 10.0)
    return min(_BEST_DB, -10.0 * math.log10(max(square - noise, noise / 4.0, 1e-9)))


def measure_errors(
    renderers: Sequence[Renderer],
    cases: Iterable[tuple[str, LayeredFrame, Lens, Reference]],
) -> Iterator[ErrorRow]:
    """How far each setting errs.

    Parameters
    ----------
    renderers : sequence of Renderer
        One for each setting, all on one kind of device.
    cases : iterable of (scene, frame, lens, reference)
    """
    for scene, frame, lens, reference in cases:
        db = [
            judged_db(renderer.render(sampled(frame, setting), lens).image, reference)
            for renderer, setting in zip(renderers, LADDER, strict=True)
        ]
        yield ErrorRow(scene, features(renderers[0].stats(frame), lens, frame), np.array(db))


def sampled(frame: LayeredFrame, setting: Setting) -> LayeredFrame:
    """The frame, or the finer one, as the setting takes it."""
    return frame if setting.samples == 1 else frame.finer


def measure_times(
    renderers: Sequence[Renderer], cases: Iterable[tuple[LayeredFrame, Lens]], copy_ms: float, busy: bool = False
) -> Iterator[TimeRow]:
    """What each setting takes for frames that are on the device already; parameters as :func:`measure_errors`.

    ``busy`` is for machines with other work: see :func:`frame_ms`.
    """
    for frame, lens in cases:
        times = [
            frame_ms(renderer, sampled(frame, setting), lens, busy=busy)
            for renderer, setting in zip(renderers, LADDER, strict=True)
        ]
        feature = features(renderers[0].stats(frame), lens, frame)
        yield TimeRow(feature, np.array(times) / copy_ms)


def frame_ms(renderer: Renderer, frame: LayeredFrame, lens: Lens, runs: int = _RUNS, busy: bool = False) -> float:
    """The shortest of several frames in ms, after one that builds what it needs.

    With ``busy``, on CPU devices that run in this process: processor time, as if no other work were there, that of the
    calling thread plus that of all others over the compute units.
    """
    renderer.render(frame, lens)
    times: list[float] = []
    units = renderer.device.traits.compute_units
    while len(times) < runs and sum(times) < _LONG_MS:
        process, thread, start = time.process_time(), time.thread_time(), time.perf_counter()
        renderer.render(frame, lens)
        wall, process = time.perf_counter() - start, time.process_time() - process
        thread = time.thread_time() - thread
        alone = thread + (process - thread) / units
        times.append(1e3 * (min(wall, alone) if busy and renderer.device.traits.is_cpu else wall))
    return min(times)


def copy_ms(device: Device, busy: bool = False) -> float:
    """What a copy of 16 MB takes: the shortest of a few."""
    return copy_baseline(device, runs=40 if busy else 8).min_ms


def fit_curves(errors: Sequence[ErrorRow], times: Sequence[TimeRow], source: dict[str, Any]) -> Curves:
    """Models of error and time over the features, from measurements."""
    model = ErrorModel(np.array([row.feature for row in errors]), np.array([row.db for row in errors]))
    return Curves(LADDER, model, *fit_times(times), source)


def fit_times(rows: Sequence[TimeRow]) -> tuple[Vector, Vector]:
    """Weights of the logarithm of times, zero for features that times do not depend on, and :attr:`Curves.time_margin`.

    The margin is over predictions for rows that were left out, a run of neighbours (which share a scene) at a time.
    """
    used = [FEATURES.index(name) for name in _TIME_FEATURES]
    feature, log = np.array([row.feature for row in rows])[:, used], np.log([row.copies for row in rows])
    weights = np.zeros((len(FEATURES), log.shape[1]))
    weights[used] = _ridge(feature, log, _TIME_RIDGE)
    error = log - feature @ weights[used]
    part = np.arange(len(rows)) * _TIME_PARTS // len(rows)
    for number in range(_TIME_PARTS) if len(rows) >= 2 * _TIME_PARTS else []:
        out = part == number
        error[out] = log[out] - feature[out] @ _ridge(feature[~out], log[~out], _TIME_RIDGE)
    return weights, np.maximum(0.0, np.quantile(error, 0.95, axis=0))


def with_times(curves: Curves, times: Sequence[TimeRow], source: dict[str, Any]) -> Curves:
    """The same errors with the times of another device."""
    log_time, margin = fit_times(times)
    return replace(curves, log_time=log_time, time_margin=margin, source=source)


def _ridge(feature: Vector, target: Vector, strength: float) -> Vector:
    """Weights of a ridge regression on standardised features, for features as they are. The first one is constant 1."""
    mean, spread = feature.mean(axis=0), feature.std(axis=0)
    varies = spread > 1e-9
    varies[0] = False
    z = (feature[:, varies] - mean[varies]) / spread[varies]
    centre = target.mean(axis=0)
    inner = np.linalg.solve(z.T @ z + strength * np.eye(z.shape[1]), z.T @ (target - centre))
    weights = np.zeros((feature.shape[1], target.shape[1]))
    weights[varies] = inner / spread[varies][:, None]
    weights[0] = centre - mean @ weights
    return weights


def frame_cases(frames: Sequence[LayeredFrame]) -> Iterator[tuple[LayeredFrame, Lens]]:
    """Lenses for frames of somebody's own: focus at three depths, blur up to 1 and 4 % of the height.

    Finer ones have every pixel several times: times are measured, not errors.
    """
    for given in frames:
        frame = given.with_finer(partial(_enlarged, given))
        low, high = frame.inverse_depth_range
        for at in (0.1, 0.5, 0.9):
            focus = low + at * (high - low)
            spread = max(high - focus, focus - low)
            for share in (0.01, 0.04):
                radius = share * frame.camera.height / (frame.camera.focal_px * spread) if spread else 0.01
                yield frame, Lens(radius, 1.0 / focus if focus > 0.0 else math.inf)


def _enlarged(frame: LayeredFrame) -> LayeredFrame:
    color, depth = (array.repeat(FINER, axis=1).repeat(FINER, axis=2) for array in (frame.color, frame.depth))
    return LayeredFrame(color, depth, frame.camera.supersampled(FINER), guard_px=FINER * frame.guard_px)


def scene_cases(
    peeler: DepthPeeler, scenes: Sequence[Scene], sizes: Sequence[int], lenses: int, seed: int, progress: Progress
) -> Iterator[tuple[Scene, LayeredFrame, Lens]]:
    """Captured frames of scenes through lenses of :func:`scene_lenses`; sizes take turns."""
    total = len(scenes) * lenses
    for number, scene in enumerate(scenes):
        look = peeler.peel(scene, scene.camera_for(192, 192), layers=2)
        for index, lens in enumerate(scene_lenses(scene, look, lenses, seed)):
            size = sizes[index % len(sizes)]
            yield scene, capture(peeler, scene, scene.camera_for(size, size), lens, look), lens
            progress(number * lenses + index + 1, total)


def setting_renderer(setting: Setting, device: int | str | None, **more: Any) -> Renderer:
    """A renderer that renders by one setting; see :func:`sampled`."""
    return Renderer(
        setting.method, device=device, supersample=setting.samples, antialias=setting.samples == 1, **more,
        **setting.options,
    )  # fmt: skip


def make_renderers(device: int | str | None) -> list[Renderer]:
    """One renderer for each setting of the ladder."""
    made: list[Renderer] = []
    try:
        for setting in LADDER:
            made.append(setting_renderer(setting, device, frames_in_flight=1))
    except BaseException:
        for renderer in made:
            renderer.close()
        raise
    return made


def tune(
    device: int | str | None = None,
    frames: Sequence[LayeredFrame] = (),
    errors: bool = False,
    busy: bool = False,
    scene_names: Sequence[str] | None = None,
    rows: Path | None = None,
    progress: Progress = lambda done, total: None,
) -> tuple[Curves, Path]:
    """Measure, fit and keep.

    Parameters
    ----------
    device : int or str, optional
        As :class:`cldof.Renderer` takes it.
    frames : sequence of LayeredFrame
        Measure times on these in place of the built-in scenes; needs no OpenGL.
    errors : bool
        Measure errors too: some ten minutes, mostly for references.
    busy : bool
        See :func:`frame_ms`.
    scene_names : sequence of str, optional
        Of the built-in scenes; all by default.
    rows : Path, optional
        Also keep the errors that were measured, as JSON (``bench/auto.py`` judges by them).
    progress : callable
        Called with (done, total).

    Returns
    -------
    Curves, Path
        And the file that they were saved in.
    """
    from . import __version__

    renderers = make_renderers(device)
    try:
        opened = renderers[0].device
        unit = copy_ms(opened, busy)
        source = {
            "device": opened.info.name,
            "platform": opened.info.platform,
            "driver": opened.info.driver_version,
            "cldof": __version__,
            "copy_ms": float(f"{unit:.4g}"),
            "busy": busy,
            "date": time.strftime("%Y-%m-%d"),
        }
        if frames:
            if errors:
                raise InputError("Errors are measured on built-in scenes, which have references; leave frames out.")
            times = list(measure_times(renderers, _counted(list(frame_cases(frames)), progress), unit, busy))
            curves = with_times(shipped_curves(), times, source)
        else:
            from .capture.peel import DepthPeeler
            from .capture.reference_cache import ReferenceCache
            from .capture.scenes import builtin_scenes

            known = builtin_scenes()
            if unknown := [name for name in scene_names or () if name not in known]:
                raise InputError(f"There is no built-in scene {unknown[0]!r}; there are {', '.join(known)}.")
            scenes = [known[name].make() for name in scene_names or known]
            with DepthPeeler() as peeler:
                cases = scene_cases(peeler, scenes, _TIME_SIZES, len(_TIME_SIZES), 1, progress)
                times = list(measure_times(renderers, ((frame, lens) for _, frame, lens in cases), unit, busy))
                if errors:
                    cache = ReferenceCache(cache_folder() / "references")
                    captured = scene_cases(peeler, scenes, _ERROR_SIZES, _LENSES, 0, progress)
                    judged = (
                        (scene.name, frame, lens, reference_for(cache, peeler, scene, frame.camera, lens))
                        for scene, frame, lens in captured
                    )
                    found = list(measure_errors(renderers, judged))
                    if rows is not None:
                        save_rows(found, rows)
                    curves = fit_curves(found, times, source)
                else:
                    curves = with_times(shipped_curves(), times, source)
        return curves, save_curves(curves, opened)
    finally:
        for renderer in renderers:
            renderer.close()


def _counted(cases: Sequence[Any], progress: Progress) -> Iterator[Any]:
    for number, case in enumerate(cases):
        yield case
        progress(number + 1, len(cases))
