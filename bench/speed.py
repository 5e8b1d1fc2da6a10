"""How long frames and blurs take on one device, in the unit of :mod:`cldof.benchmark.unit`, and where the time goes."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cldof import Camera, LayeredFrame, Lens, Renderer, __version__
from cldof.benchmark.harness import commit
from cldof.benchmark.times import Times
from cldof.benchmark.unit import MISSING, SIDE_PX, Yardstick, opencv_blur
from cldof.errors import CldofError, InputError
from cldof.files import atomic_write
from cldof.host.device import Device
from cldof.host.passes import Buffer, FrameProgram, Local, Pass, Role, read, write
from cldof.host.profile import by_label, copy_baseline, table
from cldof.host.scheduler import compile
from cldof.methods import METHODS, gaussian
from cldof.methods.base import row_pitch

__all__ = ["hard_frame", "parse_size", "report"]

# Blurs are of the image that the unit is of.
SIZE = SIDE_PX
PEELS = 4
SIGMAS = (1.0, 2.0, 4.0, 8.0, 16.0, 32.0)
# For the blurs of one sigma; OpenCV takes a third of a second for its widest.
_BLURS_S = 6.0
# What is timed of a method; of others their default options.
VARIANTS: dict[str, dict[str, dict[str, Any]]] = {
    "layered": {
        "layered, cascade": {"layers": 12},
        "layered, each layer by itself": {"layers": 12, "cascade": False},
    }
}


def parse_size(text: str) -> tuple[int, int]:
    """Width and height of ``"1920x1080"``, or of the name of a screen.

    Raises
    ------
    InputError
        It is neither.
    """
    names = {"1080p": (1920, 1080), "4k": (3840, 2160)}
    width, cross, height = text.lower().partition("x")
    if text.lower() in names:
        return names[text.lower()]
    if not (cross and width.isdecimal() and height.isdecimal() and int(width) and int(height)):
        raise InputError(f"size {text!r} is not WIDTHxHEIGHT in pixels, such as 1024x1024, nor 1080p or 4K.")
    return int(width), int(height)


def hard_frame(width: int, height: int, seed: int = 0) -> LayeredFrame:
    """Four peels with something everywhere, at all depths: nothing that tiles could skip, noise for colour."""
    rng = np.random.default_rng(seed)
    y, x = np.arange(height)[:, None] / height, np.arange(width)[None] / width
    hills = 1.5 + 3.5 * (0.5 + 0.5 * np.sin(7 * x + 3 * np.cos(5 * y)) * np.cos(6 * y + 1))
    blocks = rng.random((16, 16)).repeat(-(-height // 16), 0).repeat(-(-width // 16), 1)[:height, :width]
    near = np.where(blocks < 0.35, 1.05 + 2 * blocks, hills)
    depth = np.stack([near, np.maximum(1.15 * near, 1.1 * hills), np.maximum(1.4 * near, 1.6 * hills), 40 + 0 * near])
    color = rng.random((PEELS, height, width, 4), np.float32)
    color[..., 3] = 1.0
    return LayeredFrame(color, np.sort(depth, axis=0).astype(np.float32), Camera(width, height, 40.0))


def report(
    device: str | None,
    runs: int,
    sizes: Sequence[tuple[int, int]] = ((SIZE, SIZE),),
    methods: Sequence[str] = ("layered",),
    seconds: float = math.inf,
    blurs: bool = True,
    output: str | None = None,
) -> None:
    """Print everything, and keep it as JSON, row by row, if there is an ``output``.

    Parameters
    ----------
    device : str, optional
    runs : int
        Frames timed of each method at each size.
    sizes : sequence of (width, height)
    methods : sequence of str
    seconds : float
        For the frames of one method at one size, after the first; there are three in any case.
    blurs : bool
        Whether to time each engine of blurs as well.
    output : str, optional

    Raises
    ------
    InputError
        There is no such method.
    CldofError
        At the end, if something could not be rendered; what could has been printed and kept.
    """
    if unknown := [name for name in methods if name not in METHODS]:
        raise InputError(f"there is no method {unknown[0]!r}; there are {', '.join(sorted(METHODS))}")
    record: dict[str, Any] = {
        "schema": 1,
        "cldof": __version__,
        "commit": commit(),
        "rows": [],
        "not_timed": [],
        "blurs": [],
    }
    lens = Lens(0.021, 2.5)
    for width, height in sizes:
        frame = hard_frame(width, height)
        for method in methods:
            for title, options in VARIANTS.get(method, {method: {}}).items():
                try:
                    row = _frame(title, method, frame, lens, device, runs, seconds, options)
                except CldofError as error:  # of 4K on a small GPU, say; what else there is can be timed
                    print(f"== {title}: {width}x{height} NOT TIMED: {error}\n", flush=True)
                    record["not_timed"].append({"title": title, "width": width, "height": height, "why": str(error)})
                else:
                    record["rows"].append({"title": title, **row})
                _save(record, output)
    if blurs:
        record["blurs"] = _blurs(device, runs)
        _save(record, output)
    if failed := record["not_timed"]:
        first = failed[0]
        raise CldofError(
            f"{len(failed)} of {len(failed) + len(record['rows'])} could not be timed, first {first['title']} at "
            f"{first['width']}x{first['height']}: {first['why']}"
        )


def _save(record: dict[str, Any], path: str | None) -> None:
    if path:
        with atomic_write(Path(path)) as stream:
            stream.write(json.dumps(record, indent=1).encode() + b"\n")


def _frame(
    title: str,
    method: str,
    frame: LayeredFrame,
    lens: Lens,
    device: str | None,
    runs: int,
    seconds: float,
    options: dict[str, Any],
) -> dict[str, Any]:
    """One row: the frame as a loop would render it and the same with profiling, in turn with blur and copy."""
    width, height = frame.camera.width, frame.camera.height
    out = np.empty((height, width, 4), np.float32)
    with (
        Renderer(method, device=device, **options) as plain,
        Renderer(method, device=device, profile=True, **options) as profiled,
    ):
        results, python_ms = [], []

        def render() -> None:
            start = time.perf_counter()
            pending = plain.render_async(frame, lens, out)
            python_ms.append((time.perf_counter() - start) * 1e3)
            pending.result()

        render()
        held, peak_bytes = plain.device.pool.allocated_bytes, plain.peak_device_bytes
        with Yardstick(profiled.device) as yardstick:
            calls = {"frame": render, "profiled": lambda: results.append(profiled.render(frame, lens, out))}
            measured = yardstick.measure(calls, runs, seconds)
        grown = plain.device.pool.allocated_bytes - held
        baseline = copy_baseline(profiled.device)
        info = plain.device.info
    unit, whole, counted = measured.unit, measured.times["frame"], results[1:]
    sums = [sum(timing.ms for timing in result.timings) for result in counted]
    kernels = Times.of(sums)
    passes = by_label(counted[int(np.argmin(sums))].timings)
    judged = unit.ratio(whole)
    print(f"== {title}: {width}x{height}, {frame.layer_count} peels, {info}")
    print(unit)
    print(unit.line("render() with download", whole))
    print(unit.line("kernels, by events", kernels))
    print(f"{'judged':24s} {MISSING if judged is None else f'{judged} blurs a frame'}")
    print(table(passes, baseline))
    python = f"min {min(python_ms):.2f} ms, median {median(python_ms):.2f} ms"
    print(f"python per steady frame  {python}; allocated {grown} bytes")
    print(f"device memory            {peak_bytes / 2**20:.0f} MiB\n", flush=True)
    return {
        "method": method,
        "options": options,
        "width": width,
        "height": height,
        "peels": frame.layer_count,
        "device": asdict(info),
        "unit": asdict(unit),
        "frame": asdict(whole),
        "kernels": asdict(kernels),
        "blurs": judged and judged.value,
        "by_processor_time": judged and judged.by_processor,
        "python_ms": median(python_ms),
        "device_bytes": peak_bytes,
        "passes_ms": {one.label: one.ms for one in passes},
    }


def _blurs(choice: str | None, runs: int) -> list[dict[str, Any]]:
    """Each engine beside OpenCV's GaussianBlur on the same image."""
    image = np.random.default_rng(0).random((SIZE, SIZE, 4), np.float32)
    rows = []
    with Device.open(choice) as device, Yardstick(device) as yardstick:
        print(f"== Gaussian blur, RGBA float32 {SIZE}x{SIZE}, median ms (blurs of the unit), {device.info}")
        for sigma in SIGMAS:
            with ExitStack() as stack:
                calls = {
                    name: stack.enter_context(_blurring(device, image, program))
                    for name, program in (("FIR", _fir_program(sigma)), ("IIR", _iir_program(sigma, device.lanes)))
                }
                if opencv := opencv_blur(sigma)[0]:
                    calls["OpenCV"] = opencv
                measured = yardstick.measure(calls, runs, _BLURS_S)
            unit, times = measured.unit, measured.times
            if not rows:
                print(unit)
                print(f"{'sigma':>6s} " + " ".join(f"{name:>22s}" for name in times))
            cells = (f"{one.median:8.2f} ({unit.ratio(one) or '-'})" for one in times.values())
            print(f"{sigma:6.0f} " + " ".join(f"{cell:>22s}" for cell in cells), flush=True)
            rows.append(
                {
                    "sigma_px": sigma,
                    "unit": asdict(unit),
                    "times": {name: asdict(one) for name, one in times.items()},
                    "blurs": {
                        name: ratio and ratio.value for name, one in times.items() for ratio in [unit.ratio(one)]
                    },
                }
            )
    return rows


