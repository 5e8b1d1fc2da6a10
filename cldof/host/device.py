"""Devices: listing, choosing, opening, or taking the caller's; and what may be relied on once one is open."""

from __future__ import annotations

import os
import shutil
import warnings
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from functools import cached_property
from importlib.resources import files
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import BuildError, DeviceError, DriverError, DriverWarning
from . import opencl as cl
from .buffers import BufferPool
from .drivers import driver_advice
from .lanes import LANES, PROBE_SOURCE, lanes_for
from .launch import launch
from .program import ProgramCache, SourceDirectory
from .quirks import Effect, effects_of
from .trial import Trials, is_wanted

__all__ = ["Device", "DeviceInfo", "Traits", "list_devices"]

ENVIRONMENT_VARIABLE = "CLDOF_DEVICE"

# Larger groups gain nothing on CPUs, where one work-item's data should stay in registers, nor on GPUs, where 256
# keeps several groups on one compute unit.
_PREFERRED_GROUP_LIMIT = 256

_PROBE_SOURCE = """
__kernel void probe(__global uint *out, __local uint *tile)
{
    uint i = get_local_id(0), n = get_local_size(0);
    tile[i] = i;
    barrier(CLK_LOCAL_MEM_FENCE);
    out[i] = tile[n - 1u - i];
}
"""

# Items compete for four places; which of them wins depends on both words of the keys.
_INT64_EXTENSION = "cl_khr_int64_extended_atomics"
_INT64_SOURCE = f"""
#pragma OPENCL EXTENSION {_INT64_EXTENSION} : enable
__kernel void probe(__global ulong *out)
{{
    uint i = get_global_id(0);
    ulong key = (ulong)(0xfffffff0u - (i >> 4)) << 32 | (i * 2654435761u);
    atom_min(out + (i & 3u), key);
}}
"""
_INT64_ITEMS = 1024

# More turns than Mesa's llvmpipe gives all loops of a work-item together, which is 65535; then it leaves them silently.
_LOOP_TURNS = 1 << 18
_LOOP_SOURCE = """
__kernel void probe(__global uint *out, uint turns)
{
    uint sum = 0u;
    for (uint i = 0u; i < turns; i++) sum += out[1u + (i & 1u)];
    out[0] = sum;
}
"""


@dataclass(frozen=True)
class DeviceInfo:
    """What a driver says about a device, without opening it.

    Attributes
    ----------
    index : int
        Position in :func:`list_devices`.
    name, platform, driver_version : str
    platform_version, device_version : str
        What of OpenCL they speak, and as a rule what the driver compiles for.
    kind : str
        ``"cpu"``, ``"gpu"`` or ``"other"``.
    compute_units : int
    global_mem_bytes : int
    """

    index: int
    name: str
    platform: str
    driver_version: str
    kind: str
    compute_units: int
    global_mem_bytes: int
    platform_version: str = ""
    device_version: str = ""

    @property
    def identity(self) -> tuple[str, ...]:
        """What stays the same from process to process; a driver may tell of less memory when there is less."""
        return self.platform, self.platform_version, self.name, self.device_version, self.driver_version

    def __str__(self) -> str:
        return f"{self.index}: {self.name} ({self.kind}, {self.platform}, driver {self.driver_version})"


@dataclass(frozen=True)
class Traits:
    """What code may branch on. Sizes are in bytes.

    Attributes
    ----------
    is_cpu : bool
    name, platform, driver_version : str
    compute_units : int
    global_mem_bytes, max_alloc_bytes, local_mem_bytes : int
    max_work_group_size : int
        Found by running a kernel with a barrier, not what the driver says.
    preferred_group_limit : int
        Work-group size above which nothing is gained.
    host_unified_memory : bool
        Host arrays can be used in place.
    supports_out_of_order : bool
        A queue may run commands in any order that events allow.
    has_int64_atomics : bool
        ``atom_min`` on ulong works: claimed, built and run with the right result.
    has_long_loops : bool
        The loops of a work-item may take more than 65535 turns. Found by running one that does.
    lanes : int
        Floats that a work-item of the kernels computes with at a time; see :mod:`cldof.host.lanes`.
    """

    is_cpu: bool
    name: str
    platform: str
    driver_version: str
    compute_units: int
    global_mem_bytes: int
    max_alloc_bytes: int
    local_mem_bytes: int
    max_work_group_size: int
    preferred_group_limit: int
    host_unified_memory: bool
    supports_out_of_order: bool
    has_int64_atomics: bool
    has_long_loops: bool
    lanes: int


