"""The layered frame: everything that may be wrong with arrays is said once, here, with count and first pixel."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cldof import Camera, FrameError, LayeredFrame, OutputError
from tests.frames import noise_frame

CAMERA = Camera(5, 4, yfov_deg=40.0)


def arrays(layers: int = 2, height: int = 4, width: int = 5) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    color = rng.random((layers, height, width, 4), np.float32)
    color[..., :3] *= color[..., 3:]
    depth = np.sort(rng.uniform(1, 9, (layers, height, width)).astype(np.float32), axis=0)
    return color, depth


def test_shapes_and_names() -> None:
    color, depth = arrays(3)
    frame = LayeredFrame(color, depth, CAMERA)
    assert (frame.layer_count, frame.height, frame.width) == (3, 4, 5)
    assert "3 layers" in repr(frame) and "5x4" in repr(frame)


def test_good_arrays_are_kept_and_locked() -> None:
    color, depth = arrays()
    frame = LayeredFrame(color, depth, CAMERA)
    assert np.shares_memory(frame.color, color) and np.shares_memory(frame.depth, depth)
    with pytest.raises(ValueError, match="read-only"):
        frame.depth[0, 0, 0] = 1.0
    depth[0, 0, 0] = 0.5  # the caller's own array stays the caller's


def test_one_layer_may_come_without_its_axis() -> None:
    color, depth = arrays(1)
    frame = LayeredFrame(color[0], depth[0], CAMERA)
    assert frame.color.shape == (1, 4, 5, 4) and frame.depth.shape == (1, 4, 5)


def test_rgb_is_opaque_and_float64_is_taken() -> None:
    color, depth = arrays(1)
    frame = LayeredFrame(color[0, ..., :3].astype(np.float64), depth[0].astype(np.float64), CAMERA)
    assert (frame.color[..., 3] == 1.0).all()
    assert frame.color.dtype == frame.depth.dtype == np.float32
    assert frame.is_opaque


def test_lists_are_taken() -> None:
    frame = LayeredFrame([[[0.5, 0.5, 0.5, 1.0]]], [[2.0]], Camera(1, 1))
    assert frame.color.shape == (1, 1, 1, 4)


def test_guard_band() -> None:
    color, depth = arrays(2, 4 + 6, 5 + 6)
    depth[0, 3, 3] = 0.75
    frame = LayeredFrame(color, depth, CAMERA, guard_px=3)
    assert frame.pinhole_image().shape == (4, 5, 4)
    assert frame.depth_at(0, 0) == 0.75
    assert np.array_equal(frame.depth_at(4.9, 3.9), depth[0, 6, 7])


@pytest.mark.parametrize("pixel", [(-0.1, 0), (5, 0), (0, 4), (math.nan, 0), (0, -1)])
def test_depth_outside_the_image_is_refused(pixel: tuple[float, float]) -> None:
    frame = LayeredFrame(*arrays(), CAMERA)
    with pytest.raises(FrameError, match="outside the image"):
        frame.depth_at(*pixel)


def test_pinhole_is_front_over_back() -> None:
    color = np.zeros((2, 1, 1, 4), np.float32)
    color[0] = (0.25, 0.0, 0.0, 0.25)
    color[1] = (0.0, 2.0, 0.0, 1.0)
    frame = LayeredFrame(color, np.array([[[1.0]], [[2.0]]], np.float32), Camera(1, 1))
    assert frame.pinhole_image()[0, 0] == pytest.approx([0.25, 1.5, 0.0, 1.0])


def test_inverse_depth_range() -> None:
    color, depth = arrays(2)
    whole = LayeredFrame(color, depth, CAMERA)
    assert whole.inverse_depth_range == pytest.approx((1 / depth.max(), 1 / depth.min()))
    depth[1] = np.inf
    color[1] = 0.0
    assert LayeredFrame(color, depth, CAMERA).inverse_depth_range[0] == pytest.approx(1 / depth[0].max())
    color[1, 2, 2] = 1.0  # one pixel of sky
    assert LayeredFrame(color, depth, CAMERA).inverse_depth_range[0] == 0.0
    empty = LayeredFrame(np.zeros((4, 5, 4)), np.full((4, 5), np.inf), CAMERA)
    assert empty.inverse_depth_range == (0.0, 0.0)


def test_opacity() -> None:
    color, depth = arrays(2)
    color[..., 3] = 0.5
    assert not LayeredFrame(color, depth, CAMERA).is_opaque
    color[1, ..., 3] = 1.0
    assert LayeredFrame(color, depth, CAMERA).is_opaque
    color[1, 3, 4, 3] = 0.9
    assert not LayeredFrame(color, depth, CAMERA).is_opaque


def spoil(what: str, index: tuple[int, ...], value: float) -> tuple[np.ndarray, np.ndarray]:
    color, depth = arrays()
    {"color": color, "depth": depth}[what][index] = value
    return color, depth


@pytest.mark.parametrize(
    "what, index, value, says",
    [
        ("depth", (1, 2, 3), math.nan, "depth has 1 NaN values.*layer 1 at pixel x=3, y=2"),
        ("depth", (0, 1, 4), 0.0, "depth has 1 zero or negative.*layer 0 at pixel x=4, y=1"),
        ("depth", (0, 3, 0), -2.0, "depth has 1 zero or negative.*x=0, y=3"),
        ("depth", (0, 0, 0), -math.inf, "depth has 1 zero or negative.*x=0, y=0"),
        ("color", (1, 2, 3, 0), math.nan, "color has 1 NaN or infinite.*layer 1 at pixel x=3, y=2"),
        ("color", (0, 0, 1, 2), math.inf, "color has 1 NaN or infinite.*layer 0 at pixel x=1, y=0"),
        ("color", (0, 0, 1, 2), -0.5, "color has 1 negative.*x=1, y=0"),
        ("color", (0, 3, 1, 3), math.nan, "color has 1 NaN.*x=1, y=3"),
        ("color", (0, 3, 1, 3), 1.5, "alpha above 1.*x=1, y=3"),
    ],
)
def test_bad_values_are_refused(what: str, index: tuple[int, ...], value: float, says: str) -> None:
    with pytest.raises(FrameError, match=says):
        LayeredFrame(*spoil(what, index, value), CAMERA)


def test_all_bad_values_are_counted() -> None:
    color, depth = arrays()
    depth[:, 1:3] = math.nan
    with pytest.raises(FrameError, match=r"depth has 20 NaN values.*layer 0 at pixel x=0, y=1"):
        LayeredFrame(color, depth, CAMERA)


def test_layers_out_of_order_are_refused() -> None:
    color, depth = arrays()
    depth[1, 2, 1] = depth[0, 2, 1] * 0.5
    with pytest.raises(FrameError, match=r"out of order.*layer 1 at pixel x=1, y=2"):
        LayeredFrame(color, depth, CAMERA)
    depth[1] = depth[0]  # repeated depths are fine
    LayeredFrame(color, depth, CAMERA)


@pytest.mark.parametrize(
    "color_shape, depth_shape, says",
    [
        ((4, 5, 4), (5, 4), r"depth has shape \(5, 4\).*\(M, 4, 5\)"),
        ((5, 4, 4), (4, 5), r"color has shape \(5, 4, 4\).*\(M, 4, 5, 4\)"),
        ((4, 5, 2), (4, 5), "color has shape"),
        ((4, 5), (4, 5), "color has shape"),
        ((2, 4, 5, 4), (3, 4, 5), "color has 2 layers but depth has 3"),
        ((0, 4, 5, 4), (0, 4, 5), "depth has shape"),
        ((4, 5, 4), (), "depth has shape"),
    ],
)
def test_wrong_shapes_are_refused(color_shape: tuple[int, ...], depth_shape: tuple[int, ...], says: str) -> None:
    with pytest.raises(FrameError, match=says):
        LayeredFrame(np.zeros(color_shape, np.float32), np.ones(depth_shape, np.float32), CAMERA)


def test_integers_are_refused_with_advice() -> None:
    with pytest.raises(FrameError, match=r"color has dtype uint8.*sRGB"):
        LayeredFrame(np.zeros((4, 5, 4), np.uint8), np.ones((4, 5), np.float32), CAMERA)
    with pytest.raises(FrameError, match="depth has dtype"):
        LayeredFrame(np.zeros((4, 5, 4), np.float32), np.ones((4, 5), np.int32), CAMERA)


@pytest.mark.parametrize("guard", [-1, 1.5, 2.0, True, math.nan, "two", None])
def test_bad_guard_is_refused(guard: Any) -> None:
    with pytest.raises(FrameError, match="guard_px is"):
        LayeredFrame(*arrays(), CAMERA, guard_px=guard)


def test_something_else_for_a_camera_is_refused() -> None:
    with pytest.raises(FrameError, match="got dict"):
        LayeredFrame(*arrays(), {"yfov_deg": 40})  # type: ignore[arg-type]


def test_surface_buffers() -> None:
    color, depth = arrays()
    normal = np.zeros((2, 4, 5, 3), np.float32)
    frame = LayeredFrame(color, depth, CAMERA, normal=normal, shininess=np.ones((2, 4, 5), np.float32))
    assert set(frame.surface) == {"normal", "shininess"}
    with pytest.raises(FrameError, match="albedo has shape"):
        LayeredFrame(color, depth, CAMERA, albedo=np.ones((2, 4, 5), np.float32))
    with pytest.raises(FrameError, match="shininess has 1 layers but depth has 2"):
        LayeredFrame(color, depth, CAMERA, shininess=np.ones((4, 5), np.float32))
    normal[1, 2, 3, 1] = np.nan
    with pytest.raises(FrameError, match=r"normal has 1 NaN.*layer 1 at pixel x=3, y=2"):
        LayeredFrame(color, depth, CAMERA, normal=normal)


def test_save_and_load(tmp_path: Path) -> None:
    color, depth = arrays(3, 8, 9)
    depth[2], color[2] = np.inf, 0.0
    camera = Camera(5, 4, 33.0, near=0.1, far=80.0)
    saved = LayeredFrame(color, depth, camera, guard_px=2, albedo=np.ones((3, 8, 9, 3), np.float32))
    path = tmp_path / "a frame.npz"
    saved.save(path)
    loaded = LayeredFrame.load(path)
    assert np.array_equal(loaded.color, color) and np.array_equal(loaded.depth, depth)
    assert loaded.guard_px == 2 and loaded.camera.to_dict() == camera.to_dict()
    assert np.array_equal(loaded.surface["albedo"], saved.surface["albedo"])
    assert [entry.name for entry in tmp_path.iterdir()] == ["a frame.npz"]


def test_saving_elsewhere_is_refused(tmp_path: Path) -> None:
    frame = LayeredFrame(*arrays(), CAMERA)
    with pytest.raises(OutputError, match=r"saved as \.npz"):
        frame.save(tmp_path / "frame.npy")
    with pytest.raises(OutputError, match="Cannot write"):
        frame.save(tmp_path / "missing" / "frame.npz")
    (tmp_path / "folder.npz").mkdir()
    with pytest.raises(OutputError, match="folder"):
        frame.save(tmp_path / "folder.npz")


def test_a_failed_save_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "frame.npz"
    LayeredFrame(*arrays(), CAMERA).save(path)
    before = path.read_bytes()

    def full(stream: Any, **_: Any) -> None:
        stream.write(b"half a fra")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "savez", full)
    with pytest.raises(OutputError, match="No space left"):
        LayeredFrame(*arrays(1), CAMERA).save(path)
    assert path.read_bytes() == before
    assert [entry.name for entry in tmp_path.iterdir()] == ["frame.npz"]


def header(**change: Any) -> np.ndarray:
    data = {"version": 1, "camera": CAMERA.to_dict(), "guard_px": 0, **change}
    return np.frombuffer(json.dumps(data).encode(), np.uint8)


COLOR, DEPTH = arrays()


@pytest.mark.parametrize(
    "content, says",
    [
        ({"color": COLOR, "depth": DEPTH}, "not a frame saved by cldof"),
        ({"header": header(), "color": COLOR}, "not a frame saved by cldof"),
        ({"header": header(version=99), "color": COLOR, "depth": DEPTH}, "format version 99"),
        ({"header": header(camera={"yfov_deg": 40}), "color": COLOR, "depth": DEPTH}, "not a frame saved by cldof"),
        ({"header": header(camera=[]), "color": COLOR, "depth": DEPTH}, "not a frame saved by cldof"),
        ({"header": header(guard_px=1), "color": COLOR, "depth": DEPTH}, "depth has shape"),
        ({"header": header(guard_px=None), "color": COLOR, "depth": DEPTH}, "guard_px is None"),
        ({"header": np.frombuffer(b"[]", np.uint8), "color": COLOR, "depth": DEPTH}, "not a frame saved by cldof"),
        ({"header": header(), "color": COLOR, "depth": -DEPTH}, "zero or negative"),
        ({"header": header(), "color": np.array([{}], dtype=object), "depth": DEPTH}, "not a frame saved by cldof"),
    ],
)
def test_bad_npz_is_refused(tmp_path: Path, content: dict[str, Any], says: str) -> None:
    path = tmp_path / "frame.npz"
    np.savez(path, **content)
    with pytest.raises(FrameError, match=says):
        LayeredFrame.load(path)


@pytest.mark.parametrize("content", [b"", b"garbage", b"PK\x03\x04 cut off", b"\x93NUMPY\x01\x00v\x00"])
def test_other_files_are_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "frame.npz"
    path.write_bytes(content)
    with pytest.raises(FrameError, match="not a frame saved by cldof"):
        LayeredFrame.load(path)


def test_a_single_array_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "frame.npz"
    with path.open("wb") as stream:
        np.save(stream, DEPTH)
    with pytest.raises(FrameError, match="not a frame saved by cldof"):
        LayeredFrame.load(path)


def test_a_cut_off_file_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "frame.npz"
    LayeredFrame(*arrays(), CAMERA).save(path)
    path.write_bytes(path.read_bytes()[:900])
    with pytest.raises(FrameError, match="not a frame saved by cldof"):
        LayeredFrame.load(path)


def test_missing_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(FrameError, match="no such file"):
        LayeredFrame.load(tmp_path / "none.npz")
    with pytest.raises(FrameError, match="no such file"):
        LayeredFrame.load(tmp_path)


def test_a_finer_frame_is_of_the_same_view_and_captured_once() -> None:
    frame, finer = noise_frame(10, 8, guard_px=1), noise_frame(30, 24, guard_px=3)
    asked: list[int] = []

    def captured() -> LayeredFrame:
        asked.append(1)
        return finer

    known = frame.with_finer(captured)
    assert known.has_finer and not asked and not frame.has_finer
    assert known.finer is finer and known.finer is finer and len(asked) == 1
    assert known.color is frame.color and frame.with_finer(finer).finer is finer
    with pytest.raises(FrameError, match="no finer one"):
        _ = frame.finer
    with pytest.raises(FrameError, match="must be 30x24 with 3 px"):
        frame.with_finer(frame)
    with pytest.raises(FrameError, match="must be 30x24 with 3 px"):
        _ = frame.with_finer(lambda: frame).finer
    with pytest.raises(FrameError, match="got int"):
        _ = frame.with_finer(lambda: 3).finer  # type: ignore[arg-type,return-value]
