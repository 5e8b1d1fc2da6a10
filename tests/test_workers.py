"""Tests that build the same programs go to one worker."""

from __future__ import annotations

import pytest

from tests.workers import group_of


@pytest.mark.parametrize(
    ("nodeid", "group"),
    [
        ("tests/kernels/test_pyramid.py::test_levels[0-pthread-5]", "pyramid"),
        ("tests/methods/test_multiview_reference.py::test_scenes[row]", "multiview"),
        ("tests/hard_cases/test_alpha.py::test_glass[0-pthread-layered paper-0.5]", "layered"),
        ("tests/hard_cases/test_filters.py::test_sigma[0.5]", "tests/hard_cases/test_filters.py"),
        # Its last tests are about what those before have run.
        ("tests/test_every_kernel.py::test_memory[gather opaque 5px]", "tests/test_every_kernel.py"),
        ("tests/test_cli.py::test_bench[lightfield]", "tests/test_cli.py"),
    ],
)
def test_groups(nodeid: str, group: str) -> None:
    assert group_of(nodeid) == group
