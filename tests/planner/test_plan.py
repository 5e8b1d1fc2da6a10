"""What plans decide, what they say, and that they cost no rebuilding."""

import json
import math

import numpy as np
import pytest

from cldof import Camera, InputError, LayeredFrame, Lens, Renderer
from cldof.host.device import DeviceInfo
from cldof.planner import Decision, FramePlan, _boxes, _spread, peels_needed
from tests.frames import noise_frame
from tests.planner.pairs import ROUNDING
from tests.planner.scenes import lens_for, wall_frame


def decision(plan: FramePlan, effect: str) -> Decision:
    return next(one for one in plan.decisions if one.effect == effect)


def test_spread_is_the_maximum_of_a_square() -> None:
    values = np.random.default_rng(0).random((7, 12))
    for radius in (0, 1, 2, 3, 5, 11, 40):
        expected = [
            [values[max(y - radius, 0) : y + radius + 1, max(x - radius, 0) : x + radius + 1].max() for x in range(12)]
            for y in range(7)
        ]
        np.testing.assert_array_equal(_spread(values, radius), expected)


def test_gaps_are_distances_to_what_is_made(device_info: DeviceInfo) -> None:
    """No pixel of a tile is nearer to one that is made than its gap; and not by a pixel more is it understated."""
    frame = wall_frame(333, 222, [(30, 25, 39, 36, 1.3), (300, 190, 309, 201, 1.3)])
    with Renderer("lightfield", device=device_info.index) as renderer:
        plan = renderer.render(frame, lens_for(frame, 9.0, 2.0)).plan
        assert plan.gaps is not None
        gaps = plan.gaps
        made = np.argwhere(gaps == 0)
        for at, gap in np.ndenumerate(gaps):
            apart = int(np.abs(made - at).max(axis=1).min())
            exact = 16 * (apart - 1) + 1 if apart else 0
            assert gap == exact or (gap > 64 and exact > 9.0 + 6.0)
        # More lenses than plans are kept, then the first again: what was uploaded for it is gone.
        first = renderer.render(frame, lens_for(frame, 9.0, 2.0)).image
        for step in range(20):
            renderer.render(frame, lens_for(frame, 9.0 - 0.1 * step, 2.0))
        np.testing.assert_array_equal(renderer.render(frame, lens_for(frame, 9.0, 2.0)).image, first)


def test_boxes_hold_all_and_are_cut_along_gaps() -> None:
    rng = np.random.default_rng(1)
    for _ in range(50):
        active = rng.random((20, 30)) < 0.02
        active[rng.integers(20), rng.integers(30)] = True
        boxes = _boxes(active, 4, 5)
        covered = np.zeros_like(active)
        for x0, y0, x1, y1 in boxes:
            assert not covered[y0:y1, x0:x1].any()
            covered[y0:y1, x0:x1] = True
        assert not (active & ~covered).any()
        assert 1 <= len(boxes) <= 4
    two = np.zeros((10, 20), bool)
    two[2, 1] = two[7, 18] = True
    assert _boxes(two, 4, 5) == [(1, 2, 2, 3), (18, 7, 19, 8)]
    assert _boxes(two, 4, 17) == [(1, 2, 19, 8)]


def test_sides(device_info: DeviceInfo) -> None:
    """Near, far or both sides, by where the boxes stand."""
    with Renderer(device=device_info.index) as renderer:
        for boxes, near, far in (
            ([(10, 10, 60, 50, 1.0)], True, False),
            ([(10, 10, 60, 50, 9.0)], False, True),
            ([(10, 10, 40, 50, 1.0), (60, 10, 90, 50, 9.0)], True, True),
        ):
            frame = wall_frame(120, 80, boxes)
            plan = renderer.render(frame, lens_for(frame, 4.0, 2.0)).plan
            assert decision(plan, "near side").kept is near
            assert decision(plan, "far side").kept is far
            assert (plan.summary["focus_layer"] > 0) is near
            assert (plan.summary["focus_layer"] < plan.summary["layers"] - 1) is far


