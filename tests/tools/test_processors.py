"""The tool that compares processors notices pictures that differ, and how."""

from __future__ import annotations

import math

import numpy as np
import pytest

from tests.every_kernel import CASES
from tests.tools.processors import compared

_IMAGE = np.random.default_rng(0).random((20, 30, 4), np.float32)


def _with(value: float, pixels: int) -> np.ndarray:
    image = _IMAGE.copy()
    image.reshape(-1, 4)[:pixels, 1] += np.float32(value)
    return image


@pytest.mark.parametrize(
    ("other", "exactly", "same", "largest", "problems"),
    [
        (_IMAGE, True, 1, 0.0, 0),
        (_with(1e-4, 600), False, 0, 1e-4, 0),
        (_with(1e-4, 1), True, 0, 1e-4, 1),
        (_with(0.5, 3), False, 0, 0.5, 0),  # samples on the other side of an edge
        (_with(2e-3, 4), False, 0, 2e-3, 1),
        (_with(math.nan, 4), False, 0, math.inf, 1),
        (_IMAGE[1:], False, 0, math.inf, 1),
    ],
)
def test_pictures_that_differ_are_found(
    other: np.ndarray, exactly: bool, same: int, largest: float, problems: int
) -> None:
    found = compared({0: _IMAGE, 3: other}, {3: _IMAGE, 4: _IMAGE}, exactly=exactly)
    assert (found.forms, found.same) == (1, same)
    assert found.largest == pytest.approx(largest, rel=0.5)
    assert (found.where == CASES[3].name) == (largest > 0.0)
    assert len(found.problems) == problems
