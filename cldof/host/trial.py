"""First use of a driver, in a child process: a compiler that crashes costs a message, not the caller's process.

What this device, driver and processor have not built before is built and run once by a child, which does nothing else
(:mod:`cldof.host.trial_process`). If it ends well, what it built is taken over and what it ran is noted, and this
process builds and runs it without another thought. If it dies, at whatever point, or cannot build, nothing of it is
kept.

Its inputs are all ones: a frame of an opaque white wall, 1 m away. Scalars and constants are those of the real frame.
"""

from __future__ import annotations

import hashlib
import json
import os
import pickle
import signal
import sys
import threading
import weakref
from collections.abc import Iterable, Mapping
from contextlib import suppress
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import DriverError
from .caches import default_cache_dir, give_up_programs, own_programs
from .passes import FrameProgram
from .processor import processor_digest, processor_name
from .quirks import Effect, effects_of
from .trial_process import SWITCH, Request, TrialProcess

if TYPE_CHECKING:
    from .device import Device, DeviceInfo

__all__ = ["SWITCH", "Trials", "is_wanted"]

_KILLED = -9
# Lines of what a driver said before it died that go into the message.
_LAST_LINES = 3

# PoCL's folder is this process's, and a program is built by one thread at a time.
_lock = threading.Lock()


def is_wanted() -> bool:
    """Whether drivers are tried in a child first."""
    return os.environ.get(SWITCH, "1") != "0" and bool(sys.executable)


