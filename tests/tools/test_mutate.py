"""The tool that breaks kernels, on two mutants: one that must be noticed and one that changes nothing."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import pytest

from tests.tools.checked import messages_of
from tests.tools.mutants import MUTANTS, SUITES, Mutant
from tests.tools.mutate import ROOT, Workshop, check_anchors

SUITE = [["tests/kernels/test_frame.py"]]


@pytest.fixture(scope="module")
def workshop(tmp_path_factory: pytest.TempPathFactory) -> Workshop:
    return Workshop(ROOT, tmp_path_factory.mktemp("workshop"))


@pytest.mark.parametrize(
    ("new", "verdict"),
    [
        ("w = 2.0f / load_lanes(depth);", "caught"),
        ("w = 1.0f / (load_lanes(depth));", "survived"),
        ("w = 1.0f / nothing_of_that_name;", "broken"),
    ],
)
def test_a_mutant_meets_its_fate(workshop: Workshop, device_info: object, new: str, verdict: str) -> None:
    mutant = Mutant("frame.clh", "w = 1.0f / load_lanes(depth);", new, "weight")
    before = (workshop.tree / "cldof" / "kernels" / "frame.clh").read_text()
    outcome = workshop.try_out(mutant, SUITE, 300.0)
    assert outcome.verdict == verdict, outcome.by
    assert ("test_inverse_depth" in outcome.by) == (verdict == "caught")
    assert (workshop.tree / "cldof" / "kernels" / "frame.clh").read_text() == before
    assert workshop.tree.resolve() != Path(ROOT).resolve()


def test_the_list_fits_the_kernels() -> None:
    """Kernels change and anchors follow before the next run, which refuses to start without; here most must fit."""
    assert len(check_anchors(MUTANTS)) <= len(MUTANTS) // 10
    assert {mutant.file for mutant in MUTANTS} <= set(SUITES)
    assert len(MUTANTS) >= 40
    assert max(Counter(mutant.name for mutant in MUTANTS).values()) == 1


def test_an_anchor_that_is_gone_is_named() -> None:
    wrong = check_anchors([Mutant("frame.cl", "no such line", "other", "drop")])
    assert len(wrong) == 1 and "0 times" in wrong[0]


def test_messages_of_the_simulator_are_counted() -> None:
    log = (
        "\nInvalid write of size 4 at global memory address 0x1000000010\n\tKernel: toy_overrun\n\tEntity: Global"
        "\n\n\nWrite-write data race at local memory address 0x20\n\tKernel: toy_race\n\n\tFirst entity: 0\n"
    )
    found = messages_of(log * 2)
    assert found[("Invalid write of size 4 at global memory address 0x..", "toy_overrun")] == 2
    assert found[("Write-write data race at local memory address 0x..", "toy_race")] == 2
