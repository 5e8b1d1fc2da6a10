"""Frames on real queues: results, waits that matter, resubmission, several frames in flight."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from cldof.errors import DeviceError, InputError
from cldof.host import hazards, scheduler
from cldof.host import opencl as cl
from cldof.host.buffers import BufferPool
from cldof.host.device import Device, DeviceInfo
from cldof.host.passes import Buffer, FrameProgram, Local, Param, Pass, Role, read, read_write, write

F32, I32 = np.dtype(np.float32), np.dtype(np.int32)
N = 4096
GROUP = 64


def add(out: str, a: str, term: Any, n: int = N, kernel: str = "toy_add", **changes: Any) -> Pass:
    """out = a + term."""
    return Pass("toy", kernel, (write(out), read(a), np.int32(n), term), (n,), (GROUP,), **changes)


def chain(length: int, kernel: str = "toy_add", n: int = N) -> FrameProgram:
    """out = in + length, by one pass per step; an even number of reversing passes is none."""
    names = ["in", *(f"t{i}" for i in range(length - 1)), "out"]
    buffers = [Buffer(name, 4 * n) for name in names[1:-1]]
    buffers += [Buffer("in", 4 * n, Role.INPUT), Buffer("out", 4 * n, Role.OUTPUT)]
    steps = [add(b, a, np.float32(1), n, kernel) for a, b in pairwise(names)]
    return FrameProgram.of(buffers, steps)


def output(batch: scheduler.Batch, submission: scheduler.Submission, n: int = N) -> np.ndarray[Any, Any]:
    return batch.device.pool.to_host(batch.output("out"), (n,), F32, waits=[submission.event])


@pytest.fixture(params=["in_order", "out_of_order"])
def any_queue(request: pytest.FixtureRequest, device_info: DeviceInfo) -> Device:
    """The toy device with both kinds of queue."""
    name = "toy" if request.param == "in_order" else "toy_out_of_order"
    return request.getfixturevalue(name)  # type: ignore[no-any-return]


def test_chain(any_queue: Device) -> None:
    host = np.arange(N, dtype=np.float32)
    source = any_queue.pool.to_device(host)
    with scheduler.compile(chain(8), any_queue) as batch:
        submission = batch.submit({"in": source.buffer}, wait_for=source.waits)
        np.testing.assert_array_equal(output(batch, submission), host + 8)
        assert batch.transient_bytes == 2 * 4 * N


def test_results_do_not_depend_on_what_shares_memory(any_queue: Device) -> None:
    """Two branches that end in one pass each, over transients of different lives."""
    program = FrameProgram.of(
        [Buffer("out", 4 * N, Role.OUTPUT), *(Buffer(name, 4 * N) for name in "abcde")],
        [
            Pass("toy", "toy_fill", (write("a"), np.int32(N), np.float32(1)), (N,)),
            Pass("toy", "toy_fill", (write("b"), np.int32(N), np.float32(10)), (N,)),
            add("c", "a", np.float32(100), kernel="toy_late_reverse"),
            add("d", "b", np.float32(1000)),
            Pass("toy", "toy_increment", (read_write("d"), np.int32(N)), (N,)),
            add("e", "c", np.float32(0)),
            add("out", "d", np.float32(0)),
            add("d", "e", np.float32(0)),
        ],
    )
    with scheduler.compile(program, any_queue) as batch:
        for _ in range(5):
            submission = batch.submit()
            assert (output(batch, submission) == 1011).all()


def test_constants_locals_and_structs(toy: Device) -> None:
    taps = np.arange(N, dtype=np.float32)
    struct = np.dtype([("scale", np.float32), ("offset", np.int32)])
    program = FrameProgram.of(
        [
            Buffer("taps", taps.nbytes, Role.CONSTANT, taps),
            Buffer("out", 4 * N, Role.OUTPUT),
            Buffer("ramp", 4 * N, Role.OUTPUT),
        ],
        [
            Pass("toy", "toy_reverse", (write("out"), read("taps"), Local(4 * GROUP)), (N,), (GROUP,)),
            Pass("toy", "toy_struct", (write("ramp"), Param("p", struct)), (N,)),
        ],
    )
    with scheduler.compile(program, toy) as batch:
        submission = batch.submit(params={"p": np.array((2.0, 3), struct)})
        np.testing.assert_array_equal(output(batch, submission), taps.reshape(-1, GROUP)[:, ::-1].ravel())
        ramp = toy.pool.to_host(batch.output("ramp"), (N,), F32)
        np.testing.assert_array_equal(ramp, 2 * taps + 3)


def test_defines_make_variants(toy: Device) -> None:
    host = np.arange(N, dtype=np.float32)
    source = toy.pool.to_device(host)
    program = chain(2)
    program = replace(program, passes=tuple(replace(one, defines=(("TIMES", 3),)) for one in program.passes))
    with scheduler.compile(program, toy) as batch:
        np.testing.assert_array_equal(output(batch, batch.submit({"in": source.buffer})), (host * 3 + 1) * 3 + 1)


# -- waits


def late_chain_is_right(device: Device) -> bool:
    host = np.arange(N, dtype=np.float32)
    source = device.pool.to_device(host)
    with scheduler.compile(chain(6, "toy_late_reverse"), device) as batch:
        submission = batch.submit({"in": source.buffer}, wait_for=source.waits)
        return bool((output(batch, submission) == host + 6).all())


def test_waits_order_an_out_of_order_queue(toy_out_of_order: Device) -> None:
    assert all(late_chain_is_right(toy_out_of_order) for _ in range(5))


def test_without_waits_an_out_of_order_queue_goes_wrong(
    toy_out_of_order: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What shows that the test above tests something."""
    monkeypatch.setattr(hazards, "waits", lambda steps: tuple(() for _ in steps))
    if all(late_chain_is_right(toy_out_of_order) for _ in range(20)):
        pytest.skip(f"{toy_out_of_order.info.name} ran 20 frames in order of its own accord")


