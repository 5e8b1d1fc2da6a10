"""Lights and environments as data: what is refused, and what a frame keeps of them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cldof import (
    Ambient,
    Camera,
    DirectionalLight,
    Environment,
    FrameError,
    LayeredFrame,
    Lighting,
    PointLight,
    SceneError,
)
from tests.shaded import LIGHTS, environment, shaded_frame

BAD = np.full((4, 8, 3), 0.5, np.float32)
BAD[2, 5, 1] = np.nan


@pytest.mark.parametrize(
    "make, says",
    [
        (lambda: Lighting((DirectionalLight((0, -1, 0)),) * 9), "9 lights of kind DirectionalLight; at most 8"),
        (lambda: Lighting(("sun",)), "got str"),  # type: ignore[arg-type]
        (lambda: Lighting(ambient=(1, 1, 1)), "got tuple"),  # type: ignore[arg-type]
        (lambda: Lighting(environment=BAD), "got ndarray"),  # type: ignore[arg-type]
        (lambda: PointLight((0, float("nan"), 0)), "must be finite"),
        (lambda: DirectionalLight((0, 0, 0)), "point somewhere"),
        (lambda: Ambient((-1, 0, 0)), "none below 0"),
        (lambda: Environment(BAD), "1 values that are negative, NaN or infinite; the first is at pixel x=5, y=2"),
        (lambda: Environment(np.zeros((4, 8, 3), np.uint8)), "dtype uint8"),
        (lambda: Environment(np.zeros((4, 8), np.float32)), r"shape \(4, 8\)"),
        (lambda: Environment(np.zeros((4, 2, 3), np.float32)), "2 pixels wide"),
    ],
)
def test_what_is_wrong_is_said(make: Any, says: str) -> None:
    with pytest.raises(SceneError, match=says):
        make()


def test_plain_numbers_and_back() -> None:
    again = Lighting.from_dict(LIGHTS.to_dict())
    assert again.lights == LIGHTS.lights and again.ambient == LIGHTS.ambient
    camera = Camera(5, 4)
    np.testing.assert_array_equal(again.packed(camera, 2), LIGHTS.packed(camera, 2))


@pytest.mark.parametrize("lit_by", [None, environment()], ids=["hemisphere", "environment"])
def test_a_saved_frame_keeps_its_light(tmp_path: Path, lit_by: Environment | None) -> None:
    frame = shaded_frame(12, 7, Lighting(LIGHTS.lights, LIGHTS.ambient, lit_by))
    frame.save(tmp_path / "frame.npz")
    loaded = LayeredFrame.load(tmp_path / "frame.npz")
    assert loaded.is_glossy and loaded.inputs.keys() == frame.inputs.keys()
    for name, array in frame.inputs.items():
        np.testing.assert_array_equal(loaded.inputs[name], array)


def test_light_without_surfaces_is_refused() -> None:
    color, depth = np.ones((2, 3, 4), np.float32), np.ones((2, 3), np.float32)
    with pytest.raises(FrameError, match="needs normal, specular, shininess too"):
        LayeredFrame(color, depth, Camera(3, 2), lighting=Lighting())
    with pytest.raises(FrameError, match=r"lighting must be .* got str"):
        LayeredFrame(color, depth, Camera(3, 2), lighting="sun")  # type: ignore[arg-type]
    with pytest.raises(FrameError, match=r"specular has 18 values outside of 0 to 1"):
        LayeredFrame(color, depth, Camera(3, 2), specular=np.full((2, 3, 3), 2.0, np.float32))


def test_without_specular_nothing_is_glossy() -> None:
    frame = shaded_frame(12, 7)
    assert frame.is_glossy
    matte = {**frame.surface, "specular": np.zeros_like(frame.surface["specular"])}
    again = LayeredFrame(frame.color, frame.depth, frame.camera, lighting=frame.lighting, **matte)
    assert not again.is_glossy
    bare = LayeredFrame(frame.color, frame.depth, frame.camera, **frame.surface)
    assert not bare.is_glossy and "lighting" not in bare.inputs


def test_how_far_highlights_turn() -> None:
    """One slot of roughness 0.2 at 2 m among matte ones: alpha is 0.04, the lobe turns by half of 1/2 rad a metre."""
    shape = (1, 2, 3)
    depth = np.full(shape, 0.5, np.float32)
    specular, shininess = np.zeros((*shape, 3), np.float32), np.full(shape, 1e4, np.float32)
    depth[0, 1, 2], specular[0, 1, 2], shininess[0, 1, 2] = 2.0, 0.04, 2.0 / 0.2**4 - 2.0
    frame = LayeredFrame(
        np.ones((*shape, 4), np.float32), depth, Camera(3, 2), normal=np.ones((*shape, 3), np.float32),
        specular=specular, shininess=shininess, lighting=Lighting(),
    )  # fmt: skip
    assert frame.lobe_turn_per_m == pytest.approx(0.25 / 0.04, rel=1e-5)
