"""The one function through which every command reaches a queue."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple

from ..errors import DeviceError
from . import opencl as cl

__all__ = ["Launched", "driver_errors", "launch"]


class Launched(NamedTuple):
    """An enqueued command: its label in profiles and error messages, and its event."""

    label: str
    event: Any


@contextmanager
def driver_errors(what: str) -> Iterator[None]:
    """Whatever the driver raises inside the block is a :class:`~cldof.DeviceError` that begins with `what`."""
    try:
        yield
    except cl.Error as error:
        raise DeviceError(f"{what}: {error}. The device may have run out of memory or be lost.") from error


def launch(
    queue: Any, label: str, enqueue: Callable[..., Any], *args: Any, waits: Sequence[Any] = (), **options: Any
) -> Launched:
    """Enqueue one command.

    Parameters
    ----------
    queue : pyopencl.CommandQueue
    label : str
        What profiles and error messages call it.
    enqueue : callable
        A pyopencl enqueue function, for instance ``enqueue_nd_range_kernel`` or ``enqueue_copy``.
    *args
        Passed on after the queue.
    waits : sequence of pyopencl.Event
        Events that the command waits for on the device.
    **options
        Passed on by name.

    Returns
    -------
    Launched
        With the event of the command.

    Raises
    ------
    DeviceError
        When the driver refuses the command; names the label.
    """
    try:
        return Launched(label, enqueue(queue, *args, wait_for=waits or None, **options))
    except cl.Error as error:
        raise DeviceError(f"the device refused {label!r}: {error}") from error
