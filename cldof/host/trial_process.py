"""A child process that builds and runs what a driver may die of: both ends of the pipe.

Requests go in as pickles. Lines of JSON come out: ``{"stage": ...}`` says what is about to be done, and
``{"done": ...}``, ``{"cannot build": ...}`` or ``{"cannot try": ...}`` ends a request. A child serves one request after
another, for to start it and to have the driver's compiler ready takes a second; it ends when its input does.
"""

from __future__ import annotations

import json
import os
import pickle
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Mapping
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from importlib.resources import files
from typing import TYPE_CHECKING, Any

import numpy as np

from ..errors import BuildError, CldofError, DeviceError
from .caches import adopt_programs, lent_programs
from .passes import FrameProgram, Role

if TYPE_CHECKING:
    from .device import Device, DeviceInfo, Traits

__all__ = ["SWITCH", "Request", "TrialProcess", "main"]

SWITCH = "CLDOF_TRIAL"
"""Environment variable; 0 builds everything in the caller's process at once."""

# A child that nobody asks for anything ends, rather than keep its 200 MB.
_IDLE_S = 60.0
_END_S = 60.0


@dataclass(frozen=True)
class Request:
    """What a child is to do.

    Attributes
    ----------
    device : DeviceInfo
    program : FrameProgram or None
        Built and run once. Without one the device is opened, and what its probes find is the answer.
    params : mapping
        Of a frame.
    sources : traversable or None
        Of kernels; None for the library's own.
    traits : Traits or None
        Of the device, for a program.
    ahead : bool
        Only have the device open and its compiler ready for what will be asked.
    """

    device: DeviceInfo
    program: FrameProgram | None = None
    params: Mapping[str, Any] = field(default_factory=dict)
    sources: Any = None
    traits: Traits | None = None
    ahead: bool = False


class TrialProcess:
    """The caller's end: a child that has been started.

    Parameters
    ----------
    has_own_cache : bool
        Whether the driver keeps what it builds in a folder of this process's (PoCL). The child then has one of its own,
        from which :meth:`adopt` takes over.

    Attributes
    ----------
    told : list of dict
        What the child has said, the oldest first.
    has_given : bool
        Whether anything was taken over.

    Raises
    ------
    OSError
        It cannot be started.
    """

    def __init__(self, has_own_cache: bool) -> None:
        self.told: list[dict[str, Any]] = []
        self.has_given = False
        self._owed = 0
        self._owner = os.getpid()
        self._code: int | None = None
        with ExitStack() as stack:
            environment = {
                **os.environ,
                SWITCH: "0",
                "PYTHONPATH": os.pathsep.join(path for path in sys.path if path),
            }
            self._lent = stack.enter_context(lent_programs()) if has_own_cache else None
            if self._lent is not None:
                environment["POCL_CACHE_DIR"] = str(self._lent)
            self._errors = stack.enter_context(tempfile.TemporaryFile())
            self._child = subprocess.Popen(
                command(), stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self._errors, env=environment
            )
            self._left = stack.pop_all()

    @property
    def is_waiting(self) -> bool:
        """Whether it can be asked; not in a process that was forked since, which shares the pipe."""
        return self._owner == os.getpid() and self._code is None and self._child.poll() is None

    def tell(self, wanted: bytes) -> None:
        """Send a request without waiting for the answer."""
        self._owed += 1
        assert self._child.stdin is not None
        with suppress(OSError):  # it has died, which its exit code tells
            self._child.stdin.write(wanted)
            self._child.stdin.flush()

    def answer(self) -> dict[str, Any] | None:
        """The answer to the last request; None if the child ended before it."""
        assert self._child.stdout is not None
        for line in self._child.stdout:
            if not line.startswith(b"{"):
                continue
            self.told.append(json.loads(line))
            self._owed -= "stage" not in self.told[-1]
            if not self._owed:
                return self.told[-1]
        return None

    def adopt(self) -> None:
        """Take over what it has built so far."""
        if self._lent is not None:
            adopt_programs(self._lent)
            self.has_given = True

    def end(self) -> int:
        """Let it end, and return its exit code; negative for a signal."""
        if self._code is None and self._owner == os.getpid():
            assert self._child.stdin is not None and self._child.stdout is not None
            with suppress(OSError):
                self._child.stdin.close()
            with suppress(OSError, ValueError):
                self._owed = -1  # all that it still says
                self.answer()
            try:
                self._code = self._child.wait(_END_S)
            except subprocess.TimeoutExpired:
                self._child.kill()
                self._code = self._child.wait()
            self._child.stdout.close()
        return self._code or 0

    def drop(self) -> None:
        """Have it gone at once, and what it built with it."""
        if self._owner != os.getpid():
            return
        if self._code is None:
            self._child.kill()
            self.end()
        self._left.close()

    def last_words(self, lines: int) -> list[str]:
        """What it, or its driver, wrote to the error stream at last."""
        self._errors.seek(0)
        return self._errors.read().decode(errors="replace").strip().splitlines()[-lines:]


