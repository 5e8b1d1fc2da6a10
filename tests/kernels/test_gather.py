"""The gather kernel against float64."""

import numpy as np
import pytest

from cldof.host.device import Device
from cldof.methods.base import row_pitch
from cldof.methods.gather import _SIZE, gather_samples
from tests.oracles import gather as oracle
from tests.running import padded, run_pass
from tests.tolerances import assert_close

SIZES = [(1, 1), (1, 37), (41, 1), (37, 21), (97, 61)]


def gather(
    device: Device, image: np.ndarray, inverse: np.ndarray, samples: np.ndarray, c1: float, c0: float, aware: bool
) -> np.ndarray:
    height, width = inverse.shape
    pitch = row_pitch(width)
    args = [
        padded(image, pitch),
        padded(inverse, pitch),
        samples,
        np.array((width, height, pitch, 0), _SIZE)[()],
        np.int32(len(samples)),
        np.float32(c1),
        np.float32(c0),
    ]
    defines = (("GATHER_DEPTH_AWARE", int(aware)),)
    return run_pass(device, "gather", "gather_blur", args, (height, width, 4), (1, height), (1, 1), defines)


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("kernel", ["disc", "gaussian"])
@pytest.mark.parametrize("count", [1, 16, 64])
def test_gather_meets_the_oracle(device: Device, size: tuple[int, int], kernel: str, count: int) -> None:
    rng = np.random.default_rng(count)
    image, inverse = rng.random((*size, 4), np.float32), rng.random(size, np.float32)
    samples = gather_samples(count, kernel)
    aware = kernel == "disc"
    expected = oracle.blur(image.astype(float), inverse.astype(float), samples.astype(float), -20.0, 8.0, aware)
    assert_close(gather(device, image, inverse, samples, -20.0, 8.0, aware), expected, "gather")


def test_samples_cover_the_disc_evenly() -> None:
    x, y, distance = gather_samples(64).T
    np.testing.assert_allclose(distance, np.hypot(x, y), rtol=1e-5)
    assert distance.max() <= 1.1
    assert np.count_nonzero(distance < np.sqrt(0.5)) == pytest.approx(32, abs=3)
    assert abs(x.mean()) < 0.05
    assert abs(y.mean()) < 0.05
    assert gather_samples(64, "gaussian")[:, :2].std() == pytest.approx(0.5, rel=0.05)
