"""Peeled layers against independent ray casts and closed forms."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray
from PIL import Image

from cldof import Camera, Lens
from cldof.capture.load import load_scene
from cldof.capture.peel import DepthPeeler
from cldof.capture.scene import Ambient, DirectionalLight, Gradient, Material, Node, PointLight, Scene
from cldof.capture.scenes import builtin_scene
from cldof.errors import CaptureError, InputError, SceneError

from .conftest import camera_at, flat, quad


def pixel_rays(camera: Camera) -> NDArray[np.float64]:
    """World directions through all pixel centres, scaled so that a ray's parameter is planar depth."""
    x = (np.arange(camera.width) + 0.5 - camera.width / 2) / camera.focal_px
    y = (np.arange(camera.height) + 0.5 - camera.height / 2) / camera.focal_px
    xx, yy = np.meshgrid(x, y)
    local = np.stack([xx, -yy, -np.ones_like(xx)], axis=-1)
    return local @ camera.pose[:3, :3].T


def ray_layers(scene: Scene, camera: Camera, layers: int) -> NDArray[np.float64]:
    """Sorted planar depths of the first hits of each pixel's ray, from Embree."""
    pytest.importorskip("embreex")
    # Geometry alone: textures would be merged into one picture.
    parts = [trimesh.Trimesh(n.mesh.vertices, n.mesh.faces, process=False) for n in scene.nodes]
    mesh = trimesh.util.concatenate([p.apply_transform(n.transform) for p, n in zip(parts, scene.nodes, strict=True)])
    first_hit = trimesh.ray.ray_pyembree.RayMeshIntersector(mesh).intersects_first
    corners, normals = mesh.triangles, mesh.face_normals
    rays, eye = pixel_rays(camera).reshape(-1, 3), camera.pose[:3, 3]
    out, found = np.full((layers, len(rays)), np.inf), np.zeros(len(rays), int)
    active, reached, last = np.arange(len(rays)), np.zeros(len(rays)), np.zeros(len(rays))
    while active.size:
        # Embree finds the triangle, float64 the depth; then on from just behind it.
        triangle = first_hit(eye + reached[active, None] * rays[active], rays[active])
        active, triangle = active[triangle >= 0], triangle[triangle >= 0]
        normal, ray = normals[triangle], rays[active]
        depth = np.einsum("ij,ij->i", normal, corners[triangle, 0] - eye) / np.einsum("ij,ij->i", normal, ray)
        new = depth > last[active] * (1.0 + 2e-5)  # Embree reports both triangles of a shared edge
        out[found[active[new]], active[new]] = last[active[new]] = depth[new]
        found[active[new]] += 1
        reached[active] = np.maximum(depth, reached[active]) * (1.0 + 5e-6)
        active = active[found[active] < layers]
    return out.reshape(layers, camera.height, camera.width)


def assert_layers_agree(peeler: DepthPeeler, scene: Scene, camera: Camera) -> None:
    frame = peeler.peel(scene, camera, layers=4)
    expected = ray_layers(scene, camera, 4)
    for layer, (depth, truth) in enumerate(zip(frame.depth, expected, strict=False)):
        covered = np.isfinite(depth) | np.isfinite(truth)
        both = np.isfinite(depth) & np.isfinite(truth)
        close = both.copy()
        close[both] = np.abs(depth[both] / truth[both] - 1.0) < 1e-4
        assert close.sum() >= 0.999 * covered.sum(), f"layer {layer}: {close.sum()} of {covered.sum()} agree"


