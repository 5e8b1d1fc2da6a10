"""The statistics pass against its float64 twin."""

from typing import Any

import numpy as np
import pytest

from cldof import Camera, LayeredFrame, Lens
from cldof.host.device import Device
from cldof.methods import FrameShape
from cldof.planner import BINS, SceneStats
from cldof.renderer import Renderer, frame_stats
from tests.frames import noise_frame
from tests.oracles.stats import tile_stats

SIZES = [(1, 1), (1, 40), (37, 21), (64, 48), (16, 16), (33, 50)]


@pytest.mark.parametrize("opaque", [True, False])
@pytest.mark.parametrize("size", SIZES)
def test_tiles(device: Device, size: tuple[int, int], opaque: bool) -> None:
    frame = noise_frame(*size, layers=3, seed=sum(size), opaque=opaque)
    stats = frame_stats(device, frame)
    expected = tile_stats(frame)
    for name in ("slots", "solid"):
        np.testing.assert_array_equal(getattr(stats, name), expected[name], err_msg=name)
    for name in ("nearest", "farthest", "step", "luminance", "low", "high"):
        np.testing.assert_allclose(getattr(stats, name), expected[name], rtol=2e-6, atol=1e-6, err_msg=name)
    bits = (stats.bins[..., None] >> np.arange(BINS, dtype=np.uint64) & np.uint64(1)).astype(bool)
    # A slot at the edge of a bin may fall into the next one.
    assert (bits != expected["bins"]).mean() < 2e-3
    assert stats.shape == FrameShape.of(frame)


@pytest.mark.parametrize("across", [False, True])
def test_steps_from_tile_to_tile_count_for_the_first(device: Device, across: bool) -> None:
    """Depth changes between the last pixel of a tile and the only one of the next, and nowhere else."""
    depth = np.full((17, 33), 2.0, np.float32)
    depth[16] = 4.0
    depth = np.ascontiguousarray(depth.T) if across else depth
    height, width = depth.shape
    stats = frame_stats(
        device, LayeredFrame(np.ones((height, width, 4), np.float32), depth, Camera(width, height, 40.0))
    )
    step = stats.step[0].T if across else stats.step[0]
    np.testing.assert_array_equal(step, [[0.25, 0.25, 0.25], [0.0, 0.0, 0.0]])


def test_the_histogram_counts_what_is_there(device: Device) -> None:
    frame = noise_frame(200, 150, layers=2, seed=5)
    stats = frame_stats(device, frame)
    there = frame.color[..., 3] > 0
    first, last = frame.inverse_depth_range
    for peel in range(2):
        exact, _ = np.histogram(1.0 / frame.depth[peel][there[peel]], BINS, (first, last))
        share = stats.histogram[peel] / exact.sum()
        assert abs(share.sum() - 1.0) < 0.05
        assert np.abs(np.cumsum(share) - np.cumsum(exact) / exact.sum()).max() < 0.08


@pytest.mark.parametrize("opaque", [True, False])
def test_the_histogram_takes_one_row_in_sixteen(device: Device, opaque: bool) -> None:
    """Row 5 t modulo 16 of the t-th sixteen, or the last there is, for all of them; void is no slot."""
    frame = noise_frame(61, 75, layers=2, seed=5, opaque=opaque)
    first, last = frame.inverse_depth_range
    expected = np.zeros((2, BINS))
    for top in range(0, 75, 16):
        y = min(top + 5 * (top // 16) % 16, 74)
        for peel in range(2):
            there = frame.color[peel, y, :, 3] > 0
            counted, _ = np.histogram(1.0 / frame.depth[peel, y][there], BINS, (first, last))
            expected[peel] += counted * min(16, 75 - top)
    found = frame_stats(device, frame).histogram
    np.testing.assert_allclose(found.sum(axis=1), expected.sum(axis=1))
    # A slot at the edge of a bin may fall into the next one.
    assert np.abs(np.cumsum(found - expected, axis=1)).max() <= 16


def test_shares_of_blur(device: Device) -> None:
    """A third in front, a third in focus, a third behind."""
    depth = np.repeat(np.float32([1.0, 2.0, 8.0]), 20)[None, :].repeat(40, 0)
    color = np.ones((40, 60, 4), np.float32)
    frame = LayeredFrame(color, depth, Camera(60, 40, 40.0))
    stats = frame_stats(device, frame)
    shares = stats.blur_shares(Lens(0.1, 2.0), frame.camera)
    np.testing.assert_allclose(shares, 1.0 / 3.0, atol=1e-6)
    coc, slots = stats.coc_histogram(Lens(0.1, 2.0), frame.camera)
    assert slots.sum() == pytest.approx(2400)
    assert slots[coc < -0.5].sum() == pytest.approx(800)


def test_the_renderer_has_them(device_info: Any) -> None:
    frame = noise_frame(40, 30)
    with Renderer(device=device_info.index) as renderer:
        stats = renderer.stats(frame)
        assert isinstance(stats, SceneStats)
        assert renderer.stats(frame) is stats
        np.testing.assert_array_equal(stats.slots, tile_stats(frame)["slots"])
