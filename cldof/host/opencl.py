"""The one import of pyopencl: ``from . import opencl as cl``, then ``cl.Buffer`` and so on.

Importing this module does not import pyopencl; the first use of a name does. So every host module can be imported on
a machine without OpenCL, and a missing pyopencl is one :class:`~cldof.DeviceError` with advice, raised where a device
is asked for.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

from ..errors import DeviceError
from .caches import prepare_environment
from .drivers import driver_advice, prepare_drivers


def __getattr__(name: str) -> Any:
    if name.startswith("__"):  # the import system probes for these
        raise AttributeError(name)
    prepare_environment()
    prepare_drivers()
    try:
        pyopencl = import_module("pyopencl")
    except ImportError as error:
        raise DeviceError(
            f"pyopencl cannot be imported ({error}). Install it with a driver for the CPU: {driver_advice()}."
        ) from error
    value = getattr(pyopencl, name)
    globals()[name] = value  # the next look-up is a plain module attribute
    return value
