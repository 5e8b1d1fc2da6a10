"""The gather kernel against float64."""

import math

import numpy as np
import pytest

from cldof.host.device import Device
from cldof.methods.base import row_pitch
from cldof.methods.gather import _SIZE, RADII, gather_taps
from tests.oracles import gather as oracle
from tests.running import padded, run_pass
from tests.tolerances import assert_close

SIZES = [(1, 1), (1, 37), (41, 1), (37, 21), (97, 61)]


def gather(
    device: Device, image: np.ndarray, inverse: np.ndarray, count: int, kernel: str, c1: float, c0: float
) -> np.ndarray:
    height, width = inverse.shape
    pitch = row_pitch(width)
    args = [
        padded(image, pitch),
        padded(inverse, pitch),
        *gather_taps(count, kernel),
        np.array((width, height, pitch, 0), _SIZE)[()],
        np.nextafter(np.float32(RADII[-1]), np.float32(0.0)),
        np.float32(c1),
        np.float32(c0),
    ]
    defines = (("GATHER_DEPTH_AWARE", int(kernel == "disc")),)
    return run_pass(device, "gather", "gather_blur", args, (height, width, 4), (1, height), (1, 1), defines)


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("kernel", ["disc", "gaussian"])
@pytest.mark.parametrize("count", [1, 16, 64])
def test_gather_meets_the_oracle(device: Device, size: tuple[int, int], kernel: str, count: int) -> None:
    rng = np.random.default_rng(count)
    image, inverse = rng.random((*size, 4), np.float32), rng.random(size, np.float32)
    aware = kernel == "disc"
    expected = oracle.blur(
        image.astype(float), inverse.astype(float), *gather_taps(count, kernel), RADII, -20.0, 8.0, aware
    )
    assert_close(gather(device, image, inverse, count, kernel, -20.0, 8.0), expected, "gather")


def test_the_widest_blurs(device: Device) -> None:
    """Beyond the last step they count as its end."""
    rng = np.random.default_rng(0)
    image, inverse = rng.random((19, 23, 4), np.float32), rng.random((19, 23), np.float32)
    expected = oracle.blur(image.astype(float), inverse.astype(float), *gather_taps(16), RADII, -9e9, 5e3, True)
    assert_close(gather(device, image, inverse, 16, "disc", -9e9, 5e3), expected, "gather")


@pytest.mark.parametrize("count", [16, 64, 128])
def test_taps_stand_for_the_disc(count: int) -> None:
    """Where each step begins: weight 1, centred, as broad as a disc; all of a narrow one; no more than asked for."""
    taps, first = gather_taps(count)
    assert first[-1] == len(taps)
    before = None
    for step, radius in enumerate(RADII[RADII < 200.0]):
        here = taps[first[step] : first[step + 1]]
        weight, end = here["weight"].astype(float) / 1024.0, (here["weight"].astype(float) + here["change"]) / 1024.0
        assert weight.min() >= 0.0
        assert end.min() >= -1e-9
        assert weight.sum() == pytest.approx(1.0, abs=1e-5)
        used = {(tap["dy"], tap["dx"]): value for tap, value in zip(here, weight, strict=True) if value > 0.0}
        if before is not None:  # the step before ends as this one begins
            assert used.keys() == before.keys()
            assert max(abs(used[at] - before[at]) for at in used) < 1e-6
        before = {(tap["dy"], tap["dx"]): value for tap, value in zip(here, end, strict=True) if value > 1e-8}
        assert (0, 0) in used
        most = count if radius <= 12.0 else min(4 * count, round(count * (radius / 12.0) ** 2))
        assert len(used) <= 1.2 * most + 4
        square = (weight * here["distance"] ** 2).sum()
        if radius > 0.5:
            assert square == pytest.approx(radius**2 / 2.0, rel=0.13 if count == 16 else 0.06, abs=0.14)
        for axis in ("dx", "dy"):
            assert abs((weight * here[axis]).sum()) < 0.02 * radius
        assert here["distance"][weight > 0.0].max() <= (radius + 0.5 if radius <= 64.0 else 1.05 * radius)
        if math.pi * (radius + 0.5) ** 2 <= count:
            whole = np.hypot(*np.mgrid[-9:10, -9:10]) <= radius - 0.5
            assert len(used) >= np.count_nonzero(whole)
    assert before is not None
