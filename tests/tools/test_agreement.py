"""The tool that compares drivers notices pictures that differ."""

from __future__ import annotations

import numpy as np
import pytest

from tests.tools import agreement


@pytest.mark.parametrize(
    ("off", "code", "shown"),
    [(0.0, 0, "inf"), (1e-5, 0, "100.0"), (1e-3, 1, "60.0"), (np.nan, 1, "-inf")],
)
def test_one_form_that_differs_is_shown_and_counts(
    off: float, code: int, shown: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def rendered(part: str, pattern: str, folder: object) -> dict[str, np.ndarray]:
        images = {case.name: np.zeros((4, 5, 4), np.float32) for case in agreement.chosen(pattern)}
        if part == "b":
            del images["pyramid void 5px"]
            images["gather void 5px"] = images["gather void 5px"] + np.float32(off)
        return images

    monkeypatch.setattr(agreement, "_rendered", rendered)
    assert agreement.main(["One=a", "Other=b", "--only", "^(gather|pyramid) void 5px$"]) == code
    rows = capsys.readouterr().out.splitlines()
    assert rows[0].endswith("PSNR to One over its forms | Other |")
    assert rows[2].startswith(f"| gather | {shown} (void 5px); {int(off == 0.0)} of 1")
    assert rows[3] == "| pyramid | none that it can run |"


def test_a_pattern_that_no_form_has_is_refused() -> None:
    with pytest.raises(SystemExit):
        agreement.main(["A=a", "B=b", "--only", "nothing like this"])
