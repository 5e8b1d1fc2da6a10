"""What a plan leaves out changes no pixel by more than the plan says, and by no more than one step of 255."""

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from cldof import LayeredFrame, Lens
from tests.frames import noise_frame
from tests.planner.pairs import Pair, check
from tests.planner.scenes import Box, lens_for, wall_frame

WINDOW_CASES: dict[str, tuple[list[Box], float, int]] = {
    "near box": ([(100, 90, 150, 130, 1.0)], 4.0, 1),
    "hole": ([(100, 90, 150, 130, 9.0)], 6.0, 1),
    "hole of whole tiles": ([(112, 80, 160, 144, 9.0)], 6.0, 1),
    "at the edge": ([(0, 0, 40, 60, 1.2)], 5.0, 1),
    "in the corner": ([(300, 200, 333, 222, 1.3)], 5.0, 1),
    "two": ([(0, 0, 16, 16, 1.3), (310, 200, 333, 222, 5.0)], 2.0, 2),
    "a whole row": ([(0, 100, 333, 110, 1.4)], 2.0, 1),
}


@pytest.mark.parametrize("case", WINDOW_CASES)
def test_windows(pair: Pair, case: str) -> None:
    """Tiles in focus, by windows inside, at the edges and in corners."""
    boxes, coc, count = WINDOW_CASES[case]
    frame = wall_frame(333, 222, boxes)
    plan = check(pair, frame, lens_for(frame, coc, 2.0))
    windows = plan.structure.windows
    if pair[0].method.name in ("gather", "layered"):  # the margins of others may want the whole of so small a frame
        assert windows is not None
        assert 1 <= len(windows) <= count


@pytest.mark.parametrize("opaque", [True, False])
def test_windows_of_guard_bands_and_odd_sizes(pair: Pair, opaque: bool) -> None:
    inner = wall_frame(301, 203, [(120, 80, 150, 110, 1.1), (250, 20, 301, 60, 9.0)], opaque=opaque)
    guard = 21
    camera = inner.camera.__class__(301 - 2 * guard, 203 - 2 * guard, 40.0)
    frame = LayeredFrame(inner.color, inner.depth, camera, guard_px=guard)
    check(pair, frame, lens_for(frame, 4.0, 2.0))


# Methods that make single tiles of a frame.
SPARSE = ("lightfield", "multiview")


@pytest.mark.parametrize("guard", [0, 21])
@pytest.mark.parametrize("far_m", [9.0, 1.3])
def test_scattered_tiles(pair: Pair, far_m: float, guard: int) -> None:
    """Windows around these would be all of the frame. Elsewhere it is the pinhole's image."""
    boxes = [(x, y, x + 9, y + 11, far_m) for x, y in ((30, 25), (210, 22), (300, 190), (60, 150), (170, 90))]
    inner = wall_frame(333, 222, boxes)
    camera = inner.camera.__class__(333 - 2 * guard, 222 - 2 * guard, 40.0)
    frame = LayeredFrame(inner.color, inner.depth, camera, guard_px=guard)
    lens = lens_for(frame, 3.0, 2.0)
    plan = check(pair, frame, lens)
    if pair[0].method.name not in SPARSE:
        return
    assert plan.gaps is not None
    assert 0 < plan.summary["tiles"] < 0.7 * plan.gaps.size
    is_made = (plan.gaps == 0).repeat(16, 0).repeat(16, 1)[guard : 222 - guard, guard : 333 - guard]
    planned, full = (renderer.render(frame, lens).image for renderer in pair)
    np.testing.assert_array_equal(planned[is_made], full[is_made])
    np.testing.assert_array_equal(planned[~is_made], frame.pinhole_image()[~is_made])


@pytest.mark.parametrize("opaque", [True, False])
def test_little_depth(pair: Pair, opaque: bool) -> None:
    """All that there is fits into one layer, and what is in focus lies at its end."""
    frame = wall_frame(260, 190, [(0, 0, 4, 4, 0.9)], opaque=opaque)
    check(pair, frame, lens_for(frame, 0.3, 2.0))


def test_all_in_focus(pair: Pair) -> None:
    frame = wall_frame(70, 50, [])
    plan = check(pair, frame, lens_for(frame, 9.0, 2.0))
    assert plan.structure.windows == ()
    image = pair[0].render(frame, lens_for(frame, 9.0, 2.0)).image
    np.testing.assert_array_equal(image, frame.pinhole_image())


def test_a_plain_wall_out_of_focus_needs_no_blur(pair: Pair) -> None:
    frame = wall_frame(200, 100, [])
    color = np.broadcast_to(np.float32((0.3, 0.4, 0.5, 1.0)), frame.color.shape).copy()
    color[1:] = 0.0
    frame = LayeredFrame(color, frame.depth, frame.camera)
    plan = check(pair, frame, lens_for(frame, 9.0, 1.0))
    if pair[0].method.name != "gather":  # which blurs each pixel by itself and looks at no neighbour
        assert plan.structure.windows == ()


@pytest.mark.parametrize("opaque", [True, False])
@pytest.mark.parametrize("layers", [1, 4])
def test_glass_is_left_as_it_is_to_the_bit(pair: Pair, layers: int, opaque: bool) -> None:
    """What a pinhole sees of panes behind panes is what numpy computes, however little they let through."""
    frame = noise_frame(61, 43, layers, seed=layers, opaque=opaque)
    thick = np.random.default_rng(layers).uniform(0.5, 1.0, frame.color.shape[:3]).astype(np.float32)
    thick[-1] = 1.0
    frame = LayeredFrame(frame.color * thick[..., None], frame.depth, frame.camera)
    result = pair[0].render(frame, Lens(0.0, 1.0))
    assert result.plan.structure.windows == ()
    np.testing.assert_array_equal(result.image, frame.pinhole_image())


@settings(max_examples=12, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    boxes=st.lists(
        st.tuples(
            st.integers(0, 250), st.integers(0, 180), st.integers(4, 60), st.integers(4, 60),
            st.sampled_from([0.9, 1.3, 1.95, 2.05, 2.5, 9.0]),
        ),
        max_size=3,
    ),
    coc=st.sampled_from([0.01, 0.3, 1.0, 3.0, 7.0]),
    focus=st.sampled_from([1.3, 2.0, 9.0, 1e9]),
    tilt=st.sampled_from([0.0, 0.001, 0.3]),
    smooth=st.booleans(),
    bright=st.sampled_from([1.0, 20.0]),
    opaque=st.booleans(),
)  # fmt: skip
def test_walls_and_boxes(
    pair: Pair, boxes: list[Box], coc: float, focus: float, tilt: float, smooth: bool, bright: float, opaque: bool
) -> None:
    placed = [(x, y, x + w, y + h, z) for x, y, w, h, z in boxes]
    frame = wall_frame(260, 190, placed, tilt=tilt, smooth=smooth, bright=bright, opaque=opaque, seed=len(boxes))
    check(pair, frame, lens_for(frame, coc, focus))


@settings(max_examples=15, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    layers=st.integers(1, 4),
    seed=st.integers(0, 10**6),
    opaque=st.booleans(),
    aperture_px=st.floats(0.0, 20.0),
    focus=st.floats(0.2, 50.0),
)
def test_random_frames(pair: Pair, layers: int, seed: int, opaque: bool, aperture_px: float, focus: float) -> None:
    frame = noise_frame(75, 51, layers, seed=seed, opaque=opaque)
    if aperture_px == 0.0:
        np.testing.assert_array_equal(pair[0].render(frame, Lens(0.0, focus)).image, frame.pinhole_image())
        return
    check(pair, frame, lens_for(frame, aperture_px, focus))
