"""What waits for what, and which buffers may share memory: pure functions over passes, no OpenCL.

The order in which a frame lists its passes defines what it means. Two passes may run in any order, or at once, unless
one writes what the other reads or writes. From that follow the waits; from first and last use follow the lifetimes,
and from those the assignment of transient buffers to physical ones. Sharing memory adds conflicts of its own, so waits
are derived after the assignment, on physical buffers.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass
from math import prod
from typing import Any

from ..errors import InputError
from .passes import Access, FrameProgram, Mode, Param, Pass, Role

__all__ = ["Assignment", "assign", "check", "lifetimes", "sinks", "uses", "waits"]


@dataclass(frozen=True)
class Assignment:
    """Where transient buffers live.

    Attributes
    ----------
    slot_of : dict of str to int
        Physical buffer of each transient one that is used.
    slot_bytes : tuple of int
        Size of each physical buffer.
    """

    slot_of: Mapping[str, int]
    slot_bytes: tuple[int, ...]


def uses(step: Pass) -> dict[str, Mode]:
    """Buffers of a pass and what happens to each; one that appears as several arguments counts once."""
    found: dict[str, Mode] = {}
    for argument in step.args:
        if isinstance(argument, Access):
            before = found.get(argument.buffer, argument.mode)
            found[argument.buffer] = argument.mode if before is argument.mode else Mode.READ_WRITE
    return found


def check(program: FrameProgram) -> None:
    """Refuse a frame that cannot be run.

    Raises
    ------
    InputError
        Names the pass and the buffer, and says what is wrong.
    """
    if not program.passes:
        raise InputError("a frame program has no passes")
    for name, buffer in program.buffers.items():
        if buffer.nbytes <= 0:
            raise InputError(f"buffer {name!r} has {buffer.nbytes} bytes; it needs at least 1")
        if (buffer.role is Role.CONSTANT) != (buffer.data is not None):
            raise InputError(f"buffer {name!r} is {buffer.role.value}: contents are given for constant buffers only")
        if buffer.data is not None and (buffer.data.nbytes != buffer.nbytes or not buffer.data.flags.c_contiguous):
            raise InputError(
                f"constant buffer {name!r} has {buffer.nbytes} bytes but contents of {buffer.data.nbytes}; "
                f"they must agree and be C-contiguous"
            )
    written: set[str] = set()
    dtypes: dict[str, Param] = {}
    for step in program.passes:
        _check_range(step)
        for argument in step.args:
            if isinstance(argument, Param) and dtypes.setdefault(argument.name, argument) != argument:
                raise InputError(
                    f"pass {step.label!r}: parameter {argument.name!r} is {argument.dtype} here and "
                    f"{dtypes[argument.name].dtype} in an earlier pass"
                )
        for name, mode in uses(step).items():
            if name not in program.buffers:
                raise InputError(f"pass {step.label!r} uses buffer {name!r}, which the frame program does not have")
            role = program.buffers[name].role
            if role in (Role.INPUT, Role.CONSTANT):
                if mode is not Mode.READ:
                    raise InputError(f"pass {step.label!r} writes {name!r}, which is {role.value} and read-only")
            elif mode is not Mode.WRITE and name not in written:
                raise InputError(f"pass {step.label!r} reads {name!r} ({role.value}) before any pass has written it")
            if mode is not Mode.READ:
                written.add(name)
    for name, buffer in program.buffers.items():
        if buffer.role is Role.OUTPUT and name not in written:
            raise InputError(f"no pass writes the output {name!r}")


def lifetimes(program: FrameProgram) -> dict[str, tuple[int, int]]:
    """First and last pass that touches each transient buffer; one that no pass touches is left out.

    A second write does not start a new life: WRITE may cover a part only, a level of a pyramid for instance.
    """
    found: dict[str, tuple[int, int]] = {}
    for position, step in enumerate(program.passes):
        for name in uses(step):
            if program.buffers[name].role is Role.TRANSIENT:
                found[name] = (found.get(name, (position, position))[0], position)
    return found


def assign(program: FrameProgram) -> Assignment:
    """Put transient buffers whose lives do not overlap onto the same physical buffer.

    Largest first, each onto the first physical buffer that is free throughout its life. So a physical buffer is as
    large as its first guest and never grows; on interval graphs this stays close to the least possible memory.
    """
    lives = lifetimes(program)
    slot_of: dict[str, int] = {}
    slot_bytes: list[int] = []
    guests: list[list[tuple[int, int]]] = []
    # By name in the end, so that the same program gives the same assignment on every run.
    for name in sorted(lives, key=lambda name: (-program.buffers[name].nbytes, lives[name], name)):
        first, last = lives[name]
        slot = next((slot for slot, taken in enumerate(guests) if _is_free(taken, first, last)), len(guests))
        if slot == len(guests):
            guests.append([])
            slot_bytes.append(program.buffers[name].nbytes)
        guests[slot].append((first, last))
        slot_of[name] = slot
    return Assignment(slot_of, tuple(slot_bytes))


def waits(steps: Sequence[Mapping[Any, Mode]]) -> tuple[tuple[int, ...], ...]:
    """For every step the earlier steps that must be complete before it starts.

    Parameters
    ----------
    steps : sequence of mappings from buffer to Mode
        In the order that defines the meaning. Buffers that share memory must be the same key.

    Returns
    -------
    tuple of tuples of int
        Ascending, and reduced: a wait that follows from another wait is left out.
    """
    last_writer: dict[Hashable, int] = {}
    readers: dict[Hashable, list[int]] = {}  # since the last write
    behind: list[int] = []  # per step a bit set of all steps that are complete when it starts
    found = []
    for position, step in enumerate(steps):
        needed: set[int] = set()
        for buffer, mode in step.items():
            if buffer in last_writer:
                needed.add(last_writer[buffer])  # read after write, write after write
            if mode is not Mode.READ:
                needed.update(readers.get(buffer, ()))  # write after read
        reduced: list[int] = []
        covered = 0
        for earlier in sorted(needed, reverse=True):
            if not covered >> earlier & 1:
                reduced.append(earlier)
                covered |= behind[earlier] | 1 << earlier
        behind.append(covered)
        found.append(tuple(reversed(reduced)))
        for buffer, mode in step.items():
            if mode is Mode.READ:
                readers.setdefault(buffer, []).append(position)
            else:
                last_writer[buffer] = position
                readers[buffer] = []
    return tuple(found)


def sinks(waits_of: Sequence[Sequence[int]]) -> tuple[int, ...]:
    """Steps that no other waits for: when these are complete, all are."""
    awaited = {earlier for needed in waits_of for earlier in needed}
    return tuple(position for position in range(len(waits_of)) if position not in awaited)


def _is_free(taken: Sequence[tuple[int, int]], first: int, last: int) -> bool:
    return all(last < other_first or other_last < first for other_first, other_last in taken)


def _check_range(step: Pass) -> None:
    if not 1 <= len(step.global_size) <= 3 or any(extent < 1 for extent in step.global_size):
        raise InputError(f"pass {step.label!r}: global size {step.global_size} must have 1 to 3 positive extents")
    if step.local_size is None:
        return
    if len(step.local_size) != len(step.global_size) or any(extent < 1 for extent in step.local_size):
        raise InputError(
            f"pass {step.label!r}: local size {step.local_size} does not fit global size {step.global_size}"
        )
    if any(whole % part for whole, part in zip(step.global_size, step.local_size, strict=True)):
        raise InputError(
            f"pass {step.label!r}: local size {step.local_size} ({prod(step.local_size)} work-items) does not divide "
            f"global size {step.global_size}; round the global size up and guard the kernel's loads and stores"
        )
