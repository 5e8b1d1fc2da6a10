"""Frames on a device: compile a frame program once, then submit it again and again without a host synchronisation."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from math import prod
from types import TracebackType
from typing import Any

import numpy as np

from ..errors import DeviceError, InputError
from . import hazards
from . import opencl as cl
from .device import Device
from .launch import Launched, driver_errors, launch
from .passes import Access, FrameProgram, Local, Mode, Param, Pass, Role

__all__ = ["Batch", "FrameRing", "Submission", "compile"]


@dataclass(frozen=True)
class Submission:
    """A frame on its way.

    Attributes
    ----------
    event : pyopencl.Event
        Complete when every pass is.
    launched : tuple of Launched
        Label and event of every pass, in order; empty unless the queue is profiling.
    batch : Batch
        Holds the outputs.
    """

    event: Any
    launched: tuple[Launched, ...]
    batch: Batch

    def wait(self) -> None:
        """Block until the frame is done.

        Raises
        ------
        DeviceError
            A pass failed on the device.
        """
        try:
            self.event.wait()
        except cl.Error as error:
            raise DeviceError(f"a frame failed on {self.batch.device.info.name}: {error}") from error


@dataclass(frozen=True)
class _Command:
    """One pass, ready to be enqueued."""

    kernel: Any
    global_size: tuple[int, ...]
    local_size: tuple[int, ...] | None
    waits: tuple[int, ...]
    label: str


def compile(
    program: FrameProgram, device: Device, params: Mapping[str, Any] | None = None, *, more: bool = False
) -> Batch:
    """Make a frame program ready to run: check, build, allocate, upload constants, set what never changes.

    Parameters
    ----------
    program : FrameProgram
    device : Device
        Has to stay open as long as the batch.
    params : mapping, optional
        Of the first frame, as for :meth:`Batch.submit`: what the device has not built before is built and run with them
        in a child process first (:mod:`cldof.host.trial`). Without them it is built here at once.
    more : bool
        More programs of the same frame are to be compiled: the child stays for them.

    Returns
    -------
    Batch

    Raises
    ------
    InputError
        The program cannot be run; names the pass.
    BuildError
        A kernel does not compile.
    DeviceError
        The device lacks the memory or the work-group size.
    DriverError
        The driver died in that child process, or cannot build.
    """
    hazards.check(program)
    if params is not None and device.trials is not None:
        device.trials.program(program, params, device, more)
    with driver_errors(f"a frame cannot be made ready on {device.info.name}"):
        return Batch(program, device)


class Batch:
    """A compiled frame with its buffers and kernel objects; made by :func:`compile`.

    It can be submitted again while an earlier submission still runs: on the device, the later one waits. For frames
    that overlap use a :class:`FrameRing`. Not thread-safe.

    Attributes
    ----------
    device : Device
    program : FrameProgram
    transient_bytes : int
        Memory of all transient buffers together, after sharing.
    """

    def __init__(self, program: FrameProgram, device: Device) -> None:
        self.device = device
        self.program = program
        assignment = hazards.assign(program)
        self.transient_bytes = sum(assignment.slot_bytes)
        self._owned: list[Any] = []
        self._in_flight: deque[tuple[Any, tuple[Any, ...]]] = deque()
        self._users: list[Any] = []
        self._last: Any = None
        self._closed = False
        self._bound: dict[str, Any] = {}
        self._input_uses: dict[str, list[tuple[Any, int]]] = {}
        self._params: dict[str, _Parameter] = {}
        try:
            slots = [self._acquire(nbytes) for nbytes in assignment.slot_bytes]
            self._buffers = {name: slots[slot] for name, slot in assignment.slot_of.items()}
            self._place_named(program)
            self._commands = self._prepare(program, assignment)
        except BaseException:
            self.close()
            raise
        self._sinks = hazards.sinks([command.waits for command in self._commands])

    def submit(
        self,
        inputs: Mapping[str, Any] | None = None,
        params: Mapping[str, Any] | None = None,
        wait_for: Sequence[Any] = (),
    ) -> Submission:
        """Enqueue one frame; returns at once.

        Parameters
        ----------
        inputs : mapping of str to pyopencl.Buffer
            One per INPUT buffer. They must hold still until the submission is complete; they are kept alive.
        params : mapping of str to value
            One per :class:`Param`: a number, a numpy scalar, a structured array of one element, or bytes.
        wait_for : sequence of pyopencl.Event
            What the frame waits for: uploads of its inputs, downloads of the outputs that it overwrites.

        Returns
        -------
        Submission

        Raises
        ------
        InputError
            An input or parameter is missing, unknown or of the wrong size, or the batch is closed.
        DeviceError
            The device refused a pass.
        """
        if self._closed:
            raise InputError("a frame was submitted to a batch that is closed")
        inputs = inputs if inputs is not None else {}
        with driver_errors(f"a frame cannot be started on {self.device.info.name}"):
            self._bind(inputs)
            self._set(params if params is not None else {})
            before = [*wait_for, *self._users]
            if self._last is not None and self.device.is_out_of_order:
                before.append(self._last)
            try:
                launched = self._enqueue(before)
                event = self._completion(launched)
                self.device.queue.flush()
                self._last = event
                self._users.clear()
                self._keep_until_done(event, tuple(inputs.values()))
            except BaseException:
                # Half a frame is on its way, and nothing else would wait for it.
                with suppress(cl.Error):
                    self.device.queue.finish()
                raise
        return Submission(event, tuple(launched) if self.device.is_profiling else (), self)

    def hold(self, event: Any) -> None:
        """Have the next submission wait for `event`, for instance a download of this frame's output.

        The memory, too, is not used for anything else before, should the batch be closed.
        """
        self._users.append(event)

    @property
    def is_idle(self) -> bool:
        """Whether the last submission, and everything held for, is over."""
        events = self._users if self._last is None else [self._last, *self._users]
        return all(event.command_execution_status <= _COMPLETE for event in events)

    def output(self, name: str) -> Any:
        """Buffer of an OUTPUT.

        Returns
        -------
        pyopencl.Buffer
            The same for every submission; at least as large as declared.
        """
        buffer = self.program.buffers.get(name)
        if buffer is None or buffer.role is not Role.OUTPUT:
            raise InputError(f"{name!r} is not an output of this frame; outputs are {self._names(Role.OUTPUT)}")
        return self._buffers[name]

    def close(self) -> None:
        """Give the memory back; work under way is not disturbed."""
        self._closed = True
        after = self._last
        if self._owned and self._users:
            uses = [event for event in (self._last, *self._users) if event is not None]
            after = launch(self.device.queue, "last use", cl.enqueue_marker, waits=uses).event
        for buffer in self._owned:
            self.device.pool.release(buffer, after)
        self._owned.clear()

    def __enter__(self) -> Batch:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def _acquire(self, nbytes: int) -> Any:
        buffer = self.device.pool.acquire(nbytes)
        self._owned.append(buffer)
        return buffer

    def _place_named(self, program: FrameProgram) -> None:
        """Allocate outputs; allocate and fill constants."""
        copies = []
        for name, buffer in program.buffers.items():
            if buffer.role is Role.INPUT:
                self._input_uses[name] = []
            elif buffer.role is Role.OUTPUT:
                self._buffers[name] = self._acquire(buffer.nbytes)
            elif buffer.role is Role.CONSTANT:
                self._buffers[name] = self._acquire(buffer.nbytes)
                copies.append(
                    launch(
                        self.device.queue,
                        f"constant {name}",
                        cl.enqueue_copy,
                        self._buffers[name],
                        buffer.data,
                        is_blocking=False,
                    ).event
                )
        if copies:
            cl.wait_for_events(copies)  # once per batch, so that no frame has to wait for them

    def _prepare(self, program: FrameProgram, assignment: hazards.Assignment) -> tuple[_Command, ...]:
        # Hazards are those of physical buffers: sharing memory makes conflicts between passes that share no name.
        physical = [
            {assignment.slot_of.get(name, name): mode for name, mode in hazards.uses(step).items()}
            for step in program.passes
        ]
        return tuple(
            _Command(self._kernel(step), step.global_size, step.local_size, waits, step.label)
            for step, waits in zip(program.passes, hazards.waits(physical), strict=True)
        )

    def _kernel(self, step: Pass) -> Any:
        """A kernel object of the pass's own, with every argument set that stays."""
        _check_limits(step, self.device)
        kernel = self.device.programs.kernel(step.source, step.kernel, step.defines)
        if kernel.num_args != len(step.args):
            raise InputError(
                f"pass {step.label!r} has {len(step.args)} arguments; kernel {step.kernel} takes {kernel.num_args}"
            )
        if self.device.check_signatures:
            check_signature(step, kernel)
        for index, argument in enumerate(step.args):
            match argument:
                case Access(buffer=name) if name in self._input_uses:
                    self._input_uses[name].append((kernel, index))
                case Access(buffer=name):
                    _set_argument(step, kernel, index, self._buffers[name])
                case Local(nbytes=nbytes):
                    _set_argument(step, kernel, index, cl.LocalMemory(nbytes))
                case Param(name=name, dtype=dtype):
                    self._params.setdefault(name, _Parameter(name, np.dtype(dtype))).uses.append((step, kernel, index))
                case _:
                    _set_argument(step, kernel, index, argument)
        return kernel

    def _bind(self, inputs: Mapping[str, Any]) -> None:
        if inputs.keys() != self._input_uses.keys():
            raise InputError(f"inputs given are {sorted(inputs)}; this frame takes {sorted(self._input_uses)}")
        for name, buffer in inputs.items():
            if self._bound.get(name) is buffer:
                continue
            needed = self.program.buffers[name].nbytes
            if buffer.size < needed:
                raise InputError(f"input {name!r} is bound to a buffer of {buffer.size} bytes; it needs {needed}")
            self._bound.pop(name, None)  # until all of its kernels have the new one
            for kernel, index in self._input_uses[name]:
                kernel.set_arg(index, buffer)
            self._bound[name] = buffer

    def _set(self, params: Mapping[str, Any]) -> None:
        if params.keys() != self._params.keys():
            raise InputError(f"parameters given are {sorted(params)}; this frame takes {sorted(self._params)}")
        for name, value in params.items():
            self._params[name].set(value)

    def _enqueue(self, before: list[Any]) -> list[Launched]:
        queue = self.device.queue
        out_of_order = self.device.is_out_of_order
        launched: list[Launched] = []
        for command in self._commands:
            if out_of_order:
                # A pass with no wait inside the frame is where the frame begins; all others come after one of those.
                waits = [launched[earlier].event for earlier in command.waits] or before
            else:
                waits = [] if launched else before
            launched.append(
                launch(
                    queue,
                    command.label,
                    cl.enqueue_nd_range_kernel,
                    command.kernel,
                    command.global_size,
                    command.local_size,
                    waits=waits,
                )
            )
        return launched

    def _completion(self, launched: list[Launched]) -> Any:
        """An event that is complete when all passes are."""
        if not self.device.is_out_of_order:
            return launched[-1].event
        ends = [launched[position].event for position in self._sinks]
        if len(ends) == 1:
            return ends[0]
        return launch(self.device.queue, "frame", cl.enqueue_marker, waits=ends).event

    def _keep_until_done(self, event: Any, inputs: tuple[Any, ...]) -> None:
        # An input may wrap the caller's array, which must outlive the commands that read it, and rebinding would let
        # go of it. Asking for an event's status does not block.
        while self._in_flight and self._in_flight[0][0].command_execution_status <= _COMPLETE:
            self._in_flight.popleft()
        self._in_flight.append((event, inputs))

    def _names(self, role: Role) -> list[str]:
        return sorted(name for name, buffer in self.program.buffers.items() if buffer.role is role)


