"""Milliseconds of several runs, by the clock and by the processor; and runs of several things that take turns."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from statistics import median, quantiles

from ..errors import InputError

__all__ = ["LEAST_RUNS", "Times", "take_turns"]

LEAST_RUNS = 3
"""Runs that there are however little time they were given: a median and quartiles need as many."""


@dataclass(frozen=True)
class Times:
    """Milliseconds of several runs: the least, the median, and the distance between the quartiles.

    ``cpu``, ``cpu_min`` and ``cpu_iqr`` are the median, the least and the distance between the quartiles of processor
    time, summed over all threads of the process, where the work is done on the CPU. They hold on a machine that does
    other things as well, where the clock does not. Older records have ``cpu`` alone.
    """

    min: float
    median: float
    iqr: float
    runs: int
    cpu: float | None = None
    cpu_min: float | None = None
    cpu_iqr: float | None = None

    @classmethod
    def of(cls, ms: Sequence[float], cpu_ms: Sequence[float] = ()) -> Times:
        """Summarise measurements; at least one."""
        if not ms:
            raise InputError("Times.of needs at least one measurement.")
        if not cpu_ms:
            return cls(min(ms), median(ms), _iqr(ms), len(ms))
        return cls(min(ms), median(ms), _iqr(ms), len(ms), median(cpu_ms), min(cpu_ms), _iqr(cpu_ms))

    def by_the_clock(self) -> Times:
        """Without processor time, which says nothing of work that another device does."""
        return Times(self.min, self.median, self.iqr, self.runs)

    def divided(self, by: float) -> Times:
        """Times of one where a run was of several."""
        parts = (self.min, self.median, self.iqr, self.cpu, self.cpu_min, self.cpu_iqr)
        low, middle, iqr, *cpu = (None if part is None else part / by for part in parts)
        assert low is not None and middle is not None and iqr is not None
        return Times(low, middle, iqr, self.runs, *cpu)


def _iqr(values: Sequence[float]) -> float:
    if len(values) < 2:
        return 0.0
    low, _, high = quantiles(values, n=4, method="inclusive")
    return high - low


def take_turns(
    calls: Mapping[str, Callable[[], object]], runs: int, seconds: float = math.inf, warm_up: int = 1
) -> dict[str, Times]:
    """Time several things in turn, each once per round, so that a change of the machine's speed meets all of them.

    Parameters
    ----------
    calls : mapping
        What to time, by name. Each has to wait for what it starts.
    runs : int
        Rounds, after ``warm_up`` of them.
    seconds : float
        No round begins later than this, but for the first :data:`LEAST_RUNS` (or ``runs``, if that is less).
    warm_up : int

    Returns
    -------
    dict
        :class:`Times` by name.
    """
    for _ in range(warm_up):
        for call in calls.values():
            call()
    wall: dict[str, list[float]] = {name: [] for name in calls}
    cpu: dict[str, list[float]] = {name: [] for name in calls}
    begin = time.perf_counter()
    for done in range(runs):
        if done >= min(LEAST_RUNS, runs) and time.perf_counter() - begin > seconds:
            break
        for name, call in calls.items():
            start, cpu_start = time.perf_counter(), time.process_time()
            call()
            wall[name].append((time.perf_counter() - start) * 1e3)
            cpu[name].append((time.process_time() - cpu_start) * 1e3)
    return {name: Times.of(wall[name], cpu[name]) for name in calls}
