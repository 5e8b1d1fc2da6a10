"""Files that are cut, damaged or made to do harm: one clear error, bounded memory and time, nothing else opened."""

from __future__ import annotations

import base64
import io
import json
import pickle
import struct
import subprocess
import sys
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from PIL import Image

from cldof import Camera, LayeredFrame
from cldof.capture.load import load_scene
from cldof.errors import FrameError, SceneError
from cldof.images import save_image
from tests.frames import noise_frame

pytestmark = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="limits memory as Linux does")

ROOT = Path(__file__).parents[1]


def read_all(jobs: list[tuple[str, Path]]) -> list[dict[str, Any]]:
    """What becomes of each file in a process with limits; a process that dies answers no more."""
    done = subprocess.run(
        [sys.executable, "-m", "tests.reading"],
        input=json.dumps([(reader, str(path)) for reader, path in jobs]),
        capture_output=True,
        text=True,
        cwd=ROOT,
        env={"PATH": "/usr/bin:/bin", "PYTHONPATH": str(ROOT), "HOME": "/nonexistent", "OPENBLAS_NUM_THREADS": "1"},
        timeout=300,
    )
    answers = [json.loads(line) for line in done.stdout.splitlines()]
    if len(answers) < len(jobs):
        reader, path = jobs[len(answers)]
        pytest.fail(f"it ended (code {done.returncode}) while it read {path} as {reader}: {done.stderr[-800:]}")
    return answers


def png(width: int, height: int, color: tuple[int, ...] = (255, 0, 0)) -> bytes:
    stream = io.BytesIO()
    Image.new("RGB", (width, height), color).save(stream, "PNG")
    return stream.getvalue()


