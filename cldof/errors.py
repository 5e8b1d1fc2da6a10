"""The exception family: everything that cldof raises on purpose is a :class:`CldofError`.

A message says what was wrong, the offending value, and what to do about it. The classes exist so that a caller can
tell a mistake in its own input from a machine that lacks something; the command line turns all of them into one
paragraph and exit code 2.
"""

__all__ = [
    "BudgetWarning",
    "BuildError",
    "CaptureError",
    "CldofError",
    "DeviceError",
    "DriverError",
    "DriverWarning",
    "FrameError",
    "InputError",
    "OutputError",
    "SceneError",
]


class CldofError(Exception):
    """Base of every error that cldof raises on purpose."""


class InputError(CldofError, ValueError):
    """A lens, camera, option or other argument is out of range or of the wrong kind."""


class FrameError(InputError):
    """Colour, depth or surface arrays do not make a legal :class:`~cldof.LayeredFrame`."""


class SceneError(CldofError):
    """A scene cannot be read, is empty, or is not known by that name."""


class CaptureError(CldofError):
    """Offscreen rendering failed, or this machine lacks what it needs (EGL, an OpenGL driver)."""


class DeviceError(CldofError):
    """No OpenCL device matches, or the device failed or ran out of memory."""


class BuildError(DeviceError):
    """A kernel did not compile; the message holds device, options, numbered source and compiler log."""


class DriverError(DeviceError):
    """A driver died in the child process that tried it, or cannot build kernels for this processor."""


class OutputError(CldofError):
    """A result cannot be written where it was asked for."""


class DriverWarning(UserWarning):
    """A device that would have been chosen does not work; another one was taken."""


class BudgetWarning(UserWarning):
    """No method is expected to keep the error or the time that was asked for; the nearest one was taken."""
