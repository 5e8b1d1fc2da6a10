"""``cldof doctor``: what it finds, what it says when something is missing or dies, and its exit code."""

from __future__ import annotations

import json
import math
import sys
from dataclasses import asdict

import numpy as np
import pytest

from cldof import Renderer
from cldof.cli import main
from cldof.doctor import Report, examine, report, sample
from cldof.doctor.command import doctor
from cldof.host.device import DeviceInfo
from cldof.methods import METHODS


def one_method(monkeypatch: pytest.MonkeyPatch, *methods: str) -> None:
    monkeypatch.setattr(report, "METHODS", {name: METHODS[name] for name in methods})


def result_of(found: Report, index: int) -> dict[str, object]:
    return next(device for device in found.devices if device["index"] == index)["methods"]


@pytest.mark.parametrize("method", METHODS)
def test_stored_images_are_those_of_the_methods(device_info: DeviceInfo, method: str) -> None:
    with Renderer(method, device=device_info.index) as renderer:
        image = renderer.render(sample.sample_frame(), sample.sample_lens()).image
    assert sample.agreement_db(image, sample.expected()[method]) > 80.0


def test_what_is_wrong_is_below_the_bar() -> None:
    """A method's image is no other one's, nor that of a lens a tenth smaller: the bar tells them apart."""
    images = sample.expected()
    for name, image in images.items():
        for other in set(images) - {name}:
            assert sample.agreement_db(image, images[other]) < sample.LEAST_DB - 10.0
    image = images["layered"]
    assert sample.agreement_db(image, image) == math.inf
    assert sample.agreement_db(image[1:], image) == -math.inf
    assert sample.agreement_db(np.full_like(image, np.nan), image) == -math.inf


def test_a_machine_that_works(
    device_info: DeviceInfo, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    one_method(monkeypatch, "gather")
    assert main(["doctor", "--device", str(device_info.index)]) == 0
    said = capsys.readouterr()
    assert said.err == ""
    for words in ("Python", "numpy", "processor", "OpenCL", "OpenGL", "programs", device_info.name, "can be made here"):
        assert words in said.out
    assert main(["doctor", "--json", "--device", str(device_info.index)]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["can_render"] is True
    (worked,) = [one for one in found["devices"] if one["methods"]]
    assert worked["driver_version"] == device_info.driver_version
    agreement = worked["methods"]["gather"]["db"]
    assert agreement == "same" or agreement > 80.0


DIES = """
import json, os
print(json.dumps({"begins": "layered"}), flush=True)
os.abort()
"""


def test_a_device_that_dies_or_is_wrong(monkeypatch: pytest.MonkeyPatch, device_info: DeviceInfo) -> None:
    """Each method that ends its process is told; the rest is tried in another one."""
    one_method(monkeypatch, "layered", "gather")
    ask = report._ask

    def dying(words, look=lambda line: None):  # type: ignore[no-untyped-def]
        if words[0] == "opencl":
            return [{"devices": [asdict(device_info)]}], ""
        if words[0] == "device" and words[2] == "layered":
            look({"begins": "layered"})
            return [], "the process died with signal 6"
        if words[0] == "device":
            look({"begins": "gather"})
            look({"method": "gather", "db": 20.0, "seconds": 1.0})
            return [], ""
        return ask(words, look)

    monkeypatch.setattr(report, "_ask", dying)
    found = examine()
    assert result_of(found, device_info.index)["layered"] == {"error": "the process died with signal 6"}
    assert not found.can_render
    (judged,) = [finding for finding in found.findings if finding.what.startswith("device")]
    assert judged.state == "bad"
    assert "signal 6" in judged.found and "wrong, 20 dB" in judged.found and "another" in judged.advice
    assert doctor(as_json=True, device=None, quiet=True) == 1


@pytest.mark.skipif(sys.platform == "win32", reason="there are no signals")
def test_a_child_that_dies_is_told_with_its_signal(monkeypatch: pytest.MonkeyPatch) -> None:
    real = report.subprocess.Popen
    monkeypatch.setattr(
        report.subprocess, "Popen", lambda command, **options: real([sys.executable, "-c", DIES], **options)
    )
    lines, died = report._ask(["device", "0", "layered"])
    assert lines == [{"begins": "layered"}]
    assert "signal 6" in died


def test_a_child_that_hangs_is_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    real = report.subprocess.Popen
    hangs = "import time; time.sleep(600)"
    monkeypatch.setattr(
        report.subprocess, "Popen", lambda command, **options: real([sys.executable, "-c", hangs], **options)
    )
    monkeypatch.setattr(report, "_LIMIT_S", 0.2)
    assert report._ask(["opengl"]) == ([], "no answer within 0.2 s")


def test_reports_are_strict_json_and_hold_no_source(monkeypatch: pytest.MonkeyPatch, device_info: DeviceInfo) -> None:
    one_method(monkeypatch, "layered", "gather", "pyramid")
    failed = "layered.cl could not be built.\n--- source\n   1 | int x\n--- compiler log\nexpected ';'"

    def answers(words, look=lambda line: None):  # type: ignore[no-untyped-def]
        if words[0] == "opencl":
            return [{"devices": [asdict(device_info)]}], ""
        look({"begins": "layered"})
        look({"method": "layered", "error": failed})
        look({"begins": "gather"})
        look({"method": "gather", "db": math.inf, "seconds": 1.0})
        look({"begins": "pyramid"})
        look({"method": "pyramid", "db": -math.inf, "seconds": 1.0})
        return [], ""

    monkeypatch.setattr(report, "_ask", answers)

    def no_constant(name: str) -> None:
        raise AssertionError(f"{name} is not JSON")

    found = json.loads(examine().as_json(), parse_constant=no_constant)
    methods = found["devices"][0]["methods"]
    assert methods["layered"]["error"] == "layered.cl could not be built.\n--- compiler log\nexpected ';'"
    assert methods["gather"]["db"] == "same"
    assert methods["pyramid"]["db"] == "not comparable"
    assert found["can_render"] is True


def test_no_driver_at_all(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(report, "_ask", lambda words, look=None: ([{"devices": []}], ""))
    assert doctor(as_json=False, device=None, quiet=True) == 1
    said = capsys.readouterr().out
    assert "no device" in said and "pip install" in said and "No picture can be made here" in said