def test_peels_that_hold_nothing_or_cannot_be_seen(device_info: DeviceInfo) -> None:
    boxes = [(20, 20, 60, 60, 1.0)]
    frame = wall_frame(100, 90, boxes)  # the wall behind the box; the third peel is empty
    with Renderer(device=device_info.index) as renderer:
        plan = renderer.render(frame, lens_for(frame, 4.0, 2.0)).plan
        assert plan.summary["peels_used"] == 2
        assert not decision(plan, "peel 3").kept
        stats = renderer.stats(frame)
    lens = lens_for(frame, 4.0, 2.0)
    assert peels_needed(stats, lens, frame.camera)[0] == 2
    assert peels_needed(stats, Lens(0.0, 2.0), frame.camera)[0] == 1
    # A second wall, everywhere behind the first: no lens can see it.
    depth, color = frame.depth[[0, 0]].copy(), frame.color[[0, 0]].copy()
    depth[0], depth[1] = 2.0, 5.0
    hidden = LayeredFrame(color, depth, frame.camera)
    with Renderer(device=device_info.index) as renderer:
        stats = renderer.stats(hidden)
        plan = renderer.render(hidden, lens_for(hidden, 4.0, 3.0)).plan
    assert peels_needed(stats, lens, frame.camera)[0] == 1
    assert plan.summary["peels_used"] == 1
    assert "lets nothing through" in decision(plan, "peel 2").reason


def test_highlights(device_info: DeviceInfo) -> None:
    frame = wall_frame(64, 64, [])
    color = np.full_like(frame.color, 0.5)
    color[..., 3] = 1.0
    color[1:] = 0.0
    color[0, 20, 40, :3] = 100.0
    frame = LayeredFrame(color, frame.depth, frame.camera)
    with Renderer(device=device_info.index) as renderer:
        stats = renderer.stats(frame)
    lens = lens_for(frame, 12.0, 3.0)
    assert stats.brightest == 100.0
    spread = stats.highlights(lens, frame.camera)
    # The wall is at one depth, so all of it has the same CoC.
    area = math.pi * float(lens.coc_radius_px(frame.camera, float(frame.depth[0, 0, 0]))) ** 2
    assert area > 1.0
    assert np.unravel_index(spread.argmax(), spread.shape) == (0, 1, 2)
    assert np.sort(spread, axis=None)[-2:] == pytest.approx([0.5 * area, 100.0 * area], rel=1e-5)
    with Renderer("multiview", device=device_info.index) as renderer:
        lit, dim = (renderer.render(frame, lens_for(frame, coc, 3.0)).plan for coc in (12.0, 2.5))
    assert decision(lit, "more rays for lights").kept
    assert "100" in decision(lit, "more rays for lights").reason
    assert not decision(dim, "more rays for lights").kept


def test_a_smaller_change_allowed_is_kept(device_info: DeviceInfo) -> None:
    """A tilted wall is a little out of focus everywhere."""
    frame = wall_frame(100, 80, [], tilt=0.002, smooth=True)
    lens = lens_for(frame, 2.0, 2.0)
    bounds = []
    for allowed in (0.0, 1.0 / 50.0, 0.1):
        with Renderer(device=device_info.index, max_change=allowed) as renderer:
            plan = renderer.render(frame, lens).plan
        assert plan.error_bound <= allowed
        bounds.append(plan.error_bound)
        assert (plan.structure.windows == ()) is (allowed > 0.0)
    assert bounds[0] == 0.0 < bounds[1]
    for bad in (-1.0, math.nan, "much"):
        with pytest.raises(InputError, match="max_change"):
            Renderer(device=device_info.index, max_change=bad)  # type: ignore[arg-type]


