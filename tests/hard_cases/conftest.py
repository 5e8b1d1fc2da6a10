"""One method on one device, rendered through the renderer with canaries around its buffers, and measured."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

from cldof import LayeredFrame, Lens, Renderer
from cldof.frame import _OPAQUE_TOLERANCE
from cldof.host.device import DeviceInfo
from cldof.methods import METHODS
from tests.conftest import CanaryPool
from tests.planner.pairs import ROUNDING
from tests.stability import Key, Measurements, driver_of

# Beside the defaults of every registered method: the other engines, traversals and published forms.
VARIANTS: dict[str, tuple[str, dict[str, Any]]] = {
    "layered iir": ("layered", {"engine": "iir"}),
    "layered single": ("layered", {"cascade": False}),
    "layered paper": ("layered", {"matting": "paper"}),
    "lightfield atomic": ("lightfield", {"warp": "atomic"}),
    "multiview peels": ("multiview", {"traversal": "peels"}),
    "pyramid paper": (
        "pyramid",
        {"matting": "paper", "radius": "paper", "hidden": "interpolated", "normalise": False},
    ),
}
SUBJECTS = {name: (name, {}) for name in METHODS} | VARIANTS

_measurements = Measurements()


class Subject:
    """A method with options on a device.

    Attributes
    ----------
    name : str
        Of the method and variant.
    method : str
    options : dict
    shown, full : ndarray or None
        The last image of :meth:`render`, and the same without a planner, where it was rendered as well.
    """

    def __init__(self, name: str, info: DeviceInfo, family: str) -> None:
        self.name, self.info, self._family = name, info, family
        self.method, self.options = SUBJECTS[name]
        self.renderer = Renderer(self.method, device=info.index, **self.options)
        renderers = [self.renderer]
        if name in METHODS and not self.is_slow:
            renderers.append(Renderer(self.method, device=info.index, planned=False))
        self._unplanned = renderers[1] if len(renderers) > 1 else None
        self.shown: np.ndarray | None = None
        self.full: np.ndarray | None = None
        self._pools = []
        for renderer in renderers:
            device = renderer.device
            device.pool = CanaryPool(device.context, device.queue, shares_memory=device.pool.shares_memory)
            self._pools.append(device.pool)

    @property
    def is_gaussian(self) -> bool:
        """Whether it simulates a Gaussian lens."""
        return METHODS[self.method].simulated_aperture == "gaussian"

    @property
    def is_slow(self) -> bool:
        """Whether the device is for small cases only."""
        return "llvmpipe" in self.info.name

    def check_canaries(self) -> None:
        """Fail if a kernel wrote outside its buffers."""
        found = [what for pool in self._pools for what in pool.trampled()]
        assert not found, f"{self.name}: a kernel wrote outside its buffers: {found}"

    def close(self) -> None:
        """Give everything back."""
        self.renderer.close()
        if self._unplanned is not None:
            self._unplanned.close()

    def render(self, frame: LayeredFrame, lens: Lens, *, planned_only: bool = False) -> np.ndarray:
        """The image, float64; finite, and as near to the one without a plan as the plan says, or the test fails."""
        result = self.renderer.render(frame, lens)
        image = _finite(self.name, result.image)
        self.shown, self.full = image, None
        # The light field keeps two panes of a column apart, and the pinhole that a plan puts in its place all of them.
        is_exact = self.method != "lightfield" or frame.panes <= 2
        if self._unplanned is not None and is_exact and not planned_only:
            self.full = _finite(f"{self.name} unplanned", self._unplanned.render(frame, lens).image)
            # A column that lets less than a tolerance through may come out closed without a plan, unlike the pinhole.
            pinhole = frame.pinhole_image()
            lacks = 1.0 - pinhole[..., 3]
            lacks = lacks[lacks <= _OPAQUE_TOLERANCE].max(initial=0.0)
            brightest = max(1.0, float(frame.color.max()), float(pinhole.max()))
            off = (np.abs(image - self.full).max() - result.plan.error_bound) / brightest
            off = max(0.0, off - float(lacks))
            self.check(
                "every case of this page", "planned and unplanned differ by more than the plan says", off, ROUNDING
            )
        return image

    def check(self, case: str, invariant: str, value: float, bound: float) -> None:
        """Record a value that must not exceed its bound, and fail if it does."""
        record(self._family, case, invariant, self.name, driver_of(self.info), value, bound)


def _finite(name: str, image: np.ndarray) -> np.ndarray:
    bad = np.count_nonzero(~np.isfinite(image))
    assert bad == 0, f"{name}: {bad} of {image.size} values are not finite"
    return image.astype(np.float64)


def record(family: str, case: str, invariant: str, subject: str, driver: str, value: float, bound: float) -> None:
    """Record a value that must not exceed its bound, and fail if it does."""
    value = float(value)
    _measurements.add(Key(family, case, invariant, subject, driver), value, float(bound))
    assert value <= bound, f"{subject}, {case}: {invariant} is {value:.4g}, more than {bound:.4g}"


def pytest_sessionfinish() -> None:
    """Write what was measured, if a file was asked for."""
    path = Measurements.target()
    if path is not None and _measurements.worst:
        _measurements.save(path)


@pytest.fixture(scope="module")
def subjects(request: pytest.FixtureRequest, device_info: DeviceInfo) -> Iterator[Callable[[str], Subject]]:
    """Subjects by name, made when they are first asked for and kept for a file of tests."""
    made: dict[str, Subject] = {}
    family = request.path.stem.removeprefix("test_")

    def get(name: str) -> Subject:
        if name not in made:
            made[name] = Subject(name, device_info, family)
        return made[name]

    yield get
    for subject in made.values():
        subject.close()


@pytest.fixture(params=sorted(SUBJECTS))
def subject(request: pytest.FixtureRequest, subjects: Callable[[str], Subject]) -> Iterator[Subject]:
    """Every method and variant in turn."""
    one = subjects(request.param)
    if one.is_slow and request.param in VARIANTS:
        pytest.skip("variants are not run on llvmpipe, which takes 100 ns an item")
    yield one
    one.check_canaries()


@pytest.fixture(params=sorted(METHODS))
def method(request: pytest.FixtureRequest, subjects: Callable[[str], Subject]) -> Iterator[Subject]:
    """Every method with its default options in turn."""
    one = subjects(request.param)
    yield one
    one.check_canaries()
