"""Measuring: rows come once, survive an interruption, are reproducible, and wrong images get no time."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cldof.benchmark import harness, ladders, peers
from cldof.benchmark.harness import Settings, WrongOutputError, run, verify
from cldof.benchmark.record import Record
from cldof.errors import InputError
from cldof.host.device import DeviceInfo
from tests.opengl import require_opengl

SETTINGS = Settings(
    ("row",), ((32, 24),), ("accumulate", "layered"), runs=1, reference_views=8, quick=True, peer_scenes=("row",)
)


@pytest.fixture(autouse=True)
def _small_ladders(monkeypatch: pytest.MonkeyPatch) -> None:
    require_opengl()
    monkeypatch.setattr(ladders, "_QUICK_VIEWS", (2, 4))
    rungs = tuple(rung for rung in ladders.LADDERS["layered"] if rung.name in ("default", "1 peel", "supersample 2"))
    monkeypatch.setitem(ladders.LADDERS, "layered", rungs)
    monkeypatch.setattr(harness, "commit", lambda: "0123456789ab")


def quiet(text: str) -> None:
    """Progress that nobody reads."""


class Interrupting:
    """Presses Ctrl-C after some finished rows."""

    def __init__(self, rows: int) -> None:
        self.left = rows

    def __call__(self, text: str) -> None:
        if text.startswith("["):
            self.left -= 1
            if self.left == 0:
                raise KeyboardInterrupt


def test_an_interrupted_run_goes_on_where_it_stopped(tmp_path: Path, device_info: DeviceInfo) -> None:
    path = tmp_path / "results.json"
    with pytest.raises(KeyboardInterrupt):
        run(SETTINGS, path, Interrupting(3), [device_info])
    first = Record.load(path)
    assert len(first.rows) == 3
    lines: list[str] = []
    record = run(SETTINGS, path, lines.append, [device_info])
    assert Record.load(path) == record
    assert len(record.rows) == 5
    assert not record.skipped
    assert {key: record.rows[key] for key in first.rows} == first.rows  # kept, not measured again
    assert "3 of them there already" in lines[0]
    assert "about" in lines[0]  # the estimate comes first
    assert sum(line.startswith("[") for line in lines) == 2

    for row in record.rows.values():
        assert row.total_ms > 0.0
        assert np.isfinite(row.error("psnr_db") or np.nan)
    layered = [row for row in record.rows.values() if row.method == "layered"]
    assert {row.supersample for row in layered} == {1, 2}
    for row in layered:
        assert row.capture
        assert row.kernels
        assert row.wall
        assert row.transfer
        assert row.kernels_in_copies
        assert row.unit and row.unit.copy
        assert row.peak_device_bytes
        assert row.device in record.devices
    assert any("|error of layered" in key for key in record.images)
    assert any(key.endswith("|pinhole") for key in record.images)


def test_the_same_seed_gives_the_same_errors(tmp_path: Path, device_info: DeviceInfo) -> None:
    first, second = (run(SETTINGS, tmp_path / name, quiet, [device_info]) for name in ("a.json", "b.json"))
    assert {row.key: row.errors for row in first.rows.values()} == {row.key: row.errors for row in second.rows.values()}


def test_rows_of_other_code_or_settings_are_not_mixed(
    tmp_path: Path, device_info: DeviceInfo, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = Settings(("row",), ((32, 24),), ("accumulate",), runs=1, reference_views=4, quick=True)
    run(settings, tmp_path / "results.json", quiet, [device_info])
    monkeypatch.setattr(harness, "commit", lambda: "another")
    with pytest.raises(InputError, match="--fresh"):
        run(settings, tmp_path / "results.json", quiet, [device_info])


def test_absent_peers_are_skipped_visibly(
    tmp_path: Path, device_info: DeviceInfo, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    settings = Settings(("row",), ((32, 24),), tuple(peers.PEERS), quick=True, peer_scenes=("row",))
    lines: list[str] = []
    record = run(settings, tmp_path / "results.json", lines.append, [device_info])
    assert not record.rows
    assert len(record.skipped) == sum(len(peer.settings) for peer in peers.PEERS.values())
    assert all("pip install" in why for why in record.skipped.values())
    assert sum("not installed" in line for line in lines) == len(record.skipped)


def test_opencv_blurs_one_layer(tmp_path: Path, device_info: DeviceInfo) -> None:
    pytest.importorskip("cv2")
    settings = Settings(("row",), ((32, 24),), ("opencv",), runs=1, reference_views=16, peer_scenes=("row",))
    record = run(settings, tmp_path / "results.json", quiet, [device_info])
    (row,) = record.rows.values()
    assert row.aperture == "disc"
    assert row.capture is not None
    assert (row.error("psnr_db") or 0.0) > 20.0


@pytest.mark.parametrize("spoil", ["nan", "hole", "negative", "size"])
def test_an_image_that_cannot_be_right_is_refused(spoil: str) -> None:
    image = np.ones((4, 5, 4), np.float32)
    verify(image, (4, 5), opaque=True)
    spoiled: dict[str, Any] = {"nan": np.nan, "hole": 0.5, "negative": -1.0}
    if spoil == "size":
        image = image[:3]
    else:
        image[1, 2, 3 if spoil == "hole" else 0] = spoiled[spoil]
    with pytest.raises(WrongOutputError, match="not timed"):
        verify(image, (4, 5), opaque=True)


def test_a_wrong_image_becomes_a_skip_with_its_reason(
    tmp_path: Path, device_info: DeviceInfo, monkeypatch: pytest.MonkeyPatch
) -> None:
    def wrong(*arguments: object) -> None:
        raise WrongOutputError("The image has holes; it was not timed.")

    monkeypatch.setattr(harness, "verify", wrong)
    settings = Settings(("row",), ((32, 24),), ("layered",), runs=1, reference_views=4, quick=True)
    record = run(settings, tmp_path / "results.json", quiet, [device_info])
    assert not record.rows
    assert all("not timed" in why for why in record.skipped.values())
