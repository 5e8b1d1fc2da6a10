"""Measure row by row: the list of rows first, then each once, saved as soon as it is there.

A row is left out when the record has it already, so a run that was interrupted goes on where it stopped. What cannot be
measured (a peer that is not installed, an option that a method does not have) is entered as skipped with its reason.
"""

from __future__ import annotations

import copy
import os
import platform
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .. import __version__
from ..capture.peel import DepthPeeler
from ..capture.reference_cache import ReferenceCache
from ..errors import CldofError, InputError
from ..frame import LayeredFrame
from ..host.device import Device, DeviceInfo, list_devices
from ..host.drivers import driver_advice
from ..host.profile import copy_baseline
from ..lens import Lens
from ..method_options import shades_surfaces
from ..metrics import compare
from ..renderer import Renderer
from . import ladders, peers
from .cases import Case, CaseKey, timed
from .ladders import ACCUMULATION, Rung
from .pictures import data_uri, error_map
from .record import Record, Row
from .times import LEAST_RUNS, Times
from .unit import MISSING, Unit, Yardstick, opencv_blur

__all__ = ["Job", "Settings", "WrongOutputError", "estimate_s", "list_jobs", "run", "verify"]

# Judged by a Gaussian lens; all others by a disc.
GAUSSIAN_METHODS = frozenset({"layered", "pyramid"})
# Alpha of an opaque frame may be off by this much, and colour below zero by rounding.
_ALPHA_TOLERANCE = 2e-3
_NEGATIVE_TOLERANCE = 1e-3
# Of the blur and the copies that run between the runs of a row, on two cores.
_UNIT_S = 0.1
# Above so many views accumulation is judged by its own kind of reference only: each other one is an image more.
_OTHER_JUDGES_UP_TO = 256

Image = NDArray[np.float32]
Progress = Callable[[str], None]


class WrongOutputError(CldofError):
    """A method gave an image that cannot be right, so its time means nothing."""


@dataclass(frozen=True)
class Settings:
    """What to measure.

    Parameters
    ----------
    scenes : sequence of str
        Built-in names or files.
    sizes : sequence of (width, height)
    methods : sequence of str
        Of :data:`cldof.methods.METHODS`, ``"accumulate"``, or names of :data:`cldof.benchmark.peers.PEERS`.
    devices : sequence of str or int
        As :meth:`cldof.host.device.Device.open` takes them; empty is everything that OpenCL shows.
    runs : int
        Frames timed per row, after warm-up.
    reference_views : int
    seed : int
    quick : bool
        The short ladders.
    peer_scenes : sequence of str
        Scenes that peers draw, with base colours only (``unlit``), as no peer shares cldof's lights.
    """

    scenes: Sequence[str]
    sizes: Sequence[tuple[int, int]]
    methods: Sequence[str]
    devices: Sequence[str | int] = ()
    runs: int = 7
    reference_views: int = 1024
    seed: int = 0
    quick: bool = False
    peer_scenes: Sequence[str] = ()

    def identity(self) -> dict[str, Any]:
        """What rows of one record have to share, beside the code."""
        return {"seed": self.seed, "reference_views": self.reference_views, "runs": self.runs}


@dataclass(frozen=True)
class Job:
    """One row to be."""

    key: str
    case: CaseKey
    method: str
    setting: str
    cost_s: float = field(compare=False)
    rung: Rung | None = None
    device: DeviceInfo | None = None
    views: int = 0


def list_jobs(settings: Settings, devices: Sequence[DeviceInfo]) -> list[Job]:
    """Every row of a run, in the order of measuring: case by case.

    Raises
    ------
    InputError
        A method is unknown.
    """
    from ..methods import METHODS

    known = (*METHODS, ACCUMULATION, *peers.PEERS)
    unknown = [name for name in settings.methods if name not in known]
    if unknown:
        raise InputError(f"Method {unknown[0]!r} is unknown; there are {', '.join(known)}.")
    jobs: list[Job] = []
    for case in _cases(settings):
        for method in settings.methods:
            jobs += _jobs_of(method, case, settings, devices)
    return jobs


def _cases(settings: Settings) -> Iterator[CaseKey]:
    asks_for_peers = any(name in peers.PEERS for name in settings.methods)
    for width, height in settings.sizes:
        for scene in settings.scenes:
            yield CaseKey(scene, width, height)
        if asks_for_peers:
            for scene in settings.peer_scenes:
                yield CaseKey(scene, width, height, unlit=True)


