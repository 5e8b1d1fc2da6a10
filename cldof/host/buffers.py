"""Device memory: a pool with accounting, and the way of host arrays to the device and back.

On devices that share the host's memory an input array is wrapped where it lies and a result can be looked at where it
lies; on others both are copies.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from ..errors import DeviceError, InputError
from . import opencl as cl
from .launch import launch

__all__ = ["BufferPool", "HostInput", "size_class"]

_SMALLEST = 256
_MIB = 1024 * 1024


def size_class(nbytes: int) -> int:
    """Bytes that the pool allocates for a request: the next of eight steps per power of two, at most 1/8 too much."""
    if nbytes <= _SMALLEST:
        return _SMALLEST
    step = 1 << max((nbytes - 1).bit_length() - 4, 0)
    return -(-nbytes // step) * step


@dataclass(frozen=True)
class HostInput:
    """A host array that kernels can read.

    Attributes
    ----------
    buffer : pyopencl.Buffer
    waits : tuple of pyopencl.Event
        What a reader waits for; empty when nothing had to be copied.
    array : ndarray
        Keeps the host memory alive; it must not be written to before the readers are done.
    pooled : bool
        Whether the buffer goes back to the pool.
    """

    buffer: Any
    waits: tuple[Any, ...]
    array: NDArray[Any]
    pooled: bool


class BufferPool:
    """Allocates device buffers of one context, keeps freed ones for the next request, and counts bytes.

    Parameters
    ----------
    context : pyopencl.Context
    queue : pyopencl.CommandQueue
        For copies between host and device.
    shares_memory : bool
        Whether host pointers can be used in place.

    Attributes
    ----------
    allocated_bytes : int
        Held on the device now, in use or kept for reuse.
    in_use_bytes : int
        Handed out now.
    peak_bytes : int
        The most that was ever held.

    Notes
    -----
    Not thread-safe, like the queue that it serves. Wrapped host arrays are the caller's memory and not counted.
    """

    def __init__(self, context: Any, queue: Any, *, shares_memory: bool) -> None:
        self._context = context
        self._queue = queue
        self.shares_memory = shares_memory
        self._free: defaultdict[int, list[tuple[Any, Any]]] = defaultdict(list)  # size -> (buffer, last use)
        self._in_use: dict[int, Any] = {}  # address of the OpenCL object -> buffer
        self._closed = False
        self.allocated_bytes = 0
        self.in_use_bytes = 0
        self.peak_bytes = 0

    def acquire(self, nbytes: int) -> Any:
        """Hand out a buffer of at least `nbytes` with undefined contents.

        Returns
        -------
        pyopencl.Buffer

        Raises
        ------
        DeviceError
            When the device cannot give that much; says how much was asked and how much is held.
        """
        if self._closed:
            raise DeviceError("a buffer was asked for after its device was closed")
        if nbytes <= 0:
            raise InputError(f"a device buffer of {nbytes} bytes was asked for; it takes at least 1")
        size = size_class(nbytes)
        buffer = self._reuse(size)
        if buffer is None:
            buffer = self._allocate(size)
        self._in_use[buffer.int_ptr] = buffer
        self.in_use_bytes += buffer.size
        return buffer

    def release(self, buffer: Any, after: Any = None) -> None:
        """Take a buffer back.

        Parameters
        ----------
        buffer : pyopencl.Buffer
            From :meth:`acquire`.
        after : pyopencl.Event, optional
            Its last use; it is not handed out again before that is complete.

        Notes
        -----
        Nothing happens when the pool is closed: its owner may close it before those who hold buffers.
        """
        if self._closed:
            return
        if self._in_use.pop(buffer.int_ptr, None) is None:
            raise InputError("a buffer was released to a pool that had not handed it out, or released twice")
        self.in_use_bytes -= buffer.size
        self._free[buffer.size].append((buffer, after))

    def trim(self) -> None:
        """Give the buffers kept for reuse back to the driver."""
        for kept in self._free.values():
            for buffer, _ in kept:
                self.allocated_bytes -= buffer.size
                buffer.release()  # the driver keeps the memory until enqueued commands are done with it
        self._free.clear()

    def clear(self) -> None:
        """Release every buffer, handed out or not. Those who hold one must not use it, nor give it back."""
        self.trim()
        for buffer in self._in_use.values():
            buffer.release()
        self._in_use.clear()
        self.allocated_bytes = self.in_use_bytes = 0

    def close(self) -> None:
        """As :meth:`clear`, and no buffer is handed out any more."""
        self.clear()
        self._closed = True

    def to_device(self, array: NDArray[Any], label: str = "upload", waits: Sequence[Any] = ()) -> HostInput:
        """Make a host array readable by kernels: in place where memory is shared, by an unhurried copy elsewhere.

        Parameters
        ----------
        array : ndarray
            C-contiguous; must neither be written to nor freed while kernels read it. The result holds it.
        label : str
            Name of the copy in profiles.
        waits : sequence of pyopencl.Event
            What the copy waits for.

        Returns
        -------
        HostInput
            Give it to :meth:`free_input` when its last reader is enqueued.
        """
        if not array.flags.c_contiguous or array.nbytes == 0:
            raise InputError(f"{label}: an array of shape {array.shape} must be C-contiguous and not empty")
        if self.shares_memory:
            flags = cl.mem_flags.READ_ONLY | cl.mem_flags.USE_HOST_PTR
            try:
                return HostInput(cl.Buffer(self._context, flags, hostbuf=array), (), array, pooled=False)
            except cl.Error as error:
                raise self._refused(array.nbytes, error) from error
        buffer = self.acquire(array.nbytes)
        copy = launch(self._queue, label, cl.enqueue_copy, buffer, array, waits=waits, is_blocking=False)
        return HostInput(buffer, (copy.event,), array, pooled=True)

    def free_input(self, host_input: HostInput, after: Any = None) -> None:
        """Give back what :meth:`to_device` made; `after` is the last use."""
        if host_input.pooled:
            self.release(host_input.buffer, after)

    def to_host(self, buffer: Any, shape: tuple[int, ...], dtype: DTypeLike, waits: Sequence[Any] = ()) -> NDArray[Any]:
        """Copy the start of a buffer to a new host array; blocks until it is there.

        Returns
        -------
        ndarray
            Of that shape and dtype, owned by the caller.
        """
        out = np.empty(shape, dtype)
        if self.shares_memory:
            with self.mapped(buffer, shape, dtype, waits) as view:
                out[...] = view
        else:
            launch(self._queue, "download", cl.enqueue_copy, out, buffer, waits=waits, is_blocking=True)
        return out

    def download(self, buffer: Any, out: NDArray[Any], waits: Sequence[Any] = ()) -> Any:
        """Start copying the start of a buffer into a host array.

        Returns
        -------
        pyopencl.Event
            Complete when `out` is filled; until then it must be kept and not be touched.
        """
        return launch(self._queue, "download", cl.enqueue_copy, out, buffer, waits=waits, is_blocking=False).event

    @contextmanager
    def mapped(
        self, buffer: Any, shape: tuple[int, ...], dtype: DTypeLike, waits: Sequence[Any] = ()
    ) -> Iterator[NDArray[Any]]:
        """Look at the start of a buffer from the host, without a copy where memory is shared; blocks at first.

        Yields
        ------
        ndarray
            Read-only by agreement; invalid after the block.
        """
        mapping: Any = None

        def map_buffer(queue: Any, wait_for: Any) -> Any:
            nonlocal mapping
            mapping, event = cl.enqueue_map_buffer(
                queue, buffer, cl.map_flags.READ, 0, shape, np.dtype(dtype), wait_for=wait_for, is_blocking=True
            )
            return event

        launch(self._queue, "map", map_buffer, waits=waits)
        try:
            yield mapping
        finally:
            # Waited for, so that whoever uses the buffer next need not know that it was looked at.
            launch(self._queue, "unmap", mapping.base.release).event.wait()

    def _reuse(self, size: int) -> Any:
        kept = self._free[size]
        for position, (buffer, after) in enumerate(kept):
            # Below "complete" are the failed ones, which are over as well.
            if after is None or after.command_execution_status <= cl.command_execution_status.COMPLETE:
                del kept[position]
                return buffer
        return None

    def _allocate(self, size: int) -> Any:
        device = self._queue.device
        # Asked first, because some drivers accept any size and fail at the first kernel.
        if size > device.max_mem_alloc_size:
            raise self._refused(size, f"one allocation on {device.name} can have {_mib(device.max_mem_alloc_size)}")
        try:
            buffer = cl.Buffer(self._context, cl.mem_flags.READ_WRITE, size)
        except cl.Error:
            self.trim()
            try:
                buffer = cl.Buffer(self._context, cl.mem_flags.READ_WRITE, size)
            except cl.Error as error:
                raise self._refused(size, error) from error
        self.allocated_bytes += size
        self.peak_bytes = max(self.peak_bytes, self.allocated_bytes)
        return buffer

    def _refused(self, nbytes: int, reason: object) -> DeviceError:
        return DeviceError(
            f"no device memory for {_mib(nbytes)} more: {reason}. Held: {_mib(self.allocated_bytes)}, of which "
            f"{_mib(self.in_use_bytes)} in {len(self._in_use)} buffers in use; the device has "
            f"{_mib(self._queue.device.global_mem_size)}. Use a smaller frame, fewer layers or fewer frames in flight."
        )


def _mib(nbytes: int) -> str:
    return f"{nbytes / _MIB:.1f} MiB"
