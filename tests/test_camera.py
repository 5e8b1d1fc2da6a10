"""The camera: pixels, guard bands, poses, files."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cldof import Camera, InputError


def turned(degrees: float) -> np.ndarray:
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    return np.array([[c, 0, s, 1], [0, 1, 0, 2], [-s, 0, c, 3], [0, 0, 0, 1]])


def test_focal_length_in_pixels() -> None:
    assert Camera(100, 200, yfov_deg=90.0).focal_px == pytest.approx(100.0)


def test_intrinsics_round_trip() -> None:
    camera = Camera.from_intrinsics(900.0, 900.0, 320.0, 240.0, 640, 480)
    assert camera.focal_px == pytest.approx(900.0)
    assert (camera.width, camera.height) == (640, 480)


def test_sensor() -> None:
    camera = Camera.from_sensor(50.0, 24.0, 1500, 1000, near=0.2)
    assert camera.focal_px == pytest.approx(50.0 / 24.0 * 1000)
    assert camera.near == 0.2


@given(st.floats(5.0, 150.0), st.integers(0, 300), st.integers(1, 500))
def test_guard_band_keeps_pixels(yfov: float, guard: int, height: int) -> None:
    camera = Camera(64, height, yfov)
    wider = camera.with_guard(guard)
    assert wider.focal_px == pytest.approx(camera.focal_px, rel=1e-9)
    assert (wider.width, wider.height) == (64 + 2 * guard, height + 2 * guard)


def test_dictionary_round_trip() -> None:
    camera = Camera(320, 200, 35.0, near=0.1, far=50.0, pose=turned(30))
    again = Camera.from_dict(json.loads(json.dumps(camera.to_dict())))
    assert again.to_dict() == camera.to_dict()
    endless = Camera.from_dict(json.loads(json.dumps(Camera(3, 2).to_dict())))
    assert endless.far == math.inf


def test_file_round_trip(tmp_path: Path) -> None:
    path = tmp_path / "a camera.json"
    path.write_text(json.dumps({"yfov_deg": 50, "pose_camera_to_world": turned(10).tolist(), "znear": 0.2}))
    camera = Camera.load(path, 640, 480)
    assert (camera.width, camera.height, camera.yfov_deg, camera.near, camera.far) == (640, 480, 50, 0.2, math.inf)
    assert np.allclose(camera.pose, turned(10))


def test_pose_is_kept_safe() -> None:
    pose = np.eye(4)
    camera = Camera(4, 4, pose=pose)
    pose[0, 3] = 5.0
    assert camera.pose[0, 3] == 0.0
    with pytest.raises(ValueError, match="read-only"):
        camera.pose[0, 3] = 1.0


@pytest.mark.parametrize(
    "change, says",
    [
        ({"width": 0}, "width is 0"),
        ({"height": 0}, "height is 0"),
        ({"height": -4}, "height is -4"),
        ({"width": 2.5}, "width is 2.5"),
        ({"width": math.nan}, "width is nan"),
        ({"width": math.inf}, "width is inf"),
        ({"width": "wide"}, "width is 'wide'"),
        ({"width": None}, "width is None"),
        ({"width": 100000}, "width is 100000"),
        ({"yfov_deg": 0.0}, "yfov_deg is 0.0"),
        ({"yfov_deg": 180.0}, "yfov_deg is 180.0"),
        ({"yfov_deg": math.nan}, "yfov_deg is nan"),
        ({"near": 0.0}, "near and far"),
        ({"near": math.nan}, "near and far"),
        ({"near": 2.0, "far": 1.0}, "near and far"),
        ({"far": math.nan}, "near and far"),
        ({"pose": np.eye(3)}, r"shape \(3, 3\)"),
        ({"pose": np.full((4, 4), math.nan)}, "finite 4x4"),
        ({"pose": 2 * np.eye(4)}, "rigid"),
        ({"pose": np.diag([1.0, 1.0, -1.0, 1.0])}, "rigid"),
        ({"pose": "here"}, "4x4 matrix of numbers"),
    ],
)
def test_bad_cameras_are_refused(change: dict[str, Any], says: str) -> None:
    with pytest.raises(InputError, match=says):
        Camera(**{"width": 64, "height": 48, **change})


@pytest.mark.parametrize(
    "intrinsics, says",
    [
        ((900, 800, 320, 240), "square pixels"),
        ((900, 900, 300, 240), "off the centre"),
        ((0, 0, 320, 240), "positive"),
        ((math.nan, 900, 320, 240), "positive"),
        (("x", 900, 320, 240), "fx is 'x'"),
    ],
)
def test_bad_intrinsics_are_refused(intrinsics: tuple[Any, ...], says: str) -> None:
    with pytest.raises(InputError, match=says):
        Camera.from_intrinsics(*intrinsics, 640, 480)


@pytest.mark.parametrize(
    "text, says",
    [
        ("not json", "not JSON"),
        ("[1, 2]", "JSON object"),
        ("{}", "lacks yfov_deg"),
        ('{"yfov_deg": 40, "fov": 3}', r"unknown keys \['fov'\]"),
        ('{"yfov_deg": "wide"}', "yfov_deg is 'wide'"),
        ('{"yfov_deg": 40, "pose_camera_to_world": [[1]]}', "4x4"),
    ],
)
def test_bad_files_are_refused(tmp_path: Path, text: str, says: str) -> None:
    path = tmp_path / "camera.json"
    path.write_text(text)
    with pytest.raises(InputError, match=says):
        Camera.load(path, 64, 48)


def test_missing_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="Cannot read camera file"):
        Camera.load(tmp_path / "none.json", 64, 48)
    binary = tmp_path / "binary.json"
    binary.write_bytes(b"\xff\xfe\x00garbage\x80")
    with pytest.raises(InputError, match="not JSON"):
        Camera.load(binary, 64, 48)


def test_file_without_size_says_so(tmp_path: Path) -> None:
    path = tmp_path / "camera.json"
    path.write_text('{"yfov_deg": 40}')
    with pytest.raises(InputError, match="width is 0"):
        Camera.load(path)
