"""Accumulation at equal error, and tables."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from cldof.benchmark.analysis import (
    case_table,
    columns,
    equal_error,
    layered_table,
    markdown_table,
    summary_table,
    text_table,
    unit_text,
)
from cldof.benchmark.record import Record, Times
from tests.bench.records import UNIT, accumulation, layered, small_record

CASE = "row 8x8"


def test_equal_error_is_interpolated_in_log_time() -> None:
    record = small_record()
    found = equal_error(record, layered(CASE, 35.0))
    assert found is not None
    assert found.bound == ""
    assert found.ms == pytest.approx(200.0)  # half-way between 100 and 400 ms
    assert found.views == pytest.approx(16.0)
    assert found.speed_up(layered(CASE, 35.0)) == "20x"


@pytest.mark.parametrize(("psnr", "ms", "bound"), [(20.0, 100.0, "<"), (50.0, 400.0, ">"), (math.inf, 400.0, ">")])
def test_outside_of_the_ladder_it_is_a_bound(psnr: float, ms: float, bound: str) -> None:
    found = equal_error(small_record(), layered(CASE, psnr))
    assert found is not None
    assert (found.ms, found.bound) == (ms, bound)


def test_equal_error_needs_a_ladder_of_the_same_case() -> None:
    record = small_record()
    assert equal_error(record, layered("another 8x8", 35.0)) is None
    assert equal_error(record, accumulation(CASE, 8, 100.0, 30.0)) is None


def test_a_ladder_that_turns_back_counts_as_level() -> None:
    record = Record(rows={f"{v}": accumulation(CASE, v, 10.0 * v, p) for v, p in ((8, 30.0), (16, 29.0), (32, 40.0))})
    found = equal_error(record, layered(CASE, 35.0))
    assert found is not None
    assert 160.0 <= found.ms <= 320.0


def test_disc_methods_are_compared_with_accumulation_over_a_disc() -> None:
    row = layered(CASE, 31.0)
    disc = type(row)(**{**row.__dict__, "aperture": "disc"})
    found = equal_error(small_record(), disc)
    assert found is not None
    assert found.ms == pytest.approx(100.0)  # 31 dB is its first rung, where the Gaussian has 30


def test_tables_have_a_cell_for_every_heading() -> None:
    record = small_record()
    for heads, cells in (case_table(record, CASE), summary_table(record), layered_table(record, CASE)):
        assert cells
        assert all(len(line) == len(heads) for line in cells)
        assert len(text_table(heads, cells).splitlines()) == len(cells) + 1
        assert len(markdown_table(heads, cells).splitlines()) == len(cells) + 2
    assert summary_table(record, unlit=True)[1] == []


def test_columns_that_nobody_fills_are_left_out() -> None:
    heads, _ = case_table(small_record(), CASE)
    assert "own" not in heads
    assert "capture" in heads
    assert {column.head for column in columns()} >= set(heads)


def test_frames_are_judged_in_blurs_and_the_unit_is_described() -> None:
    record = small_record()
    heads, cells = case_table(record, CASE)
    assert [line[heads.index("blurs")] for line in cells] == ["-", "-", "0.02", "0.02"]  # 2 ms of 100
    heads, cells = summary_table(record)
    assert [line[heads.index("blurs")] for line in cells] == ["-", "-", "0.02", "0.02"]
    text = unit_text(record)
    assert text.startswith("Unit: OpenCV 1.2, GaussianBlur of sigma 16, RGBA float32 1024x1024, 2 threads.")
    assert "Medians of 2 rows: 100.0 to 100.0 ms by the clock, 200.0 to 200.0 ms of processor time" in text
    assert "not idle in 0 of them" in text


def test_a_busy_machine_is_judged_by_processor_time() -> None:
    busy = replace(UNIT, blur=Times(150.0, 300.0, 90.0, 3, 200.0, 196.0, 4.0))
    row = replace(layered(CASE, 35.0), unit=busy, wall=Times(20.0, 60.0, 9.0, 3, 50.0, 49.0, 1.0))
    record = Record(rows={"one": row}, cases=small_record().cases)
    heads, cells = case_table(record, CASE)
    assert cells[0][heads.index("blurs")] == "0.25 (cpu)"
    assert "not idle in 1 of them" in unit_text(record)


def test_a_record_made_without_opencv_says_so() -> None:
    rows = {"one": replace(layered(CASE, 35.0), unit=replace(UNIT, blur=None, threads=0, opencv=""))}
    record = Record(rows=rows, cases=small_record().cases)
    assert unit_text(record).startswith("OpenCV is not installed")
    assert "blurs" not in case_table(record, CASE)[0]
