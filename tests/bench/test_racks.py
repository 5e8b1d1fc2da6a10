"""What bench/racks.py measures, on sequences whose jumps are known."""

from __future__ import annotations

import math

import numpy as np
import pytest

from bench.racks import Steps, rack_lenses, report, step_ratios
from cldof import Camera, InputError, LayeredFrame
from cldof.capture.scenes import builtin_scene


def test_steps_are_what_changes_on_a_screen() -> None:
    dark, bright = np.zeros((2, 3, 4), np.float32), np.zeros((2, 3, 4), np.float32)
    bright[1, 2] = 0.5, 7.0, 0.0, 1.0  # clipped to 1; alpha does not count
    steps = Steps()
    for image in (dark, bright, bright):
        steps.add(image)
    assert steps.rms == pytest.approx([math.sqrt((0.25 + 1.0) / 18.0), 0.0])
    assert list(steps.pixel) == [1.0, 0.0]


def test_ratios_name_the_largest_step_and_the_worst_place() -> None:
    reference = np.array([4.0, 2.0, 0.1, 0.0])
    found = step_ratios(np.array([6.0, 5.0, 0.1, 2.0]), reference)
    assert (found["ratio"], found["at"]) == (1.5, 0)
    assert (found["local_ratio"], found["local_at"]) == (2.5, 1)  # where nothing moves a quarter of the jump counts
    assert step_ratios(np.array([0.0, 0.0, 0.0, 3.0]), reference)["local_ratio"] == 3.0


def test_a_rack_goes_through_what_is_seen() -> None:
    scene = builtin_scene("plane")
    depth = np.full((1, 10, 10), 2.0, np.float32)
    depth[0, :2], depth[0, 8:] = 1.0, 4.0
    look = LayeredFrame(np.ones((1, 10, 10, 4), np.float32), depth, Camera(10, 10))
    lenses = rack_lenses(scene, look, 5)
    assert [lens.focus_distance_m for lens in lenses] == pytest.approx([1.0, 1.0 / 0.8125, 1.6, 1.0 / 0.4375, 4.0])
    assert {lens.aperture_radius_m for lens in lenses} == {1.5 * scene.aperture_radius_m}


def test_what_there_is_not_is_refused() -> None:
    for scenes, methods, frames, says in (
        (["nowhere"], ["layered"], 9, "no built-in scene 'nowhere'"),
        (["plane"], ["magic"], 9, "no method 'magic'"),
        (["plane"], ["layered"], 2, "frames is 2"),
    ):
        with pytest.raises(InputError, match=says):
            report(None, scenes, methods, frames, 32, 8, None)
