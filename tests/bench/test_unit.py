"""The unit of speeds: its arithmetic on times that are given, turns in their order, and a real blur."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from dataclasses import asdict, replace

import pytest

from cldof.benchmark import times as times_module
from cldof.benchmark.times import Times, take_turns
from cldof.benchmark.unit import MISSING, Ratio, Unit, Yardstick, opencv_blur
from cldof.errors import InputError
from cldof.host.device import Device

IDLE = Unit(Times(96.0, 100.0, 4.0, 9, 196.0, 190.0, 8.0), Times(1.0, 2.0, 0.5, 9), threads=2, opencv="5.0")
# A third of each core: the clock trebles, processor time is what it was.
BUSY = replace(IDLE, blur=Times(200.0, 300.0, 90.0, 9, 200.0, 190.0, 8.0))
FRAME = Times(48.0, 50.0, 1.0, 9, 80.0, 78.0, 2.0)


def test_times_are_summarised() -> None:
    assert Times.of([3.0, 1.0, 2.0]) == Times(1.0, 2.0, 1.0, 3)
    assert Times.of([5.0]) == Times(5.0, 5.0, 0.0, 1)
    assert Times.of([3.0, 1.0, 2.0], [6.0, 2.0, 10.0]) == Times(1.0, 2.0, 1.0, 3, 6.0, 2.0, 4.0)
    with pytest.raises(InputError):
        Times.of([])


def test_times_of_several_are_divided_and_lose_what_means_nothing() -> None:
    assert Times(4.0, 8.0, 2.0, 3, 16.0, 12.0, 1.0).divided(4) == Times(1.0, 2.0, 0.5, 3, 4.0, 3.0, 0.25)
    assert Times(4.0, 8.0, 2.0, 3).divided(4) == Times(1.0, 2.0, 0.5, 3)
    assert FRAME.by_the_clock() == Times(48.0, 50.0, 1.0, 9)


def test_ratios_are_by_the_clock_on_an_idle_machine() -> None:
    assert IDLE.share == pytest.approx(0.98)
    assert IDLE.by_clock(FRAME) == pytest.approx(0.5)
    assert IDLE.by_processor(FRAME) == pytest.approx(80.0 / 196.0)
    assert IDLE.copies(FRAME) == pytest.approx(25.0)
    assert IDLE.ratio(FRAME) == Ratio(0.5, by_processor=False)
    assert IDLE.blur_ms == 100.0


def test_ratios_are_by_processor_time_on_a_busy_one() -> None:
    assert BUSY.share == pytest.approx(1 / 3)
    assert BUSY.ratio(FRAME) == Ratio(0.4, by_processor=True)
    assert BUSY.blur_ms == 100.0  # 200 ms on two threads
    assert str(BUSY.ratio(FRAME)) == "0.4 (cpu)"
    assert "NOT idle" in str(BUSY)
    assert "NOT idle" not in str(IDLE)


def test_work_of_another_device_is_judged_by_the_clock_alone() -> None:
    assert BUSY.by_processor(FRAME.by_the_clock()) is None
    assert BUSY.ratio(FRAME.by_the_clock()) == Ratio(50.0 / 300.0, by_processor=False)


def test_without_opencv_there_are_copies_and_it_is_said() -> None:
    bare = Unit(copy=IDLE.copy)
    assert bare.ratio(FRAME) is None
    assert bare.blur_ms is None
    assert bare.copies(FRAME) == pytest.approx(25.0)
    assert str(bare).startswith(MISSING)
    line = bare.line("frame", FRAME)
    assert "25 copies" in line
    assert "blurs" not in line
    assert "by processor time" not in line


def test_a_line_has_both_kinds_of_time_and_all_ratios() -> None:
    name, ratios = IDLE.line("frame", FRAME).split(": ")
    assert name.split("; ") == [
        "frame                    min   48.00, median   50.00, IQR   1.00 ms",
        "processor min   78.00, median   80.00 ms",
    ]
    assert ratios == "0.5 blurs by the clock, 0.408 by processor time, 25 copies"


def test_a_unit_comes_back_from_json() -> None:
    for unit in (IDLE, Unit(), replace(IDLE, copy=None)):
        assert Unit.from_dict(asdict(unit)) == unit


def test_things_take_turns() -> None:
    order: list[str] = []
    taken = take_turns({"a": lambda: order.append("a"), "b": lambda: order.append("b")}, runs=3, warm_up=1)
    assert order == ["a", "b"] * 4
    assert {name: times.runs for name, times in taken.items()} == {"a": 3, "b": 3}


def test_clocks_are_told_apart() -> None:
    """Sleeping takes the clock's time alone; work takes both."""

    def work() -> None:
        until = time.process_time() + 0.02
        while time.process_time() < until:
            pass

    taken = take_turns({"sleep": lambda: time.sleep(0.03), "work": work}, runs=3)
    assert taken["sleep"].min >= 30.0
    assert taken["sleep"].cpu is not None and taken["sleep"].cpu < 15.0
    assert taken["work"].cpu is not None and 20.0 <= taken["work"].cpu <= taken["work"].median + 5.0


def test_no_round_begins_when_the_time_is_up(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [0.0]

    def second() -> None:
        now[0] += 1.0

    monkeypatch.setattr(times_module.time, "perf_counter", lambda: now[0])
    assert take_turns({"a": second}, runs=20, seconds=5.5)["a"].runs == 6
    assert take_turns({"a": second}, runs=20, seconds=0.0)["a"].runs == 3  # a median needs as many
    assert take_turns({"a": second}, runs=2, seconds=0.0)["a"].runs == 2


def test_blur_and_copy_run_between_the_runs(device: Device) -> None:
    pytest.importorskip("cv2")
    held = device.pool.in_use_bytes
    with Yardstick(device) as yardstick:
        measured = yardstick.measure({"nothing": lambda: None}, runs=2, warm_up=0)
    assert device.pool.in_use_bytes == held
    unit = measured.unit
    assert unit.blur is not None and unit.copy is not None
    assert unit.blur.runs == unit.copy.runs == 2
    assert unit.blur.min > unit.copy.min > 0.0
    assert unit.blur.cpu and 0.0 < unit.share <= 1.2
    assert unit.threads >= 1
    assert (unit.ratio(measured.times["nothing"]) or Ratio(1.0, False)).value < 0.01
    assert (measured.times["nothing"].cpu is None) == (device.info.kind != "cpu")


def test_without_the_package_there_is_no_blur(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "cv2", None)
    assert opencv_blur() == (None, 0, "")
    calls: dict[str, Callable[[], object]] = {"nothing": lambda: None}
    measured = Yardstick().measure(calls, runs=1)
    assert measured.unit == Unit()
    assert set(measured.times) == {"nothing"}
