"""A scene is plain data that refuses what cannot be drawn."""

from __future__ import annotations

import numpy as np
import pytest

from cldof import Camera
from cldof.capture.scene import DirectionalLight, Gradient, Material, Node, PointLight, Scene
from cldof.errors import SceneError

from .conftest import quad


def test_a_narrower_image_keeps_the_horizontal_field() -> None:
    camera = Camera(800, 400, 40.0)
    scene = Scene("view", (), camera=camera)
    half = camera.focal_px * 2.0 / camera.width  # 1 / tangent of the horizontal half angle
    for width, height in ((200, 400), (333, 777)):
        narrow = scene.camera_for(width, height)
        assert narrow.focal_px * 2.0 / width == pytest.approx(half)
    wide = scene.camera_for(1600, 400)
    assert wide.yfov_deg == camera.yfov_deg
    np.testing.assert_array_equal(wide.pose, camera.pose)


def test_bounds_are_in_the_world() -> None:
    node = quad(2.0, 1.0)
    moved = Node(node.mesh, np.diag([2.0, 3.0, 4.0, 1.0]), node.material)
    np.testing.assert_allclose(Scene("one", (moved,)).bounds, [(-2, -3, -8), (2, 3, -8)])
    with pytest.raises(SceneError, match="empty"):
        _ = Scene("none", ()).bounds


def test_what_cannot_be_drawn_is_refused() -> None:
    with pytest.raises(SceneError, match="base_color is"):
        Material(base_color=(0.1, 0.2, -0.3, 1.0))
    with pytest.raises(SceneError, match="4 finite numbers"):
        Material(base_color=(0.1, 0.2, 0.3))  # type: ignore[arg-type]
    with pytest.raises(SceneError, match="alpha_mode is 'glass'"):
        Material(alpha_mode="glass")
    with pytest.raises(SceneError, match="4x4"):
        Node(quad(1.0).mesh, np.eye(3))
    with pytest.raises(SceneError, match="must point somewhere"):
        DirectionalLight((0.0, 0.0, 0.0))
    with pytest.raises(SceneError, match="must be finite"):
        PointLight((0.0, float("nan"), 0.0))
    with pytest.raises(SceneError, match="Gradient top"):
        Gradient((float("inf"), 0.0, 0.0), (0.0, 0.0, 0.0))
    with pytest.raises(SceneError, match="9 lights"):
        Scene("many", (), lights=(DirectionalLight((0.0, 0.0, -1.0)),) * 9)