def fence() -> Scene:
    nodes = []
    for index in range(24):
        box = trimesh.creation.box((0.12, 1.0 + 0.1 * (index % 5), 0.5))
        place = trimesh.transformations.rotation_matrix(0.3 * index, (0.2, 1.0, 0.1))
        place[:3, 3] = (-1.5 + 0.5 * (index % 7), 0.05 * (index % 3), -4.0 - 0.55 * (index // 7))
        nodes.append(Node(box, place, flat((0.2, 0.4, 0.6))))
    return Scene("fence", tuple(nodes))


def knot() -> Scene:
    t = np.linspace(0, 2 * np.pi, 240, endpoint=False)
    path = np.stack([(2 + np.cos(3 * t)) * np.cos(2 * t), (2 + np.cos(3 * t)) * np.sin(2 * t), np.sin(3 * t)], axis=1)
    ahead = np.roll(path, -1, axis=0) - np.roll(path, 1, axis=0)
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    side = np.cross(ahead, (0.0, 0.0, 1.0))
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    up = np.cross(side, ahead)
    around = np.linspace(0, 2 * np.pi, 16, endpoint=False)
    ring = np.cos(around)[None, :, None] * side[:, None] + np.sin(around)[None, :, None] * up[:, None]
    vertices = (path[:, None] + 0.4 * ring).reshape(-1, 3)
    i, j = (a.ravel() for a in np.meshgrid(np.arange(240), np.arange(16), indexing="ij"))
    a, b = i * 16 + j, i * 16 + (j + 1) % 16
    c, d = (i + 1) % 240 * 16 + j, (i + 1) % 240 * 16 + (j + 1) % 16
    faces = np.concatenate([np.stack([a, c, b], 1), np.stack([b, c, d], 1)])
    tilt = trimesh.transformations.rotation_matrix(0.7, (1.0, 1.0, 0.0))
    tilt[2, 3] = -9.0
    return Scene("knot", (Node(trimesh.Trimesh(vertices, faces, process=False), tilt, flat()),))


@pytest.mark.parametrize("scene", [fence(), knot()], ids=lambda scene: scene.name)
def test_layers_are_the_hits_of_rays(peeler: DepthPeeler, scene: Scene) -> None:
    assert_layers_agree(peeler, scene, camera_at(311, 257))


@pytest.mark.parametrize("name", ["row", "silhouettes"])
def test_built_in_layers_are_the_hits_of_rays(peeler: DepthPeeler, name: str) -> None:
    scene = dataclasses.replace(builtin_scene(name), background=None)
    assert_layers_agree(peeler, scene, scene.camera_for(512, 512))


def test_bunny_layers_are_the_hits_of_rays(peeler: DepthPeeler, models: Path) -> None:
    scene = load_scene(models / "stanford-bunny.obj")
    assert_layers_agree(peeler, scene, scene.camera_for(1024, 1024))


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e4])
def test_depth_of_a_tilted_plane_is_exact(peeler: DepthPeeler, scale: float) -> None:
    normal = np.array([0.3, 0.8, 0.52])
    normal /= np.linalg.norm(normal)
    turn = trimesh.geometry.align_vectors((0, 0, 1), normal)
    turn[:3, 3] = (0.0, 0.0, -3.0 * scale)
    plane = trimesh.Trimesh([(-9, -9, 0), (9, -9, 0), (9, 9, 0), (-9, 9, 0)], [(0, 1, 2), (0, 2, 3)], process=False)
    plane.apply_scale(scale)
    camera = dataclasses.replace(camera_at(123, 77), near=0.01 * scale)
    frame = peeler.peel(Scene("plane", (Node(plane, turn, flat()),)), camera, layers=1)
    rays = pixel_rays(camera)
    truth = (turn[:3, 3] @ normal) / (rays @ normal)
    seen = np.isfinite(frame.depth[0])
    assert seen.mean() > 0.5
    np.testing.assert_allclose(frame.depth[0][seen], truth[seen], rtol=3e-6)


@pytest.mark.parametrize("distance", [1.0, 1000.0])
def test_a_near_surface_hides_one_just_behind_it_at_any_distance(peeler: DepthPeeler, distance: float) -> None:
    near, far = quad(distance, 5.0 * distance), quad(distance * 1.0001, 5.0 * distance, flat((1.0, 0.0, 0.0)))
    for nodes in ((near, far), (far, near)):
        frame = peeler.peel(Scene("pair", nodes), camera_at(), layers=4)
        assert frame.layer_count == 2
        assert (frame.color[0, ..., 1] == 1.0).all()
        assert (frame.color[1, ..., 1] == 0.0).all()


