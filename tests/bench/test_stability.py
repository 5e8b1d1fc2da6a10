"""The stability page is what the stored record says, and the record keeps the worst."""

import json
from pathlib import Path

from bench.stability import PAGE, RECORD, page
from tests.stability import Key, Measurements


def test_the_page_is_made_of_the_record() -> None:
    record = json.loads(RECORD.read_text())
    assert PAGE.read_text() == page(record)
    assert all(value <= bound for *_, value, bound in record["rows"])


def test_the_worst_is_kept(tmp_path: Path) -> None:
    key, other = (Key("size", case, "off by", "layered", "PoCL 3.0") for case in ("one", "two"))
    measured = Measurements()
    for value in (0.2, 0.5, 0.3):
        measured.add(key, value, 1.0)
    measured.add(other, float("nan"), 1.0)
    measured.add(other, 0.1, 1.0)
    assert measured.worst[key] == (0.5, 1.0)
    assert measured.worst[other][0] != measured.worst[other][0]
    del measured.worst[other]
    path = tmp_path / "record.json"
    measured.save(path)
    again = Measurements()
    again.add(key, 0.7, 1.0)
    again.add(other, 0.0, 0.0)
    again.save(path)
    elsewhere = Measurements()
    elsewhere.add(key._replace(driver="Intel 1"), 0.9, 1.0)
    elsewhere.save(path)
    rows = {Key(*row[:5]): row[5:] for row in json.loads(path.read_text())["rows"]}
    assert rows == {key: [0.7, 1.0], other: [0.0, 0.0], key._replace(driver="Intel 1"): [0.9, 1.0]}
