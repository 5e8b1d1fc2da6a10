"""What every method reads: inverse depth with what stands for sky, void and the end of a row."""

import numpy as np
import pytest

from cldof import Camera, LayeredFrame
from cldof.host.device import Device
from cldof.methods.base import row_pitch
from tests.running import inverse_depth


@pytest.mark.parametrize("size", [(1, 1), (1, 9), (17, 1), (16, 3), (256, 2), (37, 21)])
@pytest.mark.parametrize("opaque", [True, False])
@pytest.mark.parametrize("with_stats", [False, True])
def test_inverse_depth_of_every_slot(device: Device, size: tuple[int, int], opaque: bool, with_stats: bool) -> None:
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
    found = inverse_depth(device, frame, with_stats)
    np.testing.assert_allclose(found, expected, rtol=2e-7)
    np.testing.assert_array_equal(found <= 0.0, expected <= 0.0)


@pytest.mark.parametrize("with_stats", [False, True])
@pytest.mark.parametrize("channel", [0, 1, 2])
def test_light_without_coverage_is_there(device: Device, channel: int, with_stats: bool) -> None:
    """A slot with neither light nor coverage is EMPTY whatever its depth; one channel of light is enough."""
    depth = np.stack([np.full((3, 37), 1.0, np.float32), np.full((3, 37), 2.0, np.float32)])
    color = np.ones((2, 3, 37, 4), np.float32)
    color[0] = 0.0
    color[0, :, ::2, channel] = 0.5
    found = inverse_depth(device, LayeredFrame(color, depth, Camera(37, 3, 40.0)), with_stats)
    assert (found[0, :, 0:37:2] == 1.0).all()
    assert (found[0, :, 1:37:2] == -1.0).all()
    assert (found[1, :, :37] == 0.5).all()
