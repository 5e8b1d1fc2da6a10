"""The built-in scenes: the same every time, quick enough, and with a blur that can be seen."""

from __future__ import annotations

import functools
import math

import numpy as np
import pytest

from cldof import Lens, SceneError
from cldof.capture import shapes
from cldof.capture.peel import DepthPeeler
from cldof.capture.scene import Scene
from cldof.capture.scenes import builtin_scene, builtin_scenes

NAMES = tuple(builtin_scenes())
MOST_TRIANGLES = 100_000


build = functools.cache(builtin_scene)


@pytest.fixture(params=NAMES)
def named_scene(request: pytest.FixtureRequest) -> tuple[str, Scene]:
    """Each scene in turn, built once."""
    return request.param, build(request.param)


def test_list() -> None:
    assert {"row", "fence", "foliage", "tabletop", "glass"} <= set(NAMES)
    assert all(scene.description for scene in builtin_scenes().values())
    with pytest.raises(SceneError, match=r"'nowhere'; there are row, fence"):
        builtin_scene("nowhere")


def test_complete_and_not_too_heavy(named_scene: tuple[str, Scene]) -> None:
    name, scene = named_scene
    assert scene.name == name
    assert scene.camera is not None and scene.focus_distance_m and scene.aperture_radius_m
    triangles = sum(len(node.mesh.faces) for node in scene.nodes)
    assert 1000 < triangles <= MOST_TRIANGLES
    assert len(scene.nodes) < 60
    for node in scene.nodes:
        assert np.isfinite(node.mesh.vertices).all()
        normals = np.linalg.norm(node.mesh.vertex_normals, axis=1)
        assert normals == pytest.approx(1.0, abs=1e-6)


def test_same_every_time() -> None:
    first, second = build("foliage"), builtin_scene("foliage")
    assert len(first.nodes) == len(second.nodes)
    for a, b in zip(first.nodes, second.nodes, strict=True):
        assert np.array_equal(a.mesh.vertices, b.mesh.vertices)
        if a.material.base_color_texture is not None:
            assert a.material.base_color_texture.tobytes() == b.material.base_color_texture.tobytes()


def test_blur_is_clear_but_not_garish(named_scene: tuple[str, Scene], peeler: DepthPeeler) -> None:
    name, scene = named_scene
    camera = scene.camera_for(96, 96)
    lens = Lens(scene.aperture_radius_m, scene.focus_distance_m)
    frame = peeler.peel(scene, camera, layers=4, lens=lens)
    c1, c0 = lens.coc_coefficients(camera)
    largest = max(abs(c1 * inverse + c0) for inverse in frame.inverse_depth_range) / camera.height
    assert 0.02 < largest < 0.032
    # Something is in focus, and more than one layer matters.
    coc = lens.coc_radius_px(camera, frame.depth[frame.color[..., 3] > 0]) / camera.height
    assert (np.abs(coc) < 0.002).mean() > 0.02
    assert frame.layer_count == 4
    assert frame.is_opaque == (name != "floating")


@pytest.mark.parametrize("size", [(160, 90), (64, 64), (54, 96)])
def test_any_image_shape_is_filled(size: tuple[int, int], peeler: DepthPeeler) -> None:
    # Floors and walls reach past the edges, guard band included: nothing in sight of the ground is sky.
    for name in ("row", "fence", "foliage", "glass"):
        scene = build(name)
        camera = scene.camera_for(*size)
        frame = peeler.peel(scene, camera, layers=1, guard_px=math.ceil(0.1 * max(size)))
        assert np.isfinite(frame.depth[0, -1]).all(), name


def test_tabletop_has_lights_brighter_than_white(peeler: DepthPeeler) -> None:
    scene = build("tabletop")
    frame = peeler.peel(scene, scene.camera_for(128, 128), layers=1)
    assert frame.color.max() > 5.0


def test_glass_is_half_transparent(peeler: DepthPeeler) -> None:
    scene = build("glass")
    frame = peeler.peel(scene, scene.camera_for(128, 128), layers=4)
    alpha = frame.color[0, ..., 3]
    assert ((alpha > 0.1) & (alpha < 0.9)).mean() > 0.2


SOLIDS = {
    "ball": (lambda: shapes.ball(1.0), 4 / 3 * math.pi),
    "block": (lambda: shapes.block((1.0, 2.0, 3.0), 1e-3), 6.0),
    "cylinder": (lambda: shapes.lathe([(0, 0), (1, 0), (1, 2), (0, 2)], 96), 2 * math.pi),
    "ring": (lambda: shapes.ring(1.0, 0.2, 96, 48), 2 * math.pi**2 * 0.04),
    "pipe": (lambda: shapes.pipe([(0, 0, 0), (0, 0.5, 0), (0, 3, 0)], 0.2, 96), 3 * math.pi * 0.04),
    "star": (lambda: shapes.star(5, 1.0, 0.5, 2.0), 2 * 10 * 0.5 * 0.5 * math.sin(math.pi / 5)),
}


@pytest.mark.parametrize("name", SOLIDS)
def test_shapes_are_solid_and_face_out(name: str) -> None:
    make, volume = SOLIDS[name]
    mesh = make()
    assert mesh.volume == pytest.approx(volume, rel=0.02)
    facing = (mesh.face_normals * np.asarray(mesh.vertex_normals)[mesh.faces].mean(axis=1)).sum(axis=1)
    assert facing.min() > 0.9
    assert mesh.visual.uv.shape == (len(mesh.vertices), 2)


def test_moved_meshes_keep_their_normals() -> None:
    mesh = shapes.moved(shapes.ball(1.0), (1, 2, 3), (30, 40, 50), (1.0, 2.0, 0.5))
    assert np.allclose(mesh.vertices.mean(axis=0), (1, 2, 3), atol=0.05)
    facing = (mesh.face_normals * np.asarray(mesh.vertex_normals)[mesh.faces].mean(axis=1)).sum(axis=1)
    assert facing.min() > 0.9
