"""Image files: the sRGB curve, alpha, metadata, and that a file is whole or not there."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from cldof import InputError, OutputError
from cldof.images import (
    check_writable,
    linear_from_srgb,
    read_linear,
    read_metadata,
    save_image,
    srgb8_from_linear,
    srgb_from_linear,
)

METADATA = {"lens": {"aperture_radius_m": 0.02, "focus_distance_m": None}, "scene": "Nürburg 北"}


def gradient(alpha: float = 1.0) -> np.ndarray:
    image = np.empty((6, 9, 4), np.float32)
    image[..., :3] = np.linspace(0, 1.5, 6 * 9 * 3, dtype=np.float32).reshape(6, 9, 3) * alpha
    image[..., 3] = alpha
    return image


def test_srgb_curve() -> None:
    # IEC 61966-2-1: the linear piece, both sides of the joint, 18 % grey, and what is clipped.
    linear = np.array([-1.0, 0.0, 0.001, 0.0031308, 0.0031309, 0.18, 0.5, 1.0, 7.0])
    encoded = [0.0, 0.0, 0.01292, 0.0404499, 0.0404511, 0.4613561, 0.7353570, 1.0, 1.0]
    assert srgb_from_linear(linear) == pytest.approx(encoded, abs=2e-6)


def test_srgb_round_trip() -> None:
    every_byte = np.arange(256) / 255.0
    assert np.array_equal(np.rint(srgb_from_linear(linear_from_srgb(every_byte)) * 255), np.arange(256))


def test_opaque_is_rgb() -> None:
    pixels = srgb8_from_linear(gradient())
    assert pixels.shape == (6, 9, 3)
    assert np.array_equal(pixels, np.rint(srgb_from_linear(gradient()[..., :3]) * 255))


def test_transparent_is_straight() -> None:
    image = np.zeros((1, 3, 4), np.float32)
    image[0, 0] = (0.09, 0.0, 0.25, 0.5)  # straight: 0.18, 0, 0.5
    image[0, 1] = (3.0, 1.0, 1e-6, 1e-3)  # alpha below half a step of 8 bits
    pixels = srgb8_from_linear(image)
    assert pixels[0, 0].tolist() == [118, 0, 188, 128]
    assert pixels[0, 1].tolist() == [0, 0, 0, 0]
    assert pixels[0, 2].tolist() == [0, 0, 0, 0]


def test_png(tmp_path: Path) -> None:
    path = tmp_path / "an image.PNG"
    save_image(path, gradient(), METADATA)
    with Image.open(path) as picture:
        assert picture.mode == "RGB" and picture.size == (9, 6)
        assert np.array_equal(np.asarray(picture), srgb8_from_linear(gradient()))
        assert json.loads(picture.text["cldof"]) == METADATA  # type: ignore[attr-defined]
    assert read_metadata(path) == METADATA
    save_image(path, gradient(0.5), METADATA)
    with Image.open(path) as picture:
        assert picture.mode == "RGBA"


@pytest.mark.parametrize("half", [False, True])
def test_exr(tmp_path: Path, half: bool) -> None:
    import OpenEXR

    path = tmp_path / "image.exr"
    image = gradient(0.5) * np.float32(1000.0)
    image[..., 3] = 0.5
    save_image(path, image, METADATA, half=half)
    with OpenEXR.File(str(path)) as exr:
        assert exr.header()["type"] == OpenEXR.scanlineimage
        assert exr.header()["compression"] == OpenEXR.ZIP_COMPRESSION
        pixels = exr.channels()["RGBA"].pixels
    assert pixels.dtype == (np.float16 if half else np.float32)
    assert np.array_equal(pixels, image.astype(pixels.dtype))
    assert read_metadata(path) == METADATA


def test_npy(tmp_path: Path) -> None:
    path = tmp_path / "image.npy"
    save_image(path, gradient().astype(np.float64), METADATA)
    loaded = np.load(path)
    assert loaded.dtype == np.float32 and np.array_equal(loaded, gradient())
    assert json.loads((tmp_path / "image.npy.json").read_text(encoding="utf-8")) == METADATA
    assert read_metadata(path) == METADATA


@pytest.mark.parametrize("size", [(1, 1), (1, 37), (37, 1), (13, 7)])
@pytest.mark.parametrize("ending", ["png", "exr", "npy"])
def test_awkward_sizes(tmp_path: Path, ending: str, size: tuple[int, int]) -> None:
    save_image(tmp_path / f"image.{ending}", np.full((*size, 4), 0.5, np.float32))
    assert read_metadata(tmp_path / f"image.{ending}") == {}


@pytest.mark.parametrize(
    "image",
    [np.zeros((4, 4, 3)), np.zeros((4, 4)), np.zeros((0, 4, 4)), np.zeros((4, 4, 4), np.uint8), [[1.0]]],
)
def test_other_arrays_are_refused(tmp_path: Path, image: Any) -> None:
    with pytest.raises(InputError, match=r"\(H, W, 4\)"):
        save_image(tmp_path / "image.png", image)
    assert not list(tmp_path.iterdir())


def test_metadata_outside_json_is_refused(tmp_path: Path) -> None:
    for value in (float("nan"), object()):
        with pytest.raises(InputError, match="JSON"):
            save_image(tmp_path / "image.png", gradient(), {"value": value})
    assert not list(tmp_path.iterdir())


def test_half_floats_have_a_limit(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="65504"):
        save_image(tmp_path / "image.exr", gradient() * np.float32(1e5), half=True)


@pytest.mark.parametrize("name", ["image.jpg", "image", "image.png.bak", ".png"])
def test_unknown_endings_list_the_known(tmp_path: Path, name: str) -> None:
    with pytest.raises(OutputError, match=r"\.png, \.exr, \.npy"):
        save_image(tmp_path / name, gradient())


def test_check_writable(tmp_path: Path) -> None:
    assert check_writable(tmp_path / "image.png") == tmp_path / "image.png"
    with pytest.raises(OutputError, match="does not exist"):
        check_writable(tmp_path / "missing" / "image.png")
    (tmp_path / "folder.png").mkdir()
    with pytest.raises(OutputError, match="it is a folder"):
        check_writable(tmp_path / "folder.png")
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(OutputError, match="does not exist"):
        check_writable(tmp_path / "file" / "image.png")
    assert check_writable(tmp_path / "report", ()) == tmp_path / "report"
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["file", "folder.png"]


@pytest.mark.skipif(hasattr(os, "geteuid") and os.geteuid() == 0, reason="root may write anywhere")
def test_closed_folders_are_found(tmp_path: Path) -> None:
    closed = tmp_path / "closed"
    closed.mkdir(mode=0o500)
    with pytest.raises(OutputError, match="Permission denied"):
        check_writable(closed / "image.png")


@pytest.mark.parametrize("ending", ["png", "exr", "npy"])
def test_a_failed_write_leaves_the_old_file(tmp_path: Path, ending: str, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / f"image.{ending}"
    save_image(path, gradient(), METADATA)
    before = {entry.name: entry.read_bytes() for entry in tmp_path.iterdir()}

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.replace", full)
    with pytest.raises(OutputError, match="No space left"):
        save_image(path, gradient(0.5), {})
    assert {entry.name: entry.read_bytes() for entry in tmp_path.iterdir()} == before


def test_metadata_of_other_files(tmp_path: Path) -> None:
    Image.new("RGB", (2, 2)).save(tmp_path / "plain.png")
    assert read_metadata(tmp_path / "plain.png") == {}
    (tmp_path / "broken.png").write_bytes(b"not a picture")
    (tmp_path / "broken.exr").write_bytes(b"not a picture")
    for name in ("broken.png", "broken.exr", "none.png", "none.exr", "none.npy"):
        with pytest.raises(InputError, match="Cannot read the metadata"):
            read_metadata(tmp_path / name)
    with pytest.raises(InputError, match="not an image of ours"):
        read_metadata(tmp_path / "image.jpg")


def test_linear_pictures_are_read_as_they_were_written(tmp_path: Path) -> None:
    image = np.random.default_rng(0).random((5, 8, 4), np.float32) * 4.0
    image[..., 3] = 1.0
    for name in ("a.exr", "a.npy"):
        save_image(tmp_path / name, image)
        np.testing.assert_array_equal(read_linear(tmp_path / name), image[..., :3])
    save_image(tmp_path / "a.png", image * (0.25, 0.25, 0.25, 1.0))
    np.testing.assert_allclose(read_linear(tmp_path / "a.png"), image[..., :3] / 4.0, atol=6e-3)


def test_what_is_no_picture_is_refused(tmp_path: Path) -> None:
    np.save(tmp_path / "flat.npy", np.zeros((4, 8)))
    np.save(tmp_path / "bytes.npy", np.zeros((4, 8, 3), np.uint8))
    (tmp_path / "text.exr").write_bytes(b"not a picture")
    (tmp_path / "text.npy").write_bytes(b"not an array")
    (tmp_path / "text.png").write_bytes(b"not a picture")
    for name, says in (
        ("flat.npy", "float64 of shape"),
        ("bytes.npy", "uint8 of shape"),
        ("text.exr", "Cannot read"),
        ("text.npy", "Cannot read"),
        ("text.png", "Cannot read"),
        ("none.exr", "Cannot read"),
        ("none.npy", "No such file"),
    ):
        with pytest.raises(InputError, match=says):
            read_linear(tmp_path / name)
