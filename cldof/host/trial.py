"""First use of a driver, in a child process: a compiler that crashes costs a message, not the caller's process.

What this device, driver and processor have not built before is built and run once by ``python -m cldof.host.trial``,
which does nothing else. If it ends well, what it built is taken over and what it ran is noted, and this process builds
and runs it without another thought. If it dies, at whatever point, or cannot build, nothing of it is kept.

Its inputs are all ones: a frame of an opaque white wall, 1 m away. Scalars and constants are those of the real frame.
"""

from __future__ import annotations

import hashlib
import json
import os
import pickle
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterable, Mapping
from contextlib import nullcontext, suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..errors import BuildError, CldofError, DeviceError, DriverError
from .caches import adopt_programs, default_cache_dir, lent_programs, own_programs
from .passes import FrameProgram, Role
from .processor import processor_digest, processor_name
from .quirks import Effect, effects_of

if TYPE_CHECKING:
    from .device import Device, DeviceInfo, Traits

__all__ = ["SWITCH", "Trials", "is_wanted"]

SWITCH = "CLDOF_TRIAL"
"""Environment variable; 0 builds everything in the caller's process at once."""

# The child's exit codes beside 0 and signals.
_CANNOT_BUILD, _CANNOT_TRY = 3, 4
_KILLED = -9
# Lines of what a driver said before it died that go into the message.
_LAST_LINES = 3

# PoCL's folder is this process's, and a program is built by one thread at a time.
_lock = threading.Lock()


def is_wanted() -> bool:
    """Whether drivers are tried in a child first."""
    return os.environ.get(SWITCH, "1") != "0" and bool(sys.executable)


@dataclass(frozen=True)
class _Request:
    """What a child is to do; without a program, to open the device and look at its traits."""

    device: DeviceInfo
    lanes: int | None
    sources: Any
    traits: Traits | None
    program: FrameProgram | None
    params: Mapping[str, Any]


class Trials:
    """What has been tried on one device.

    Parameters
    ----------
    info : DeviceInfo
        Its index is that of :func:`cldof.host.device.list_devices`.
    """

    def __init__(self, info: DeviceInfo) -> None:
        self._info = info
        self._has_own_cache = Effect.TRUSTS_CACHE in effects_of(info.platform, info.name)
        self._tried: set[str] = set()

    def device(self, lanes: int | None) -> None:
        """Have a child open the device, unless one has before.

        Raises
        ------
        DriverError
            It died, or the driver cannot build the smallest kernel.
        """
        self._try([self._key("device")], _Request(self._info, lanes, None, None, None, {}))

    def program(self, program: FrameProgram, params: Mapping[str, Any], device: Device) -> None:
        """Have a child build a frame's kernels and run them once, unless children have before.

        Parameters
        ----------
        program : FrameProgram
        params : mapping
            Of a frame, as :meth:`cldof.host.scheduler.Batch.submit` takes them.
        device : Device
            Whose kernels and traits they are.

        Raises
        ------
        DriverError
            The child died, or could not build a kernel.
        """
        source = device.programs.source
        keys = {
            self._key(source(step.source, step.defines), step.kernel, str(step.local_size)) for step in program.passes
        }
        request = _Request(self._info, device.lanes, device.programs.directory, device.traits, program, params)
        self._try(sorted(keys), request)

    @cached_property
    def _identity(self) -> str:
        return "\0".join((*self._info.identity, processor_digest()))

    @property
    def _folder(self) -> Path:
        """Of notes, which go when PoCL's programs go."""
        return (own_programs() if self._has_own_cache else default_cache_dir()) / "tried"

    def _key(self, *parts: str) -> str:
        return hashlib.sha256("\0".join((self._identity, *parts)).encode()).hexdigest()

    def _try(self, keys: Iterable[str], request: _Request) -> None:
        with _lock:
            new = [key for key in keys if key not in self._tried and not (self._folder / key).exists()]
            if not new:
                return
            try:
                wanted = pickle.dumps(request)
            except (pickle.PicklingError, AttributeError, TypeError):
                return  # kernels of a caller's own that only this process can read
            self._run(wanted)
            self._tried.update(new)
            with suppress(OSError):  # without notes the next process tries again
                self._folder.mkdir(parents=True, exist_ok=True)
                for key in new:
                    (self._folder / key).touch()

    def _run(self, wanted: bytes) -> None:
        """Have a child do it; raises what says that the driver is no good, and passes over what does not."""
        environment = {
            **os.environ,
            SWITCH: "0",
            "PYTHONPATH": os.pathsep.join(path for path in sys.path if path),
        }
        with suppress(OSError), lent_programs() if self._has_own_cache else nullcontext() as lent:
            if lent is not None:
                environment["POCL_CACHE_DIR"] = str(lent)
            with tempfile.TemporaryFile() as errors:
                child = subprocess.run(
                    _command(), input=wanted, stdout=subprocess.PIPE, stderr=errors, env=environment, check=False
                )
                errors.seek(0)
                said = errors.read().decode(errors="replace")
            told = [json.loads(line) for line in child.stdout.splitlines() if line.startswith(b"{")]
            # What ends before it begins, or is killed from outside for its memory, says nothing of the driver.
            if told and child.returncode not in (0, _CANNOT_TRY, _KILLED):
                raise self._error(child.returncode, told, said)
            if child.returncode == 0 and lent is not None:
                adopt_programs(lent)

    def _error(self, code: int, told: list[dict[str, str]], said: str) -> DriverError:
        on = f"on device {self._info}, processor {processor_name()}"
        report = next((line["error"] for line in told if "error" in line), None)
        if code == _CANNOT_BUILD and report is not None:
            return DriverError(
                f"the driver cannot build for this processor, or not this kernel, {on}. Choose another device or "
                f"install another driver (`cldof devices` lists what there is, `cldof doctor` what works). {report}"
            )
        stage = next((line["stage"] for line in reversed(told) if "stage" in line), "starting")
        last = "".join(f"\n  {line}" for line in said.strip().splitlines()[-_LAST_LINES:])
        return DriverError(
            f"the driver died while {stage}: {_how(code)}, {on}. That was a child process; nothing of it was kept. "
            "Choose another device or install another driver (`cldof devices` lists what there is, `cldof doctor` what "
            f"works), and report this message to us{f'. It said last:{last}' if last else '.'}"
        )