class Trials:
    """What has been tried on one device.

    Parameters
    ----------
    info : DeviceInfo
        Its index is that of :func:`cldof.host.device.list_devices`.

    Attributes
    ----------
    found : dict
        What probes of the device found in a child; empty before :meth:`device` and where no child could say.
    """

    def __init__(self, info: DeviceInfo) -> None:
        self.found: dict[str, Any] = {}
        self._info = info
        self._has_own_cache = Effect.TRUSTS_CACHE in effects_of(info.platform, info.name)
        self._tried: set[str] = set()
        # Tried by the child that waits for more, noted when that has ended.
        self._pending: set[str] = set()
        self._child: TrialProcess | None = None
        self._forget: Any = None

    def device(self) -> None:
        """Have a child open the device and run its probes, unless one has before.

        Raises
        ------
        DriverError
            It died, or the driver cannot build the smallest kernel.
        """
        key = self._key("device")
        with _lock, suppress(OSError):
            with suppress(OSError, ValueError):
                self.found = dict(json.loads((self._folder / key).read_text()))
                return
            child = TrialProcess(self._has_own_cache)
            try:
                child.tell(pickle.dumps(Request(self._info)))
                # A frame's kernels come next, as a rule. A second child gets ready for them on another core, while this
                # one works and ends. A device that is no processor may be for one process at a time.
                if self._info.kind == "cpu" and (os.cpu_count() or 1) > 1:
                    ahead = self._take_on(TrialProcess(self._has_own_cache))
                    ahead.tell(pickle.dumps(Request(self._info, ahead=True)))
                self.found = self._verdict(child, child.answer(), stays=False) or {}
            except BaseException:
                self._dismiss()
                raise
            finally:
                child.drop()
            self._note([key], json.dumps(self.found))

    def program(self, program: FrameProgram, params: Mapping[str, Any], device: Device, more: bool = False) -> None:
        """Have a child build a frame's kernels and run them once, unless children have before.

        Parameters
        ----------
        program : FrameProgram
        params : mapping
            Of a frame, as :meth:`cldof.host.scheduler.Batch.submit` takes them.
        device : Device
            Whose kernels and traits they are.
        more : bool
            Kernels of the same frame are to follow: the child stays for them, and its end is looked at after the last.

        Raises
        ------
        DriverError
            The child died, or could not build a kernel.
        """
        source = device.programs.source
        keys = {
            self._key(source(step.source, step.defines), step.kernel, str(step.local_size)) for step in program.passes
        }
        with _lock:
            new = {key for key in keys - self._tried - self._pending if not (self._folder / key).exists()}
            if not new and (more or not self._pending):
                return
            request = Request(self._info, program, params, device.programs.directory, device.traits)
            try:
                wanted = pickle.dumps(request) if new else None
            except (pickle.PicklingError, AttributeError, TypeError):
                return  # kernels of a caller's own that only this process can read
            self._pending |= new
            try:
                with suppress(OSError):
                    self._try(wanted, more)
            except BaseException:
                self._pending.clear()
                self._dismiss()
                raise
            if not more:
                self._dismiss()
                self._note(self._pending)
                self._pending = set()

    def close(self) -> None:
        """Let the child go that may wait for more."""
        with _lock:
            with suppress(DriverError):
                if self._pending and self._waits:
                    self._try(None, more=False)
                    self._note(self._pending)
            self._pending = set()
            self._dismiss()

    @cached_property
    def _identity(self) -> str:
        return "\0".join((*self._info.identity, processor_digest()))

    @property
    def _folder(self) -> Path:
        """Of notes, which go when PoCL's programs go."""
        return (own_programs() if self._has_own_cache else default_cache_dir()) / "tried"

    def _key(self, *parts: str) -> str:
        return hashlib.sha256("\0".join((self._identity, *parts)).encode()).hexdigest()

    @property
    def _waits(self) -> bool:
        return self._child is not None and self._child.is_waiting

    def _try(self, wanted: bytes | None, more: bool) -> None:
        """Have the child do it that waits, or a new one; without a request it is only to end well."""
        child = self._child
        if child is None or not self._waits:
            if wanted is None:
                return
            child = self._take_on(TrialProcess(self._has_own_cache))
        if wanted is not None:
            child.tell(wanted)
        self._verdict(child, child.answer() if wanted is not None else {"done": {}}, stays=more)

    def _verdict(self, child: TrialProcess, answer: dict[str, Any] | None, stays: bool) -> Any:
        """Take over what a child built that answers; raises what says that the driver is no good, else None."""
        if answer is not None and "cannot build" in answer:
            raise self._cannot_build(answer["cannot build"])
        if answer is not None and "cannot try" in answer:
            return None
        code = 0 if answer is not None and stays else child.end()
        # What ends before it begins, or is killed from outside for its memory, says nothing of the driver.
        if child.told and code not in (0, _KILLED):
            if child.has_given:
                give_up_programs()
            raise self._died(code, child)
        if answer is None:
            return None
        child.adopt()
        return answer["done"]

    def _take_on(self, child: TrialProcess) -> TrialProcess:
        """Keep a child for what comes, until this object goes or the process ends."""
        self._dismiss()
        self._child, self._forget = child, weakref.finalize(self, child.drop)
        return child

    def _dismiss(self) -> None:
        if self._forget is not None:
            self._forget()
        self._child = self._forget = None

    def _note(self, keys: Iterable[str], text: str = "") -> None:
        self._tried.update(keys)
        with suppress(OSError):  # without notes the next process tries again
            self._folder.mkdir(parents=True, exist_ok=True)
            for key in keys:
                (self._folder / key).write_text(text)

    def _cannot_build(self, report: str) -> DriverError:
        return DriverError(
            f"the driver cannot build for this processor, or not this kernel, {self._place}. Choose another device or "
            f"install another driver (`cldof devices` lists what there is, `cldof doctor` what works). {report}"
        )

    def _died(self, code: int, child: TrialProcess) -> DriverError:
        stage = next((line["stage"] for line in reversed(child.told) if "stage" in line), "starting")
        last = "".join(f"\n  {line}" for line in child.last_words(_LAST_LINES))
        return DriverError(
            f"the driver died while {stage}: {_how(code)}, {self._place}. That was a child process; nothing of it was "
            "kept. Choose another device or install another driver (`cldof devices` lists what there is, "
            f"`cldof doctor` what works), and report this message to us{f'. It said last:{last}' if last else '.'}"
        )

    @property
    def _place(self) -> str:
        return f"on device {self._info}, processor {processor_name()}"


def _how(code: int) -> str:
    if code >= 0:
        return f"exit code {code}"
    try:
        return signal.Signals(-code).name
    except ValueError:
        return f"signal {-code}"
