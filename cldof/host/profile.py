"""Time per pass from events, and the copy that bandwidths are compared with."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from statistics import median

from ..errors import DeviceError, InputError
from . import opencl as cl
from .device import Device
from .launch import launch
from .scheduler import Submission

__all__ = [
    "COPIES_PER_RUN",
    "CopyBaseline",
    "PassTiming",
    "by_label",
    "copy_baseline",
    "copy_baseline_ms",
    "copying",
    "pass_timings",
    "table",
]

COPIES_PER_RUN = 4
"""Copies per measurement: enough that a launch and a host synchronisation (8-40 us on a CPU) do not show."""


@dataclass(frozen=True)
class PassTiming:
    """Time of one pass, or of several with the same label.

    Attributes
    ----------
    label : str
    ms : float
        From start to end on the device.
    traffic_bytes, flops : int
        As the pass declares them; 0 is not declared.
    count : int
        Launches in this sum.
    """

    label: str
    ms: float
    traffic_bytes: int = 0
    flops: int = 0
    count: int = 1

    @property
    def gb_per_s(self) -> float:
        """Declared bytes per time, in 1e9 bytes per second."""
        return self.traffic_bytes / self.ms / 1e6 if self.ms else 0.0

    @property
    def gflop_per_s(self) -> float:
        """Declared operations per time, in 1e9 per second."""
        return self.flops / self.ms / 1e6 if self.ms else 0.0


@dataclass(frozen=True)
class CopyBaseline:
    """Time to copy a buffer to another on the device: what its memory gives to a pass that does nothing else.

    Attributes
    ----------
    nbytes : int
        Of one buffer; a copy moves twice that.
    median_ms, min_ms : float
    runs : int
    """

    nbytes: int
    median_ms: float
    min_ms: float
    runs: int

    @property
    def gb_per_s(self) -> float:
        """Bytes read and written per time, in 1e9 bytes per second."""
        return 2 * self.nbytes / self.median_ms / 1e6


def pass_timings(submission: Submission) -> list[PassTiming]:
    """Time of every pass of a frame, in order; blocks until the frame is done.

    Raises
    ------
    DeviceError
        The device was opened without profiling.
    """
    if not submission.launched:
        raise DeviceError("times per pass need a profiling queue: open the device with profiling=True")
    submission.wait()
    return [
        PassTiming(
            launched.label,
            (launched.event.profile.end - launched.event.profile.start) * 1e-6,
            step.traffic_bytes,
            step.flops,
        )
        for launched, step in zip(submission.launched, submission.batch.program.passes, strict=True)
    ]


def by_label(timings: Iterable[PassTiming]) -> list[PassTiming]:
    """Sum timings of the same label; in the order in which labels first appear."""
    sums: dict[str, PassTiming] = {}
    for one in timings:
        so_far = sums.get(one.label, PassTiming(one.label, 0.0, count=0))
        sums[one.label] = PassTiming(
            one.label,
            so_far.ms + one.ms,
            so_far.traffic_bytes + one.traffic_bytes,
            so_far.flops + one.flops,
            so_far.count + one.count,
        )
    return list(sums.values())


def table(timings: Sequence[PassTiming], baseline: CopyBaseline | None = None) -> str:
    """Timings summed by label as text, the slowest first, with a total.

    Parameters
    ----------
    timings : sequence of PassTiming
    baseline : CopyBaseline, optional
        Adds a column with the bandwidth relative to that of a copy.
    """
    rows = sorted(by_label(timings), key=lambda row: -row.ms)
    total = PassTiming(
        "total",
        sum(row.ms for row in rows),
        sum(row.traffic_bytes for row in rows),
        sum(row.flops for row in rows),
        sum(row.count for row in rows),
    )
    width = max(len(row.label) for row in (*rows, total))
    head = f"{'pass':<{width}}  {'count':>5}  {'ms':>9}  {'share':>6}  {'GB/s':>7}  {'GFLOP/s':>8}"
    lines = [head + ("  of copy" if baseline else "")]
    for row in (*rows, total):
        share = row.ms / total.ms if total.ms else 0.0
        line = f"{row.label:<{width}}  {row.count:>5}  {row.ms:>9.3f}  {share:>6.1%}"
        line += f"  {_or_dash(row.gb_per_s):>7}  {_or_dash(row.gflop_per_s):>8}"
        if baseline:
            line += f"  {row.gb_per_s / baseline.gb_per_s:>7.0%}" if row.traffic_bytes else f"  {'-':>7}"
        lines.append(line)
    return "\n".join(lines)


@contextmanager
def copying(device: Device, nbytes: int = 16 * 1024 * 1024) -> Iterator[Callable[[], None]]:
    """A function that copies one buffer to another on the device, four times over, and waits for it.

    Parameters
    ----------
    device : Device
    nbytes : int
        Of one buffer. The default is one 1024x1024 RGBA float32 image.
    """
    pool = device.pool
    source, target = pool.acquire(nbytes), pool.acquire(nbytes)

    def copy() -> None:
        done = filled
        for _ in range(COPIES_PER_RUN):
            done = launch(device.queue, "copy", cl.enqueue_copy, target, source, byte_count=nbytes, waits=[done]).event
        done.wait()

    try:
        filled = launch(device.queue, "fill", cl.enqueue_fill_buffer, source, b"\0\0\0\0", 0, source.size).event
        filled.wait()  # touches the memory; untouched pages would be read from one shared zero page
        yield copy
    finally:
        pool.release(source)
        pool.release(target)


def copy_baseline(device: Device, nbytes: int = 16 * 1024 * 1024, runs: int = 20) -> CopyBaseline:
    """Measure a device-to-device copy by the wall clock, warmed up.

    Parameters
    ----------
    device : Device
    nbytes : int
        As for :func:`copying`.
    runs : int
        Measurements of four copies each.
    """
    if nbytes < 1 or runs < 1:
        raise InputError(f"a copy baseline needs bytes and runs, not nbytes={nbytes}, runs={runs}")
    times = []
    with copying(device, nbytes) as copy:
        for run in range(-2, runs):
            start = time.perf_counter()
            copy()
            if run >= 0:  # the first two warm up
                times.append((time.perf_counter() - start) * 1e3 / COPIES_PER_RUN)
    return CopyBaseline(nbytes, median(times), min(times), runs)


def copy_baseline_ms(device: Device, nbytes: int = 16 * 1024 * 1024) -> float:
    """Median of :func:`copy_baseline`, in milliseconds."""
    return copy_baseline(device, nbytes).median_ms


def _or_dash(value: float) -> str:
    return f"{value:.1f}" if value else "-"