def list_devices() -> list[DeviceInfo]:
    """Every OpenCL device of this machine, in the drivers' order; empty when there is none.

    Raises
    ------
    DeviceError
        pyopencl is not installed.
    """
    return [_info(index, device) for index, device in enumerate(_devices())]


class Device:
    """A context and a queue on one device, with the programs and the memory that belong to them.

    Make one with :meth:`open`, or with :meth:`adopt` from objects of the caller's. Use it as a context manager or call
    :meth:`close`. Not thread-safe: one per thread.

    Attributes
    ----------
    context : pyopencl.Context
    queue : pyopencl.CommandQueue
    info : DeviceInfo
        Its index is -1 for an adopted device.
    programs : ProgramCache
    pool : BufferPool
    is_out_of_order, is_profiling : bool
        How the queue was made.
    check_signatures : bool
        Whether passes are checked against the kernels' argument lists when a frame is compiled. Meant for tests: it
        relies on what drivers say about arguments, and does without binaries from disk, which say nothing.
    trials : Trials or None
        Tries in a child process what was never built and run on this device; None builds everything here at once.
    """

    def __init__(
        self,
        context: Any,
        queue: Any,
        *,
        index: int = -1,
        owned: bool = True,
        sources: SourceDirectory | None = None,
        check_signatures: bool = False,
        lanes: int | None = None,
        trials: Trials | None = None,
    ) -> None:
        if lanes is not None and lanes not in LANES:
            raise DeviceError(f"kernels can be built for {', '.join(map(str, LANES))} lanes, not for {lanes!r}")
        self.context = context
        self.queue = queue
        self.check_signatures = check_signatures
        self._owned = owned
        self._cl_device = queue.device
        self.info = _info(index, self._cl_device)
        self.trials = trials
        properties = queue.properties
        self.is_out_of_order = bool(properties & cl.command_queue_properties.OUT_OF_ORDER_EXEC_MODE_ENABLE)
        self.is_profiling = bool(properties & cl.command_queue_properties.PROFILING_ENABLE)
        self.pool = BufferPool(context, queue, shares_memory=_shares_memory(self._cl_device))
        self._lanes = lanes
        self.programs = ProgramCache(
            context,
            self._cl_device,
            sources or files("cldof.kernels"),
            defines=lambda: (("LANES", self.lanes),),
            from_source=check_signatures,
        )

    @classmethod
    def open(
        cls,
        choice: int | str | None = None,
        *,
        besides: Collection[int] = (),
        profiling: bool = False,
        out_of_order: bool = False,
        sources: SourceDirectory | None = None,
        check_signatures: bool = False,
        lanes: int | None = None,
    ) -> Device:
        """Open a device.

        Parameters
        ----------
        choice : int or str, optional
            An index of :func:`list_devices`, ``"cpu"``, ``"gpu"``, or part of a device's or platform's name in any
            case. None looks at the environment variable ``CLDOF_DEVICE`` and else takes a GPU, or a CPU if there is
            none. Where that leaves a choice, and what would be taken does not work, the next one is taken, with a
            :class:`~cldof.errors.DriverWarning`.
        besides : collection of int
            Indices of devices that are out of the question.
        profiling : bool
            Have the queue measure every command.
        out_of_order : bool
            Ask for an out-of-order queue; a device without one gets an in-order queue.
        sources : SourceDirectory, optional
            Kernel files other than the library's own.
        check_signatures : bool
            See the attribute.
        lanes : int, optional
            Build kernels for that width in place of the one that suits the device: 4, 8 or 16.

        Raises
        ------
        DeviceError
            There is no such device, or none that works; lists those that there are.
        DriverError
            The driver of the only one died, or cannot build for this processor.
        """
        devices = _devices()
        infos = [_info(index, device) for index, device in enumerate(devices)]
        choice = choice if choice is not None else os.environ.get(ENVIRONMENT_VARIABLE) or None
        candidates = [index for index in _candidates(infos, choice) if index not in besides]
        failed: list[DeviceError] = []
        for index in candidates:
            try:
                trials = _trials(infos[index])
                context, queue = _open(devices[index], infos[index], profiling, out_of_order)
            except DeviceError as error:
                failed.append(error)
                continue
            if failed:
                _warn_of(failed[0], infos[index])
            return cls(
                context,
                queue,
                index=index,
                sources=sources,
                check_signatures=check_signatures,
                lanes=lanes,
                trials=trials,
            )
        if not failed:
            raise DeviceError("no other OpenCL device is there to be taken in place of the one that failed")
        if len(failed) > 1:
            kind = DriverError if all(isinstance(error, DriverError) for error in failed) else DeviceError
            raise kind(f"no OpenCL device works here. {' Then: '.join(map(str, failed))}") from failed[0]
        raise failed[0]

    @classmethod
    def adopt(
        cls,
        *,
        context: Any = None,
        queue: Any = None,
        sources: SourceDirectory | None = None,
        check_signatures: bool = False,
    ) -> Device:
        """Work in the caller's context, on the caller's queue or one of our own.

        Parameters
        ----------
        context : pyopencl.Context, optional
            Its first device is used. Not needed with `queue`.
        queue : pyopencl.CommandQueue, optional
            Stays the caller's: :meth:`close` leaves it alone.
        sources, check_signatures
            As in :meth:`open`.
        """
        if queue is None and context is None:
            raise DeviceError("Device.adopt needs a pyopencl Context or CommandQueue; Device.open makes its own")
        if queue is not None:
            if context is not None and queue.context != context:
                raise DeviceError("the queue given to Device.adopt belongs to another context than the one given")
            return cls(
                queue.context,
                queue,
                owned=False,
                sources=sources,
                check_signatures=check_signatures,
                trials=_trials_of_adopted(queue.device),
            )
        queue = _new_queue(context, context.devices[0], profiling=False, out_of_order=False)
        trials = _trials_of_adopted(context.devices[0])
        return cls(context, queue, sources=sources, check_signatures=check_signatures, trials=trials)

    @cached_property
    def traits(self) -> Traits:
        """What code may branch on."""
        device = self._cl_device
        return Traits(
            is_cpu=self.info.kind == "cpu",
            name=self.info.name,
            platform=self.info.platform,
            driver_version=self.info.driver_version,
            compute_units=device.max_compute_units,
            global_mem_bytes=device.global_mem_size,
            max_alloc_bytes=device.max_mem_alloc_size,
            local_mem_bytes=device.local_mem_size,
            max_work_group_size=self.found["max_work_group_size"],
            preferred_group_limit=min(self.found["max_work_group_size"], _PREFERRED_GROUP_LIMIT),
            host_unified_memory=self.pool.shares_memory,
            supports_out_of_order=_supports_out_of_order(device),
            has_int64_atomics=self.found["has_int64_atomics"],
            has_long_loops=self.found["has_long_loops"],
            lanes=self.lanes,
        )

    @cached_property
    def found(self) -> dict[str, Any]:
        """Traits that take tiny kernels to find; those of the child that tried the device, if one did."""
        known = {} if self.trials is None else self.trials.found
        probes: dict[str, Callable[[], Any]] = {
            "max_work_group_size": self._usable_group_size,
            "has_int64_atomics": self._int64_atomics_work,
            "has_long_loops": self._long_loops_work,
            "compiled_width": lambda: self.compiled_width,
        }
        return {name: known[name] if name in known else probe() for name, probe in probes.items()}

    @cached_property
    def compiled_width(self) -> int:
        """Floats in a register of the processor that the driver compiles for; 0 where it does not say."""
        if self.trials is not None and "compiled_width" in self.trials.found:
            return int(self.trials.found["compiled_width"])
        found = self._probed(PROBE_SOURCE, np.zeros(1, np.uint32), 1) if self.info.kind == "cpu" else None
        return 0 if found is None else int(found[0])

    @cached_property
    def lanes(self) -> int:
        """Floats that a work-item computes with at a time."""
        if self._lanes is not None:
            return self._lanes
        native = self._cl_device.native_vector_width_float
        return lanes_for(self.info.kind == "cpu", self.compiled_width, native)

    def finish(self) -> None:
        """Block until everything enqueued is done."""
        try:
            self.queue.finish()
        except cl.Error as error:
            raise DeviceError(f"{self.info.name} failed while working: {error}") from error

    def close(self) -> None:
        """Release memory and programs; the queue and the context too, unless they are the caller's."""
        try:
            if self._owned:
                self.finish()
        finally:
            if self.trials is not None:
                self.trials.close()
            self.pool.close()
            self.programs.clear()

    def __enter__(self) -> Device:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def _probe(self, source: str) -> Any:
        """The kernel of a probe."""
        program = cl._cl._Program(self.context, source)
        try:
            program._build(options=b"", devices=[self._cl_device])
        except cl.Error as error:
            log = program.get_build_info(self._cl_device, cl.program_build_info.LOG).strip()
            raise BuildError(f"{self.info.name} cannot compile the smallest kernel: {log or error}") from error
        return cl.Kernel(program, "probe")

    def _int64_atomics_work(self) -> bool:
        """Whether atomic minima on 64 bits are claimed, compile, and are right when many compete for one place."""
        if _INT64_EXTENSION not in self._cl_device.extensions.split():
            return False
        item = np.arange(_INT64_ITEMS, dtype=np.uint64)
        low = item * np.uint64(2654435761) & np.uint64(0xFFFFFFFF)
        keys = (np.uint64(0xFFFFFFF0) - (item >> np.uint64(4))) << np.uint64(32) | low
        found = self._probed(_INT64_SOURCE, np.full(4, ~np.uint64(0)), _INT64_ITEMS)
        return found is not None and bool((found == keys.reshape(-1, 4).min(axis=0)).all())

    def _long_loops_work(self) -> bool:
        found = self._probed(_LOOP_SOURCE, np.array([0, 1, 1], np.uint32), 1, np.uint32(_LOOP_TURNS))
        return found is not None and int(found[0]) == _LOOP_TURNS

    def _probed(self, source: str, start: NDArray[Any], items: int, *scalars: Any) -> NDArray[Any] | None:
        """What a probe makes of its buffer; None if the driver cannot run it."""
        try:
            kernel = self._probe(source)
            buffer = self.pool.acquire(start.nbytes)
        except (DeviceError, cl.Error):
            return None
        try:
            written = launch(self.queue, "probe", cl.enqueue_copy, buffer, start).event
            kernel.set_args(buffer, *scalars)
            done = launch(self.queue, "probe", cl.enqueue_nd_range_kernel, kernel, (items,), None, waits=[written])
            return self.pool.to_host(buffer, start.shape, start.dtype, waits=[done.event])
        except (DeviceError, cl.Error):
            return None
        finally:
            self.pool.release(buffer)

    def _usable_group_size(self) -> int:
        """Halve the driver's claim until a kernel with a barrier gives the right answer."""
        kernel = self._probe(_PROBE_SOURCE)
        size: int = self._cl_device.max_work_group_size
        while size > 1:
            if self._group_works(kernel, size):
                return size
            size //= 2
        return 1

    def _group_works(self, kernel: Any, size: int) -> bool:
        buffer = self.pool.acquire(4 * size)
        try:
            kernel.set_arg(0, buffer)
            kernel.set_arg(1, cl.LocalMemory(4 * size))
            done = launch(self.queue, "probe", cl.enqueue_nd_range_kernel, kernel, (size,), (size,)).event
            found = self.pool.to_host(buffer, (size,), np.uint32, waits=[done])
            return bool((found == np.arange(size, dtype=np.uint32)[::-1]).all())
        except (DeviceError, cl.Error):
            return False
        finally:
            self.pool.release(buffer)


