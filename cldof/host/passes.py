"""Passes as data: what a method hands to the scheduler. No OpenCL here.

A method describes one frame as buffers and an ordered list of passes. It names buffers; the scheduler decides where
they live, what waits for what, and when to enqueue.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["Access", "Buffer", "FrameProgram", "Local", "Param", "Pass", "Role", "read", "read_write", "write"]


class Role(Enum):
    """Where a buffer's contents come from and who sees them."""

    INPUT = "input"  # bound by the caller per frame (frame layers)
    OUTPUT = "output"  # read by the caller after the frame
    TRANSIENT = "transient"  # lives from first writer to last reader; may share memory with others
    CONSTANT = "constant"  # contents given once, with the program (filter taps)


@dataclass(frozen=True)
class Buffer:
    """A named device buffer.

    Parameters
    ----------
    name : str
    nbytes : int
    role : Role
    data : ndarray, optional
        Contents of a CONSTANT buffer, C-contiguous.
    """

    name: str
    nbytes: int
    role: Role = Role.TRANSIENT
    data: NDArray[Any] | None = field(default=None, compare=False)


class Mode(Enum):
    READ = "r"
    WRITE = "w"
    READ_WRITE = "rw"


@dataclass(frozen=True)
class Access:
    """A kernel argument that is a buffer, with what the kernel does to it. WRITE does not depend on what was there."""

    buffer: str
    mode: Mode


def read(buffer: str) -> Access:
    """A buffer that the kernel only reads."""
    return Access(buffer, Mode.READ)


def write(buffer: str) -> Access:
    """A buffer that the kernel writes, not depending on what was there."""
    return Access(buffer, Mode.WRITE)


def read_write(buffer: str) -> Access:
    """A buffer that the kernel updates in place."""
    return Access(buffer, Mode.READ_WRITE)


@dataclass(frozen=True)
class Param:
    """A scalar or struct argument that changes from frame to frame; its value comes with each submission."""

    name: str
    dtype: np.dtype[Any]


@dataclass(frozen=True)
class Local:
    """A ``__local`` argument of so many bytes."""

    nbytes: int


Argument = Access | Param | Local | np.generic


@dataclass(frozen=True)
class Pass:
    """One kernel launch.

    Parameters
    ----------
    source : str
        File stem in ``cldof/kernels``, for instance ``"layered"``.
    kernel : str
        Kernel name; starts with the stem.
    args : tuple
        In kernel order: :class:`Access`, :class:`Param`, :class:`Local`, or a numpy scalar that never changes.
    global_size, local_size : tuple of int
        ``local_size`` divides ``global_size``; None leaves it to the driver.
    defines : tuple of (str, value) pairs
        Compile-time constants.
    label : str
        Name in profiles; the kernel's name unless told otherwise.
    traffic_bytes, flops : int
        What the pass has to move and to compute at least; for GB/s and GFLOP/s in reports.
    """

    source: str
    kernel: str
    args: tuple[Argument, ...]
    global_size: tuple[int, ...]
    local_size: tuple[int, ...] | None = None
    defines: tuple[tuple[str, Any], ...] = ()
    label: str = ""
    traffic_bytes: int = 0
    flops: int = 0

    def __post_init__(self) -> None:
        if not self.label:
            object.__setattr__(self, "label", self.kernel)


@dataclass(frozen=True)
class FrameProgram:
    """One frame: its buffers and its passes in an order that is right when run one after another."""

    buffers: Mapping[str, Buffer]
    passes: tuple[Pass, ...]

    @classmethod
    def of(cls, buffers: list[Buffer], passes: list[Pass]) -> FrameProgram:
        """Build from lists; buffer names must be unique."""
        return cls({buffer.name: buffer for buffer in buffers}, tuple(passes))