def _jobs_of(method: str, case: CaseKey, settings: Settings, devices: Sequence[DeviceInfo]) -> Iterator[Job]:
    megapixels = case.width * case.height / 1e6
    if method in peers.PEERS:
        if case.unlit:
            for name in peers.PEERS[method].settings:
                yield Job(f"{case}|{method}|{name}", case, method, name, 3.0 + 8.0 * megapixels)
    elif method == ACCUMULATION:
        for views in ladders.accumulation_views(settings.quick):
            images = 4 if views <= _OTHER_JUDGES_UP_TO else 1
            cost = (images + (views <= 64)) * views * _view_s(megapixels)
            yield Job(f"{case}|{method}|{views} views", case, method, f"{views} views", cost, views=views)
    else:
        for device in devices:
            for rung in ladders.rungs(method, settings.quick):
                if case.unlit and not rung.shown:  # a case for peers: their table needs one row per method
                    continue
                # Two renderers, some frames each; the error; and perhaps a capture.
                pixels = megapixels * rung.supersample**2
                cost = 0.4 + settings.runs * (0.15 * pixels + 0.01 + _UNIT_S) + 3.0 * megapixels
                key = f"{case}|{method}|{rung.name}|{device.index}"
                yield Job(key, case, method, rung.name, cost, rung, device)


def _view_s(megapixels: float) -> float:
    return 0.008 + 0.06 * megapixels


def estimate_s(jobs: Sequence[Job], settings: Settings, begun: CaseKey | None = None) -> float:
    """Rough seconds on two CPU cores, references included but for the case that has begun."""
    cases = {job.case for job in jobs} - {begun}
    references = sum(
        4.0 + 4 * settings.reference_views * _view_s(case.width * case.height / 1e6) + 3.0 for case in cases
    )
    return references + sum(job.cost_s for job in jobs)


def choose_devices(choices: Sequence[str | int]) -> list[DeviceInfo]:
    """The devices asked for, or all.

    Raises
    ------
    DeviceError, InputError
        One does not exist, or there is none at all.
    """
    found = list_devices()
    if not choices:
        if not found:
            raise InputError(f"No OpenCL device found. For the CPU {driver_advice()}.")
        return found
    indices = []
    for choice in choices:
        with Device.open(choice) as device:
            indices.append(device.info.index)
    return [info for info in found if info.index in indices]


def run(settings: Settings, path: Path, progress: Progress, devices: Sequence[DeviceInfo] | None = None) -> Record:
    """Measure what the record at ``path`` lacks.

    Parameters
    ----------
    settings : Settings
    path : Path
        The JSON document; read if it is there, saved after every row.
    progress : callable
        Takes one line of text per step.
    devices : sequence of DeviceInfo, optional
        In place of ``settings.devices``.

    Raises
    ------
    InputError
        The record there was made by other code or with other settings.
    """
    devices = choose_devices(settings.devices) if devices is None else list(devices)
    jobs = list_jobs(settings, devices)
    record = _open_record(settings, path)
    if opencv_blur()[0] is None:
        progress(MISSING)
    labels = _labels(devices)
    todo = [job for job in jobs if job.key not in record.rows]
    left_s = estimate_s(todo, settings)
    progress(
        f"{len(jobs)} rows on {len(devices)} device(s), {len(jobs) - len(todo)} of them there already; "
        f"about {_duration(left_s)} on two cores"
    )
    if not todo:
        return record
    started, estimated = time.perf_counter(), left_s
    with DepthPeeler(64, 64) as peeler:
        record.run.setdefault("capture_device", peeler.device)
        bench = _Bench(settings, record, peeler, ReferenceCache(path.parent / "references"), labels, progress)
        for number, job in enumerate(todo, 1):
            bench.do(job)
            record.save(path)
            left_s = estimate_s(todo[number:], settings, job.case)
            spent = time.perf_counter() - started
            pace = spent / max(estimated - left_s, 1e-9)
            done = record.rows.get(job.key)
            outcome = _line(done) if done else f"skipped: {record.skipped[job.key]}"
            progress(f"[{number}/{len(todo)}, {_duration(left_s * pace)} left] {job.key}: {outcome}")
    return record