def command() -> list[str]:
    """What starts a child."""
    return [sys.executable, "-m", "cldof.host.trial_process"]


def main() -> int:
    """The child: do what is asked for on standard input, and say on standard output how far it got."""
    # Drivers write to both streams; the parent reads the first.
    out = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)

    def say(what: str, text: Any) -> None:
        print(json.dumps({what: text}), file=out)

    with ExitStack() as stack:
        devices = _Devices(stack)
        while True:
            idle = threading.Timer(_IDLE_S, os._exit, (0,))
            idle.daemon = True
            idle.start()
            try:
                request: Request = pickle.load(sys.stdin.buffer)
            except EOFError:
                break
            finally:
                idle.cancel()
            try:
                say("done", _carry_out(request, devices, lambda what: say("stage", what)))
            except BuildError as error:
                say("cannot build", str(error))
            except CldofError as error:  # too little memory for two, a device that one process has for itself
                say("cannot try", str(error))
        say("stage", "ending")
    return 0


class _Devices:
    """Those that a child has open; a driver's compiler takes half a second to be ready for a new context."""

    def __init__(self, stack: ExitStack) -> None:
        self._stack = stack
        self._open: list[tuple[int, Any, Device]] = []

    def device(self, request: Request) -> Device:
        from .device import Device

        index, sources = request.device.index, request.sources or files("cldof.kernels")
        for before, of, device in self._open:
            if (before, of) == (index, sources):
                return device
        device = self._stack.enter_context(Device.open(index, sources=sources))
        if device.info.identity != request.device.identity:
            raise DeviceError(f"device {request.device} is {device.info} in another process")
        self._open.append((index, sources, device))
        return device


def _carry_out(request: Request, devices: _Devices, stage: Callable[[str], None]) -> dict[str, Any]:
    from .scheduler import compile

    stage("opening the device")
    device = devices.device(request)
    if request.program is None:
        stage("trying a small kernel")
        return {"compiled_width": device.compiled_width} if request.ahead else device.found
    if request.traits is not None:
        device.__dict__.update(traits=request.traits, lanes=request.traits.lanes)
    program = request.program
    for source, defines in dict.fromkeys((step.source, step.defines) for step in program.passes):
        stage(f"building {source}.cl")
        device.programs.program(source, defines)
    kernels = ", ".join(dict.fromkeys(step.kernel for step in program.passes))
    stage(f"making a frame of {kernels}")
    with compile(program, device) as batch:
        stage(f"running {kernels}")
        inputs = {
            name: device.pool.to_device(np.ones(-(-buffer.nbytes // 4), np.float32))
            for name, buffer in program.buffers.items()
            if buffer.role is Role.INPUT
        }
        waits = [event for one in inputs.values() for event in one.waits]
        batch.submit({name: one.buffer for name, one in inputs.items()}, request.params, waits).wait()
        for one in inputs.values():
            device.pool.free_input(one)
    device.pool.trim()
    return {}


if __name__ == "__main__":
    sys.exit(main())