class FrameRing:
    """Several batches of one frame program, so that frames can overlap.

    Each has transients and outputs of its own and is made when it is first needed: frames that never overlap share one.
    When all are busy the new frame waits for the one that was started longest ago, on the device and not on the host.

    Parameters
    ----------
    program : FrameProgram
    device : Device
    slots : int
        The most frames in flight.
    params : mapping, optional
        Of the first frame; see :func:`compile`.

    Attributes
    ----------
    program : FrameProgram
    """

    def __init__(
        self, program: FrameProgram, device: Device, slots: int = 2, params: Mapping[str, Any] | None = None
    ) -> None:
        if slots < 1:
            raise InputError(f"a frame ring of {slots} slots was asked for; it needs at least 1")
        self._slots = slots
        self.program = program
        # In the order of their last submission.
        self.batches: deque[Batch] = deque([compile(program, device, params)])

    def submit(
        self,
        inputs: Mapping[str, Any] | None = None,
        params: Mapping[str, Any] | None = None,
        wait_for: Sequence[Any] = (),
    ) -> Submission:
        """As :meth:`Batch.submit`, on a free batch; its outputs are ``submission.batch.output(name)``."""
        batch = next((batch for batch in self.batches if batch.is_idle), None)
        if batch is None and len(self.batches) < self._slots:
            batch = compile(self.program, self.batches[0].device)
            self.batches.append(batch)
        batch = batch or self.batches[0]
        self.batches.remove(batch)
        self.batches.append(batch)
        return batch.submit(inputs, params, wait_for)

    def close(self) -> None:
        """Give the memory back; work under way is not disturbed."""
        for batch in self.batches:
            batch.close()

    def __enter__(self) -> FrameRing:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()