def _open_record(settings: Settings, path: Path) -> Record:
    identity = {**settings.identity(), "cldof": __version__, "commit": commit()}
    if path.exists():
        record = Record.load(path)
        for name, value in identity.items():
            if record.run.get(name) != value:
                raise InputError(
                    f"{path} was made with {name} {record.run.get(name)!r}, this run has {value!r}; rows of both do "
                    "not belong together. Choose another output folder, or start again with --fresh."
                )
        record.skipped.clear()
        return record
    return Record(
        run={
            **identity,
            "quick": settings.quick,
            "date": time.strftime("%Y-%m-%d", time.gmtime()),
            "cpu_cores": os.cpu_count(),
            "system": f"{platform.system()} {platform.machine()}",
            "versions": versions(),
        }
    )


class _Bench:
    """Does jobs; holds one case at a time."""

    def __init__(
        self,
        settings: Settings,
        record: Record,
        peeler: DepthPeeler,
        cache: ReferenceCache,
        labels: dict[int, str],
        progress: Progress,
    ) -> None:
        self.settings, self.record, self.peeler, self.cache = settings, record, peeler, cache
        self.labels, self.progress = labels, progress
        self._case: Case | None = None
        self._yardstick = Yardstick()

    def do(self, job: Job) -> None:
        """Measure one row, or say why not."""
        self.record.skipped.pop(job.key, None)
        try:
            if job.method in peers.PEERS:
                peers.PEERS[job.method].check()
            case = self._open(job.case)
            if job.method == ACCUMULATION:
                row, image = self._accumulate(job, case)
            elif job.method in peers.PEERS:
                row, image = self._peer(job, case)
            else:
                row, image = self._method(job, case)
        except CldofError as error:
            self.record.skipped[job.key] = str(error)
            return
        self.record.rows[job.key] = row
        if self._is_shown(job):
            self._keep(case, f"{job.method}, {job.setting}", image, row.aperture)

    def _is_shown(self, job: Job) -> bool:
        if job.device is not None and job.device.index != min(self.labels):
            return False
        return job.method in peers.PEERS or (job.rung is not None and job.rung.shown)

    def _open(self, key: CaseKey) -> Case:
        if self._case is None or self._case.key != key:
            settings = self.settings
            case = Case(key, self.peeler, self.cache, settings.seed, settings.reference_views, settings.runs)
            name = str(key)
            self.record.cases[name] = case.facts()
            images = self.record.images
            if f"{name}|pinhole" not in images:
                images[f"{name}|pinhole"] = data_uri(case.frame(4)[0].pinhole_image())
            self._case = case
        return self._case

    def _keep(self, case: Case, what: str, image: Image, aperture: str) -> None:
        reference, _ = case.reference(aperture, jitter=False)
        self.record.images[f"{case.key}|{what}"] = data_uri(image)
        self.record.images[f"{case.key}|error of {what}"] = data_uri(error_map(image, reference))
        name = f"{case.key}|reference, {aperture} lens"
        if name not in self.record.images:
            self.record.images[name] = data_uri(reference)

    def _reference(self, case: Case, aperture: str, jitter: bool) -> Image:
        name = f"{case.key}|{aperture}|{'jittered' if jitter else 'not jittered'}"

        def tell(done: int, total: int) -> None:
            if done == total or (done % 256 == 0):
                self.progress(f"reference {name}: {done}/{total} views")

        image, facts = case.reference(aperture, jitter, tell)
        self.record.references[name] = facts
        return image

    def _errors(self, case: Case, image: Image, aperture: str) -> dict[str, dict[str, float]]:
        frame, _ = case.frame(4)
        judges = {"method": (aperture, False), "picture": (aperture, True)}
        if aperture == "gaussian":
            judges["disc"] = ("disc", False)
        return {
            judge: _floats(compare(image, self._reference(case, *kind), frame, case.lens))
            for judge, kind in judges.items()
        }

    def _method(self, job: Job, case: Case) -> tuple[Row, Image]:
        assert job.rung is not None and job.device is not None
        rung, aperture = job.rung, "gaussian" if job.method in GAUSSIAN_METHODS else "disc"
        options = dict(rung.options)
        if rung.supersample != 1:
            options["supersample"] = rung.supersample
        frame, capture = case.frame(rung.peels, rung.supersample, shades_surfaces(job.method, options))
        size = (case.key.height, case.key.width)
        measured = measure(job.method, options, frame, case.lens, job.device.index, self.settings.runs, size)
        label = self.labels[job.device.index]
        self.record.devices[label] = measured.device
        return (
            Row(
                key=job.key,
                case=str(case.key),
                method=job.method,
                setting=job.setting,
                device=label,
                aperture=aperture,
                total_ms=capture.median + measured.wall.median,
                errors=self._errors(case, measured.image, aperture),
                options=dict(rung.options),
                peels=rung.peels,
                supersample=rung.supersample,
                capture=capture,
                transfer=measured.transfer,
                kernels=measured.kernels,
                wall=measured.wall,
                build_ms=measured.build_ms,
                kernels_in_copies=measured.unit.copies(measured.kernels),
                unit=measured.unit,
                peak_device_bytes=measured.peak_bytes,
                input_bytes=frame.color.nbytes + frame.depth.nbytes,
            ),
            measured.image,
        )

    def _accumulate(self, job: Job, case: Case) -> tuple[Row, Image]:
        """Judged by the Gaussian reference, and by the disc one under ``"disc"``, each with points of its own lens."""
        seed = self.settings.seed
        case.accumulated(1, "gaussian", False, seed)  # uploads the scene
        runs = 1 if job.views > 64 else 2
        made: list[Image] = []

        def draw() -> None:
            made[:] = [case.accumulated(job.views, "gaussian", False, seed).image]

        measured = self._yardstick.measure({"wall": draw}, runs, warm_up=0)
        image, times = made[0], measured.times["wall"]
        frame, _ = case.frame(4)
        errors = {}
        for judge, aperture, jitter in (
            ("method", "gaussian", False),
            ("picture", "gaussian", True),
            ("disc", "disc", False),
            ("disc picture", "disc", True),
        ):
            if judge != "method" and job.views > _OTHER_JUDGES_UP_TO:
                continue
            own = image if judge == "method" else case.accumulated(job.views, aperture, jitter, seed).image
            found = compare(own, self._reference(case, aperture, jitter), frame, case.lens)
            errors[judge] = _floats(found)
        row = Row(
            key=job.key,
            case=str(case.key),
            method=job.method,
            setting=job.setting,
            device=f"OpenGL: {self.peeler.device}",
            aperture="gaussian",
            total_ms=times.median,
            errors=errors,
            views=job.views,
            wall=times,
            unit=measured.unit,
        )
        return row, image

    def _peer(self, job: Job, case: Case) -> tuple[Row, Image]:
        peer = peers.PEERS[job.method]
        image, times, note = peer.draw(case, job.setting, self.settings.runs, self.settings.seed)
        verify(image, (case.key.height, case.key.width), opaque=False)
        capture = case.frame(1)[1] if peer.needs_capture else None
        errors = self._errors(case, image, "disc")
        own = peer.converged(case)
        if own is not None:
            errors["own"] = _floats(compare(image, own))
        row = Row(
            key=job.key,
            case=str(case.key),
            method=job.method,
            setting=job.setting,
            device=peer.device,
            aperture="disc",
            total_ms=times.median + (capture.median if capture else 0.0),
            errors=errors,
            capture=capture,
            wall=times,
            unit=self._yardstick.measure({}, LEAST_RUNS).unit,  # peers have processes of their own: right after them
            note=note,
        )
        return row, image