@pytest.mark.parametrize("degrees", [0.0, 60.0, 88.0])
def test_coplanar_surfaces_count_once_and_nothing_behind_them_is_lost(peeler: DepthPeeler, degrees: float) -> None:
    turn = trimesh.transformations.rotation_matrix(math.radians(degrees), (1.0, 0.0, 0.0))
    turn[:3, 3] = (0.0, 0.0, -3.0)

    def plane(corners: list[tuple[float, float]]) -> Node:
        mesh = trimesh.Trimesh([(x, y, 0.0) for x, y in corners], [(0, 1, 2), (0, 2, 3)], process=False)
        return Node(mesh, turn, flat())

    one = plane([(-2.0, -2.0), (2.0, -2.0), (2.0, 2.0), (-2.0, 2.0)])
    same = plane([(-1.7, -2.5), (2.3, -1.9), (1.9, 2.2), (-2.4, 1.6)])
    behind = quad(40.0, 100.0, flat((0.0, 1.0, 0.0)))
    camera = camera_at(256, 256)
    single = peeler.peel(Scene("one", (one, behind)), camera)
    double = peeler.peel(Scene("two", (one, same, behind)), camera)
    both = np.isfinite(peeler.peel(Scene("other", (same,)), camera).depth[0])
    assert single.layer_count == 2
    assert double.layer_count == 2  # the second plane makes no layer of its own
    hit = np.isfinite(peeler.peel(Scene("alone", (one,)), camera).depth[0])
    np.testing.assert_array_equal(double.depth[1][hit], single.depth[1][hit])
    assert (double.depth[0][hit | both] < 39.0).all()


def test_layers_are_bit_identical_from_run_to_run(peeler: DepthPeeler) -> None:
    first, second = (peeler.peel(knot(), camera_at(97, 61), layers=6) for _ in range(2))
    np.testing.assert_array_equal(first.depth, second.depth)
    np.testing.assert_array_equal(first.color, second.color)


def test_peeling_stops_when_nothing_is_left(peeler: DepthPeeler) -> None:
    scene = Scene("three", tuple(quad(z) for z in (4.0, 2.0, 3.0)))
    assert peeler.peel(scene, camera_at(), layers=9).layer_count == 3
    calls: list[tuple[int, int]] = []
    frame = peeler.peel(scene, camera_at(), layers=2, progress=lambda done, total: calls.append((done, total)))
    assert frame.layer_count == 2
    assert calls == [(1, 2), (2, 2)]
    np.testing.assert_allclose(frame.depth[:, 5, 5], [2.0, 3.0], rtol=1e-6)


def test_nothing_in_sight_is_one_empty_layer(peeler: DepthPeeler) -> None:
    behind = trimesh.transformations.translation_matrix((0.0, 0.0, 9.0))
    scene = Scene("behind", (Node(trimesh.creation.box(), behind),))
    for empty in (scene, Scene("empty", ())):
        frame = peeler.peel(empty, camera_at(), surface=True)
        assert frame.layer_count == 1
        assert np.isinf(frame.depth).all()
        assert not frame.color.any()


def test_a_scene_without_a_camera_is_framed(peeler: DepthPeeler) -> None:
    with DepthPeeler(90, 50) as other:
        frame = other.peel(fence())
    assert (frame.camera.width, frame.camera.height) == (90, 50)
    seen = np.isfinite(frame.depth[0])
    assert seen.any()
    assert not (seen[0].any() or seen[-1].any() or seen[:, 0].any() or seen[:, -1].any())