@contextmanager
def _blurring(device: Device, image: NDArray[np.float32], program: FrameProgram) -> Iterator[Callable[[], object]]:
    """A function that blurs the image on the device and waits for it."""
    padded = np.zeros((SIZE, row_pitch(SIZE), 4), np.float32)
    padded[:, :SIZE] = image
    source = device.pool.to_device(padded)
    try:
        with compile(program, device) as batch:
            yield lambda: batch.submit({"source": source.buffer}, wait_for=source.waits).wait()
    finally:
        device.pool.free_input(source)


def _image_buffers() -> list[Buffer]:
    nbytes = SIZE * row_pitch(SIZE) * 16
    return [Buffer("source", nbytes, Role.INPUT), Buffer("out", nbytes, Role.OUTPUT)]


def _fir_program(sigma: float) -> FrameProgram:
    # 3.3 sigma: within 1.5e-3 of the exact Gaussian for any image in [0, 1].
    taps = gaussian.fir_taps(sigma, cutoff=3.3)
    data, radius, segment, rows = gaussian.half_taps(taps), len(taps) // 2, 512, 8
    halo = (radius + 4) & ~3
    sizes = (np.int32(n) for n in (SIZE, SIZE, row_pitch(SIZE), radius, segment))
    blur = Pass(
        "blur",
        "blur_fir",
        (write("out"), read("source"), read("taps"), *sizes, Local(rows * (segment + 2 * halo) * 16)),
        (SIZE // segment, SIZE // rows),
        (1, 1),
    )
    return FrameProgram.of([*_image_buffers(), Buffer("taps", data.nbytes, Role.CONSTANT, data)], [blur])


def _iir_program(sigma: float, lanes: int) -> FrameProgram:
    sections = gaussian.iir_sections(sigma)
    sizes = tuple(np.int32(n) for n in (SIZE, SIZE, row_pitch(SIZE)))
    passes = [
        Pass("blur", kernel, (write(target), read(source), read("sections"), *sizes), (SIZE // (lanes // 4),), (1,))
        for kernel, source, target in (("blur_iir_rows", "source", "rows"), ("blur_iir_columns", "rows", "out"))
    ]
    buffers = [
        *_image_buffers(),
        Buffer("rows", SIZE * row_pitch(SIZE) * 16),
        Buffer("sections", sections.nbytes, Role.CONSTANT, sections),
    ]
    return FrameProgram.of(buffers, passes)