@dataclass(frozen=True)
class Measured:
    """What :func:`measure` found."""

    image: Image
    wall: Times
    kernels: Times
    transfer: Times
    build_ms: float
    peak_bytes: int
    device: dict[str, Any]
    unit: Unit


def measure(
    method: str,
    options: dict[str, Any],
    frame: LayeredFrame,
    lens: Lens,
    device: int,
    runs: int,
    size: tuple[int, int],
) -> Measured:
    """Verify a method's output, then time it.

    Each timed frame is new to the renderer: it is uploaded, rendered and downloaded, as in an animation.
    """
    out = np.empty((*size, 4), np.float32)
    with Renderer(method, device=device, **options) as renderer:
        first = renderer.render(_renewed(frame), lens, out)
        verify(first.image, size, frame.is_opaque)
        image = first.image.copy()
        for _ in range(2):  # the ring's other slots
            renderer.render(_renewed(frame), lens, out)
        peak = renderer.peak_device_bytes
        with Yardstick(renderer.device) as yardstick:
            calls = {"wall": lambda: renderer.render(_renewed(frame), lens, out)}
            measured = yardstick.measure(calls, runs)
        wall = measured.times["wall"]
        if not np.array_equal(out, image):
            raise WrongOutputError(f"{method} gave another image for the same frame; its time means nothing.")
    with Renderer(method, device=device, profile=True, **options) as renderer:
        results = [renderer.render(_renewed(frame), lens, out) for _ in range(runs + 2)][2:]
        kernels = [sum(timing.ms for timing in result.timings) for result in results]
        transfer = _transfers(renderer.device, frame, size, runs)
        traits = _traits(renderer.device)
    build_ms = max(0.0, first.wall_ms - wall.median)
    return Measured(image, wall, Times.of(kernels), transfer, build_ms, peak, traits, measured.unit)


