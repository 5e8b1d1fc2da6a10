"""Model files become scenes: materials, cameras, lights, framing, and errors in one paragraph."""

from __future__ import annotations

import dataclasses
import json
import logging
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from PIL import Image

from cldof import Lens
from cldof.capture.load import load_scene
from cldof.capture.normals import with_crease_normals
from cldof.capture.peel import DepthPeeler
from cldof.capture.scene import DirectionalLight, Gradient, PointLight, Scene
from cldof.errors import SceneError


def write_glb(path: Path, scene: Any, change: Any = None) -> Path:
    """Export with trimesh, then let ``change`` edit the JSON."""
    data = scene.export(file_type="glb")
    length = int.from_bytes(data[12:16], "little")
    document, rest = json.loads(data[20 : 20 + length]), data[20 + length :]
    if change is not None:
        change(document)
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    body = len(text).to_bytes(4, "little") + data[16:20] + text + rest
    path.write_bytes(data[:8] + (12 + len(body)).to_bytes(4, "little") + body)
    return path


def coloured_box(**options: Any) -> trimesh.Trimesh:
    box = trimesh.creation.box()
    material = trimesh.visual.material.PBRMaterial(**options)
    box.visual = trimesh.visual.TextureVisuals(uv=np.random.default_rng(0).random((8, 2)), material=material)
    return box


def test_gltf_materials_are_read_unrounded(tmp_path: Path) -> None:
    image = Image.new("RGB", (4, 4), (255, 0, 0))
    scene = trimesh.Scene({"a": coloured_box(name="same", baseColorTexture=image), "b": coloured_box(name="same")})

    def change(document: dict[str, Any]) -> None:
        first, second = document["materials"]
        assert first["name"] == second["name"] == "same"
        first["pbrMetallicRoughness"].update(baseColorFactor=[0.123, 0.456, 0.789, 0.5], metallicFactor=0.25)
        first.update(alphaMode="BLEND", doubleSided=True, emissiveFactor=[1.0, 0.5, 0.0])
        first["extensions"] = {"KHR_materials_emissive_strength": {"emissiveStrength": 40.0}, "KHR_materials_unlit": {}}
        second.update(alphaMode="MASK", alphaCutoff=0.3)

    loaded = load_scene(write_glb(tmp_path / "box.glb", scene, change))
    first, second = (node.material for node in loaded.nodes)
    if first.alpha_mode != "blend":
        first, second = second, first
    assert first.base_color == (0.123, 0.456, 0.789, 0.5)
    assert first.emissive == (40.0, 20.0, 0.0)
    assert (first.alpha_mode, first.double_sided, first.unlit, first.metallic) == ("blend", True, True, 0.25)
    assert first.base_color_texture is not None
    assert (second.alpha_mode, second.alpha_cutoff, second.unlit) == ("mask", 0.3, False)
    assert loaded.has_blending


def test_gltf_with_files_beside_it(tmp_path: Path) -> None:
    image = Image.new("RGB", (4, 4), (0, 255, 0))
    files = trimesh.Scene(coloured_box(name="x", baseColorTexture=image)).export(file_type="gltf")
    for name, data in files.items():
        (tmp_path / name).write_bytes(data)
    scene = load_scene(tmp_path / "model.gltf")
    assert scene.nodes[0].material.base_color_texture.getpixel((1, 1))[:3] == (0, 255, 0)


