"""Times per pass and the copy baseline. No test says how fast something has to be."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from cldof.errors import DeviceError, InputError
from cldof.host import profile, scheduler
from cldof.host.device import Device, DeviceInfo
from cldof.host.passes import Buffer, FrameProgram, Pass, Role, read, write
from cldof.host.profile import CopyBaseline, PassTiming

N = 4096
PROGRAM = FrameProgram.of(
    [Buffer("t", 4 * N), Buffer("out", 4 * N, Role.OUTPUT)],
    [
        Pass("toy", "toy_fill", (write("t"), np.int32(N), np.float32(1)), (N,), traffic_bytes=4 * N),
        Pass("toy", "toy_add", (write("out"), read("t"), np.int32(N), np.float32(1)), (N,), traffic_bytes=8 * N),
        Pass("toy", "toy_fill", (write("t"), np.int32(N), np.float32(2)), (N,), traffic_bytes=4 * N, label="clear"),
    ],
)


@pytest.mark.parametrize("out_of_order", [False, True])
def test_every_pass_has_a_time(
    device_info: DeviceInfo, kernels: Path, open_device: Callable[..., Device], out_of_order: bool
) -> None:
    device = open_device(device_info, sources=kernels, profiling=True, out_of_order=out_of_order)
    with scheduler.compile(PROGRAM, device) as batch:
        timings = profile.pass_timings(batch.submit())
    assert [one.label for one in timings] == ["toy_fill", "toy_add", "clear"]
    assert [one.traffic_bytes for one in timings] == [4 * N, 8 * N, 4 * N]
    assert all(one.ms > 0 for one in timings)


def test_without_profiling_there_are_no_times(toy: Device) -> None:
    with scheduler.compile(PROGRAM, toy) as batch, pytest.raises(DeviceError, match="profiling=True"):
        profile.pass_timings(batch.submit())


def test_speeds() -> None:
    one = PassTiming("blur", 2.0, 4_000_000, 6_000_000)
    assert (one.gb_per_s, one.gflop_per_s) == (2.0, 3.0)
    assert PassTiming("blur", 0.0, 1, 1).gb_per_s == 0.0
    assert CopyBaseline(1_000_000, 0.5, 0.4, 3).gb_per_s == 4.0


def test_table_sums_labels_slowest_first() -> None:
    timings = [PassTiming("a", 1.0, 1_000_000), PassTiming("blur", 2.0), PassTiming("a", 4.0, 4_000_000)]
    assert profile.by_label(timings) == [PassTiming("a", 5.0, 5_000_000, count=2), PassTiming("blur", 2.0)]
    assert profile.table(timings, CopyBaseline(1_000_000, 1.0, 1.0, 3)).splitlines() == [
        "pass   count         ms   share     GB/s   GFLOP/s  of copy",
        "a          2      5.000   71.4%      1.0         -      50%",
        "blur       1      2.000   28.6%        -         -        -",
        "total      3      7.000  100.0%      0.7         -      36%",
    ]


def test_copy_baseline(device: Device, out_of_order_device: Device) -> None:
    for one in (device, out_of_order_device):
        found = profile.copy_baseline(one, nbytes=1 << 16, runs=3)
        assert 0 < found.min_ms <= found.median_ms
        assert found.nbytes == 1 << 16
    assert profile.copy_baseline_ms(device, nbytes=1 << 10) > 0
    with pytest.raises(InputError, match="runs=0"):
        profile.copy_baseline(device, runs=0)
