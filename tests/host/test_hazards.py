"""Waits, lifetimes and memory sharing, without OpenCL."""

from __future__ import annotations

import random
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cldof.errors import InputError
from cldof.host import hazards
from cldof.host.passes import Access, Buffer, FrameProgram, Mode, Param, Pass, Role, read, read_write, write

R, W, RW = Mode.READ, Mode.WRITE, Mode.READ_WRITE


def step(*args: Any, label: str = "step", **changes: Any) -> Pass:
    return replace(Pass("toy", "toy_step", args, (64,), label=label), **changes)


# -- waits


def test_read_waits_for_write() -> None:
    assert hazards.waits([{"a": W}, {"a": R}]) == ((), (0,))


def test_write_waits_for_all_readers_since_the_last_write() -> None:
    assert hazards.waits([{"a": W}, {"a": R}, {"a": R}, {"a": W}]) == ((), (0,), (0,), (1, 2))


def test_write_waits_for_write_when_nobody_read() -> None:
    assert hazards.waits([{"a": W}, {"a": W}]) == ((), (0,))


def test_readers_do_not_wait_for_each_other() -> None:
    assert hazards.waits([{"a": R}, {"a": R}]) == ((), ())


def test_update_in_place_is_a_read_and_a_write() -> None:
    assert hazards.waits([{"a": W}, {"a": R}, {"a": RW}, {"a": R}]) == ((), (0,), (1,), (2,))


def test_implied_waits_are_left_out() -> None:
    assert hazards.waits([{"a": W}, {"a": R, "b": W}, {"a": R, "b": R}]) == ((), (0,), (1,))


def test_independent_passes_share_no_wait_and_are_all_sinks() -> None:
    waits = hazards.waits([{"a": W}, {"b": W}])
    assert waits == ((), ())
    assert hazards.sinks(waits) == (0, 1)


# -- random frames

SIZES = st.sampled_from([64, 100, 256])


@st.composite
def programs(draw: st.DrawFn) -> FrameProgram:
    """A legal frame of up to 12 passes over up to 6 transients; passes write one half of a buffer, or both."""
    buffers = [Buffer("in", 64, Role.INPUT), Buffer("out", 64, Role.OUTPUT)]
    buffers += [Buffer(f"t{i}", draw(SIZES)) for i in range(draw(st.integers(1, 6)))]
    names = [buffer.name for buffer in buffers[2:]]
    written: set[str] = set()
    passes = []
    for position in range(draw(st.integers(1, 12))):
        target = draw(st.sampled_from(names))
        sources = draw(st.lists(st.sampled_from([*sorted(written - {target}), "in"]), max_size=3, unique=True))
        mode = draw(st.sampled_from([W, RW])) if target in written else W
        parts = draw(st.sampled_from([(0,), (1,), (0, 1)]))
        passes.append(
            step(Access(target, mode), *map(read, sources), label=f"p{position}", defines=(("PARTS", parts),))
        )
        written.add(target)
    passes.append(step(write("out"), *map(read, sorted(written)), label="last", defines=(("PARTS", (0, 1)),)))
    return FrameProgram.of(buffers, passes)


def readable(program: FrameProgram) -> list[dict[str, tuple[int, ...]]]:
    """Per pass, the halves of every buffer that have been written before it."""
    written: dict[str, set[int]] = {"in": {0, 1}}
    found = []
    for one in program.passes:
        found.append({name: tuple(sorted(parts)) for name, parts in written.items()})
        for name, mode in hazards.uses(one).items():
            if mode is not R:
                written.setdefault(name, set()).update(dict(one.defines)["PARTS"])
    return found


def run(program: FrameProgram, order: list[int], place: dict[str, Any]) -> Any:
    """Run passes in some order on buffers placed somewhere; every value is the whole history behind it."""
    memory: dict[Any, dict[int, Any]] = {"in": {0: "in", 1: "in"}}
    visible = readable(program)
    for position in order:
        one = program.passes[position]
        found = []
        for name, mode in hazards.uses(one).items():
            if mode is not W:
                contents = memory.get(place.get(name, name), {})
                found.append((name, tuple(contents.get(part) for part in visible[position].get(name, ()))))
        for name, mode in hazards.uses(one).items():
            if mode is not R:
                for part in dict(one.defines)["PARTS"]:
                    memory.setdefault(place.get(name, name), {})[part] = hash((one.label, part, tuple(found)))
    return memory["out"]


def physical_waits(program: FrameProgram) -> tuple[dict[str, Any], tuple[tuple[int, ...], ...]]:
    slot_of = dict(hazards.assign(program).slot_of)
    physical = [{slot_of.get(name, name): mode for name, mode in hazards.uses(one).items()} for one in program.passes]
    return slot_of, hazards.waits(physical)


@given(programs(), st.randoms(use_true_random=False))
def test_any_order_that_the_waits_allow_gives_the_serial_result(program: FrameProgram, rng: random.Random) -> None:
    hazards.check(program)
    slot_of, waits = physical_waits(program)
    done: list[int] = []
    while len(done) < len(waits):
        ready = [p for p in range(len(waits)) if p not in done and set(waits[p]) <= set(done)]
        done.append(rng.choice(ready))
    serial = run(program, list(range(len(waits))), {})
    assert run(program, done, slot_of) == serial


