"""What is made of ptxas's words, and occupancy by the published limits."""

from __future__ import annotations

import pytest

from tests.tools.registers import ARCHITECTURES, Usage, occupancy, usage_of

_LOG = """ptxas info    : 0 bytes gmem
ptxas info    : Compiling entry function 'toy_light' for 'sm_90'
ptxas info    : Function properties for toy_light
    0 bytes stack frame, 0 bytes spill stores, 0 bytes spill loads
ptxas info    : Used 24 registers, used 0 barriers
ptxas info    : Compile time = 86.554 ms
ptxas info    : Compiling entry function 'toy_heavy' for 'sm_90'
ptxas info    : Function properties for toy_heavy
    16 bytes stack frame, 80 bytes spill stores, 68 bytes spill loads
ptxas info    : Used 255 registers, used 1 barriers, 1000 bytes cumulative stack size, 4096 bytes smem
ptxas info    : Function properties for toy_function
    0 bytes stack frame, 8 bytes spill stores, 4 bytes spill loads
"""


def test_words_of_ptxas_are_read() -> None:
    assert usage_of(_LOG) == {
        "toy_light": Usage(24, 0, 0, 0, 0),
        "toy_heavy": Usage(255, 1000, 80, 68, 4096),
        "toy_function": Usage(0, 0, 8, 4, 0),
    }


@pytest.mark.parametrize(
    ("usage", "is_fit"),
    [
        (Usage(128, 0, 0, 0, 9000), True),
        (Usage(129, 0, 0, 0, 0), False),
        (Usage(20, 8, 0, 0, 0), False),
        (Usage(20, 0, 4, 0, 0), False),
        (Usage(20, 0, 0, 4, 0), False),
    ],
)
def test_what_leaves_registers_does_not_fit(usage: Usage, is_fit: bool) -> None:
    assert usage.is_fit is is_fit


@pytest.mark.parametrize(
    ("name", "registers", "group", "local_bytes", "share"),
    [
        ("sm_90", 32, 256, 0, 1.0),
        ("sm_90", 33, 256, 0, 0.75),  # 40 registers are given: 48 warps
        ("sm_90", 128, 256, 0, 0.25),
        ("sm_90", 255, 256, 0, 0.125),
        ("sm_90", 32, 32, 0, 0.5),  # 32 groups of one warp
        ("sm_90", 32, 64, 100 << 10, 0.0625),  # two groups' local memory
        ("sm_90", 32, 1, 0, 1 / 64),  # a work-item takes a warp
        ("sm_75", 64, 256, 0, 1.0),
        ("sm_75", 128, 256, 0, 0.5),
        ("sm_75", 32, 64, 32 << 10, 0.125),
    ],
)
def test_occupancy_is_what_nvidia_s_calculator_says(
    name: str, registers: int, group: int, local_bytes: int, share: float
) -> None:
    (architecture,) = (one for one in ARCHITECTURES if one.name == name)
    assert occupancy(architecture, registers, group, local_bytes) == pytest.approx(share)
