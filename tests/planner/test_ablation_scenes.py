"""Plans of every built-in scene, by every method, against everything switched on."""

from functools import cache

import numpy as np
import pytest

from cldof import LayeredFrame, Lens
from cldof.capture.scenes import builtin_scene, builtin_scenes
from tests.opengl import require_opengl
from tests.planner.pairs import Pair, check

SIZE = 80


@cache
def captured(name: str) -> tuple[LayeredFrame, tuple[Lens, ...]]:
    """A frame of four peels, and lenses: its own, a narrow one, and one focused on the nearest surface."""
    from cldof.capture.peel import DepthPeeler

    scene = builtin_scene(name)
    radius, focus = scene.aperture_radius_m, scene.focus_distance_m
    assert radius is not None
    assert focus is not None
    with DepthPeeler(SIZE, SIZE) as peeler:
        frame = peeler.peel(scene, scene.camera_for(SIZE, SIZE), layers=4, guard_px=4)
    nearest = float(frame.depth.min())
    return frame, (Lens(radius, focus), Lens(radius / 50, focus), Lens(radius, nearest))


@pytest.mark.parametrize("name", list(builtin_scenes()))
def test_nothing_left_out_shows(pair: Pair, name: str) -> None:
    require_opengl()
    frame, lenses = captured(name)
    for lens in lenses:
        plan = check(pair, frame, lens)
        # Every effect is decided on, one way or the other.
        effects = {one.effect for one in plan.decisions}
        assert {"near side", "far side"} <= effects
        assert effects & {"tiles in focus", "whole frame"}
    image = pair[0].render(frame, Lens(0.0, lenses[0].focus_distance_m)).image
    np.testing.assert_array_equal(image, frame.pinhole_image())