@given(programs())
def test_every_wait_is_needed(program: FrameProgram) -> None:
    _, waits = physical_waits(program)

    def behind(position: int, without: tuple[int, int] | None = None) -> set[int]:
        direct = {earlier for earlier in waits[position] if (position, earlier) != without}
        return direct.union(*(behind(earlier, without) for earlier in direct))

    for position, needed in enumerate(waits):
        for earlier in needed:
            assert earlier not in behind(position, without=(position, earlier))


@given(programs())
def test_buffers_that_share_memory_never_live_at_once(program: FrameProgram) -> None:
    lives = hazards.lifetimes(program)
    assignment = hazards.assign(program)
    assert assignment.slot_of.keys() == lives.keys()
    for one, slot in assignment.slot_of.items():
        assert program.buffers[one].nbytes <= assignment.slot_bytes[slot]
        for other in lives.keys() - {one}:
            if assignment.slot_of[other] == slot:
                assert lives[one][1] < lives[other][0] or lives[other][1] < lives[one][0]


@given(programs())
def test_buffers_of_one_size_take_no_more_memory_than_live_at_once(program: FrameProgram) -> None:
    same = FrameProgram.of([replace(buffer, nbytes=64) for buffer in program.buffers.values()], list(program.passes))
    lives = hazards.lifetimes(same).values()
    at_once = max(sum(first <= now <= last for first, last in lives) for now in range(len(same.passes)))
    assert len(hazards.assign(same).slot_bytes) == at_once


def test_a_chain_of_any_length_lives_in_two_buffers() -> None:
    names = ["in", *(f"t{i}" for i in range(20)), "out"]
    buffers = [Buffer("in", 4, Role.INPUT), Buffer("out", 4, Role.OUTPUT), *(Buffer(name, 4) for name in names[1:-1])]
    program = FrameProgram.of(buffers, [step(write(b), read(a)) for a, b in pairwise(names)])
    assert len(hazards.assign(program).slot_bytes) == 2


def test_a_second_write_does_not_end_a_life() -> None:
    """Two halves of t, written apart and read together: u must not slip in between the writes."""
    program = FrameProgram.of(
        [Buffer("out", 4, Role.OUTPUT), Buffer("t", 4), Buffer("u", 4)],
        [step(write("t")), step(write("u")), step(read_write("u")), step(write("t")), step(write("out"), read("t"))],
    )
    assert len(set(hazards.assign(program).slot_of.values())) == 2


# -- programs that cannot be run

OUT = Buffer("out", 4, Role.OUTPUT)
WRITE_OUT = step(write("out"))


@pytest.mark.parametrize(
    ("buffers", "passes", "message"),
    [
        ([], [], "no passes"),
        ([Buffer("out", 0, Role.OUTPUT)], [WRITE_OUT], "'out' has 0 bytes"),
        ([OUT], [step(write("other"), label="blur")], "'blur' uses buffer 'other'"),
        ([OUT, Buffer("t", 4)], [step(write("out"), read("t"), label="blur")], "'blur' reads 't'.*before"),
        ([OUT, Buffer("t", 4)], [step(read_write("t"), label="blur"), WRITE_OUT], "'blur' reads 't'.*before"),
        ([OUT, Buffer("t", 4)], [step(write("t"), read("t"), label="blur"), WRITE_OUT], "'blur' reads 't'.*before"),
        ([OUT, Buffer("i", 4, Role.INPUT)], [step(write("i"), label="blur"), WRITE_OUT], "'blur' writes 'i'.*input"),
        ([OUT], [step(read("out"), label="blur")], "'blur' reads 'out'.*before"),
        ([OUT, Buffer("t", 4)], [step(write("t"))], "no pass writes the output 'out'"),
        ([OUT, Buffer("c", 4, Role.CONSTANT)], [WRITE_OUT], "'c' is constant"),
        ([OUT, Buffer("c", 8, Role.CONSTANT, np.zeros(1, np.float32))], [WRITE_OUT], "8 bytes but contents of 4"),
        ([OUT], [replace(WRITE_OUT, local_size=(48,), label="blur")], r"'blur': local size \(48,\).*does not divide"),
        ([OUT], [replace(WRITE_OUT, local_size=(8, 8), label="blur")], "'blur': local size.*does not fit"),
        ([OUT], [replace(WRITE_OUT, global_size=(0,), label="blur")], "'blur': global size"),
        (
            [OUT],
            [
                step(write("out"), Param("p", np.dtype(np.float32))),
                step(write("out"), Param("p", np.dtype(np.int32)), label="blur"),
            ],
            "'blur': parameter 'p' is int32 here and float32",
        ),
    ],
)
def test_refused_programs_name_the_pass(buffers: list[Buffer], passes: list[Pass], message: str) -> None:
    with pytest.raises(InputError, match=message):
        hazards.check(FrameProgram.of(buffers, passes))


def test_unused_transients_are_legal_and_cost_nothing() -> None:
    program = FrameProgram.of([OUT, Buffer("t", 4)], [WRITE_OUT])
    hazards.check(program)
    assert hazards.assign(program).slot_bytes == ()
