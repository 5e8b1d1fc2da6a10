"""The unit of speeds: OpenCV's Gaussian blur of sigma 16 on an RGBA float32 image of 1024x1024, and the 16 MB copy.

A time in milliseconds says little about another machine, or about the same one an hour later. Speeds are therefore
given as ratios to work that runs between the runs of what is measured. A copy of 16 MB on the device does not serve:
on some machines it takes four times as long in one run as in the next. The blur is arithmetic and memory as a frame is,
uses all cores, and its processor time scatters by 3 to 5 % while other processes take two thirds of the machine
(docs/accuracy-versus-time.md). Speeds are judged in blurs; copies are printed beside them.

On a CPU device ratios are by the clock as long as the blur got its threads' time, else by processor time, since both
sides work in threads of this process. Processor time does not see threads that wait for one another, so on an idle
machine the clock decides.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from types import TracebackType
from typing import Any, NamedTuple

import numpy as np

from ..host.device import Device
from ..host.profile import COPIES_PER_RUN, copying
from .times import Times, take_turns

__all__ = ["MISSING", "QUIET", "SIDE_PX", "SIGMA_PX", "Measured", "Ratio", "Unit", "Yardstick", "opencv_blur"]

SIGMA_PX, SIDE_PX = 16.0, 1024
QUIET = 0.9
"""Share of its threads' time that the blur gets on a machine that counts as idle; there it gets 0.97 to 1."""
# Names of what is timed beside the caller's calls.
_BLUR, _COPY = "blur of the unit", "copies of the unit"
MISSING = (
    "OpenCV is not installed (pip install opencv-python-headless): no ratios to its blur, which speeds are judged by; "
    "copies of 16 MB alone, which scatter by a factor of four on some machines"
)


class Ratio(NamedTuple):
    """A speed in units, and whether it is by processor time."""

    value: float
    by_processor: bool

    def __str__(self) -> str:
        return f"{self.value:.3g}{' (cpu)' if self.by_processor else ''}"


@dataclass(frozen=True)
class Unit:
    """What the blur and the copy took between the runs of something.

    Attributes
    ----------
    blur : Times, optional
        None where OpenCV is not installed.
    copy : Times, optional
        Of one copy of 16 MB on the device; None where no OpenCL device took part.
    threads : int
        That OpenCV chose to use.
    opencv : str
        Its version.
    """

    blur: Times | None = None
    copy: Times | None = None
    threads: int = 0
    opencv: str = ""

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Unit:
        """From what ``dataclasses.asdict`` made."""
        times = {name: Times(**data[name]) if data.get(name) else None for name in ("blur", "copy")}
        return cls(**times, threads=data["threads"], opencv=data["opencv"])

    @property
    def what(self) -> str:
        """The blur in words."""
        image = f"RGBA float32 {SIDE_PX}x{SIDE_PX}"
        return f"OpenCV {self.opencv}, GaussianBlur of sigma {SIGMA_PX:g}, {image}, {self.threads} threads"

    @property
    def share(self) -> float:
        """Share of its threads' time that the blur got: 1 on an idle machine; 0 if there was none."""
        if self.blur is None or self.blur.cpu is None:
            return 0.0
        return self.blur.cpu / (self.blur.median * self.threads)

    @property
    def is_quiet(self) -> bool:
        """Whether the clock may be believed."""
        return self.share >= QUIET

    @property
    def blur_ms(self) -> float | None:
        """Median of the blur by the clock; on a busy machine what it would be by its processor time on all threads."""
        if self.blur is None:
            return None
        return self.blur.median if self.is_quiet or self.blur.cpu is None else self.blur.cpu / self.threads

    def by_clock(self, times: Times) -> float | None:
        """Median over median by the clock, in blurs."""
        return times.median / self.blur.median if self.blur else None

    def by_processor(self, times: Times) -> float | None:
        """Median over median by processor time, in blurs; None for what another device did."""
        if self.blur is None or times.cpu is None or not self.blur.cpu:
            return None
        return times.cpu / self.blur.cpu

    def ratio(self, times: Times) -> Ratio | None:
        """What a speed is judged by, in blurs: by the clock, or by processor time where the machine was not idle."""
        cpu, wall = self.by_processor(times), self.by_clock(times)
        if cpu is not None and not self.is_quiet:
            return Ratio(cpu, True)
        return None if wall is None else Ratio(wall, False)

    def copies(self, times: Times) -> float | None:
        """Median over median by the clock, in copies."""
        return times.median / self.copy.median if self.copy else None

    def line(self, name: str, times: Times) -> str:
        """Everything about one thing that was timed."""
        text = f"{name:24s} min {times.min:7.2f}, median {times.median:7.2f}, IQR {times.iqr:6.2f} ms"
        if times.cpu is not None:
            text += f"; processor min {times.cpu_min:7.2f}, median {times.cpu:7.2f} ms"
        ratios = [
            f"{value:.3g} {what}"
            for value, what in (
                (self.by_clock(times), "blurs by the clock"),
                (self.by_processor(times), "by processor time"),
                (self.copies(times), "copies"),
            )
            if value is not None
        ]
        return text + (f": {', '.join(ratios)}" if ratios else "")

    def __str__(self) -> str:
        lines = []
        if self.blur is None:
            lines.append(MISSING)
        else:
            lines.append(f"{_summary('unit', self.blur)}: {self.what}")
            kind = "idle: ratios are judged by the clock"
            if not self.is_quiet:
                kind = "NOT idle: ratios are judged by processor time, where the device is a CPU"
            lines.append(f"{'':24s} got {min(self.share, 1.0):.0%} of its threads' time; the machine is {kind}")
        if self.copy is not None:
            lines.append(_summary("copy of 16 MB", self.copy))
        return "\n".join(lines)


