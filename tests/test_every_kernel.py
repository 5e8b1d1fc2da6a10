"""Every kernel in every form, between canaries, on memory filled in two ways: nothing outside, nothing unwritten.

Private variables, which nobody can fill from outside, are left to the compiler's analysis of the same programs, and
vectors and arrays, which it does not follow, to ``python -m tests.tools.checked --private``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest

from cldof.host.device import Device, DeviceInfo
from cldof.host.passes import Buffer, FrameProgram, Pass, Role, write
from tests.every_kernel import CASES, Case, FilledSources, Program, kernels_in_sources, record_kernels, unset_variables
from tests.running import run_program


@pytest.fixture(scope="module")
def seen() -> set[str]:
    """Kernels that have run so far."""
    return set()


@pytest.fixture(scope="module")
def programs() -> set[Program]:
    """Programs that have been built so far."""
    return set()


@pytest.fixture
def canaried(device_info: DeviceInfo, open_device: Callable[..., Device]) -> Iterator[Device]:
    """Closed after each test: its buffers would be looked at after all tests that follow."""
    with open_device(device_info) as device:
        yield device


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_memory_is_left_alone_and_written_before_it_is_read(
    case: Case, canaried: Device, seen: set[str], programs: set[Program]
) -> None:
    """The canaries are those of every test; the same bits from other garbage mean that no garbage was read."""
    if lacks := case.lacks(canaried.traits):
        pytest.skip(lacks)
    images = []
    with record_kernels(canaried, programs) as names:
        for fill in (0xFF, 0x3E):  # NaN, and 0.18 as float32
            canaried.pool.fill = fill  # type: ignore[attr-defined]
            images.append(case.run(canaried))
    seen |= names
    assert np.isfinite(images[0]).all()
    np.testing.assert_array_equal(images[0], images[1])


def test_no_kernel_was_left_out(seen: set[str], canaried: Device, request: pytest.FixtureRequest) -> None:
    if sum(item.name.startswith("test_memory") for item in request.session.items) < len(CASES):
        pytest.skip("only some of the cases were run")
    missing = kernels_in_sources() - seen
    if not canaried.traits.has_int64_atomics:
        missing -= {"lightfield_packed"}
    if not canaried.traits.has_long_loops:
        missing -= {"lightfield_views"}
    assert not missing, "a new kernel needs a case in tests/every_kernel.py"


def test_the_programs_are_known_without_a_device(
    programs: set[Program], canaried: Device, request: pytest.FixtureRequest
) -> None:
    """What tests/test_portable_kernels.py compiles for other processors is what was built here."""
    if sum(item.name.startswith("test_memory") for item in request.session.items) < len(CASES):
        pytest.skip("only some of the cases were run")
    expected = set().union(*(case.programs(canaried.traits) for case in CASES if not case.lacks(canaried.traits)))
    assert programs == expected


FAULTS = {
    "float x; if (n > 3) x = 2.0f; o[0] = x;": "'x'",
    "float x; for (int i = 0; i < n; i++) x = i; o[0] = x;": "'x'",
    "float v[3] = {1.0f, 2.0f, 3.0f}; o[0] = v[3];": "past the end",
    "float x = 0.0f; if (n > 3) x = 2.0f; o[0] = x;": "",
}


@pytest.mark.parametrize("body", FAULTS)
def test_the_compiler_knows_what_is_not_set(body: str, canaried: Device, tmp_path: Path) -> None:
    (tmp_path / "faulty.cl").write_text(f"__kernel void faulty(__global float *o, int n) {{ {body} }}\n")
    said = unset_variables(canaried, ("faulty", ()), tmp_path)
    if said is None:
        pytest.skip(f"the compiler of {canaried.traits.name} cannot be asked")
    assert FAULTS[body] in "".join(said)
    assert bool(said) == bool(FAULTS[body])


def test_variables_are_set_before_they_are_read(canaried: Device, programs: set[Program]) -> None:
    """In every program that the cases above have built, on every way through it."""
    said = {
        program: unset_variables(canaried, program, files("cldof.kernels")) for program in sorted(programs, key=str)
    }
    if None in said.values():
        pytest.skip(f"the compiler of {canaried.traits.name} cannot be asked")
    assert not any(said.values()), said


def test_private_memory_is_filled_where_it_is_declared_without_a_value(
    tmp_path: Path, open_device, device_info
) -> None:  # type: ignore[no-untyped-def]
    """A vector of which one part is never set, and an array with a hole, both of which show; structs stay structs."""
    (tmp_path / "faulty.cl").write_text(
        "typedef struct {\n    float a, b;\n} Pair;\n"
        "__kernel void faulty(__global float *o)\n{\n    float4 v;\n    float u[2], w;\n    Pair pair = {3.0f, 4.0f};\n"
        "    v.x = 1.0f;\n    u[0] = w = 2.0f;\n"
        "    o[0] = v.x; o[1] = v.y; o[2] = u[0]; o[3] = u[1]; o[4] = w; o[5] = pair.a;\n}\n"
    )
    device = open_device(device_info, sources=FilledSources(0xFF, tmp_path))
    program = FrameProgram.of([Buffer("out", 24, Role.OUTPUT)], [Pass("faulty", "faulty", (write("out"),), (1,))])
    out = run_program(device, program, {}, {}, "out", (6,))
    assert np.isnan(out[[1, 3]]).all()
    assert out[[0, 2, 4, 5]].tolist() == [1.0, 2.0, 2.0, 3.0]
