"""How long a frame takes on one device, in copies of 16 MB measured in the same run, and where the time goes."""

from __future__ import annotations

import time
from collections.abc import Callable
from statistics import median

import numpy as np
from numpy.typing import NDArray

from cldof import Camera, LayeredFrame, Lens, Renderer
from cldof.host.device import Device
from cldof.host.passes import Buffer, FrameProgram, Local, Pass, Role, read, write
from cldof.host.profile import by_label, copy_baseline, pass_timings, table
from cldof.host.scheduler import compile
from cldof.methods import gaussian
from cldof.methods.base import row_pitch

SIZE = 1024
PEELS = 4
SIGMAS = (1.0, 2.0, 4.0, 8.0, 16.0, 32.0)


def hard_frame(size: int = SIZE, seed: int = 0) -> LayeredFrame:
    """Four peels with something everywhere, at all depths: nothing that tiles could skip, noise for colour."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[0:size, 0:size] / size
    hills = 1.5 + 3.5 * (0.5 + 0.5 * np.sin(7 * x + 3 * np.cos(5 * y)) * np.cos(6 * y + 1))
    blocks = rng.random((16, 16)).repeat(size // 16, 0).repeat(size // 16, 1)
    near = np.where(blocks < 0.35, 1.05 + 2 * blocks, hills)
    depth = np.stack([near, np.maximum(1.15 * near, 1.1 * hills), np.maximum(1.4 * near, 1.6 * hills), 40 + 0 * near])
    color = np.concatenate([rng.random((PEELS, size, size, 3)), np.ones((PEELS, size, size, 1))], axis=-1)
    return LayeredFrame(color.astype(np.float32), np.sort(depth, axis=0).astype(np.float32), Camera(size, size, 40.0))


def report(device: str | None, runs: int) -> None:
    """Print everything."""
    frame, lens = hard_frame(), Lens(0.021, 2.5)
    for title, options in (
        ("layered, cascade", {"layers": 12}),
        ("layered, each layer by itself", {"layers": 12, "cascade": False}),
    ):
        _frame(title, frame, lens, device, runs, options)
    _blurs(device, runs)


def _frame(
    title: str, frame: LayeredFrame, lens: Lens, device: str | None, runs: int, options: dict[str, object]
) -> None:
    out = np.empty((frame.camera.height, frame.camera.width, 4), np.float32)
    with Renderer("layered", device=device, profile=True, **options) as renderer:
        results = [renderer.render(frame, lens, out) for _ in range(runs)][2:]
        baseline = copy_baseline(renderer.device)
        kernels = [sum(timing.ms for timing in result.timings) for result in results]
        best = results[int(np.argmin(kernels))]
        layers = best.plan.summary["layers"]
        print(f"== {title}: {SIZE}x{SIZE}, {frame.layer_count} peels, {layers} layers, {renderer.device.info}")
        print(f"copy of 16 MB: min {baseline.min_ms:.2f} ms, median {baseline.median_ms:.2f} ms (the unit below)")
        for name, values in (("kernels", kernels), ("render() with download", [result.wall_ms for result in results])):
            print(
                f"{name:24s} min {min(values):6.1f} ms, median {median(values):6.1f} ms; "
                f"{min(values) / baseline.min_ms:5.1f} copies (min/min), "
                f"{median(values) / baseline.median_ms:5.1f} (median/median)"
            )
        print(table(by_label(best.timings), baseline))
    # Without profiling, as a loop would run it.
    with Renderer("layered", device=device, **options) as renderer:
        renderer.render(frame, lens, out)
        held = renderer.device.pool.allocated_bytes
        spent, busy = [], []
        for _ in range(runs):
            start, used = time.perf_counter(), time.process_time()
            pending = renderer.render_async(frame, lens, out)
            spent.append((time.perf_counter() - start) * 1e3)
            pending.result()
            busy.append((time.process_time() - used) * 1e3)
        grown = renderer.device.pool.allocated_bytes - held
        if renderer.device.traits.is_cpu:
            # What is left of the clock when other work shares the machine.
            cores = renderer.device.traits.compute_units
            per_core = min(busy) / cores
            print(
                f"processor time           min {per_core:6.1f} ms on each of {cores} cores; "
                f"{per_core / baseline.min_ms:5.1f} copies"
            )
        print(
            f"python per steady frame  min {min(spent):.2f} ms, median {median(spent):.2f} ms; allocated {grown} bytes"
        )
        print(f"device memory            {renderer.peak_device_bytes / 2**20:.0f} MiB\n")


def _blurs(choice: str | None, runs: int) -> None:
    """Each engine beside OpenCV's GaussianBlur on the same image."""
    image = np.random.default_rng(0).random((SIZE, SIZE, 4), np.float32)
    try:
        import cv2
    except ImportError:
        cv2 = None
        print("opencv-python-headless is not installed: no column for it")
    with Device.open(choice, profiling=True) as device:
        copy_ms = copy_baseline(device).min_ms
        print(f"== Gaussian blur, RGBA float32 {SIZE}x{SIZE}, min ms (copies), {device.info}")
        print(f"{'sigma':>6s} {'FIR':>16s} {'IIR':>16s} {'OpenCV':>16s}")
        for sigma in SIGMAS:
            row = [
                _blur_ms(device, image, _fir_program(sigma), runs),
                _blur_ms(device, image, _iir_program(sigma), runs),
            ]
            if cv2 is not None:
                row.append(_min_ms(lambda s=sigma: cv2.GaussianBlur(image, (0, 0), s), 5))
            print(f"{sigma:6.0f} " + " ".join(f"{ms:8.2f} ({ms / copy_ms:4.1f})" for ms in row))


