"""The built-in scenes: the same every time, quick enough, and with a blur that can be seen."""

from __future__ import annotations

import functools
import math
from pathlib import Path

import numpy as np
import pytest

from cldof import Lens, SceneError
from cldof.capture import shapes
from cldof.capture.find import find_scene
from cldof.capture.model_scenes import bunnies
from cldof.capture.peel import DepthPeeler
from cldof.capture.scene import Scene
from cldof.capture.scenes import SHOW, TEST, builtin_scene, builtin_scenes

NAMES = tuple(builtin_scenes())
MOST_TRIANGLES = 100_000


build = functools.cache(builtin_scene)


@pytest.fixture(params=NAMES)
def named_scene(request: pytest.FixtureRequest) -> tuple[str, Scene]:
    """Each scene in turn, built once."""
    return request.param, build(request.param)


def test_list() -> None:
    groups = {
        group: {name for name, scene in builtin_scenes().items() if scene.group == group} for group in (SHOW, TEST)
    }
    assert groups[SHOW] == {"row", "fence", "foliage", "tabletop", "glass", "floating"}
    assert groups[TEST] == {"silhouettes", "branches", "plane", "lights", "sky", "near", "floor", "flat", "mirrors"}
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
    first, second = build("foliage"), builtin_scenes()["foliage"].make.__wrapped__()  # type: ignore[attr-defined]
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
    # The hall around the mirrors is at infinity.
    unusual = {"near": (0.05, 0.06), "flat": (0.0, 0.002), "mirrors": (0.07, 0.08)}
    low, high = unusual.get(name, (0.02, 0.032))
    assert low < largest < high
    # Something is in focus, and more than one layer matters.
    coc = lens.coc_radius_px(camera, frame.depth[frame.color[..., 3] > 0]) / camera.height
    assert (np.abs(coc) < 0.002).mean() > (0.01 if name == "near" else 0.02)
    assert frame.layer_count >= (2 if name == "plane" else 4)
    assert frame.is_opaque == (name != "floating")


@pytest.mark.parametrize("size", [(160, 90), (64, 64), (54, 96)])
def test_any_image_shape_is_filled(size: tuple[int, int], peeler: DepthPeeler) -> None:
    # Floors and walls reach past the edges, guard band included: nothing in sight of the ground is sky.
    for name in ("row", "fence", "foliage", "glass", "silhouettes", "plane", "near", "floor", "flat"):
        scene = build(name)
        camera = scene.camera_for(*size)
        frame = peeler.peel(scene, camera, layers=1, guard_px=math.ceil(0.1 * max(size)))
        assert np.isfinite(frame.depth[0, -1]).all(), name


@pytest.mark.parametrize("name", ["tabletop", "lights", "floor"])
def test_lights_brighter_than_white(name: str, peeler: DepthPeeler) -> None:
    scene = build(name)
    frame = peeler.peel(scene, scene.camera_for(128, 128), layers=1)
    assert frame.color.max() > 5.0


def test_silhouettes_hide_more_than_is_captured(peeler: DepthPeeler) -> None:
    scene = build("silhouettes")
    depth = peeler.peel(scene, scene.camera_for(64, 64), layers=8).depth
    assert np.isfinite(depth[4]).mean() > 0.3


def test_sky_is_infinitely_far_behind_thin_things(peeler: DepthPeeler) -> None:
    scene = build("sky")
    frame = peeler.peel(scene, scene.camera_for(128, 128), layers=1)
    sky = np.isinf(frame.depth[0])
    assert 0.6 < sky.mean() < 0.95 and (frame.color[0, sky, 3] == 1.0).all()


def test_branches_cross_before_and_behind_focus(peeler: DepthPeeler) -> None:
    scene = build("branches")
    depth = peeler.peel(scene, scene.camera_for(96, 96), layers=4).depth[:, 40:56, 40:56]
    assert depth.min() < 0.8 * scene.focus_distance_m  # type: ignore[operator]
    assert (np.abs(depth - scene.focus_distance_m) < 0.03).any()
    assert ((depth > 1.3 * scene.focus_distance_m) & (depth < 2.0)).any()  # type: ignore[operator]


def test_nearest_pencil_touches_the_near_plane(peeler: DepthPeeler) -> None:
    scene = build("near")
    camera = scene.camera_for(256, 256)
    assert camera.near < peeler.peel(scene, camera, layers=1).depth.min() < 1.02 * camera.near


def test_polished_floor_is_shiny_in_all_layers(peeler: DepthPeeler) -> None:
    scene = build("floor")
    frame = peeler.peel(scene, scene.camera_for(64, 64), layers=2, surface=True)
    assert (frame.surface["shininess"] > 500.0).mean() > 0.3


def test_flat_is_all_in_focus(peeler: DepthPeeler) -> None:
    scene = build("flat")
    camera = scene.camera_for(1024, 1024)
    frame = peeler.peel(scene, camera, layers=8)
    seen = frame.depth[np.isfinite(frame.depth)]
    assert np.abs(Lens(scene.aperture_radius_m, scene.focus_distance_m).coc_radius_px(camera, seen)).max() < 0.5  # type: ignore[arg-type]


@pytest.mark.parametrize("name", ["silhouettes", "sky"])
def test_hard_scenes_are_the_same_every_time(name: str) -> None:
    first, second = build(name), builtin_scenes()[name].make.__wrapped__()  # type: ignore[attr-defined]
    for a, b in zip(first.nodes, second.nodes, strict=True):
        assert np.array_equal(a.mesh.vertices, b.mesh.vertices)


def test_bunnies(models: Path, peeler: DepthPeeler) -> None:
    scene = bunnies(models / "stanford-bunny.obj")
    assert sum(len(node.mesh.faces) for node in scene.nodes) > 600_000
    assert len({id(node.mesh) for node in scene.nodes if len(node.mesh.faces) > 10_000}) == 1
    frame = peeler.peel(scene, scene.camera_for(64, 64), layers=4)
    assert frame.is_opaque and frame.layer_count == 4
    with pytest.raises(SceneError, match="no such file"):
        bunnies(models / "none.obj")


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


def test_a_band_faces_along_cross_across() -> None:
    s = np.linspace(0, 1, 5)
    low, high = (np.stack([s, np.full(5, y), np.zeros(5)], axis=1) for y in (0.0, 2.0))
    mesh = shapes.band(low, high)
    assert mesh.area == pytest.approx(2.0)
    assert np.allclose(mesh.face_normals, (0, 0, 1)) and np.allclose(mesh.vertex_normals, (0, 0, 1))
    assert len(shapes.band(low, np.vstack([low[:2], high[2:]])).faces) < len(mesh.faces)


def test_moved_meshes_keep_their_normals() -> None:
    mesh = shapes.moved(shapes.ball(1.0), (1, 2, 3), (30, 40, 50), (1.0, 2.0, 0.5))
    assert np.allclose(mesh.vertices.mean(axis=0), (1, 2, 3), atol=0.05)
    facing = (mesh.face_normals * np.asarray(mesh.vertex_normals)[mesh.faces].mean(axis=1)).sum(axis=1)
    assert facing.min() > 0.9


def test_a_scene_is_found_by_name_or_file_or_put_around_a_model(models: Path) -> None:
    assert find_scene("row", unlit=True).unlit
    assert find_scene(str(models / "Duck.glb")).camera is not None
    nine = find_scene(f"bunnies:{models / 'suzanne.obj'}")
    assert nine.focus_distance_m is not None
    assert len(nine.nodes) > 9
    with pytest.raises(SceneError, match="neither a file nor a built-in scene"):
        find_scene("bunnies")