def png_that_promises(width: int, height: int) -> bytes:
    """A few bytes whose header says that there are many pixels."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", width, height, 8, 6, 0, 0, 0)
    parts = chunk(b"IHDR", header), chunk(b"IDAT", zlib.compress(b"\0" * 64)), chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)


def textured_box() -> trimesh.Trimesh:
    box = trimesh.creation.box()
    material = trimesh.visual.material.PBRMaterial(baseColorTexture=Image.open(io.BytesIO(png(9, 7))))
    box.visual = trimesh.visual.TextureVisuals(uv=np.asarray(box.vertices)[:, :2], material=material)
    return box


def good_gltf() -> dict[str, Any]:
    """One triangle with an image, all in the JSON."""
    data = np.float32([[0, 0, 0], [1, 0, 0], [0, 1, 0]]).tobytes() + np.uint16([0, 1, 2, 0]).tobytes()
    views = [{"buffer": 0, "byteOffset": 0, "byteLength": 36}, {"buffer": 0, "byteOffset": 36, "byteLength": 6}]
    accessors = [
        {"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3", "min": [0, 0, 0], "max": [1, 1, 0]},
        {"bufferView": 1, "componentType": 5123, "count": 3, "type": "SCALAR"},
    ]
    return {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1, "material": 0}]}],
        "materials": [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}],
        "textures": [{"source": 0}],
        "images": [{"uri": "data:image/png;base64," + base64.b64encode(png(4, 4)).decode()}],
        "buffers": [{"byteLength": len(data), "uri": "data:;base64," + base64.b64encode(data).decode()}],
        "bufferViews": views,
        "accessors": accessors,
    }


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> list[tuple[str, Path]]:
    """Sound files of every kind that is read."""
    folder = tmp_path_factory.mktemp("good")
    frame = noise_frame(20, 12)
    frame.save(folder / "frame.npz")
    with np.load(folder / "frame.npz") as data:
        np.savez_compressed(folder / "packed.npz", **data)
    box = trimesh.creation.box()
    (folder / "textured.glb").write_bytes(trimesh.Scene(textured_box()).export(file_type="glb"))
    (folder / "triangle.gltf").write_text(json.dumps(good_gltf()))
    for suffix in ("ply", "stl", "off", "obj"):
        box.export(folder / f"box.{suffix}")
    image = np.random.default_rng(0).random((9, 11, 4)).astype(np.float32)
    for suffix in ("png", "exr", "npy"):
        save_image(folder / f"image.{suffix}", image, {"lens": {"f_number": 2.0}})
    (folder / "camera.json").write_text(json.dumps(Camera(64, 64, 40.0).to_dict()))
    jobs = [("frame", "frame.npz"), ("frame", "packed.npz"), ("scene", "textured.glb"), ("scene", "triangle.gltf")]
    jobs += [("scene", f"box.{suffix}") for suffix in ("ply", "stl", "off", "obj")]
    jobs += [("metadata", f"image.{suffix}") for suffix in ("png", "exr", "npy")]
    jobs += [("aperture", "image.png"), ("camera", "camera.json")]
    return [(reader, folder / name) for reader, name in jobs]


def test_damage_of_any_kind_is_a_clear_error(good: list[tuple[str, Path]], tmp_path: Path) -> None:
    """Cut at many places and overwritten at random: read as something, or refused by an error of ours."""
    rng = np.random.default_rng(8)
    jobs = list(good)
    for number, (reader, path) in enumerate(good):
        whole = path.read_bytes()
        damaged = [whole[: int(cut)] for cut in rng.integers(0, len(whole), 16)]
        for _ in range(24):
            copy = bytearray(whole)
            # Headers are at the front, and of archives at the end: that is where it hurts.
            span = [(0, len(copy)), (0, min(len(copy), 300)), (max(0, len(copy) - 300), len(copy))][rng.integers(3)]
            for at in rng.integers(*span, rng.integers(1, 9)):
                copy[at] = rng.choice([0, 255, rng.integers(256)])
            damaged.append(bytes(copy))
        for index, content in enumerate(damaged):
            target = tmp_path / f"{number}-{index}{path.suffix}"
            target.write_bytes(content)
            if reader == "metadata" and path.suffix == ".npy":
                target.with_name(target.name + ".json").write_bytes(content)
            jobs.append((reader, target))
    answers = read_all(jobs)
    for (reader, path), answer in zip(jobs, answers, strict=True):
        assert answer["error"] is None or answer["ours"], (reader, path.name, answer)
        assert answer["seconds"] < 5.0, (reader, path.name, answer)
        if answer["error"]:
            assert answer["message"], (reader, path.name)
    assert not any(answer["error"] for answer in answers[: len(good)]), answers[: len(good)]
    refused = sum(answer["error"] is not None for answer in answers)
    assert refused > len(answers) // 3, "the damage should show"


Change = Callable[[dict[str, Any]], None]


def deep(depth: int) -> str:
    return "[" * depth + "]" * depth


def embedded(content: bytes) -> str:
    return "data:image/png;base64," + base64.b64encode(content).decode()


def gltf_cases() -> dict[str, tuple[Change, str]]:
    def nodes(nodes: list[dict[str, Any]], roots: list[int]) -> Change:
        return lambda d: d.update(nodes=nodes, scenes=[{"nodes": roots}])

    def set_in(name: str, index: int, **values: Any) -> Change:
        return lambda d: d[name][index].update(values)

    doubling = [{"children": [i + 1, i + 1]} for i in range(40)] + [{"mesh": 0}]
    return {
        "loop": (nodes([{"mesh": 0, "children": [0]}], [0]), "tree"),
        "loop of two": (nodes([{"mesh": 0}, {"children": [2]}, {"children": [1]}], [0]), "own ancestors"),
        "doubling": (nodes(doubling, [0]), "two parents"),
        "no such node": (nodes([{"mesh": 0, "children": [7]}], [0]), "there are 1"),
        "nodes of another kind": (lambda d: d.update(nodes={"a": 1}), "list of objects"),
        "count": (set_in("accessors", 0, count=10**9), "accessor 0"),
        "count without data": (
            lambda d: d["accessors"].append({"componentType": 5126, "count": 10**9, "type": "MAT4"}),
            "accessor 2",
        ),
        "many zeros": (
            lambda d: d["accessors"].extend({"componentType": 5126, "count": 10**6, "type": "MAT4"} for _ in range(99)),
            "geometry takes",
        ),
        "negative": (set_in("accessors", 0, count=-1), "whole number"),
        "float": (set_in("accessors", 0, count=3.5), "whole number"),
        "view beyond": (set_in("bufferViews", 0, byteLength=10**6), "buffer view 0"),
        "offset beyond": (set_in("bufferViews", 1, byteOffset=2**62), "buffer view 1"),
        "stride": (set_in("bufferViews", 0, byteStride=1), "item to item"),
        "buffer": (set_in("buffers", 0, byteLength=10**12), "cut short"),
        "huge picture": (
            set_in("images", 0, uri=embedded(png_that_promises(10**5, 10**5))),
            "image 0",
        ),
        "cut picture": (
            set_in("images", 0, uri=embedded(png(64, 64)[:90])),
            "Cannot read",
        ),
        "program": (
            set_in("images", 0, uri=embedded(b"%!PS-Adobe-3.0 EPSF-3.0\n")),
            "image 0",
        ),
    }


def test_hostile_gltf(tmp_path: Path) -> None:
    jobs, expected = [], []
    for name, (change, says) in gltf_cases().items():
        document = good_gltf()
        change(document)
        path = tmp_path / f"{name}.gltf"
        path.write_text(json.dumps(document))
        jobs.append(("scene", path))
        expected.append(says)
    (tmp_path / "deep.gltf").write_text('{"asset": {"version": "2.0"}, "extras": ' + deep(200_000) + "}")
    jobs.append(("scene", tmp_path / "deep.gltf"))
    expected.append("nested too deeply")
    for (_, path), says, answer in zip(jobs, expected, read_all(jobs), strict=True):
        assert answer["error"] == "SceneError", (path.name, answer)
        assert says in answer["message"], (path.name, answer)
        assert path.name in answer["message"]
        assert answer["seconds"] < 5.0, (path.name, answer)


@pytest.fixture
def outside(tmp_path: Path) -> Path:
    """Something that a model in the folder ``tmp_path / "model"`` must not see."""
    (tmp_path / "model" / "sub").mkdir(parents=True)
    secret = tmp_path / "secret.png"
    secret.write_bytes(png(8, 8))
    return secret


def test_uris_lead_nowhere_else(outside: Path, tmp_path: Path) -> None:
    folder = tmp_path / "model"
    (folder / "link.png").symlink_to(outside)
    names = [
        "../secret.png",
        str(outside),
        f"file://{outside}",
        "sub/../../secret.png",
        "%2e%2e/secret.png",
        "link.png",
    ]
    names += ["http://127.0.0.1:9/secret.png", "..\\secret.png", "../../../../../../../../etc/passwd", "\0"]
    jobs = []
    for number, name in enumerate(names):
        for part in ("images", "buffers"):
            document = good_gltf()
            document[part][0]["uri"] = name
            path = folder / f"{part}{number}.gltf"
            path.write_text(json.dumps(document))
            jobs.append(("scene", path))
    mesh = "mtllib {}\nusemtl a\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nf 1/1 2/1 3/1\n"
    (tmp_path / "secret.mtl").write_text("newmtl a\nmap_Kd secret.png\n")
    (folder / "own.mtl").write_text("newmtl a\nmap_Kd ../secret.png\n")
    for number, name in enumerate(("../secret.mtl", "own.mtl")):
        (folder / f"mesh{number}.obj").write_text(mesh.format(name))
        jobs.append(("scene", folder / f"mesh{number}.obj"))
    answers = read_all(jobs)
    for (_, path), answer in zip(jobs, answers, strict=True):
        inside = [name for name in answer["opened"] if name.startswith(str(tmp_path))]
        assert all(Path(name).is_relative_to(folder) for name in inside), (path.name, inside)
        assert not any("passwd" in name for name in answer["opened"]), path.name
        if path.suffix == ".gltf":
            assert answer["error"] == "SceneError", (path.name, answer)
            assert "outside of its own folder" in answer["message"], (path.name, answer)


def test_files_of_the_own_folder_are_read(tmp_path: Path) -> None:
    document = good_gltf()
    data = base64.b64decode(document["buffers"][0]["uri"].partition(",")[2])
    (tmp_path / "sub dir").mkdir()
    (tmp_path / "sub dir" / "data.bin").write_bytes(data)
    (tmp_path / "a b.png").write_bytes(png(4, 4))
    document["buffers"][0]["uri"] = "sub%20dir/data.bin"
    document["images"][0]["uri"] = "a b.png"
    (tmp_path / "scene.gltf").write_text(json.dumps(document))
    assert load_scene(tmp_path / "scene.gltf").nodes[0].material.base_color_texture.size == (4, 4)
    document["images"][0]["uri"] = "gone.png"
    (tmp_path / "scene.gltf").write_text(json.dumps(document))
    with pytest.raises(SceneError, match=r"image 0 is in 'gone\.png', which is missing"):
        load_scene(tmp_path / "scene.gltf")


def npy(header: str, data: bytes = b"") -> bytes:
    text = header.encode() + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text + data


def write_npz(path: Path, members: dict[str, bytes], method: int = zipfile.ZIP_STORED) -> Path:
    with zipfile.ZipFile(path, "w", method) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return path


class Harm:
    """Unpickling one writes a file."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return open, (str(self.path), "w")