def _devices() -> list[Any]:
    try:
        platforms = cl.get_platforms()
    except cl.Error:  # the loader found no driver
        return []
    devices = []
    for platform in platforms:
        try:
            devices += platform.get_devices()
        except cl.Error:  # a driver without its device, for instance a GPU driver on a machine without the GPU
            continue
    return devices


def _info(index: int, device: Any) -> DeviceInfo:
    kinds = cl.device_type
    kind = "gpu" if device.type & kinds.GPU else "cpu" if device.type & kinds.CPU else "other"
    return DeviceInfo(
        index=index,
        name=" ".join(device.name.split()),
        platform=" ".join(device.platform.name.split()),
        driver_version=device.driver_version,
        kind=kind,
        compute_units=device.max_compute_units,
        global_mem_bytes=device.global_mem_size,
        platform_version=device.platform.version,
        device_version=device.version,
    )


def _open(device: Any, info: DeviceInfo, profiling: bool, out_of_order: bool) -> tuple[Any, Any]:
    """A context and a queue."""
    if Effect.NEEDS_LINKER in effects_of(info.platform, info.name) and shutil.which("ld") is None:
        raise DeviceError(
            f"device {info} links kernels with the system linker `ld`, which is not on the PATH. Install it (Debian "
            "and Ubuntu: apt-get install gcc libc6-dev)."
        )
    try:
        context = cl.Context([device])
        return context, _new_queue(context, device, profiling, out_of_order)
    except cl.Error as error:
        raise DeviceError(f"device {info} cannot be opened: {error}. Choose another one.") from error


