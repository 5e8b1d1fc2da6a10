"""What every method reads: inverse depth with what stands for sky, void and the end of a row."""

import numpy as np
import pytest

from cldof import Camera, LayeredFrame
from cldof.host.device import Device
from cldof.methods.base import row_pitch
from tests.running import inverse_depth


@pytest.mark.parametrize("size", [(1, 1), (1, 9), (17, 1), (16, 3), (256, 2), (37, 21)])
@pytest.mark.parametrize("opaque", [True, False])
def test_inverse_depth_of_every_slot(device: Device, size: tuple[int, int], opaque: bool) -> None:
    """Where the image is opaque nothing is seen past it, so a slot that holds nothing is EMPTY (-1), else void (0)."""
    width, height = size
    rng = np.random.default_rng(width)
    depth = np.sort(rng.uniform(0.1, 90.0, (3, height, width)).astype(np.float32), axis=0)
    color = np.ones((3, height, width, 4), np.float32)
    sky, nothing = rng.random((height, width)) < 0.3, rng.random((height, width)) < 0.3
    depth[2, sky | nothing] = np.inf
    color[2, nothing] = 0.0
    if not opaque:
        depth[:, 0, 0], color[:, 0, 0] = np.inf, 0.0
    frame = LayeredFrame(color, depth, Camera(width, height, 40.0))
    assert frame.is_opaque == opaque
    expected = np.full((3, height, row_pitch(width)), -1.0)
    here = 1.0 / depth.astype(np.float64)
    expected[..., :width] = np.where(np.isinf(depth) & (color[..., 3] == 0.0), -1.0 if opaque else 0.0, here)
    found = inverse_depth(device, frame)
    np.testing.assert_allclose(found, expected, rtol=2e-7)
    np.testing.assert_array_equal(found <= 0.0, expected <= 0.0)