def test_explain_says_all_of_it(device_info: DeviceInfo) -> None:
    frame = wall_frame(333, 222, [(100, 90, 150, 130, 1.0)])
    with Renderer(device=device_info.index) as renderer:
        plan = renderer.render(frame, lens_for(frame, 4.0, 2.0)).plan
    text = plan.explain()
    for part in ("layered: 333x222 px", "focus at 2 m", "near side", "left out  far side", "saves about", "255 steps"):
        assert part in text
    for one in plan.decisions:
        assert one.effect in text
        assert one.kept or one.error <= plan.error_bound
        assert one.error_db == (math.inf if one.error == 0.0 else pytest.approx(-20 * math.log10(one.error)))
    assert max(map(len, text.splitlines()[1:])) <= 120
    assert sum(one.error for one in plan.decisions) == pytest.approx(plan.error_bound)
    report = plan.to_dict()
    assert {one["effect"] for one in report["decisions"]} == {one.effect for one in plan.decisions}
    json.dumps({key: str(value) for key, value in report.items()})


def test_a_focus_sweep_builds_few_programs(device_info: DeviceInfo) -> None:
    """Windows begin and end on a grid, so a lens in motion meets the same sizes again."""
    frame = wall_frame(333, 222, [(100, 90, 150, 130, 1.0)])
    with Renderer("gather", device=device_info.index) as renderer:
        built = set()
        for coc in np.linspace(2.0, 6.0, 60):
            built.add(renderer.render(frame, lens_for(frame, float(coc), 2.0)).plan.structure)
    assert len(built) <= 4


def test_a_known_frame_is_planned_once_a_lens(device_info: DeviceInfo) -> None:
    frame = noise_frame(50, 40)
    with Renderer(device=device_info.index) as renderer:
        first = renderer.render(frame, Lens(0.1, 2.0)).plan
        assert renderer.render(frame, Lens(0.1, 2.0)).plan is first
        assert renderer.render(frame, Lens(0.1, 1.0)).plan is not first


def test_planning_can_be_off(device_info: DeviceInfo) -> None:
    frame = wall_frame(64, 48, [])
    with Renderer(device=device_info.index, planned=False) as renderer:
        plan = renderer.render(frame, Lens(0.0, 2.0)).plan
        assert "planning is off" in plan.explain()
        with pytest.raises(InputError, match="planned=False"):
            renderer.stats(frame)
    with pytest.raises(InputError, match="statistics"):
        Renderer(device=device_info.index, statistics="some")


@pytest.mark.parametrize("method", ["gather", "lightfield"])
def test_by_the_frame_before_nothing_waits(device_info: DeviceInfo, method: str) -> None:
    """A box that moves by less than a tile per frame is right without waiting for statistics."""
    frames = [wall_frame(300, 200, [(100 + 3 * n, 90, 140 + 3 * n, 130, 1.0)]) for n in range(6)]
    lens = lens_for(frames[0], 4.0, 2.0)
    with Renderer(method, device=device_info.index, planned=method == "gather") as renderer:
        expected = [renderer.render(frame, lens).image for frame in frames]
    with Renderer(method, device=device_info.index, statistics="last", frames_in_flight=3) as renderer:
        pending = [renderer.render_async(frame, lens) for frame in frames]
        results = [one.result() for one in pending]
    for result, image in zip(results, expected, strict=True):
        np.testing.assert_allclose(result.image, image, atol=0.0 if method == "gather" else ROUNDING)
    kinds = [result.plan.summary["statistics"] for result in results]
    assert kinds[0] == "frame"
    for result in results:
        if result.plan.summary["statistics"] == "last":
            assert "Judged by the frame before" in result.plan.explain()
            assert result.plan.summary["peels_used"] == 3


def test_supersampling_by_the_method_itself(device_info: DeviceInfo) -> None:
    """Its image is smaller than the frame, so nothing may be copied or pasted."""
    color = np.random.default_rng(0).random((64, 96, 4), np.float32)
    color[..., 3] = 1.0
    frame = LayeredFrame(color, np.full((64, 96), 2.0, np.float32), Camera(96, 64, 40.0))
    for method in ("multiview", "layered"):
        with Renderer(method, device=device_info.index, supersample=2) as renderer:
            image = renderer.render(frame, Lens(0.0, 2.0)).image
        expected = color.reshape(32, 2, 48, 2, 4).mean(axis=(1, 3))
        np.testing.assert_allclose(image, expected, atol=1e-6)