def verify(image: Image, size: tuple[int, int], opaque: bool) -> None:
    """Refuse an image that cannot be right.

    Raises
    ------
    WrongOutputError
        It has another size, values that are not finite or negative, or holes where the scene has none.
    """
    if image.shape != (*size, 4):
        raise WrongOutputError(f"The image has shape {image.shape} instead of {(*size, 4)}; it was not timed.")
    bad = np.count_nonzero(~np.isfinite(image))
    if bad:
        raise WrongOutputError(f"The image has {bad} values that are NaN or infinite; it was not timed.")
    if image.min() < -_NEGATIVE_TOLERANCE:
        raise WrongOutputError(f"The image has negative values down to {image.min():.3g}; it was not timed.")
    alpha = image[..., 3]
    if alpha.max() > 1.0 + _ALPHA_TOLERANCE or (opaque and alpha.min() < 1.0 - _ALPHA_TOLERANCE):
        raise WrongOutputError(
            f"The image has alpha from {alpha.min():.4f} to {alpha.max():.4f}, the frame is "
            f"{'opaque' if opaque else 'not'}; it was not timed."
        )


def _floats(found: dict[str, float]) -> dict[str, float]:
    return {name: float(value) for name, value in found.items()}


def _renewed(frame: LayeredFrame) -> LayeredFrame:
    """The same arrays as a frame that the renderer has not seen."""
    return copy.copy(frame)


def _transfers(device: Device, frame: LayeredFrame, size: tuple[int, int], runs: int) -> Times:
    """Colour and depth to the device, an image back; by the wall clock."""
    image = device.pool.acquire(size[0] * size[1] * 16)

    def transfer() -> None:
        held = [device.pool.to_device(array) for array in (frame.color, frame.depth)]
        for one in held:
            for event in one.waits:
                event.wait()
        device.pool.to_host(image, (*size, 4), np.float32)
        for one in held:
            device.pool.free_input(one)

    try:
        transfer()
        return timed(transfer, runs)[1]
    finally:
        device.pool.release(image)


def _traits(device: Device) -> dict[str, Any]:
    traits, copies = device.traits, copy_baseline(device)
    return {
        **{name: getattr(traits, name) for name in traits.__dataclass_fields__},
        "copy_16_mb": {"median_ms": copies.median_ms, "min_ms": copies.min_ms, "gb_per_s": copies.gb_per_s},
    }


def _labels(devices: Sequence[DeviceInfo]) -> dict[int, str]:
    """A name per device, with its index where two have the same."""
    names = {device.index: f"{device.platform}: {device.name}" for device in devices}
    counts = list(names.values())
    return {index: name if counts.count(name) == 1 else f"{name} #{index}" for index, name in names.items()}


def commit() -> str | None:
    """The source's git commit, with ``+`` when files differ from it; None outside a repository."""
    root = Path(__file__).resolve().parents[2]
    if not (root / ".git").exists():
        return None
    try:
        head = _git(root, "rev-parse", "--short=12", "HEAD").strip()
        changed = any(line[3:].startswith("cldof/") for line in _git(root, "status", "--porcelain").splitlines())
    except (OSError, subprocess.SubprocessError):
        return None
    return head + ("+" if changed else "")


def _git(root: Path, *arguments: str) -> str:
    done = subprocess.run(["git", *arguments], cwd=root, capture_output=True, text=True, check=True, timeout=20)
    return done.stdout


def versions() -> dict[str, str]:
    """Of what has a part in the numbers."""
    found = {"python": platform.python_version()}
    packages = ("numpy", "pyopencl", "pocl-binary-distribution", "pyrender", "scikit-image", "trimesh")
    for package in (*packages, "mitsuba", "mitsuba-oidn", "vtk", "opencv-python-headless"):
        try:
            found[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            continue
    return found


def _duration(seconds: float) -> str:
    if seconds < 90:
        return f"{max(seconds, 0):.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"


def _line(row: Row) -> str:
    psnr = row.error("psnr_db")
    return f"{row.total_ms:.1f} ms" + ("" if psnr is None else f", {psnr:.2f} dB")


def print_progress(text: str) -> None:
    """One line on stderr."""
    print(text, file=sys.stderr, flush=True)
