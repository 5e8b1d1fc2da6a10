"""The JSON document keeps everything, and says what is wrong with one that is not ours."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import pytest

from cldof.benchmark.analysis import case_table, unit_text
from cldof.benchmark.record import Record
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
    assert data["schema"] == 2
    assert Record.load(tmp_path / "results.json").rows_of("inf")  # a scene of that name stays text


@pytest.mark.parametrize(
    "text", ["", "[]", "{}", '{"schema": 1}', '{"schema": 2}', '{"schema": 3}', '{"schema": 1, "rows": [{}]}']
)
def test_other_files_are_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "results.json").write_text(text)
    with pytest.raises(InputError, match=r"results\.json"):
        Record.load(tmp_path / "results.json")


def test_records_without_the_unit_are_read_and_say_so(tmp_path: Path) -> None:
    """Schema 1, before speeds were in blurs; among them those in bench/results."""
    record = small_record()
    record.rows = {key: replace(row, unit=None, kernels_in_copies=7.0) for key, row in record.rows.items()}
    path = tmp_path / "results.json"
    record.save(path)
    data = json.loads(path.read_text())
    data["schema"] = 1
    for row in data["rows"]:
        del row["unit"]
        for name in ("wall", "kernels", "transfer", "capture"):
            if row[name]:
                del row[name]["cpu_min"], row[name]["cpu_iqr"]
    path.write_text(json.dumps(data))
    old = Record.load(path)
    assert old == record
    assert unit_text(old).startswith("An older record: speeds in copies of 16 MB alone")
    heads, _ = case_table(old, "row 8x8")
    assert "copies" in heads and "blurs" not in heads


@pytest.mark.parametrize(
    "path", sorted((Path(__file__).parents[2] / "bench/results").glob("2-core*.json")), ids=lambda path: path.stem
)
def test_records_of_the_repository_are_read(path: Path) -> None:
    record = Record.load(path)
    assert record.rows
    assert unit_text(record)


def test_a_missing_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="Cannot read"):
        Record.load(tmp_path / "results.json")
