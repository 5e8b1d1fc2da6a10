"""One pair of renderers a method for the tests of a module."""

from collections.abc import Iterator

import pytest

from cldof import Renderer
from cldof.host.device import DeviceInfo
from cldof.methods import METHODS
from tests.planner.pairs import Pair


@pytest.fixture(scope="module", params=sorted(METHODS))
def pair(request: pytest.FixtureRequest, device_info: DeviceInfo) -> Iterator[Pair]:
    with (
        Renderer(request.param, device=device_info.index) as planned,
        Renderer(request.param, device=device_info.index, planned=False) as full,
    ):
        yield planned, full