def check_signature(step: Pass, kernel: Any) -> None:
    """Compare a pass with the kernel's argument list, as far as the driver tells it.

    A ``read`` must be a ``const`` pointer and a ``write`` must not be: a pass that says it reads what its kernel writes
    would run without the waits it needs. Scalars must have the declared type, since a float's bits in an int argument
    go unnoticed.

    Raises
    ------
    InputError
        Names pass, argument, and both sides.
    """
    info = cl.kernel_arg_info
    for index, argument in enumerate(step.args):
        try:
            space = kernel.get_arg_info(index, info.ADDRESS_QUALIFIER)
            type_name = kernel.get_arg_info(index, info.TYPE_NAME)
            is_const = bool(kernel.get_arg_info(index, info.TYPE_QUALIFIER) & cl.kernel_arg_type_qualifier.CONST)
            name = kernel.get_arg_info(index, info.NAME)
        except cl.Error:  # a program from a binary may not have it
            return
        spaces = cl.kernel_arg_address_qualifier
        match argument:
            case Access(mode=mode):
                fits = space in (spaces.GLOBAL, spaces.CONSTANT)
                fits = fits and (space == spaces.CONSTANT or is_const) == (mode is Mode.READ)
            case Local():
                fits = space == spaces.LOCAL
            case _:
                dtype = np.dtype(argument.dtype)
                fits = space == spaces.PRIVATE and _SCALAR_TYPES.get(type_name, dtype) == dtype
        if not fits:
            kind = " ".join((*(("const",) if is_const else ()), type_name))
            raise InputError(
                f"pass {step.label!r}, argument {index} ({name}): the pass declares {argument}, the kernel takes {kind}"
            )