def _min_ms(call: Callable[[], object], runs: int) -> float:
    call()
    times = []
    for _ in range(runs):
        start = time.perf_counter()
        call()
        times.append((time.perf_counter() - start) * 1e3)
    return min(times)


def _blur_ms(device: Device, image: NDArray[np.float32], program: FrameProgram, runs: int) -> float:
    padded = np.zeros((SIZE, row_pitch(SIZE), 4), np.float32)
    padded[:, :SIZE] = image
    source = device.pool.to_device(padded)
    with compile(program, device) as batch:
        times = []
        for _ in range(runs):
            submission = batch.submit({"source": source.buffer}, wait_for=source.waits)
            times.append(sum(timing.ms for timing in pass_timings(submission)))
    device.pool.free_input(source)
    return min(times[1:])


def _image_buffers() -> list[Buffer]:
    nbytes = SIZE * row_pitch(SIZE) * 16
    return [Buffer("source", nbytes, Role.INPUT), Buffer("out", nbytes, Role.OUTPUT)]


def _fir_program(sigma: float) -> FrameProgram:
    # 3.3 sigma: within 1.5e-3 of the exact Gaussian for any image in [0, 1].
    taps = gaussian.fir_taps(sigma, cutoff=3.3)
    data, radius, segment, rows = gaussian.padded_taps(taps), len(taps) // 2, 512, 8
    halo = (radius + 7) & ~3
    sizes = (np.int32(n) for n in (SIZE, SIZE, row_pitch(SIZE), radius, segment))
    blur = Pass(
        "blur",
        "blur_fir",
        (write("out"), read("source"), read("taps"), *sizes, Local(rows * (segment + 2 * halo) * 16)),
        (SIZE // segment, SIZE // rows),
        (1, 1),
    )
    return FrameProgram.of([*_image_buffers(), Buffer("taps", data.nbytes, Role.CONSTANT, data)], [blur])


def _iir_program(sigma: float) -> FrameProgram:
    sections = gaussian.iir_sections(sigma)
    sizes = tuple(np.int32(n) for n in (SIZE, SIZE, row_pitch(SIZE)))
    passes = [
        Pass("blur", kernel, (write(target), read(source), read("sections"), *sizes), (SIZE // 4,), (1,))
        for kernel, source, target in (("blur_iir_rows", "source", "rows"), ("blur_iir_columns", "rows", "out"))
    ]
    buffers = [
        *_image_buffers(),
        Buffer("rows", SIZE * row_pitch(SIZE) * 16),
        Buffer("sections", sections.nbytes, Role.CONSTANT, sections),
    ]
    return FrameProgram.of(buffers, passes)
