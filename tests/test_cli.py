"""The command line: what it makes, and how it says no (one paragraph, exit code 2, nothing half-written)."""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

import cldof
from cldof import Camera, CaptureError, LayeredFrame
from cldof.capture.accumulate import accumulate
from cldof.capture.peel import DepthPeeler
from cldof.capture.scenes import SHOW, TEST, builtin_scenes
from cldof.cli import main
from cldof.host.device import DeviceInfo
from cldof.host.drivers import driver_advice
from cldof.images import read_metadata
from cldof.method_options import options_of
from cldof.methods import METHODS
from tests.opengl import require_opengl

TRIANGLE = "v -1 -1 0\nv 1 -1 0\nv 0 1 0.4\nf 1 2 3\n"


@pytest.fixture(autouse=True)
def _in_a_folder_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


@pytest.fixture(autouse=True)
def _patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """No progress lines on stderr, however busy the machine is; what else is there is the command's."""
    monkeypatch.setattr("cldof.cli._PATIENCE_S", 1e6)


@pytest.fixture
def on_device(device_info: DeviceInfo, monkeypatch: pytest.MonkeyPatch) -> DeviceInfo:
    """The device under test, chosen through the environment."""
    monkeypatch.setenv("CLDOF_DEVICE", str(device_info.index))
    return device_info


def a_frame(guard_px: int = 0) -> LayeredFrame:
    """A red square at 1 m before a grey wall at 3 m."""
    side = 32 + 2 * guard_px
    color = np.full((2, side, side, 4), (0.2, 0.2, 0.2, 1.0), np.float32)
    depth = np.full((2, side, side), 3.0, np.float32)
    middle = slice(guard_px + 8, guard_px + 24)
    color[0, middle, middle], depth[0, middle, middle] = (0.8, 0.1, 0.1, 1.0), 1.0
    color[1], depth[1] = 0.0, np.inf
    color[1, middle, middle], depth[1, middle, middle] = (0.2, 0.2, 0.2, 1.0), 3.0
    return LayeredFrame(color, depth, Camera(32, 32, 40.0), guard_px=guard_px)


@pytest.fixture
def frame_file(tmp_path: Path) -> str:
    a_frame().save(tmp_path / "frame.npz")
    return "frame.npz"


@pytest.fixture
def model_file(tmp_path: Path) -> str:
    (tmp_path / "model.obj").write_text(TRIANGLE)
    return "model.obj"


def files() -> set[str]:
    return {str(path) for path in Path().rglob("*") if path.is_file()}