def _summary(name: str, times: Times) -> str:
    return Unit().line(name, times)


@dataclass(frozen=True)
class Measured:
    """Times by name, and the unit between them."""

    unit: Unit
    times: dict[str, Times] = field(default_factory=dict)


class Yardstick:
    """Times things with the blur and the copy between their runs. A context manager.

    Parameters
    ----------
    device : Device, optional
        Whose copies to time, and whose processor time means something if it is a CPU. Without one all calls are taken
        to work on the CPU.
    """

    def __init__(self, device: Device | None = None) -> None:
        self._blur, self._threads, self._opencv = opencv_blur()
        self._copying = copying(device) if device else None
        self._copy = self._copying.__enter__() if self._copying else None
        self._on_cpu = device is None or device.info.kind == "cpu"

    def __enter__(self) -> Yardstick:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._copying:
            self._copying.__exit__(kind, error, trace)

    def measure(
        self, calls: Mapping[str, Callable[[], object]], runs: int, seconds: float = math.inf, warm_up: int = 1
    ) -> Measured:
        """Time the calls, the blur and the copy in turn; parameters as for :func:`.times.take_turns`."""
        own = {_BLUR: self._blur, _COPY: self._copy}
        taken = take_turns({**calls, **{name: call for name, call in own.items() if call}}, runs, seconds, warm_up)
        blur, copy = taken.pop(_BLUR, None), taken.pop(_COPY, None)
        if not self._on_cpu:
            taken = {name: times.by_the_clock() for name, times in taken.items()}
            copy = copy and copy.by_the_clock()
        return Measured(Unit(blur, copy and copy.divided(COPIES_PER_RUN), self._threads, self._opencv), taken)


def opencv_blur(sigma_px: float = SIGMA_PX) -> tuple[Callable[[], object] | None, int, str]:
    """A function that blurs the unit's image, OpenCV's number of threads and its version; None, 0, "" without it."""
    try:
        import cv2
    except ImportError:
        return None, 0, ""
    image = np.random.default_rng(0).random((SIDE_PX, SIDE_PX, 4), np.float32)
    out = np.empty_like(image)
    return lambda: cv2.GaussianBlur(image, (0, 0), sigma_px, out), cv2.getNumThreads(), cv2.__version__