def test_rows_and_columns_are_where_they_belong(peeler: DepthPeeler) -> None:
    spot = quad(2.0, 0.1, at=(0.4, 0.6))  # right and up
    rows, columns = np.nonzero(np.isfinite(peeler.peel(Scene("spot", (spot,)), camera_at(80, 60)).depth[0]))
    focal = camera_at(80, 60).focal_px
    assert columns.mean() + 0.5 == pytest.approx(40 + focal * 0.2, abs=0.5)
    assert rows.mean() + 0.5 == pytest.approx(30 - focal * 0.3, abs=0.5)


def test_back_faces_stay_without_a_lens_and_go_with_a_pinhole(peeler: DepthPeeler) -> None:
    ball = Node(trimesh.creation.icosphere(3), trimesh.transformations.translation_matrix((0, 0, -4)), Material())
    scene = Scene("ball", (ball,))
    assert peeler.peel(scene, camera_at()).layer_count == 2
    assert peeler.peel(scene, camera_at(), lens=Lens(0.0, 4.0)).layer_count == 1
    two_sided = dataclasses.replace(ball, material=Material(double_sided=True))
    assert peeler.peel(Scene("both", (two_sided,)), camera_at(), lens=Lens(0.0, 4.0)).layer_count == 2


def test_mirrored_nodes_keep_their_front(peeler: DepthPeeler) -> None:
    transform = np.diag([-1.0, 1.0, 1.0, 1.0])
    transform[2, 3] = -4.0
    scene = Scene("mirror", (Node(trimesh.creation.icosphere(3), transform, Material()),), lights=(HEADLIGHT,))
    frame = peeler.peel(scene, camera_at(), lens=Lens(0.0, 4.0))
    assert frame.layer_count == 1
    assert frame.depth_at(32, 32) == pytest.approx(3.0, abs=0.05)
    assert frame.color[0, 32, 32, 0] > 0.3


def test_a_back_face_stays_when_the_rim_of_the_lens_sees_its_front(peeler: DepthPeeler) -> None:
    # A wall at x = 0.5 parallel to the axis, its front towards +x: only lens points beyond 0.5 see the front.
    corners = [(0.5, -1.0, -3.0), (0.5, 1.0, -3.0), (0.5, 1.0, -5.0), (0.5, -1.0, -5.0)]
    for faces, front in (([(0, 1, 2), (0, 2, 3)], 1), ([(0, 2, 1), (0, 3, 2)], -1)):
        mesh = trimesh.Trimesh(corners, faces, process=False)
        scene = Scene("wall", (Node(mesh, np.eye(4), dataclasses.replace(flat(), double_sided=False)),))
        facing_away = mesh.face_normals[0][0] > 0
        narrow = np.isfinite(peeler.peel(scene, camera_at(), lens=Lens(0.2, 4.0)).depth).any()
        wide = np.isfinite(peeler.peel(scene, camera_at(), lens=Lens(0.3, 4.0)).depth).any()
        assert narrow != facing_away, front  # reach = 2 x 0.2 < 0.5
        assert wide, front  # reach = 2 x 0.3 > 0.5


def test_guard_band_crops_to_the_capture_without(peeler: DepthPeeler) -> None:
    camera, guard = camera_at(96, 64), 13
    scene = dataclasses.replace(fence(), background=Gradient((0.2, 0.4, 0.9), (0.1, 0.1, 0.1)))
    plain, wide = peeler.peel(scene, camera), peeler.peel(scene, camera, guard_px=guard)
    assert (wide.width, wide.height, wide.guard_px) == (96 + 26, 64 + 26, 13)
    inner = wide.depth[:, guard:-guard, guard:-guard]
    same = np.isclose(inner[0], plain.depth[0], rtol=1e-5) | (inner[0] == plain.depth[0])
    assert same.mean() > 0.999  # another projection rounds a few edges to the other side
    colors = np.isclose(wide.color[0, guard:-guard, guard:-guard], plain.color[0], atol=1e-5).all(axis=-1)
    assert colors.mean() > 0.999
    assert (wide.color[0, ..., 3] == 1.0).all()


