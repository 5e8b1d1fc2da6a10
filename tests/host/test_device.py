"""Listing, choosing, opening and adopting devices."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from cldof.errors import DeviceError
from cldof.host import device as device_module
from cldof.host import opencl as cl
from cldof.host import scheduler
from cldof.host.device import Device, DeviceInfo, list_devices
from cldof.host.drivers import driver_advice
from cldof.host.passes import Buffer, FrameProgram, Pass, Role, write

POCL = DeviceInfo(0, "pthread-Some CPU", "Portable Computing Language", "3.0", "cpu", 2, 1 << 30)
LLVMPIPE = DeviceInfo(1, "llvmpipe (LLVM 15)", "rusticl", "22.3", "cpu", 2, 1 << 30)
RADEON = DeviceInfo(2, "Radeon RX", "AMD Accelerated Parallel Processing", "1", "gpu", 60, 1 << 34)
GEFORCE = DeviceInfo(3, "GeForce", "NVIDIA CUDA", "1", "gpu", 80, 1 << 34)
ALL = (POCL, LLVMPIPE, RADEON, GEFORCE)


@pytest.mark.parametrize(
    ("choice", "index"),
    [(None, 2), (1, 1), ("1", 1), ("cpu", 0), ("GPU", 2), ("geforce", 3), ("nvidia", 3), ("llvm", 1), ("portable", 0)],
)
def test_choices(choice: int | str | None, index: int) -> None:
    assert device_module._candidates(ALL, choice)[0] == index


def test_default_without_a_gpu_is_a_cpu_that_is_no_last_resort() -> None:
    assert device_module._candidates([replace(LLVMPIPE, index=0), replace(POCL, index=1)], None) == [1, 0]
    assert device_module._candidates([replace(LLVMPIPE, index=0)], None) == [0]


@pytest.mark.parametrize("choice", ["voodoo", 4, "-1", -1, "4"])
def test_a_choice_that_matches_nothing_lists_what_there_is(choice: int | str) -> None:
    with pytest.raises(DeviceError, match=r"no OpenCL device matches .*0: pthread.*3: GeForce.*CLDOF_DEVICE"):
        device_module._candidates(ALL, choice)


def test_no_device_says_how_to_get_one() -> None:
    with pytest.raises(DeviceError, match=re.escape(driver_advice())):
        device_module._candidates([], None)


def test_listing(device: Device) -> None:
    assert device.info in list_devices()
    assert device.info.name in str(device.info)


def test_environment_chooses(device_info: DeviceInfo, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CLDOF_DEVICE", str(device_info.index))
    with Device.open() as device:
        assert device.info == device_info
    monkeypatch.setenv("CLDOF_DEVICE", "no such device")
    with pytest.raises(DeviceError, match="'no such device'"):
        Device.open()
    with Device.open(device_info.index) as device:  # the argument goes first
        assert device.info == device_info


def test_traits(device: Device) -> None:
    traits = device.traits
    assert traits.is_cpu == (device.info.kind == "cpu")
    assert 1 <= traits.preferred_group_limit <= traits.max_work_group_size
    assert traits.local_mem_bytes > 0
    assert device.traits is traits


def test_work_group_size_is_probed_not_believed(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    claimed = device._cl_device.max_work_group_size
    monkeypatch.setattr(device, "_group_works", lambda kernel, size: size <= claimed // 4)
    assert device._usable_group_size() == max(claimed // 4, 1)


def claim_int64(monkeypatch: pytest.MonkeyPatch, device: Device) -> None:
    """Have the device claim 64-bit atomics, whatever it can do."""

    class Claiming:
        extensions = device._cl_device.extensions + " cl_khr_int64_extended_atomics"

        def __getattr__(self, name: str) -> object:
            return getattr(device._cl_device, name)

    claiming = Claiming()
    probe = device._probe

    def build(source: str) -> object:
        monkeypatch.setattr(device, "_cl_device", real)
        return probe(source)

    real = device._cl_device
    monkeypatch.setattr(device, "_cl_device", claiming)
    monkeypatch.setattr(device, "_probe", build)


def test_int64_atomics_need_the_claim(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    claims = "cl_khr_int64_extended_atomics" in device._cl_device.extensions.split()
    assert claims or not device.traits.has_int64_atomics
    monkeypatch.setattr(device_module, "_INT64_EXTENSION", "cl_khr_nobody_has_this")
    assert not device._int64_atomics_work()


@pytest.mark.parametrize(
    ("right", "wrong"),
    [
        ("atom_min", "no_such_builtin"),  # does not build
        ("atom_min(out + (i & 3u), key)", "if (key < out[i & 3u]) out[i & 3u] = 1ul"),  # wrong
        ("<< 32", "<< 24"),  # the upper word is lost
        ("__kernel void probe", "__kernel void another"),  # no kernel
    ],
)
def test_a_driver_that_claims_and_fails_has_no_int64_atomics(
    device: Device, monkeypatch: pytest.MonkeyPatch, right: str, wrong: str
) -> None:
    claim_int64(monkeypatch, device)
    source = device_module._INT64_SOURCE
    assert right in source
    monkeypatch.setattr(device_module, "_INT64_SOURCE", source.replace(right, wrong))
    assert not device._int64_atomics_work()


@pytest.mark.parametrize(
    ("right", "wrong"), [("i < turns", "i < turns && i < 65535u"), ("uint sum", "no_such_type sum")]
)
def test_loops_that_are_broken_off_are_found(
    device: Device, monkeypatch: pytest.MonkeyPatch, right: str, wrong: str
) -> None:
    """As llvmpipe does."""
    assert device._long_loops_work() == device.traits.has_long_loops
    source = device_module._LOOP_SOURCE
    assert right in source
    monkeypatch.setattr(device_module, "_LOOP_SOURCE", source.replace(right, wrong))
    assert not device._long_loops_work()


def test_a_failing_queue_is_no_int64_atomics(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    if not device.traits.has_int64_atomics:
        pytest.skip(f"{device.info.name} has no 64-bit atomics")

    def fail(*arguments: object, **options: object) -> None:
        raise DeviceError("out of resources")

    monkeypatch.setattr(device_module, "launch", fail)
    assert not device._int64_atomics_work()
    monkeypatch.undo()
    assert device._int64_atomics_work()


def test_queue_kinds(device_info: DeviceInfo, open_device: Callable[..., Device]) -> None:
    plain = open_device(device_info)
    assert (plain.is_profiling, plain.is_out_of_order) == (False, False)
    assert open_device(device_info, profiling=True).is_profiling
    reordering = open_device(device_info, out_of_order=True)
    assert reordering.is_out_of_order == plain.traits.supports_out_of_order


FILL = FrameProgram.of(
    [Buffer("out", 256, Role.OUTPUT)], [Pass("toy", "toy_fill", (write("out"), np.int32(64), np.float32(5)), (64,))]
)


def test_adopted_queue_stays_the_callers(toy: Device, kernels: object) -> None:
    queue = cl.CommandQueue(toy.context, toy._cl_device)
    with Device.adopt(queue=queue, sources=kernels) as mine:  # type: ignore[arg-type]
        assert mine.queue is queue
        assert mine.context == toy.context
        with scheduler.compile(FILL, mine) as batch:
            submission = batch.submit()
            assert (mine.pool.to_host(batch.output("out"), (64,), np.float32, [submission.event]) == 5).all()
    queue.finish()  # still usable


def test_adopted_context_gets_a_queue(toy: Device, kernels: object) -> None:
    with Device.adopt(context=toy.context, sources=kernels) as mine:  # type: ignore[arg-type]
        assert mine.queue != toy.queue
        with scheduler.compile(FILL, mine) as batch:
            batch.submit().wait()


def test_adopting_nothing_or_strangers_is_refused(toy: Device) -> None:
    with pytest.raises(DeviceError, match="needs a pyopencl Context or CommandQueue"):
        Device.adopt()
    other = cl.Context([toy._cl_device])
    with pytest.raises(DeviceError, match="another context"):
        Device.adopt(context=other, queue=toy.queue)


def test_close_may_come_before_the_batch_is_closed(device_info: DeviceInfo, kernels: object) -> None:
    device = Device.open(device_info.index, sources=kernels)  # type: ignore[arg-type]
    batch = scheduler.compile(FILL, device)
    device.close()
    device.close()
    batch.close()
    with pytest.raises(DeviceError, match="closed"):
        device.pool.acquire(1)


def test_a_missing_linker_is_said_before_pocl_aborts(monkeypatch: pytest.MonkeyPatch, device_info: DeviceInfo) -> None:
    if "Portable Computing Language" not in device_info.platform:
        pytest.skip("only PoCL links with ld")
    monkeypatch.setenv("PATH", "/nonexistent")
    with pytest.raises(DeviceError, match="apt-get install gcc libc6-dev"):
        Device.open(device_info.index)