def refused(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    """Run a command that must fail in the agreed way; returns what it said."""
    before = files()
    code = main(arguments)
    out, err = capsys.readouterr()
    assert code == 2
    assert not out
    assert err.startswith("cldof: ")
    assert err.count("\n") == 1 and "Traceback" not in err
    assert files() == before
    return err


# What it makes


def test_renders_a_saved_frame(frame_file: str, on_device: DeviceInfo, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["render", frame_file, "-o", "out.png", "--report", "report.json", "--pinhole", "sharp.exr"]) == 0
    out, err = capsys.readouterr()
    assert not err
    assert "out.png  32x32" in out and on_device.name in out and "focus 1 m" in out and "times" in out
    with Image.open("out.png") as picture:
        assert picture.size == (32, 32) and picture.mode == "RGB"
    report = json.loads(Path("report.json").read_text())
    assert report["lens"]["focus_distance_m"] == 1.0
    assert report["method"] == "layered" and on_device.name in report["device"]
    assert set(report["timings"]["steps_s"]) == {"device", "render", "write"}
    assert report["timings"]["passes_ms"] and all(item["ms"] >= 0 for item in report["timings"]["passes_ms"])
    assert report["versions"]["cldof"] == cldof.__version__
    facts = read_metadata("out.png")
    assert facts["lens"] == report["lens"] and facts["camera"]["yfov_deg"] == 40.0
    assert read_metadata("sharp.exr")["method"] == "pinhole"
    # Of our choosing: the largest blur is a few per cent of the image height.
    assert max(map(abs, facts["coc_radius_px"])) == pytest.approx(0.02 * 32, rel=0.01)


def test_linear_output_is_the_renderers(frame_file: str, on_device: DeviceInfo) -> None:
    assert main(["render", frame_file, "-o", "out.npy", "--aperture-radius", "0.05", "--focus-distance", "3"]) == 0
    with cldof.Renderer(device=on_device.index) as renderer:
        expected = renderer.render(a_frame(), cldof.Lens(0.05, 3.0)).image
    assert np.array_equal(np.load("out.npy"), expected)
    assert read_metadata("out.npy")["lens"]["aperture_radius_m"] == 0.05


def test_pinhole_aperture_is_the_pinhole_image(frame_file: str, on_device: DeviceInfo) -> None:
    assert main(["render", frame_file, "-o", "out.npy", "--aperture-radius", "0", "--pinhole", "sharp.npy"]) == 0
    assert np.load("out.npy") == pytest.approx(np.load("sharp.npy"), abs=1e-6)


@pytest.mark.parametrize(
    "options, radius, focus",
    [
        (["--focus-distance", "inf", "--aperture-radius", "0.01"], 0.01, None),
        (["--focus-at", "1,1", "--aperture-radius", "0.01"], 0.01, 3.0),
        (["--focus-at", "16,16", "--aperture-radius", "0.01"], 0.01, 1.0),
        (["--f-number", "2", "--focal-length", "50"], 0.0125, 1.0),
        (["--f-number", "2"], 12e-3 / math.tan(math.radians(20.0)) / 4, 1.0),
    ],
)
def test_lens_options(
    options: list[str], radius: float, focus: float | None, frame_file: str, on_device: DeviceInfo
) -> None:
    assert main(["render", frame_file, "-o", "out.png", "--quiet", *options]) == 0
    lens = read_metadata("out.png")["lens"]
    assert lens["aperture_radius_m"] == pytest.approx(radius)
    assert lens["focus_distance_m"] == focus


def test_quiet_prints_nothing(frame_file: str, on_device: DeviceInfo, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["render", frame_file, "-o", "out.png", "--quiet"]) == 0
    assert capsys.readouterr() == ("", "")


def test_slow_steps_are_told(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("cldof.cli._PATIENCE_S", -1.0)
    from cldof.cli import _Stopwatch

    with _Stopwatch(quiet=False).step("capture"):
        pass
    assert capsys.readouterr().err.startswith("capture: 0.0 s")
    with _Stopwatch(quiet=True).step("capture"):
        pass
    assert not capsys.readouterr().err


def test_slow_steps_are_told_while_they_last(monkeypatch: pytest.MonkeyPatch) -> None:
    import io
    import time

    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

    from cldof.cli import _Stopwatch

    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    monkeypatch.setattr("cldof.cli._PATIENCE_S", 0.02)
    with _Stopwatch(quiet=False).step("capture") as progress:
        for done, total, shown in ((2, 4, "capture 2/4 "), (16, 64, f"capture 16/64 [{'#' * 7}{'.' * 23}] ")):
            progress(done, total)
            limit = time.monotonic() + 20
            while shown not in terminal.getvalue() and time.monotonic() < limit:
                time.sleep(0.01)
            assert shown in terminal.getvalue()
    assert terminal.getvalue().rstrip().endswith(" s")


@pytest.mark.parametrize("name", ["fence", "floating"])
def test_renders_builtin_scenes(name: str, on_device: DeviceInfo) -> None:
    require_opengl()
    arguments = ["--size", "80x60", "--save-frame", "frame.npz", "--report", "report.json", "--quiet"]
    assert main(["render", name, "-o", "out.png", *arguments]) == 0
    with Image.open("out.png") as picture:
        assert picture.size == (80, 60) and picture.mode == ("RGB" if name == "fence" else "RGBA")
    report = json.loads(Path("report.json").read_text())
    scene = builtin_scenes()[name].make()
    assert report["lens"]["aperture_radius_m"] == scene.aperture_radius_m
    assert report["lens"]["focus_distance_m"] == scene.focus_distance_m
    assert report["guard_px"] >= max(map(abs, report["coc_radius_px"])) - 1
    assert {"scene", "preview", "capture", "render", "write"} <= set(report["timings"]["steps_s"])
    saved = LayeredFrame.load("frame.npz")
    assert saved.guard_px == report["guard_px"] and saved.layer_count == report["layers"]


def test_renders_a_model_file(model_file: str, on_device: DeviceInfo) -> None:
    require_opengl()
    Path("camera.json").write_text(json.dumps(Camera(40, 30, 45.0).to_dict() | {"pose_camera_to_world": pose(0, 0, 4)}))
    base = ["render", model_file, "--quiet", "--unlit", "--transparent", "--camera", "camera.json"]
    assert main([*base, "-o", "out.npy"]) == 0
    image = np.load("out.npy")
    assert image.shape == (30, 40, 4)
    assert image[0, 0].tolist() == [0, 0, 0, 0] and image[15, 20, 3] == pytest.approx(1.0, abs=1e-3)
    facts = read_metadata("out.npy")
    assert 3.6 <= facts["lens"]["focus_distance_m"] <= 4.0
    assert main([*base, "-o", "out.npy", "--size", "64x32", "--yfov", "60", "--peels", "1"]) == 0
    facts = read_metadata("out.npy")
    assert facts["layers"] == 1 and facts["camera"]["yfov_deg"] == 60.0 and facts["camera"]["width"] == 64


def test_focus_on_a_pixel_of_a_scene(on_device: DeviceInfo) -> None:
    require_opengl()
    assert main(["render", "fence", "-o", "out.png", "--size", "90x90", "--focus-at", "45,20", "--quiet"]) == 0
    assert read_metadata("out.png")["lens"]["focus_distance_m"] == pytest.approx(5.6, abs=0.3)


def test_a_capped_guard_band_is_told(on_device: DeviceInfo, capsys: pytest.CaptureFixture[str]) -> None:
    require_opengl()
    assert main(["render", "floating", "-o", "out.png", "--size", "64x64", "--aperture-radius", "0.5"]) == 0
    assert "guard band is capped at 7 px" in capsys.readouterr().out


@pytest.mark.parametrize("name", [name for name, scene in builtin_scenes().items() if scene.group == TEST])
def test_renders_scenes_to_test(name: str, on_device: DeviceInfo) -> None:
    require_opengl()
    assert main(["render", name, "-o", "out.png", "--size", "48x36", "--peels", "2", "--quiet"]) == 0
    with Image.open("out.png") as picture:
        assert picture.size == (48, 36) and picture.mode == "RGB"


def test_method_options(frame_file: str, on_device: DeviceInfo) -> None:
    lens = ["--aperture-radius", "0.1", "--focus-distance", "3", "--quiet"]
    short = ["--layers", "5", "--sigma-step", "0.7", "--no-cascade", "--engine", "fir"]
    long = ["--option", "layers=5", "--option", "sigma-step=0.7", "--option", "cascade=no", "--option", "engine=fir"]
    for options in (short, long):
        assert main(["render", frame_file, "-o", "out.npy", "--report", "report.json", *lens, *options]) == 0
        settings = json.loads(Path("report.json").read_text())["settings"]
        expected = {"layers": 5, "sigma_step": 0.7, "cascade": False, "engine": "fir", "supersample": 1}
        assert expected.items() <= settings.items()
        with cldof.Renderer(device=on_device.index, layers=5, sigma_step=0.7, cascade=False, engine="fir") as renderer:
            assert np.array_equal(np.load("out.npy"), renderer.render(a_frame(), cldof.Lens(0.1, 3.0)).image)


def test_supersampling(on_device: DeviceInfo, capsys: pytest.CaptureFixture[str]) -> None:
    require_opengl()
    view = ["--size", "60x48", "--focus-at", "30,12"]
    save = ["--save-frame", "frame.npz", "--report", "report.json", "--pinhole", "sharp.npy"]
    assert main(["render", "fence", "-o", "large.npy", *view, *save, "--supersample", "2"]) == 0
    assert "60x48, layered, 4 layers, supersampled by 2" in capsys.readouterr().out
    report = json.loads(Path("report.json").read_text())
    assert report["settings"]["supersample"] == 2
    assert (report["camera"]["width"], report["camera"]["height"]) == (60, 48)
    frame = LayeredFrame.load("frame.npz")
    assert frame.camera.width == 120 and frame.guard_px == report["guard_px"]
    assert frame.guard_px >= 2 * max(map(abs, report["coc_radius_px"])) - 2
    sharp = frame.pinhole_image().reshape(48, 2, 60, 2, 4).mean(axis=(1, 3))
    assert np.load("sharp.npy") == pytest.approx(sharp, abs=1e-6)
    # The saved frame gives the same image, and pixels to focus on are those of the image.
    again = ["--supersample", "2", "--aperture-radius", str(report["lens"]["aperture_radius_m"])]
    assert main(["render", "frame.npz", "-o", "again.npy", "--focus-at", "30,12", *again]) == 0
    assert read_metadata("again.npy")["lens"]["focus_distance_m"] == pytest.approx(
        report["lens"]["focus_distance_m"], rel=0.01
    )
    assert np.load("again.npy") == pytest.approx(np.load("large.npy"), abs=0.01)
    assert np.load("again.npy").shape == (48, 60, 4)
    capsys.readouterr()
    assert "does not divide" in refused(capsys, "render", "frame.npz", "-o", "x.png", "--supersample", "7")


def test_accumulates(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    require_opengl()
    monkeypatch.setattr("cldof.host.device._devices", list)  # no OpenCL needed
    extra = ["--aperture", "gaussian", "--no-jitter", "--report", "report.json", "--pinhole", "sharp.npy"]
    arguments = ["render", "floating", "--method", "accumulate", "--views", "8", "--size", "40x30"]
    assert main([*arguments, "-o", "out.npy", *extra]) == 0
    out = capsys.readouterr().out
    assert "out.npy  40x30, accumulate, 8 views" in out and "noise floor" in out
    report = json.loads(Path("report.json").read_text())
    assert report["settings"] == {"views": 8, "jitter": False, "seed": 0, "view_dependent": True}
    assert report["lens"]["aperture"]["shape"] == "gaussian"
    assert report["device"] is None and report["capture_device"] and report["layers"] is None
    assert 15.0 < report["plan"]["noise_floor_db"] < 80.0
    assert {"scene", "preview", "accumulate", "write"} == set(report["timings"]["steps_s"])
    scene = builtin_scenes()["floating"].make()
    camera = scene.camera_for(40, 30)
    lens = cldof.Lens(scene.aperture_radius_m or 0.0, scene.focus_distance_m or 0.0)
    with DepthPeeler(40, 30) as peeler:
        expected = accumulate(peeler, scene, camera, lens, 8, shape="gaussian").image
        pinhole = peeler.peel(scene, camera, layers=8).pinhole_image()
    assert np.array_equal(np.load("out.npy"), expected)
    assert np.load("sharp.npy") == pytest.approx(pinhole, abs=1e-5)


def test_accumulates_with_any_aperture() -> None:
    require_opengl()
    Image.fromarray(np.pad(np.full((8, 8), 255, np.uint8), 8)).save("hole.png")
    images = {}
    for text, shape in (
        ("disc", {"shape": "disc", "ratio": 2.0}),
        ("polygon:5", {"shape": "polygon", "blades": 5, "rotation_deg": 0.0, "curvature": 0.0}),
        ("polygon:7:15:0.5", {"shape": "polygon", "blades": 7, "rotation_deg": 15.0, "curvature": 0.5}),
        ("image:hole.png", {"shape": "image", "image_size": [24, 24]}),
    ):
        more = ["--views", "4", "--size", "24x24", "--aperture", text, "--anamorphic", "2", "--quiet"]
        assert main(["render", "floating", "-o", "out.npy", "--method", "accumulate", *more]) == 0
        assert shape.items() <= read_metadata("out.npy")["lens"]["aperture"].items()
        assert read_metadata("out.npy")["settings"]["jitter"] is True
        images[text] = np.load("out.npy").tobytes()
    assert len(set(images.values())) == len(images)


def test_files_are_seen_from_where_one_likes(model_file: str, on_device: DeviceInfo) -> None:
    require_opengl()
    poses = []
    for view in ([], ["--azimuth", "-50"], ["--azimuth", "0", "--elevation", "-10"]):
        assert main(["render", model_file, "-o", "out.npy", "--size", "24x24", "--quiet", *view]) == 0
        back = np.array(read_metadata("out.npy")["camera"]["pose_camera_to_world"])[:3, 2]
        poses.append((math.degrees(math.atan2(back[0], back[2])), math.degrees(math.asin(back[1]))))
    assert poses == [pytest.approx(expected, abs=1e-6) for expected in ((30, 14), (-50, 14), (0, -10))]


def pose(x: float, y: float, z: float) -> list[list[float]]:
    return [[1, 0, 0, x], [0, 1, 0, y], [0, 0, 1, z], [0, 0, 0, 1]]


def test_lists_scenes(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["scenes"]) == 0
    out = capsys.readouterr().out
    assert all(name in out for name in builtin_scenes())
    assert out.startswith(f"{SHOW}:") and f"\n{TEST}:\n" in out


def test_lists_methods_and_their_options(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["methods"]) == 0
    out = capsys.readouterr().out
    for method in METHODS:
        assert f"\n{method}: " in f"\n{out}"
        assert all(f"  {option}=" in out for option in options_of(method))
    assert "accumulate: " in out and "--views" in out
    assert max(map(len, out.splitlines())) <= 100


def test_lists_devices(on_device: DeviceInfo, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["devices"]) == 0
    assert on_device.name in capsys.readouterr().out


@pytest.mark.parametrize("arguments", [["--version"], ["--help"], ["render", "--help"]])
def test_help_and_version(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main(arguments)
    assert stop.value.code == 0
    assert ("cldof " + cldof.__version__ if "--version" in arguments else "usage: cldof") in capsys.readouterr().out


def test_help_imports_nothing_heavy() -> None:
    code = (
        "import sys\n"
        "from cldof.cli import main\n"
        "try: main(['--help'])\n"
        "except SystemExit: pass\n"
        "heavy = {'pyopencl', 'pyrender', 'trimesh', 'OpenGL', 'PIL', 'skimage'} & set(sys.modules)\n"
        "sys.exit(str(heavy) if heavy else 0)\n"
    )
    root = str(Path(cldof.__file__).parents[1])
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, [root, os.environ.get("PYTHONPATH")]))}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment, timeout=60)
    assert done.returncode == 0, done.stderr