HEADLIGHT = DirectionalLight((0.0, 0.0, -1.0), (1.0, 1.0, 1.0))


def test_emission_above_one_is_kept(peeler: DepthPeeler) -> None:
    lamp = Material((0.0, 0.0, 0.0, 1.0), emissive=(900.0, 30.0, 1e-6), double_sided=True, roughness=1.0)
    frame = peeler.peel(Scene("lamp", (quad(2.0, material=lamp),), ambient=Ambient((0,) * 3, (0,) * 3)), camera_at())
    np.testing.assert_allclose(frame.color[0, 9, 9], (900.0, 30.0, 1e-6, 1.0), rtol=1e-5)


def test_a_light_of_one_shows_white_as_about_one(peeler: DepthPeeler) -> None:
    white = Material((1.0, 1.0, 1.0, 1.0), roughness=1.0, double_sided=True)
    dark = Ambient((0.0,) * 3, (0.0,) * 3)
    point = PointLight((0.0, 0.0, 0.0), (4.0, 4.0, 4.0))
    spot = dataclasses.replace(point, direction=(0.0, 0.0, -1.0), cone_deg=(10.0, 12.0))
    for light in (HEADLIGHT, point, spot):
        frame = peeler.peel(Scene("lit", (quad(2.0, material=white),), lights=(light,), ambient=dark), camera_at())
        assert frame.color[0, 32, 32, 0] == pytest.approx(1.0, abs=0.06)
        if light is spot:
            assert frame.color[0, 0, 0, 0] == 0.0


def test_textures_and_vertex_colours_are_decoded(peeler: DepthPeeler) -> None:
    grey = flat(base_color_texture=Image.new("RGB", (8, 8), (128, 128, 128)))
    frame = peeler.peel(Scene("grey", (quad(2.0, material=grey),)), camera_at())
    np.testing.assert_allclose(frame.color[0, ..., :3], 0.21586, atol=2e-4)
    node = quad(2.0)
    node.mesh.visual = trimesh.visual.ColorVisuals(node.mesh, vertex_colors=[(128, 128, 128, 255)] * 4)
    frame = peeler.peel(Scene("vertex", (node,)), camera_at())
    np.testing.assert_allclose(frame.color[0, ..., :3], 0.21586, atol=1e-5)
    node = quad(2.0)
    node.mesh.visual = trimesh.visual.ColorVisuals(node.mesh, face_colors=[(255, 0, 0, 255), (0, 0, 255, 255)])
    frame = peeler.peel(Scene("face", (node,)), camera_at())
    assert set(map(tuple, frame.color[0].reshape(-1, 4))) == {(1.0, 0.0, 0.0, 1.0), (0.0, 0.0, 1.0, 1.0)}


def test_textures_are_the_right_way_up(peeler: DepthPeeler) -> None:
    image = Image.new("RGB", (64, 64), (255, 0, 0))
    image.paste((0, 0, 255), (0, 32, 64, 64))  # lower half blue
    half = 2.0 * math.tan(math.radians(22.5))  # fills the image
    frame = peeler.peel(Scene("up", (quad(2.0, half, flat(base_color_texture=image)),)), camera_at())
    np.testing.assert_allclose(frame.color[0, 4, 32, :3], (1.0, 0.0, 0.0), atol=1e-6)
    np.testing.assert_allclose(frame.color[0, -4, 32, :3], (0.0, 0.0, 1.0), atol=1e-6)


