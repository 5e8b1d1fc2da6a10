"""The pool: reuse, accounting, host arrays."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cldof.errors import DeviceError, InputError
from cldof.host import opencl as cl
from cldof.host.buffers import BufferPool, size_class
from cldof.host.device import Device


@given(st.integers(1, 1 << 40))
def test_size_classes_waste_at_most_an_eighth(nbytes: int) -> None:
    size = size_class(nbytes)
    assert nbytes <= size <= max(256, nbytes * 9 / 8)
    assert size_class(size) == size


@given(st.integers(1, 1 << 40), st.integers(1, 1 << 40))
def test_size_classes_keep_order(one: int, other: int) -> None:
    assert (one <= other) <= (size_class(one) <= size_class(other))


@pytest.fixture(params=["shared memory", "separate memory"])
def pool(request: pytest.FixtureRequest, device: Device) -> Iterator[BufferPool]:
    """A pool as on this device, and one that behaves as if the device had memory of its own."""
    shares = request.param == "shared memory"
    if shares and not device.traits.host_unified_memory:
        pytest.skip(f"{device.info.name} has memory of its own")
    pool = BufferPool(device.context, device.queue, shares_memory=shares)
    yield pool
    pool.close()
    assert (pool.allocated_bytes, pool.in_use_bytes) == (0, 0)


def test_accounting(pool: BufferPool) -> None:
    first, second = pool.acquire(1000), pool.acquire(5000)
    held = size_class(1000) + size_class(5000)
    assert (pool.allocated_bytes, pool.in_use_bytes, pool.peak_bytes) == (held, held, held)
    pool.release(first)
    assert (pool.allocated_bytes, pool.in_use_bytes) == (held, size_class(5000))
    assert pool.acquire(990) is first
    pool.release(first)
    pool.trim()
    assert (pool.allocated_bytes, pool.peak_bytes) == (size_class(5000), held)
    pool.release(second)


def test_a_buffer_still_in_use_by_the_device_is_not_handed_out(
    pool: BufferPool, device: Device, make_gate: Callable[[Device], Any]
) -> None:
    gate = make_gate(device)
    buffer = pool.acquire(1000)
    pool.release(buffer, after=gate.event)
    other = pool.acquire(1000)
    assert other is not buffer
    gate.open()
    assert pool.acquire(1000) is buffer


def test_releasing_twice_is_refused(pool: BufferPool) -> None:
    buffer = pool.acquire(100)
    pool.release(buffer)
    with pytest.raises(InputError, match="released twice"):
        pool.release(buffer)


def test_too_much_says_how_much_was_asked_and_held(pool: BufferPool) -> None:
    pool.acquire(1 << 20)
    with pytest.raises(DeviceError, match=r"no device memory for 67108864\.0 MiB more.*Held: 1\.0 MiB.*1 buffers"):
        pool.acquire(1 << 46)
    with pytest.raises(InputError, match="0 bytes"):
        pool.acquire(0)


def test_running_out_frees_what_is_only_kept_then_tells(pool: BufferPool, monkeypatch: pytest.MonkeyPatch) -> None:
    pool.release(pool.acquire(1 << 20))

    def full(*args: object) -> None:
        raise cl.MemoryError("create_buffer", -4, "no memory")

    monkeypatch.setattr(cl, "Buffer", full)
    with pytest.raises(DeviceError, match=r"no device memory for 2\.0 MiB more.*Held: 0\.0 MiB"):
        pool.acquire(1 << 21)


@pytest.mark.parametrize("shape", [(1,), (37, 21, 4)])
def test_round_trip(pool: BufferPool, shape: tuple[int, ...]) -> None:
    array = np.random.default_rng(1).random(shape, np.float32)
    array.flags.writeable = False
    source = pool.to_device(array)
    assert bool(source.waits) == (not pool.shares_memory)
    np.testing.assert_array_equal(pool.to_host(source.buffer, shape, np.float32, source.waits), array)
    with pool.mapped(source.buffer, shape, np.float32, source.waits) as view:
        np.testing.assert_array_equal(view, array)
        if pool.shares_memory and pool._queue.device.type & cl.device_type.CPU:
            assert np.shares_memory(view, array)
    pool.free_input(source)
    assert pool.in_use_bytes == 0


def test_arrays_that_cannot_be_wrapped_are_refused(pool: BufferPool) -> None:
    with pytest.raises(InputError, match=r"colour: .*contiguous"):
        pool.to_device(np.zeros((4, 4), np.float32)[:, ::2], label="colour")
    with pytest.raises(InputError, match="not empty"):
        pool.to_device(np.zeros((0, 4), np.float32))
