"""The tool that compares drivers notices pictures that differ, and devices that fail."""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from cldof.host.device import DeviceInfo
from tests.every_kernel import CASES, Case
from tests.tools import agreement
from tests.tools.agreement import Rendered


@pytest.mark.parametrize(
    ("off", "code", "shown"),
    [(0.0, 0, "inf"), (1e-5, 0, "100.0"), (1e-3, 1, "60.0"), (np.nan, 1, "-inf")],
)
def test_one_form_that_differs_is_shown_and_counts(
    off: float,
    code: int,
    shown: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
) -> None:
    def rendered(part: str, limit: str, cases: Sequence[Case], *rest: object) -> Rendered:
        images = {case.name: np.zeros((4, 5, 4), np.float32) for case in cases}
        if part == "b":
            del images["pyramid void 5px"]
            images["gather void 5px"] = images["gather void 5px"] + np.float32(off)
        return Rendered(images)

    monkeypatch.setattr(agreement, "_rendered", rendered)
    output = tmp_path / "agreement.json"
    command = ["One=a", "Other=b", "--only", "^(gather|pyramid) void 5px$", "--output", str(output)]
    assert agreement.main(command) == code
    rows = capsys.readouterr().out.splitlines()
    assert rows[0].endswith("PSNR to One over its forms | Other |")
    assert rows[2].startswith(f"| gather | {shown} (void 5px); {int(off == 0.0)} of 1")
    assert rows[3] == "| pyramid | none that it can run |"
    facts = json.loads(output.read_text())
    assert facts["forms"] == 2
    assert float(facts["db"]["Other"]["gather void 5px"]) == pytest.approx(float(shown), abs=0.05)
    assert facts["devices"]["Other"]["rendered"] == 1


@pytest.mark.parametrize(
    "failed",
    [Rendered({}), Rendered({}, cut=True), Rendered(died="ended with -11"), Rendered(errors={"gather void 5px": "no"})],
)
def test_a_device_that_fails_counts_whatever_agrees(failed: Rendered, monkeypatch: pytest.MonkeyPatch) -> None:
    good = {"gather void 5px": np.zeros((4, 5, 4), np.float32)}
    if failed.died or failed.errors:
        failed.images.update(good)
    made = {"a": Rendered(good), "b": failed}
    monkeypatch.setattr(agreement, "_rendered", lambda part, *rest: made[part])
    assert agreement.main(["One=a", "Other=b", "--only", "^gather void 5px$", "--seconds", "9"]) == 1


def test_forms_come_from_processes_of_their_own(
    device_info: DeviceInfo, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With limits for the second alone; one whose time is up has what it had by then."""
    output = tmp_path / "agreement.json"
    monkeypatch.setenv("CLDOF_TEST_LIMITS", "64,32768,gpu")
    part = str(device_info.index)
    command = [f"One={part}", f"Other={part}", "--only", "^layered (one|void) 5px$", "--every", "--output", str(output)]
    assert agreement.main(command) == 0
    facts = json.loads(output.read_text())
    assert set(facts["db"]["Other"]) == {"layered one 5px", "layered void 5px"}
    options = argparse.Namespace(only="^gather", every=True, seconds=0.05)
    cut = agreement._rendered(part, "", agreement.chosen("^gather"), options, tmp_path)
    assert cut.cut and not cut.images and not cut.died


def test_methods_take_turns_and_every_form_is_more_than_whole_frames() -> None:
    every = agreement.chosen(every=True)
    assert {case.name for case in every} == {case.name for case in CASES}
    assert len(every) == len(CASES)
    methods = {case.method for case in CASES}
    assert {case.method for case in every[: len(methods)]} == methods
    assert 0 < len(agreement.chosen()) < len(CASES)


def test_a_pattern_that_no_form_has_is_refused() -> None:
    with pytest.raises(SystemExit):
        agreement.main(["A=a", "B=b", "--only", "nothing like this"])