# How it says no


def save_spoiled(name: str, change: Callable[[dict[str, Any]], None]) -> None:
    """A saved frame with its arrays tampered with."""
    a_frame().save(name)
    with np.load(name) as data:
        arrays = {key: data[key].copy() for key in data}
    change(arrays)
    np.savez(name, **arrays)


def test_missing_scene(on_device: DeviceInfo, capsys: pytest.CaptureFixture[str]) -> None:
    assert "neither a file nor a built-in scene" in refused(capsys, "render", "none.glb", "-o", "out.png")
    assert "no such file" in refused(capsys, "render", "none.npz", "-o", "out.png")


@pytest.mark.parametrize("name", ["broken.glb", "broken.obj", "broken.stl", "broken.ply", "broken.xyzzy", "broken.npz"])
@pytest.mark.parametrize("content", [b"", b"\x00\x01garbage\xff", b"glTF\x02\x00\x00\x00\xff\xff\xff\xff"])
def test_unreadable_scene(name: str, content: bytes, on_device: DeviceInfo, capsys: pytest.CaptureFixture[str]) -> None:
    Path(name).write_bytes(content)
    refused(capsys, "render", name, "-o", "out.png")


def test_a_folder_for_a_scene(on_device: DeviceInfo, capsys: pytest.CaptureFixture[str]) -> None:
    Path("folder.glb").mkdir()
    refused(capsys, "render", "folder.glb", "-o", "out.png")