_COMPLETE = 0  # CL_COMPLETE; less than that is a failed command, which is over as well

# Other names, structs above all, are not compared.
_SCALAR_TYPES = {
    "float": np.dtype(np.float32),
    "int": np.dtype(np.int32),
    "uint": np.dtype(np.uint32),
    "unsigned int": np.dtype(np.uint32),
    "long": np.dtype(np.int64),
    "ulong": np.dtype(np.uint64),
    "unsigned long": np.dtype(np.uint64),
    "double": np.dtype(np.float64),
}


class _Parameter:
    """A value that comes with each submission and the kernel arguments that it goes to."""

    def __init__(self, name: str, dtype: np.dtype[Any]) -> None:
        self.name = name
        self.dtype = dtype
        self.uses: list[tuple[Pass, Any, int]] = []
        self._bytes = b""

    def set(self, value: Any) -> None:
        """Set the arguments, unless they are set to the same bytes already."""
        data = self._encoded(value)
        if data == self._bytes:
            return
        self._bytes = b""  # until all kernels have the new value
        for step, kernel, index in self.uses:
            _set_argument(step, kernel, index, data)
        self._bytes = data

    def _encoded(self, value: Any) -> bytes:
        dtype = self.dtype
        if isinstance(value, bytes) and len(value) == dtype.itemsize:
            return value
        if isinstance(value, np.generic | np.ndarray) and value.dtype == dtype and value.size == 1:
            return bytes(value.data)
        is_whole = isinstance(value, int | np.integer)
        if (dtype.kind in "iu" and is_whole) or (
            dtype.kind == "f" and (is_whole or isinstance(value, float | np.floating))
        ):
            with suppress(OverflowError):
                return bytes(np.array(int(value) if is_whole else value, dtype).data)
        raise InputError(f"parameter {self.name!r} cannot be {value!r}: it takes {dtype}")


def _set_argument(step: Pass, kernel: Any, index: int, value: Any) -> None:
    try:
        if isinstance(value, bytes | np.generic):
            # set_arg would try every other kind of argument first, which takes 6 us instead of 0.1.
            kernel._set_arg_buf(index, value)
        else:
            kernel.set_arg(index, value)
    except cl.Error as error:
        raise InputError(
            f"pass {step.label!r}: argument {index} of kernel {step.kernel} cannot be {value!r}: {error}"
        ) from error


def _check_limits(step: Pass, device: Device) -> None:
    local_bytes = sum(argument.nbytes for argument in step.args if isinstance(argument, Local))
    if local_bytes > device.traits.local_mem_bytes:
        raise DeviceError(
            f"pass {step.label!r} wants {local_bytes} bytes of local memory; {device.info.name} has "
            f"{device.traits.local_mem_bytes}"
        )
    if step.local_size is not None and prod(step.local_size) > device.traits.max_work_group_size:
        raise DeviceError(
            f"pass {step.label!r} wants work-groups of {prod(step.local_size)}; {device.info.name} runs up to "
            f"{device.traits.max_work_group_size}"
        )