def _trials(info: DeviceInfo) -> Trials | None:
    """Trials of a device, after the first one; None where there are to be none."""
    if not is_wanted():
        return None
    trials = Trials(info)
    trials.device()
    return trials


def _trials_of_adopted(device: Any) -> Trials | None:
    """The same for a device that the caller has opened, if a child can find it."""
    adopted = _info(-1, device)
    for info in list_devices():
        if info.identity == adopted.identity:
            return _trials(info)
    return None


def _warn_of(error: DeviceError, taken: DeviceInfo) -> None:
    warnings.warn(f"{error} Device {taken} was taken in its place.", DriverWarning, stacklevel=4)


def _candidates(infos: Sequence[DeviceInfo], choice: int | str | None) -> list[int]:
    """Indices of the devices that a choice may mean, the best first; pure, so that it can be tested without devices."""
    if not infos:
        raise DeviceError(
            f"no OpenCL device was found. Any driver will do: a GPU's own, or for the CPU {driver_advice()}."
        )
    if isinstance(choice, str) and choice.strip().lstrip("-").isdigit():
        choice = int(choice)
    if choice is None:
        matching = list(infos)
    elif isinstance(choice, int):
        matching = [info for info in infos if info.index == choice]
    elif choice.lower() in ("cpu", "gpu"):
        matching = [info for info in infos if info.kind == choice.lower()]
    else:
        part = choice.lower()
        matching = [info for info in infos if part in info.name.lower() or part in info.platform.lower()]
    if not matching:
        raise DeviceError(
            f"no OpenCL device matches {choice!r}. There is: {'; '.join(map(str, infos))}. Choose by index, by part "
            f"of a name, 'cpu' or 'gpu', in the call or in the environment variable {ENVIRONMENT_VARIABLE}."
        )
    return [info.index for info in sorted(matching, key=_preference)]


def _preference(info: DeviceInfo) -> tuple[bool, bool, int]:
    """Sorts the better device first: no last resorts, GPUs before others, then the drivers' order."""
    return Effect.LAST_RESORT in effects_of(info.platform, info.name), info.kind != "gpu", info.index


def _new_queue(context: Any, device: Any, profiling: bool, out_of_order: bool) -> Any:
    wanted = cl.command_queue_properties
    properties = 0
    if profiling:
        properties |= wanted.PROFILING_ENABLE
    if out_of_order and _supports_out_of_order(device):
        properties |= wanted.OUT_OF_ORDER_EXEC_MODE_ENABLE
    return cl.CommandQueue(context, device, properties=properties)


def _supports_out_of_order(device: Any) -> bool:
    return bool(device.queue_properties & cl.command_queue_properties.OUT_OF_ORDER_EXEC_MODE_ENABLE)


def _shares_memory(device: Any) -> bool:
    # Every CPU device does, whatever the driver says of a query that OpenCL 2.0 deprecated.
    return bool(device.type & cl.device_type.CPU) or bool(device.host_unified_memory)