def test_empty_scene(on_device: DeviceInfo, capsys: pytest.CaptureFixture[str]) -> None:
    Path("empty.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\n")
    refused(capsys, "render", "empty.obj", "-o", "out.png")
    Path("empty.gltf").write_text('{"asset": {"version": "2.0"}, "scenes": [{"nodes": []}], "scene": 0}')
    refused(capsys, "render", "empty.gltf", "-o", "out.png")


def test_nothing_in_sight(model_file: str, on_device: DeviceInfo, capsys: pytest.CaptureFixture[str]) -> None:
    require_opengl()
    Path("away.json").write_text(json.dumps({"yfov_deg": 40, "pose_camera_to_world": pose(0, 0, -5)}))
    base = ["render", model_file, "-o", "out.png", "--camera", "away.json", "--size", "32x32"]
    assert "Nothing is in sight" in refused(capsys, *base)
    assert "nothing is there" in refused(capsys, *base, "--focus-at", "16,16", "--transparent")


def test_bad_frames(on_device: DeviceInfo, capsys: pytest.CaptureFixture[str]) -> None:
    def nan_depth(arrays: dict[str, Any]) -> None:
        arrays["depth"][0, 3, 2] = np.nan

    def wrong_shape(arrays: dict[str, Any]) -> None:
        arrays["color"] = arrays["color"][:, :-1]

    def zero_area(arrays: dict[str, Any]) -> None:
        header = json.loads(bytes(arrays["header"]))
        header["camera"]["width"] = 0
        arrays["header"] = np.frombuffer(json.dumps(header).encode(), np.uint8)

    for name, change, says in (
        ("nan.npz", nan_depth, "depth has 1 NaN values; use inf where nothing is there; the first is in layer 0"),
        ("shape.npz", wrong_shape, "color has shape"),
        ("zero.npz", zero_area, "width is 0"),
    ):
        save_spoiled(name, change)
        assert says in refused(capsys, "render", name, "-o", "out.png")