def test_in_order_queues_are_given_no_waits(toy: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    given = []
    original = scheduler.launch

    def spy(queue: Any, label: str, *args: Any, waits: Any = (), **options: Any) -> Any:
        given.append(list(waits))
        return original(queue, label, *args, waits=waits, **options)

    source = toy.pool.to_device(np.zeros(N, np.float32))
    with scheduler.compile(chain(4), toy) as batch:
        monkeypatch.setattr(scheduler, "launch", spy)
        batch.submit({"in": source.buffer})
        batch.submit({"in": source.buffer}).wait()
    assert given == [[]] * 8


def test_frame_waits_for_the_callers_events(toy_out_of_order: Device, make_gate: Callable[[Device], Any]) -> None:
    device = toy_out_of_order
    source = device.pool.to_device(np.zeros(N, np.float32))
    gate = make_gate(device)
    with scheduler.compile(chain(3), device) as batch:
        submission = batch.submit({"in": source.buffer}, wait_for=[gate.event])
        assert submission.event.command_execution_status != cl.command_execution_status.COMPLETE
        gate.open()
        submission.wait()


# -- again and again


def test_parameters_and_inputs_change_from_frame_to_frame(any_queue: Device) -> None:
    program = FrameProgram.of(
        [Buffer("in", 4 * N, Role.INPUT), Buffer("out", 4 * N, Role.OUTPUT)], [add("out", "in", Param("term", F32))]
    )
    hosts = [np.full(N, value, np.float32) for value in (100, 200)]
    sources = [any_queue.pool.to_device(host) for host in hosts]
    with scheduler.compile(program, any_queue) as batch:
        for turn, term in enumerate([1, 2.0, np.float32(3), np.int64(4), np.float32(5).tobytes(), 5]):
            source = sources[turn // 2 % 2]
            submission = batch.submit({"in": source.buffer}, {"term": term}, wait_for=source.waits)
            assert (output(batch, submission) == hosts[turn // 2 % 2] + min(turn + 1, 5)).all()


def test_resubmission_waits_for_the_frame_before_it(toy_out_of_order: Device) -> None:
    """Frames of one batch share transients; each must be whole when its turn ends."""
    device = toy_out_of_order
    program = FrameProgram.of(
        [Buffer("out", 4 * N, Role.OUTPUT), Buffer("t", 4 * N)],
        [
            Pass("toy", "toy_fill", (write("t"), np.int32(N), Param("value", F32)), (N,)),
            add("out", "t", np.float32(0), kernel="toy_late_reverse"),
        ],
    )
    with scheduler.compile(program, device) as batch:
        results = []
        for value in range(10):
            submission = batch.submit(params={"value": value})
            out = np.empty(N, np.float32)
            copy = cl.enqueue_copy(
                device.queue, out, batch.output("out"), wait_for=[submission.event], is_blocking=False
            )
            batch.hold(copy)
            results.append((out, copy))
        for value, (out, copy) in enumerate(results):
            copy.wait()
            assert (out == value).all()


def test_frames_in_flight_are_independent(any_queue: Device, make_gate: Callable[[Device], Any]) -> None:
    """All three wait at a gate, so that none is over when the next one asks for a batch."""
    program = chain(6, "toy_late_reverse")
    hosts = [np.full(N, value, np.float32) for value in range(3)]
    sources = [any_queue.pool.to_device(host) for host in hosts]
    with scheduler.FrameRing(program, any_queue, slots=3) as ring:
        for _ in range(3):
            gate = make_gate(any_queue)
            frames = [ring.submit({"in": one.buffer}, wait_for=[*one.waits, gate.event]) for one in sources]
            assert len({id(frame.batch) for frame in frames}) == 3
            gate.open()
            for value, frame in enumerate(frames):
                assert (output(frame.batch, frame) == value + 6).all()


def test_steady_frames_allocate_and_build_nothing(toy: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    source = toy.pool.to_device(np.zeros(N, np.float32))
    with scheduler.compile(chain(4), toy) as batch:
        batch.submit({"in": source.buffer}).wait()
        before = toy.pool.allocated_bytes
        monkeypatch.setattr(toy, "programs", None)
        monkeypatch.setattr(toy.pool, "acquire", None)
        for _ in range(3):
            batch.submit({"in": source.buffer})
        toy.finish()
        assert toy.pool.allocated_bytes == before


def test_inputs_live_until_the_frame_is_done(toy_out_of_order: Device, make_gate: Callable[[Device], Any]) -> None:
    """Rebinding lets go of the buffer that wraps the caller's array; the frame must not."""
    device = toy_out_of_order
    gate = make_gate(device)
    with scheduler.compile(chain(3), device) as batch:
        source = device.pool.to_device(np.full(1 << 12, 7, np.float32))
        first = batch.submit({"in": source.buffer}, wait_for=[gate.event])
        batch.hold(first.event)
        other = device.pool.to_device(np.zeros(N, np.float32))
        del source
        second = batch.submit({"in": other.buffer}, wait_for=other.waits)
        held = [inputs for _, inputs in batch._in_flight]
        assert len(held) == 2
        gate.open()
        assert (output(batch, second) == 3).all()


def test_closing_gives_the_memory_back(toy: Device) -> None:
    before = toy.pool.in_use_bytes
    with scheduler.compile(chain(4), toy):
        assert toy.pool.in_use_bytes > before
    assert toy.pool.in_use_bytes == before


def test_a_closed_batch_takes_no_frames(toy: Device) -> None:
    source = toy.pool.to_device(np.zeros(N, np.float32))
    with scheduler.compile(chain(1), toy) as batch:
        pass
    with pytest.raises(InputError, match="closed"):
        batch.submit({"in": source.buffer})


def test_memory_of_a_closed_batch_is_held_for_its_readers(
    toy_out_of_order: Device, make_gate: Callable[[Device], Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    device = toy_out_of_order
    gate = make_gate(device)
    pool = BufferPool(device.context, device.queue, shares_memory=True)
    monkeypatch.setattr(device, "pool", pool)
    source = pool.to_device(np.zeros(N, np.float32))
    with scheduler.compile(chain(1), device) as batch:
        batch.submit({"in": source.buffer}).wait()
        batch.hold(gate.event)
        held = batch.output("out")
    assert pool.acquire(4 * N) is not held
    gate.open()
    device.finish()
    assert pool.acquire(4 * N) is held


# -- refusals


def test_inputs_and_parameters_are_checked(toy: Device) -> None:
    program = FrameProgram.of(
        [Buffer("in", 4 * N, Role.INPUT), Buffer("out", 4 * N, Role.OUTPUT)],
        [Pass("toy", "toy_add", (write("out"), read("in"), Param("n", I32), Param("term", F32)), (N,))],
    )
    source = toy.pool.to_device(np.zeros(N, np.float32)).buffer
    small = toy.pool.to_device(np.zeros(N - 1, np.float32)).buffer
    good = {"n": N, "term": 1.0}
    with scheduler.compile(program, toy) as batch:
        with pytest.raises(InputError, match=r"inputs given are \[\]; this frame takes \['in'\]"):
            batch.submit({}, good)
        with pytest.raises(InputError, match="buffer of 16380 bytes; it needs 16384"):
            batch.submit({"in": small}, good)
        with pytest.raises(InputError, match=r"parameters given are \['n'\]"):
            batch.submit({"in": source}, {"n": N})
        for bad in (1.5, "1", 1 << 40, np.zeros(2, np.int32), b"123"):
            with pytest.raises(InputError, match=r"'n' cannot be .* takes int32"):
                batch.submit({"in": source}, {**good, "n": bad})
        with pytest.raises(InputError, match="'t0' is not an output"):
            batch.output("t0")
        batch.submit({"in": source}, good).wait()


def one_pass(*args: Any, kernel: str = "toy_fill", **changes: Any) -> FrameProgram:
    buffers = [Buffer("out", 4 * N, Role.OUTPUT), Buffer("in", 4 * N, Role.INPUT)]
    return FrameProgram.of(buffers, [Pass("toy", kernel, args, (N,), label="the pass", **changes)])


@pytest.mark.parametrize(
    ("args", "kernel", "message"),
    [
        ((write("out"),), "toy_fill", "'the pass' has 1 arguments; kernel toy_fill takes 3"),
        ((write("out"), np.int64(N), np.float32(0)), "toy_fill", r"'the pass'.* argument 1"),
        ((write("out"), np.float32(N), np.float32(0)), "toy_fill", r"'the pass', argument 1 \(n\)"),
        ((write("out"), np.int32(N), Param("x", I32)), "toy_fill", r"'the pass', argument 2 \(value\)"),
        ((write("out"), read_write("out"), np.int32(N), np.float32(0)), "toy_add", r"'the pass', argument 1 \(a\)"),
    ],
)
def test_passes_must_fit_their_kernels(toy: Device, args: tuple[Any, ...], kernel: str, message: str) -> None:
    program = one_pass(*args, kernel=kernel)
    if kernel == "toy_add":  # make the access itself legal
        program = replace(
            program,
            passes=(Pass("toy", "toy_fill", (write("out"), np.int32(N), np.float32(0)), (N,)), *program.passes),
        )
    before = toy.pool.in_use_bytes
    with pytest.raises(InputError, match=message):
        scheduler.compile(program, toy)
    assert toy.pool.in_use_bytes == before


def test_limits_of_the_device_name_the_pass(toy: Device) -> None:
    group = 2 * toy.traits.max_work_group_size
    program = FrameProgram.of(
        [Buffer("out", 4 * group, Role.OUTPUT)],
        [Pass("toy", "toy_fill", (write("out"), np.int32(group), np.float32(0)), (group,), (group,), label="wide")],
    )
    with pytest.raises(DeviceError, match=f"'wide' wants work-groups of {group}"):
        scheduler.compile(program, toy)
    tile = toy.traits.local_mem_bytes + 4
    program = one_pass(write("out"), read("in"), Local(tile), kernel="toy_reverse", local_size=(GROUP,))
    with pytest.raises(DeviceError, match=f"'the pass' wants {tile} bytes of local memory"):
        scheduler.compile(program, toy)


def test_rings_have_at_least_one_slot(toy: Device) -> None:
    with pytest.raises(InputError, match="0 slots"):
        scheduler.FrameRing(chain(2), toy, slots=0)


def test_canaries_catch_an_overrun(toy: Device) -> None:
    """The guard that every test stands behind, tested."""
    program = FrameProgram.of(
        [Buffer("out", 4 * N, Role.OUTPUT)], [Pass("toy", "toy_overrun", (write("out"), np.int32(N)), (N,))]
    )
    with scheduler.compile(program, toy) as batch:
        batch.submit().wait()
    assert toy.pool.trampled() == [f"4 bytes written after a buffer of {4 * N}, first at 0"]  # type: ignore[attr-defined]