def test_hostile_npz(tmp_path: Path) -> None:
    noise_frame(20, 12).save(tmp_path / "good.npz")
    with zipfile.ZipFile(tmp_path / "good.npz") as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    float_header = "{{'descr': '<f4', 'fortran_order': False, 'shape': {}, }}"
    objects = npy("{'descr': '|O', 'fortran_order': False, 'shape': (1,), }", pickle.dumps([Harm(tmp_path / "harm")]))
    text = "{'descr': '|u1', 'fortran_order': False, 'shape': (%d,), }"
    nested = b'{"version": 1, "camera": ' + deep(100_000).encode() + b"}"
    cases = {
        "absurd size": {"color.npy": npy(float_header.format("(1000000000, 1000000000, 4)"))},
        "more than there is": {"depth.npy": npy(float_header.format("(100000, 100000)"), b"\0" * 100)},
        "negative size": {"depth.npy": npy(float_header.format("(-1, 3)"))},
        "object": {"color.npy": objects},
        "object header": {"header.npy": objects},
        "pickle": {"color.npy": pickle.dumps(Harm(tmp_path / "harm"))},
        "nested header": {"header.npy": npy(text % len(nested), nested)},
        "code as header": {"color.npy": npy("__import__('os').system('true')")},
        "no color": {"color.npy": b""},
    }
    jobs = [("frame", write_npz(tmp_path / f"{name}.npz", {**members, **change})) for name, change in cases.items()]
    # 3 GB of zeros in 3 MB, without spending the time to pack them: the archive says so, and is refused for it.
    zeros = npy(float_header.format(f"({3 << 28},)"), bytes(1 << 20))
    packed = write_npz(tmp_path / "bomb.npz", {**members, "color.npy": zeros}, zipfile.ZIP_DEFLATED)
    content = bytearray(packed.read_bytes())
    entry = content.rindex(b"PK\x01\x02", 0, content.rindex(b"color.npy"))
    struct.pack_into("<I", content, entry + 24, 3 << 30)
    packed.write_bytes(content)
    jobs.append(("frame", tmp_path / "bomb.npz"))
    for (_, path), answer in zip(jobs, read_all(jobs), strict=True):
        assert answer["error"] == "FrameError", (path.name, answer)
        assert path.name in answer["message"], (path.name, answer)
        assert answer["seconds"] < 2.0, (path.name, answer)
    assert not (tmp_path / "harm").exists(), "something was unpickled"