def test_gltf_camera_and_lights(tmp_path: Path) -> None:
    def change(document: dict[str, Any]) -> None:
        document["cameras"] = [
            {"type": "orthographic", "orthographic": {"xmag": 1, "ymag": 1, "znear": 0.1, "zfar": 9}},
            {"type": "perspective", "perspective": {"yfov": 0.5, "aspectRatio": 2.0, "znear": 100.0}},
        ]
        lights = [
            {"type": "point", "intensity": 40.0, "color": [1.0, 0.0, 0.0]},
            {"type": "spot", "intensity": 10.0, "spot": {"outerConeAngle": 0.3}},
            {"type": "directional", "intensity": 3.0},
        ]
        document["extensions"] = {"KHR_lights_punctual": {"lights": lights}}
        first = len(document["nodes"])
        document["nodes"] += [
            {"camera": 0},
            {"scale": [2.0, 2.0, 2.0], "translation": [0.0, 0.0, 4.0], "children": [first + 2]},
            {"camera": 1, "translation": [0.0, 0.0, 1.0]},
            *({"translation": [0, 2, 0], "extensions": {"KHR_lights_punctual": {"light": i}}} for i in range(3)),
        ]
        document["scenes"][0]["nodes"] += [first, first + 1, first + 3, first + 4, first + 5]

    scene = load_scene(write_glb(tmp_path / "lit.glb", trimesh.Scene(trimesh.creation.box()), change))
    camera = scene.camera_for(512, 256)
    assert camera.yfov_deg == pytest.approx(math.degrees(0.5))
    np.testing.assert_allclose(camera.pose, trimesh.transformations.translation_matrix((0.0, 0.0, 6.0)))
    assert camera.near < 1.0
    directional, point, spot = scene.lights
    assert isinstance(directional, DirectionalLight)
    assert isinstance(point, PointLight)
    assert isinstance(spot, PointLight)
    assert point.color[1] == 0.0
    assert point.color[0] == pytest.approx(4.0 * spot.color[0])
    assert spot.cone_deg[1] == pytest.approx(math.degrees(0.3))
    np.testing.assert_allclose(directional.direction, (0.0, 0.0, -1.0), atol=1e-12)


def test_instances_share_their_mesh(tmp_path: Path) -> None:
    scene = trimesh.Scene({"box": coloured_box(name="x")})
    for index in (1, 2):
        place = trimesh.transformations.translation_matrix((2.0 * index, 0.0, 0.0))
        scene.graph.update(frame_to=f"n{index}", matrix=place, geometry="box")
    loaded = load_scene(write_glb(tmp_path / "row.glb", scene))
    assert len(loaded.nodes) == 3
    assert len({id(node.mesh) for node in loaded.nodes}) == 1
    np.testing.assert_allclose(loaded.bounds, [[-0.5] * 3, [4.5, 0.5, 0.5]])


def test_vertex_colours(tmp_path: Path, peeler: DepthPeeler) -> None:
    """0.5 in a glTF is linear light, 128 in a PLY is sRGB."""
    box = trimesh.creation.box()
    box.visual.vertex_colors = [128, 128, 128, 255]
    for name, expected in (("a.ply", 0.2159), ("a.glb", 0.502)):
        box.export(tmp_path / name)
        scene = load_scene(tmp_path / name, unlit=True)
        assert scene.nodes[0].material.base_color == (1.0, 1.0, 1.0, 1.0)
        frame = peeler.peel(scene, scene.camera_for(32, 32))
        assert frame.color[0, 16, 16, 1] == pytest.approx(expected, abs=2e-3)