def checker(alphas: tuple[int, int, int, int]) -> Image.Image:
    image = Image.new("RGBA", (64, 64))
    for index, alpha in enumerate(alphas):
        x, y = 32 * (index % 2), 32 * (index // 2)
        image.paste((255, 255, 255, alpha), (x, y, x + 32, y + 32))
    return image


def test_a_larger_capture_can_have_the_textures_of_the_image(peeler: DepthPeeler) -> None:
    """The middle one of 3 x 3 samples is the pixel's own, once its mip level is, too."""
    noise = Image.fromarray(np.random.default_rng(1).integers(0, 256, (256, 256, 3), np.uint8))
    scene = Scene("noise", (quad(3.0, 1.5, flat(base_color_texture=noise)),))
    plain = peeler.peel(scene, camera_at(), layers=1).color[0]
    larger = camera_at().supersampled(3)
    sharp, coarse = (
        peeler.peel(scene, larger, layers=1, lod_bias=bias).color[0, 1::3, 1::3] for bias in (0, math.log2(3))
    )
    assert np.abs(coarse - plain).max() <= 1e-2  # drivers work levels out roughly
    assert np.abs(sharp - plain).max() >= 0.05
    with pytest.raises(InputError, match="lod_bias is nan"):
        peeler.peel(scene, lod_bias=math.nan)


def test_alpha_modes(peeler: DepthPeeler) -> None:
    image, half = checker((0, 64, 153, 255)), 2.0 * math.tan(math.radians(22.5))
    back = quad(5.0, material=flat((0.0, 1.0, 0.0)))
    places = [(16, 16), (16, 48), (48, 16), (48, 48)]

    def alphas(mode: str) -> tuple[list[float], list[float]]:
        front = quad(2.0, half, flat(base_color_texture=image, alpha_mode=mode))
        frame = peeler.peel(Scene(mode, (front, back)), camera_at())
        return [frame.color[0, y, x, 3] for y, x in places], [frame.depth[0, y, x] for y, x in places]

    assert alphas("opaque")[0] == [1.0] * 4
    alpha, depth = alphas("mask")  # cut at 0.5
    assert alpha == [1.0] * 4
    np.testing.assert_allclose(depth, [5.0, 5.0, 2.0, 2.0], rtol=1e-6)
    alpha, depth = alphas("blend")
    np.testing.assert_allclose(alpha, [1.0, 64 / 255, 153 / 255, 1.0], atol=5e-4)
    np.testing.assert_allclose(depth, [5.0, 2.0, 2.0, 2.0], rtol=1e-6)


def test_blended_layers_are_premultiplied(peeler: DepthPeeler) -> None:
    pane = flat((1.0, 0.5, 0.0, 0.25), alpha_mode="blend")
    scene = Scene("pane", (quad(2.0, material=pane), quad(3.0, material=flat((0.0, 0.0, 1.0)))))
    frame = peeler.peel(scene, camera_at())
    np.testing.assert_allclose(frame.color[0, 1, 1], (0.25, 0.125, 0.0, 0.25), rtol=1e-6)
    np.testing.assert_allclose(frame.pinhole_image()[1, 1], (0.25, 0.125, 0.75, 1.0), rtol=1e-6)


def test_surface_buffers(peeler: DepthPeeler) -> None:
    turn = trimesh.transformations.rotation_matrix(0.5, (0.0, 1.0, 0.0))
    turn[:3, 3] = (0.0, 0.0, -3.0)
    plane = trimesh.Trimesh([(-9, -9, 0), (9, -9, 0), (9, 9, 0), (-9, 9, 0)], [(0, 1, 2), (0, 2, 3)], process=False)
    stuff = Material((0.2, 0.4, 0.6, 1.0), roughness=0.5)
    scene = Scene("surface", (Node(plane, turn, stuff),), lights=(HEADLIGHT,), background=(0.5, 0.5, 0.5))
    frame = peeler.peel(scene, camera_at(), surface=True)
    np.testing.assert_allclose(frame.surface["normal"][0, 32, 32], (math.sin(0.5), 0.0, math.cos(0.5)), atol=1e-6)
    np.testing.assert_allclose(frame.surface["albedo"][0, 32, 32], (0.2, 0.4, 0.6), rtol=1e-6)
    assert frame.surface["shininess"][0, 32, 32] == pytest.approx(2 / 0.5**4 - 2, rel=1e-5)
    plain = peeler.peel(scene, camera_at())
    np.testing.assert_array_equal(plain.color, frame.color)
    assert not plain.surface


def test_sky_fills_the_first_empty_slot(peeler: DepthPeeler) -> None:
    scene = Scene("sky", (quad(2.0, 0.4), quad(3.0, 0.4)), background=(0.1, 0.2, 7.0))
    frame = peeler.peel(scene, camera_at(), layers=6)
    assert frame.layer_count == 3
    open_sky, behind = frame.color[:, 1, 1], frame.color[:, 32, 32]
    np.testing.assert_allclose(open_sky[0], (0.1, 0.2, 7.0, 1.0), rtol=1e-6)
    assert not open_sky[1:].any()
    np.testing.assert_allclose(behind[2], (0.1, 0.2, 7.0, 1.0), rtol=1e-6)
    assert np.isinf(frame.depth[0, 1, 1])
    assert np.isinf(frame.depth[2, 32, 32])
    full = peeler.peel(scene, camera_at(), layers=2)
    np.testing.assert_allclose(full.color[1, 32, 32], (1.0, 1.0, 1.0, 1.0))  # no slot left for the sky
    assert np.isfinite(full.depth[:, 32, 32]).all()


def test_gradient_follows_the_direction_of_view(peeler: DepthPeeler) -> None:
    camera = camera_at(31, 47)
    sky = Scene("sky", (), background=Gradient((1.0, 0.0, 2.0), (0.0, 1.0, 0.0)))
    for angle in (0.0, 0.4):
        pose = trimesh.transformations.rotation_matrix(angle, (1.0, 0.0, 0.2))
        tilted = dataclasses.replace(camera, pose=pose)
        rays = pixel_rays(tilted)
        share = 0.5 + 0.5 * rays[..., 1] / np.linalg.norm(rays, axis=-1)
        frame = peeler.peel(sky, tilted)
        np.testing.assert_allclose(frame.color[0, ..., 0], share, atol=1e-5)
        np.testing.assert_allclose(frame.color[0, ..., 1], 1.0 - share, atol=1e-5)


def test_moving_the_camera_uploads_nothing(peeler: DepthPeeler, monkeypatch: pytest.MonkeyPatch) -> None:
    from cldof.capture import draw

    uploads: list[object] = []
    original = draw._upload_mesh
    monkeypatch.setattr(draw, "_upload_mesh", lambda *a: uploads.append(a) or original(*a))
    node = quad(2.0)
    scene = Scene("moving", (node, dataclasses.replace(node, transform=np.diag([1.0, 1.0, 2.0, 1.0]))))
    for x in (0.0, 0.1):
        peeler.peel(scene, camera_at(eye=(x, 0.0, 0.0)))
    assert len(uploads) == 1  # two nodes of one mesh and material
    moved = dataclasses.replace(scene, nodes=(dataclasses.replace(node, transform=np.diag([1.0, 1.0, 3.0, 1.0])),))
    assert peeler.peel(moved, camera_at()).depth_at(3, 3) == pytest.approx(6.0)
    assert len(uploads) == 1


def test_bad_arguments_are_refused(peeler: DepthPeeler) -> None:
    scene = Scene("one", (quad(2.0),))
    with pytest.raises(InputError, match="layers is 0"):
        peeler.peel(scene, camera_at(), layers=0)
    with pytest.raises(InputError, match="guard_px is -1"):
        peeler.peel(scene, camera_at(), guard_px=-1)
    with pytest.raises(SceneError, match="is empty"):
        peeler.peel(Scene("empty", ()))
    with pytest.raises(CaptureError, match="too large"):
        peeler.peel(scene, camera_at(32000, 8))
    with pytest.raises(SceneError, match="flattens"):
        peeler.peel(Scene("flat", (dataclasses.replace(quad(2.0), transform=np.diag([1.0, 0, 1, 1])),)), camera_at())
    assert peeler.peel(scene, camera_at()).layer_count == 1  # still well