def test_an_encrypted_or_oddly_packed_archive_is_refused(tmp_path: Path) -> None:
    noise_frame(9, 5).save(tmp_path / "good.npz")
    with np.load(tmp_path / "good.npz") as data:
        arrays = dict(data)
    stream = io.BytesIO()
    np.save(stream, arrays["color"])
    write_npz(tmp_path / "lzma.npz", {"color.npy": stream.getvalue()}, zipfile.ZIP_LZMA)
    with pytest.raises(FrameError, match="method that is not read"):
        LayeredFrame.load(tmp_path / "lzma.npz")
    content = bytearray((tmp_path / "good.npz").read_bytes())
    at = content.index(b"PK\x01\x02")
    content[at + 8] |= 1  # the flag of an encrypted member
    (tmp_path / "locked.npz").write_bytes(content)
    with pytest.raises(FrameError, match="encrypted"):
        LayeredFrame.load(tmp_path / "locked.npz")


def test_hostile_pictures_and_json(tmp_path: Path) -> None:
    (tmp_path / "huge.png").write_bytes(png_that_promises(10**9, 10**9))
    (tmp_path / "large.png").write_bytes(png_that_promises(12_000, 12_000))
    (tmp_path / "page.png").write_bytes(b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n")
    (tmp_path / "deep.json").write_text(deep(200_000))
    (tmp_path / "list.json").write_text("[1, 2]")
    (tmp_path / "list.npy.json").write_text("[1, 2]")
    (tmp_path / "deep.npy.json").write_text(deep(200_000))
    save_image(tmp_path / "image.exr", np.zeros((4, 4, 4), np.float32), {"lens": 1})
    content = bytearray((tmp_path / "image.exr").read_bytes())
    at = content.index(b"dataWindow\0box2i\0") + len(b"dataWindow\0box2i\0") + 4
    content[at : at + 16] = struct.pack("<4i", 0, 0, 10**9, 10**9)
    (tmp_path / "huge.exr").write_bytes(content)
    refused = [("metadata", "huge.png"), ("aperture", "huge.png"), ("aperture", "large.png"), ("aperture", "page.png")]
    refused += [("camera", "deep.json"), ("camera", "list.json"), ("record", "deep.json"), ("record", "list.json")]
    refused += [("metadata", "list.npy"), ("metadata", "deep.npy"), ("camera", "/dev/zero")]
    jobs = [(reader, tmp_path / name) for reader, name in refused]
    *answers, huge = read_all([*jobs, ("metadata", tmp_path / "huge.exr")])
    for (reader, path), answer in zip(jobs, answers, strict=True):
        assert answer["ours"], (reader, path.name, answer)
        assert answer["seconds"] < 5.0, (reader, path.name, answer)
    assert huge["error"] is None or huge["ours"], "only the header of an EXR is read, so that its size does no harm"