def test_obj_materials(tmp_path: Path) -> None:
    (tmp_path / "m.mtl").write_text("newmtl red\nKd 1 0 0\nNs 98\nd 0.5\n")
    (tmp_path / "m.obj").write_text("mtllib m.mtl\nusemtl red\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    material = load_scene(tmp_path / "m.obj").nodes[0].material
    assert material.base_color[:3] == (1.0, 0.0, 0.0)
    assert material.roughness == pytest.approx(0.02**0.25, rel=1e-3)
    assert material.double_sided


@pytest.mark.parametrize(("width", "height"), [(512, 512), (640, 200), (200, 640)])
def test_default_view_shows_all_of_the_model(tmp_path: Path, peeler: DepthPeeler, width: int, height: int) -> None:
    box = trimesh.creation.box((0.03, 0.01, 0.02))
    box.apply_translation((5.0, -3.0, 1.0))
    box.export(tmp_path / "far.ply")
    scene = load_scene(tmp_path / "far.ply", background=None)
    seen = peeler.peel(scene, scene.camera_for(width, height)).color[0, ..., 3] > 0
    rows, columns = np.flatnonzero(seen.any(axis=1)), np.flatnonzero(seen.any(axis=0))
    assert rows[0] > 0
    assert columns[0] > 0
    assert rows[-1] < height - 1
    assert columns[-1] < width - 1
    used = max((rows[-1] - rows[0]) / height, (columns[-1] - columns[0]) / width)
    assert 0.6 < used < 0.95
    assert abs(rows[0] + rows[-1] + 1 - height) < 0.1 * height
    assert abs(columns[0] + columns[-1] + 1 - width) < 0.1 * width


def test_up_axis(tmp_path: Path) -> None:
    cone = trimesh.creation.cone(1.0, 3.0)  # base at z = 0, tip towards +z
    for name in ("cone.ply", "cone.stl", "cone.glb"):
        cone.export(tmp_path / name)
    for name, axis, height in (
        ("cone.ply", None, 3.0),  # stands on its base
        ("cone.stl", None, 3.0),  # z up by custom
        ("cone.glb", None, 2.0),  # y up by its standard
        ("cone.ply", "y", 2.0),
        ("cone.glb", "z", 3.0),
    ):
        extent = np.diff(load_scene(tmp_path / name, up=axis).bounds, axis=0)[0]
        assert extent[1] == pytest.approx(height, rel=0.02), name
    standing = load_scene(tmp_path / "cone.ply")
    tip = standing.nodes[0].transform[:3, :3] @ (0.0, 0.0, 1.0)
    np.testing.assert_allclose(tip, (0.0, 1.0, 0.0), atol=1e-12)
    with pytest.raises(SceneError, match="up is 'w'"):
        load_scene(tmp_path / "cone.ply", up="w")


def test_normals_keep_edges_hard_and_curves_smooth() -> None:
    box = with_crease_normals(trimesh.creation.box())
    assert len(box.vertices) == 24
    np.testing.assert_allclose(box.vertex_normals[box.faces], np.repeat(box.face_normals[:, None], 3, 1), atol=1e-12)
    ball = with_crease_normals(trimesh.creation.icosphere(3))
    assert len(ball.vertices) == 642
    np.testing.assert_allclose(np.einsum("ij,ij->i", ball.vertex_normals, ball.vertices), 1.0, atol=1e-3)
    can = with_crease_normals(trimesh.creation.cylinder(1.0, 1.0, sections=64))
    side = np.abs(can.vertex_normals[:, 2]) < 0.5
    outward = can.vertices[side] * (1, 1, 0)
    np.testing.assert_allclose(np.einsum("ij,ij->i", can.vertex_normals[side], outward), 1.0, atol=1e-3)
    np.testing.assert_allclose(np.abs(can.vertex_normals[~side][:, 2]), 1.0, atol=1e-9)


def test_background_and_unlit_options(tmp_path: Path) -> None:
    trimesh.creation.box().export(tmp_path / "box.ply")
    assert isinstance(load_scene(tmp_path / "box.ply").background, Gradient)
    assert load_scene(tmp_path / "box.ply", background=None).background is None
    assert load_scene(tmp_path / "box.ply", background=(1, 2, 3)).background == (1.0, 2.0, 3.0)
    assert load_scene(tmp_path / "box.ply", unlit=True).unlit


def test_damaged_files_give_one_clear_error(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    good = write_glb(tmp_path / "good.glb", trimesh.Scene(trimesh.creation.box())).read_bytes()
    draco = json.dumps({"asset": {"version": "2.0"}, "extensionsRequired": ["KHR_draco_mesh_compression"]})
    cases: list[tuple[str, bytes | None, str]] = [
        ("missing.glb", None, "no such file"),
        ("empty.glb", b"", "Cannot read"),
        ("text.glb", b"hello, this is not a model", "Cannot read"),
        ("short.glb", good[: len(good) // 2], "Cannot read"),
        ("cut.glb", good[:30], "cut short"),
        ("draco.gltf", draco.encode(), "KHR_draco_mesh_compression"),
        ("old.gltf", b'{"asset": {"version": "1.0"}}', "not glTF 2.0"),
        ("list.gltf", b"[1, 2]", "not glTF 2.0"),
        ("none.gltf", b'{"asset": {"version": "2.0"}}', ""),
        ("odd.xyzzy", b"?", "Cannot read"),
        ("empty.obj", b"", ""),
        ("points.obj", b"v 0 0 0\nv 1 1 1\n", ""),
        ("junk.ply", bytes(range(256)), "Cannot read"),
        ("nan.obj", b"v nan 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "1 vertices with NaN"),
        ("line.obj", b"v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n", "zero area"),
        ("index.obj", b"v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 9\n", ""),
    ]
    with caplog.at_level(logging.DEBUG):
        for name, content, expected in cases:
            if content is not None:
                (tmp_path / name).write_bytes(content)
            with pytest.raises(SceneError) as caught:
                load_scene(tmp_path / name)
            message = str(caught.value)
            assert name in message
            assert "\n" not in message
            assert expected in message, message
        with pytest.raises(SceneError, match="it is a folder"):
            load_scene(tmp_path)
    assert capfd.readouterr() == ("", "")
    assert not [record for record in caplog.records if record.name.startswith("trimesh")]
    assert not logging.getLogger("trimesh").disabled


MODELS = [
    "AlphaBlendModeTest.glb",
    "CesiumMilkTruck.glb",
    "Duck.glb",
    "nefertiti.obj",
    "spot.glb",
    "stanford-bunny.obj",
    "suzanne.obj",
    "teapot.obj",
]


@pytest.mark.parametrize("name", MODELS)
def test_real_models_make_a_picture(models: Path, peeler: DepthPeeler, name: str) -> None:
    scene = load_scene(models / name)
    image = peeler.peel(scene, scene.camera_for(128, 128), layers=8, lens=Lens(0.0, 1.0)).pinhole_image()
    assert (image[..., 3] == 1.0).all()
    bare = dataclasses.replace(scene, background=None)
    covered = peeler.peel(bare, scene.camera_for(128, 128), lens=Lens(0.0, 1.0)).pinhole_image()[..., 3] > 0.5
    assert 0.02 < covered.mean() < 0.8
    shown = image[covered][:, :3]
    assert 0.05 < shown.mean() < 0.9
    assert shown.std() > 0.02
    assert (shown > 1.0).mean() < 0.1
    assert scene.focus_distance_m is None


def test_models_keep_what_their_files_say(models: Path) -> None:
    assert load_scene(models / "AlphaBlendModeTest.glb").has_blending
    duck = load_scene(models / "Duck.glb")
    assert duck.camera is not None
    assert duck.camera.width == 1536  # its own camera, 3:2
    truck = load_scene(models / "CesiumMilkTruck.glb")
    glass = [n.material for n in truck.nodes if n.material.base_color_texture is None]
    assert (0.0, 0.04050629958510399, 0.021240700036287308, 1.0) in [m.base_color for m in glass]
    assert len({id(node.mesh) for node in truck.nodes}) < len(truck.nodes)  # two axles, one set of wheels
    assert not load_scene(models / "stanford-bunny.obj").nodes[0].material.double_sided
    assert load_scene(models / "teapot.obj").nodes[0].material.double_sided
    nefertiti: Scene = load_scene(models / "nefertiti.obj")
    extent = np.diff(nefertiti.bounds, axis=0)[0]
    assert extent.argmax() == 1  # stands upright
