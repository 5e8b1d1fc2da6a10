"""Every kernel in every form, between canaries, on memory filled in two ways: nothing outside, nothing unwritten."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from cldof.host.device import Device, DeviceInfo
from tests.every_kernel import CASES, Case, kernels_in_sources, record_kernels


@pytest.fixture(scope="module")
def seen() -> set[str]:
    """Kernels that have run so far."""
    return set()


@pytest.fixture(scope="module")
def canaried(device_info: DeviceInfo, open_device: Callable[..., Device]) -> Device:
    return open_device(device_info)


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_memory_is_left_alone_and_written_before_it_is_read(case: Case, canaried: Device, seen: set[str]) -> None:
    """The canaries are those of every test; the same bits from other garbage mean that no garbage was read."""
    if case.options.get("warp") == "packed" and not canaried.traits.has_int64_atomics:
        pytest.skip(f"{canaried.traits.name} has no 64-bit atomics")
    images = []
    with record_kernels(canaried) as names:
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
    assert not missing, "a new kernel needs a case in tests/every_kernel.py"
