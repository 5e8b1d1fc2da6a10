"""Small kernels to schedule, so that host tests depend on no method."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

from cldof.host import opencl as cl
from cldof.host.device import Device, DeviceInfo

KERNELS = """
#ifndef TIMES
#define TIMES 1
#endif
#include "toy_maths.clh"

/* toy_fill: a constant. */
__kernel void toy_fill(__global float *out, const int n, const float value)
{
    const int i = get_global_id(0);
    if (i < n)
        out[i] = value;
}

/* toy_add: out = a * TIMES + term. */
__kernel void toy_add(__global float *out, __global const float *restrict a, const int n, const float term)
{
    const int i = get_global_id(0);
    if (i < n)
        out[i] = toy_times(a[i]) + term;
}

/* toy_late_reverse: out = a + term back to front; the last item, which the next pass needs first, takes its time. */
__kernel void toy_late_reverse(__global float *out, __global const float *restrict a, const int n, const float term)
{
    const int i = get_global_id(0);
    float x = a[i < n ? n - 1 - i : 0];
    const int turns = i == n - 1 ? 2000000 : 0;
    for (int turn = 0; turn < turns; ++turn)
        x = x + (turn & 1 ? 1.0f : -1.0f);
    if (i < n)
        out[i] = x + term;
}

/* toy_increment: in place. */
__kernel void toy_increment(__global float *a, const int n)
{
    const int i = get_global_id(0);
    if (i < n)
        a[i] = a[i] + 1.0f;
}

/* toy_reverse: each work-group turns its part around in local memory. */
__kernel void toy_reverse(__global float *out, __global const float *restrict a, __local float *tile)
{
    const int i = get_local_id(0);
    tile[i] = a[get_global_id(0)];
    barrier(CLK_LOCAL_MEM_FENCE);
    out[get_global_id(0)] = tile[get_local_size(0) - 1 - i];
}

typedef struct { float scale; int offset; } toy_params;

/* toy_struct: out = index * scale + offset. */
__kernel void toy_struct(__global float *out, const toy_params params)
{
    const int i = get_global_id(0);
    out[i] = i * params.scale + params.offset;
}

/* toy_overrun: writes one element too many. */
__kernel void toy_overrun(__global float *out, const int n)
{
    out[get_global_id(0)] = 0.0f;
    out[n] = 0.0f;
}
"""

MATHS = "static inline float toy_times(float x) { return x * TIMES; }\n"


@pytest.fixture(scope="session")
def kernels(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Directory with the file ``toy.cl`` and its include."""
    directory = tmp_path_factory.mktemp("kernels")
    (directory / "toy.cl").write_text(KERNELS)
    (directory / "toy_maths.clh").write_text(MATHS)
    return directory


@pytest.fixture(scope="session")
def toy(device_info: DeviceInfo, kernels: Path, open_device: Callable[..., Device]) -> Device:
    """A device that knows the toy kernels."""
    return open_device(device_info, sources=kernels)


@pytest.fixture(scope="session")
def toy_out_of_order(device_info: DeviceInfo, kernels: Path, open_device: Callable[..., Device]) -> Device:
    """The same with an out-of-order queue."""
    device = open_device(device_info, sources=kernels, out_of_order=True)
    if not device.is_out_of_order:
        pytest.skip(f"{device_info.name} has no out-of-order queues")
    return device


class Gate:
    """A device event that the host completes, to hold commands back."""

    def __init__(self, device: Device) -> None:
        self.event: Any = cl.UserEvent(device.context)

    def open(self) -> None:
        """Let what waits go on."""
        self.event.set_status(cl.command_execution_status.COMPLETE)


@pytest.fixture
def make_gate() -> Iterator[Callable[[Device], Gate]]:
    """Make gates that open at the end of the test at the latest, so that a failing test does not hang."""
    gates: list[Gate] = []

    def make(device: Device) -> Gate:
        if device.info.name.startswith("basic"):
            pytest.skip("PoCL's basic device runs commands in the calling thread, which would wait for itself")
        gates.append(Gate(device))
        return gates[-1]

    yield make
    for gate in gates:
        with suppress(cl.Error):  # open already
            gate.open()
