"""The JSON document keeps everything, and says what is wrong with one that is not ours."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest

from cldof.benchmark.record import Record, Times
from cldof.errors import InputError
from tests.bench.records import small_record


def test_a_record_comes_back_as_it_was(tmp_path: Path) -> None:
    record = small_record()
    record.save(tmp_path / "results.json")
    again = Record.load(tmp_path / "results.json")
    assert again == record
    assert again.rows["row 8x8|layered|exact|a device"].error("psnr_db") == math.inf


def test_the_document_is_strict_json(tmp_path: Path) -> None:
    small_record("inf").save(tmp_path / "results.json")

    def refuse(name: str) -> None:
        raise AssertionError(f"{name} is no JSON")

    data = json.loads((tmp_path / "results.json").read_text(), parse_constant=refuse)
    assert data["schema"] == 1
    assert Record.load(tmp_path / "results.json").rows_of("inf")  # a scene of that name stays text


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"schema": 1}', '{"schema": 2}', '{"schema": 1, "rows": [{}]}'])
def test_other_files_are_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "results.json").write_text(text)
    with pytest.raises(InputError, match=r"results\.json"):
        Record.load(tmp_path / "results.json")


def test_a_missing_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="Cannot read"):
        Record.load(tmp_path / "results.json")


def test_times_are_summarised() -> None:
    assert Times.of([3.0, 1.0, 2.0]) == Times(1.0, 2.0, 1.0, 3)
    assert Times.of([5.0]) == Times(5.0, 5.0, 0.0, 1)
    with pytest.raises(InputError):
        Times.of([])