def test_zero_area_image(on_device: DeviceInfo, capsys: pytest.CaptureFixture[str]) -> None:
    assert "width is 0" in refused(capsys, "render", "floating", "-o", "out.png", "--size", "0x64")


def test_no_such_device(frame_file: str, on_device: DeviceInfo, capsys: pytest.CaptureFixture[str]) -> None:
    says = refused(capsys, "render", frame_file, "-o", "out.png", "--device", "no such device")
    assert "no such device" in says and on_device.name in says


def test_no_device_at_all(frame_file: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("cldof.host.device._devices", list)
    assert driver_advice() in refused(capsys, "render", frame_file, "-o", "out.png")
    assert driver_advice() in refused(capsys, "devices")


def test_no_opengl(on_device: DeviceInfo, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(*_: object) -> None:
        raise CaptureError("No offscreen OpenGL: apt-get install libegl1 libgl1 libgl1-mesa-dri.")

    monkeypatch.setattr("cldof.capture.peel.GLContext", missing)
    assert "libegl1" in refused(capsys, "render", "floating", "-o", "out.png")


def test_no_opengl_for_real(on_device: DeviceInfo) -> None:
    """A fresh process whose EGL finds no driver at all."""
    require_opengl()
    root = str(Path(cldof.__file__).parents[1])
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, [root, os.environ.get("PYTHONPATH")]))}
    environment |= {"__EGL_VENDOR_LIBRARY_FILENAMES": os.devnull, "LIBGL_DRIVERS_PATH": os.devnull}
    command = [sys.executable, "-m", "cldof.cli", "render", "floating", "-o", "out.png", "--size", "16x16"]
    done = subprocess.run(command, capture_output=True, text=True, env=environment, timeout=120)
    assert done.returncode == 2
    assert "libegl1" in done.stderr and "Traceback" not in done.stderr
    assert not files()