def _command() -> list[str]:
    return [sys.executable, "-m", "cldof.host.trial"]


def _how(code: int) -> str:
    if code >= 0:
        return f"exit code {code}"
    try:
        return signal.Signals(-code).name
    except ValueError:
        return f"signal {-code}"


def main() -> int:
    """The child: do what is asked for on standard input, and say on standard output how far it got."""
    # Drivers write to both streams; the parent reads the first.
    out = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)

    def stage(what: str) -> None:
        print(json.dumps({"stage": what}), file=out)

    request: _Request = pickle.load(sys.stdin.buffer)
    try:
        _carry_out(request, stage)
        stage("ending")
    except BuildError as error:
        print(json.dumps({"error": str(error)}), file=out)
        return _CANNOT_BUILD
    except CldofError:  # too little memory for two, a device that one process has for itself
        return _CANNOT_TRY
    return 0


def _carry_out(request: _Request, stage: Any) -> None:
    from .device import Device
    from .scheduler import compile

    stage("opening the device")
    with Device.open(request.device.index, sources=request.sources, lanes=request.lanes) as device:
        if device.info.identity != request.device.identity:
            raise DeviceError(f"device {request.device} is {device.info} in another process")
        if request.program is None:
            stage("trying a small kernel")
            _ = device.traits
            return
        if request.traits is not None:
            device.__dict__["traits"] = request.traits
        program = request.program
        for source, defines in dict.fromkeys((step.source, step.defines) for step in program.passes):
            stage(f"building {source}.cl")
            device.programs.program(source, defines)
        stage("making a frame of " + ", ".join(dict.fromkeys(step.kernel for step in program.passes)))
        with compile(program, device) as batch:
            stage("running " + ", ".join(dict.fromkeys(step.kernel for step in program.passes)))
            inputs = {
                name: device.pool.to_device(np.ones(-(-buffer.nbytes // 4), np.float32))
                for name, buffer in program.buffers.items()
                if buffer.role is Role.INPUT
            }
            waits = [event for one in inputs.values() for event in one.waits]
            batch.submit({name: one.buffer for name, one in inputs.items()}, request.params, waits).wait()


if __name__ == "__main__":
    sys.exit(main())
