"""`bench speed`, `bench planned` and the budgets of `bench auto`: sizes, arithmetic, and a run on a tiny frame."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from bench import auto, planned, speed
from cldof.benchmark.times import Times
from cldof.benchmark.unit import Measured, Unit
from cldof.errors import CldofError, DeviceError, InputError
from cldof.host.device import Device, DeviceInfo
from cldof.methods.base import row_pitch
from tests.bench.records import UNIT
from tests.running import padded, run_program


def test_sizes_have_names_too() -> None:
    found = [speed.parse_size(text) for text in ("1080p", "4K", "4k", "37x21")]
    assert found == [(1920, 1080), (3840, 2160), (3840, 2160), (37, 21)]
    for text in ("1080", "x", "0x5", "4x-1", "big"):
        with pytest.raises(InputError, match="WIDTHxHEIGHT"):
            speed.parse_size(text)


def test_the_hard_frame_has_any_size_and_leaves_nothing_out() -> None:
    frame = speed.hard_frame(37, 21)
    assert frame.color.shape == (4, 21, 37, 4)
    assert frame.is_opaque
    assert np.isfinite(frame.depth).all()
    assert (np.diff(frame.depth, axis=0) >= 0.0).all()
    assert frame.depth[0].min() < 2.5 < frame.depth[0].max()  # on both sides of the lens's focus


def test_a_report_keeps_what_it_prints(
    device_info: DeviceInfo, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("cv2")
    path = tmp_path / "speed.json"
    device = str(device_info.index)
    speed.report(device, 3, [(40, 24), (24, 40)], ["layered"], blurs=False, output=str(path))
    printed = capsys.readouterr().out
    record = json.loads(path.read_text())
    assert [(row["title"], row["width"], row["height"]) for row in record["rows"]] == [
        (title, *size) for size in ((40, 24), (24, 40)) for title in speed.VARIANTS["layered"]
    ]
    for row in record["rows"]:
        unit, frame = Unit.from_dict(row["unit"]), Times(**row["frame"])
        judged = unit.ratio(frame)
        assert judged is not None
        assert (row["blurs"], row["by_processor_time"]) == tuple(judged)
        assert row["kernels"]["runs"] == frame.runs == 3
        assert 0.0 < row["kernels"]["min"] <= sum(row["passes_ms"].values()) * 1.001
        assert f"{judged} blurs a frame" in printed


@pytest.mark.parametrize("engine", ["fir", "iir"])
def test_what_is_timed_as_a_blur_is_one(engine: str, device: Device) -> None:
    """Away from the edges, which OpenCV continues in another way."""
    cv2 = pytest.importorskip("cv2")
    sigma = 3.0
    size, margin = speed.SIZE, 40
    image = np.random.default_rng(0).random((size, size, 4), np.float32)
    program = speed._fir_program(sigma) if engine == "fir" else speed._iir_program(sigma, device.lanes)
    pitch = row_pitch(size)
    out = run_program(device, program, {"source": padded(image, pitch)}, {}, "out", (size, pitch, 4))
    inner = slice(margin, -margin)
    expected = cv2.GaussianBlur(image, (0, 0), sigma)[inner, inner]
    assert np.abs(out[:, :size][inner, inner] - expected).max() < 5e-3


def test_what_cannot_be_rendered_costs_its_own_row_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def frame(title: str, method: str, *rest: object) -> dict[str, object]:
        if method == "pyramid":
            raise DeviceError("out of memory")
        return {"method": method}

    monkeypatch.setattr(speed, "_frame", frame)
    path = tmp_path / "speed.json"
    with pytest.raises(CldofError, match="1 of 2 could not be timed, first pyramid at 8x8: out of memory"):
        speed.report(None, 3, [(8, 8)], ["pyramid", "gather"], blurs=False, output=str(path))
    record = json.loads(path.read_text())
    assert [row["title"] for row in record["rows"]] == ["gather"]
    assert record["not_timed"] == [{"title": "pyramid", "width": 8, "height": 8, "why": "out of memory"}]
    assert "pyramid: 8x8 NOT TIMED: out of memory" in capsys.readouterr().out


def test_an_unknown_method_is_refused() -> None:
    with pytest.raises(InputError, match="no method 'magic'"):
        speed.report(None, 3, methods=["magic"])


def test_planning_is_measured_by_processor_time_less_downloads() -> None:
    times = {
        "download": Times(1.0, 1.0, 0.0, 3, 2.0, 2.0, 0.0),
        "planned_ms": Times(10.0, 11.0, 0.0, 3, 15.0, 14.0, 0.0),
    }
    found = planned.milliseconds(Measured(UNIT, times))
    assert found == {"blur_ms": 196.0, "copy_ms": 1.0, "planned_ms": 12.0}
    gpu = {name: one.by_the_clock() for name, one in times.items()}
    assert planned.milliseconds(Measured(UNIT, gpu)) == {"blur_ms": 98.0, "copy_ms": 1.0, "planned_ms": 9.0}
    assert planned.milliseconds(Measured(Unit(), gpu))["blur_ms"] is None


def test_budgets_of_auto_are_in_blurs() -> None:
    assert auto.budgets(UNIT, busy=False)["0.5"] == pytest.approx(50.0)
    assert auto.budgets(UNIT, busy=True)["0.5"] == pytest.approx(49.0)  # 196 ms of processor time on two threads
    assert auto.budgets(Unit(copy=UNIT.copy), busy=False)["8 copies"] == pytest.approx(8.0)