def test_unknown_method(frame_file: str, on_device: DeviceInfo, capsys: pytest.CaptureFixture[str]) -> None:
    says = refused(capsys, "render", frame_file, "-o", "out.png", "--method", "magic")
    assert "magic" in says and "layered" in says


@pytest.mark.parametrize("option", ["-o", "--pinhole", "--save-frame", "--report"])
def test_unwritable_output(
    option: str, frame_file: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def too_late(*_: object, **__: object) -> None:
        raise AssertionError("work began before the output path was checked")

    monkeypatch.setattr("cldof.renderer.Renderer", too_late)
    where = "missing/frame.npz" if option == "--save-frame" else "missing/out.png"
    rest = [] if option == "-o" else ["-o", "out.png"]
    assert "does not exist" in refused(capsys, "render", frame_file, option, where, *rest)
    Path("folder.npz").mkdir()
    Path("folder.png").mkdir()
    where = "folder.npz" if option == "--save-frame" else "folder.png"
    assert "folder" in refused(capsys, "render", frame_file, option, where, *rest)


def test_unknown_ending(frame_file: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert ".png, .exr, .npy" in refused(capsys, "render", frame_file, "-o", "out.jpg")
    assert "supported are .npz" in refused(capsys, "render", "row", "-o", "out.png", "--save-frame", "frame.npy")


@pytest.mark.parametrize(
    "options, says",
    [
        (["--device", "0", "--peels", "3"], "leave out --device, --peels"),
        (["--layers", "5", "--option", "x=1", "--save-frame", "f.npz"], "leave out --option, --layers, --save-frame"),
        (["--supersample", "2"], "leave out --supersample"),
        (["--views", "0"], "views is 0"),
        (["--aperture", "star"], "use disc, gaussian, polygon:BLADES"),
        (["--aperture", "polygon:six"], "use disc, gaussian, polygon:BLADES"),
        (["--aperture", "polygon:6:1:0:9"], "use disc, gaussian, polygon:BLADES"),
        (["--aperture", "polygon:2"], "blades is 2"),
        (["--aperture", "polygon:6:0:7"], "curvature is 7"),
        (["--aperture", "image:none.png"], "Cannot read the aperture image none.png"),
        (["--anamorphic", "0"], "ratio is 0"),
        (["--azimuth", "3"], "floating has a camera of its own; leave out --azimuth"),
    ],
)
def test_bad_options_of_accumulate(options: list[str], says: str, capsys: pytest.CaptureFixture[str]) -> None:
    require_opengl()
    base = ["render", "floating", "-o", "out.png", "--method", "accumulate", "--size", "16x16"]
    assert says in refused(capsys, *base, *options)


def test_a_full_disk(
    frame_file: str, on_device: DeviceInfo, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.replace", full)
    assert "No space left" in refused(capsys, "render", frame_file, "-o", "out.png")


@pytest.mark.parametrize(
    "options, says",
    [
        (["--aperture-radius", "-1"], "aperture_radius_m is -1"),
        (["--aperture-radius", "nan"], "aperture_radius_m is NaN"),
        (["--focus-distance", "0"], "focus_distance_m is 0"),
        (["--f-number", "2", "--focal-length", "50", "--focus-distance", "0.04"], "inside the focal length"),
        (["--f-number", "0"], "f_number is 0"),
        (["--focal-length", "50"], "--f-number"),
        (["--focus-at", "99,3"], "outside the image"),
        (["--size", "32x32"], "leave out --size"),
        (["--unlit", "--peels", "3"], "leave out --unlit, --peels"),
        (["--azimuth", "0"], "leave out --azimuth"),
        (["--method", "accumulate"], "is a captured frame; --method accumulate draws the scene itself"),
        (["--views", "8", "--no-jitter"], "--views, --no-jitter: for --method accumulate only, not for 'layered'"),
        (["--jitter"], "--jitter: for --method accumulate only"),
        (["--aperture", "disc"], "simulates a gaussian lens and no other; leave out --aperture"),
        (["--anamorphic", "2"], "leave out --anamorphic"),
        (["--option", "rays=3"], "no option 'rays'; its options are: layers, "),
        (["--option", "layers"], "is not NAME=VALUE"),
        (["--layers", "many"], "'layers' of method 'layered' is 'many'; it must be: int"),
        (["--layers", "2"], "layers is 2"),
        (["--layers", "5", "--option", "layers=6"], "given twice"),
        (["--engine", "steam"], "engine is 'steam'"),
        (["--supersample", "0"], "supersample is 0"),
        (["--supersample", "1000"], "supersample is 1000"),
    ],
)
def test_bad_options(
    options: list[str], says: str, frame_file: str, on_device: DeviceInfo, capsys: pytest.CaptureFixture[str]
) -> None:
    assert says in refused(capsys, "render", frame_file, "-o", "out.png", *options)


@pytest.mark.parametrize(
    "options, says",
    [
        (["--peels", "0"], "layers is 0"),
        (["--yfov", "200"], "yfov_deg is 200"),
        (["--camera", "none.json"], "Cannot read camera file"),
    ],
)
def test_bad_views(options: list[str], says: str, on_device: DeviceInfo, capsys: pytest.CaptureFixture[str]) -> None:
    require_opengl()
    assert says in refused(capsys, "render", "floating", "-o", "out.png", "--size", "32x32", *options)


@pytest.mark.parametrize(
    "arguments",
    [
        [],
        ["render"],
        ["render", "row"],
        ["paint", "row"],
        ["render", "row", "-o", "out.png", "--size", "big"],
        ["render", "row", "-o", "out.png", "--size", "64x-3"],
        ["render", "row", "-o", "out.png", "--focus-at", "3"],
        ["render", "row", "-o", "out.png", "--yfov", "wide"],
        ["render", "row", "-o", "out.png", "--aperture-radius", "1", "--f-number", "2"],
        ["render", "row", "-o", "out.png", "--focus-distance", "1", "--focus-at", "2,3"],
    ],
)
def test_wrong_usage(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main(arguments)
    assert stop.value.code == 2
    assert "usage: cldof" in capsys.readouterr().err


def test_interrupted(frame_file: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupt(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("cldof.renderer.Renderer", interrupt)
    assert main(["render", frame_file, "-o", "out.png"]) == 130
    assert "interrupted" in capsys.readouterr().err
    assert files() == {frame_file}


# Sequences


def test_a_sequence_of_a_saved_frame(
    frame_file: str, on_device: DeviceInfo, capsys: pytest.CaptureFixture[str]
) -> None:
    keys = ["--key", "0 focus=1 radius=0.05", "--key", "last at=1,1 radius=0"]
    assert main(["sequence", frame_file, "-o", "f#.npy", "--frames", "3", *keys, "--report", "r.json"]) == 0
    out, err = capsys.readouterr()
    assert "f0.npy .. f2.npy  3 frames, 32x32" in out and not err
    report = json.loads(Path("r.json").read_text())
    lenses = [item["lens"] for item in report["frames"]]
    # The pixel at 1,1 shows the wall at 3 m; half-way in 1/z is 1.5 m; an aperture that closes does so evenly.
    assert [lens["focus_distance_m"] for lens in lenses] == pytest.approx([1.0, 1.5, 3.0])
    assert [lens["aperture_radius_m"] for lens in lenses] == pytest.approx([0.05, 0.025, 0.0])
    with cldof.Renderer(device=on_device.index) as renderer:
        for index, (focus, radius) in enumerate(((1.0, 0.05), (1.5, 0.025), (3.0, 0.0))):
            assert np.array_equal(np.load(f"f{index}.npy"), renderer.render(a_frame(), cldof.Lens(radius, focus)).image)


def test_a_sequence_of_a_scene_is_captured_once(on_device: DeviceInfo, capsys: pytest.CaptureFixture[str]) -> None:
    require_opengl()
    base = ["--size", "40x40", "--frames", "2", "--quiet", "--report", "r.json"]
    assert main(["sequence", "floating", "-o", "##.png", *base, "--key", "0 auto", "--key", "last on=knot"]) == 0
    assert {"00.png", "01.png"} <= files()
    frames = json.loads(Path("r.json").read_text())["frames"]
    assert frames[1]["lens"]["focus_distance_m"] == pytest.approx(3.0, abs=0.4)
    assert frames[0]["lens"]["aperture_radius_m"] == pytest.approx(0.03)
    capsys.readouterr()


@pytest.mark.parametrize(
    "options, says",
    [
        (["-o", "x.png"], "needs one run of #"),
        (["-o", "#.png", "--frames", "11"], "room for 10 frames, not for 11"),
        (["-o", "#.gif"], ".gif"),
        (["-o", "#.png", "--frames", "0"], "--frames is 0"),
        (["-o", "##.png", "--key", "x focus=1"], "not FRAME WORD=VALUE"),
        (["-o", "##.png", "--key", ""], "not FRAME WORD=VALUE"),
        (["-o", "##.png", "--key", "0"], "says nothing about the lens"),
        (["-o", "##.png", "--key", "0 focus=1 auto"], "more than once"),
        (["-o", "##.png", "--key", "0 zoom=2"], "'zoom=2' is none of"),
        (["-o", "##.png", "--key", "0 focus=near"], "focus=near is not a number"),
        (["-o", "##.png", "--key", "0 focus=-1"], "must be positive"),
        (["-o", "##.png", "--key", "0 at=99,3"], "outside the image"),
        (["-o", "##.png", "--key", "0 at=top"], "not X,Y in pixels"),
        (["-o", "##.png", "--key", "0 on=knot"], "a saved frame has no nodes"),
        (["-o", "##.png", "--key", "0 f=2"], "needs --focal-length"),
        (["-o", "##.png", "--method", "accumulate"], "captured layers"),
    ],
)
def test_impossible_sequences_are_refused(
    frame_file: str, capsys: pytest.CaptureFixture[str], options: list[str], says: str
) -> None:
    frames = [] if "--frames" in options else ["--frames", "2"]
    assert says in refused(capsys, "sequence", frame_file, *frames, *options)


def test_focus_on_needs_a_scene_with_that_node(frame_file: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert "a saved frame has no nodes" in refused(capsys, "render", frame_file, "-o", "x.png", "--focus-on", "knot")
    require_opengl()
    base = ["render", "floating", "-o", "x.png", "--size", "32x32"]
    assert "no node 'tree'; named are knot" in refused(capsys, *base, "--focus-on", "tree")


def test_glossy_scenes_are_captured_with_their_surfaces(on_device: DeviceInfo) -> None:
    """Only by a method that shades them, where the lens sees the difference, and unless told otherwise."""
    require_opengl()
    base = ["-o", "out.npy", "--size", "48x36", "--peels", "2", "--quiet", "--save-frame", "frame.npz"]
    images = []
    for scene, more, eyes, has_surface in (
        ("mirrors", ["--method", "multiview"], 16, True),
        ("mirrors", ["--method", "multiview", "--no-view-dependent"], 0, False),
        ("mirrors", ["--method", "multiview", "--aperture-radius", "1e-4"], 0, False),
        ("fence", ["--method", "multiview"], 0, False),
        ("mirrors", [], None, False),
    ):
        assert main(["render", scene, *base, *more, "--report", "report.json"]) == 0
        assert json.loads(Path("report.json").read_text())["plan"].get("eyes") == eyes
        assert bool(LayeredFrame.load("frame.npz").surface) == has_surface
        images.append(np.load("out.npy"))
    assert np.abs(images[0] - images[1]).max() > 0.05


def test_no_view_dependent_shading_for_methods_that_have_none(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["render", "fence", "-o", "out.png", "--method", "gather", "--no-view-dependent"]) == 2
    assert "has no option 'view_dependent'" in capsys.readouterr().err


def test_accumulates_as_the_centre_sees_it() -> None:
    require_opengl()
    base = ["render", "mirrors", "--method", "accumulate", "--views", "8", "--size", "40x30", "--quiet"]
    assert main([*base, "-o", "own.npy"]) == 0 and main([*base, "-o", "centre.npy", "--no-view-dependent"]) == 0
    assert np.abs(np.load("own.npy") - np.load("centre.npy")).max() > 0.05


def test_lights_a_scene_by_an_environment(on_device: DeviceInfo, capsys: pytest.CaptureFixture[str]) -> None:
    require_opengl()
    around = np.zeros((8, 16, 3), np.float32)
    around[:4, :, 2], around[4:, :, 0] = 2.0, 0.5  # blue above, red below
    np.save("around.npy", around)
    base = ["render", "floating", "-o", "out.npy", "--size", "48x36", "--peels", "2", "--quiet"]
    assert main([*base, "--environment", "around.npy"]) == 0
    image = np.load("out.npy")
    assert (image[..., 3] > 0.999).all()
    assert image[2, 24, 2] > 1.5 and image[33, 24, 0] > 0.3
    np.save("around.npy", -around)
    assert main([*base, "--environment", "around.npy"]) == 2
    assert "--environment around.npy: Environment image has 128 values" in capsys.readouterr().err
