"""Measures of error against direct formulas in numpy, against scikit-image, and on shapes whose answer is known."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy.ndimage import correlate1d

from cldof import Camera, InputError, LayeredFrame, Lens
from cldof.metrics import (
    compare,
    highlight_energy,
    in_focus_error,
    in_focus_region,
    psf_profile,
    psf_radius,
    psnr,
    rms_error,
    silhouette_band,
    silhouette_band_error,
    ssim,
    worst_tile,
)


def noise(shape: tuple[int, ...] = (40, 50, 4), seed: int = 0, high: float = 1.0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(0.0, high, shape).astype(np.float32)


def frame_of(depth: Any, guard_px: int = 0, alpha: Any = 1.0) -> LayeredFrame:
    """One layer of grey at these depths, through a camera with a focal length of 100 px."""
    array = np.array(depth, np.float32)
    height, width = (n - 2 * guard_px for n in array.shape)
    camera = Camera(width, height, math.degrees(2.0 * math.atan(height / 200.0)))
    color = np.full((*array.shape, 4), 0.5, np.float32) * np.asarray(alpha, np.float32)[..., None]
    color[..., 3] = alpha
    return LayeredFrame(color, array, camera, guard_px=guard_px)


# With 100 px a focal length, CoC = 100 R (1/zf - 1/z).
LENS = Lens(0.1, 2.0)


def test_psnr_is_the_formula() -> None:
    image, reference = noise(high=1.6), noise(seed=1, high=1.3)
    difference = np.clip(image[..., :3], 0, 1).astype(float) - np.clip(reference[..., :3], 0, 1)
    assert psnr(image, reference) == pytest.approx(10.0 * math.log10(1.0 / (difference**2).mean()))
    assert rms_error(image, reference) == pytest.approx(math.sqrt((difference**2).mean()))
    raw = image[..., :3].astype(float) - reference[..., :3]
    assert psnr(image, reference, None) == pytest.approx(-10.0 * math.log10((raw**2).mean()))
    assert rms_error(image, reference, None) == pytest.approx(math.sqrt((raw**2).mean()))
    wide = np.clip(image[..., :3], -1, 3).astype(float) - np.clip(reference[..., :3], -1, 3)
    assert psnr(image, reference, (-1.0, 3.0)) == pytest.approx(10.0 * math.log10(16.0 / (wide**2).mean()))


def test_alpha_is_left_out_and_equal_images_are_exact() -> None:
    image = noise()
    other = image.copy()
    other[..., 3] = 0.0
    assert psnr(image, other) == psnr(image, other[..., :3]) == math.inf
    assert ssim(image, other) == 1.0 and rms_error(image, other) == 0.0
    assert psnr(image + 5.0, other + 2.0) == math.inf  # both clipped to 1


def test_sums_are_in_double_precision() -> None:
    image, reference = np.full((300, 300, 3), 0.5, np.float32), np.full((300, 300, 3), 0.5, np.float32)
    image += np.float32(1e-6)
    step = float(image[0, 0, 0]) - 0.5
    assert rms_error(image, reference) == pytest.approx(step, rel=1e-9)


def direct_ssim(x: np.ndarray, y: np.ndarray, peak: float) -> float:
    """Wang et al. 2004, eq. 13, with its 11 x 11 Gaussian window, over the pixels where the window fits."""
    tap = np.exp(-(np.arange(-5, 6) ** 2) / (2.0 * 1.5**2))
    tap /= tap.sum()

    def window(image: np.ndarray) -> np.ndarray:
        return np.asarray(correlate1d(correlate1d(image, tap, 0), tap, 1)[5:-5, 5:-5])

    c1, c2 = (0.01 * peak) ** 2, (0.03 * peak) ** 2
    mx, my = window(x), window(y)
    vx, vy, vxy = window(x * x) - mx * mx, window(y * y) - my * my, window(x * y) - mx * my
    return float(((2 * mx * my + c1) * (2 * vxy + c2) / ((mx**2 + my**2 + c1) * (vx + vy + c2))).mean())


def test_ssim_is_wangs() -> None:
    reference = noise((24, 31, 4), high=1.2)
    image = reference + 0.2 * noise((24, 31, 4), 1)
    clipped = [np.clip(each[..., :3].astype(float), 0, 1) for each in (image, reference)]
    expected = np.mean([direct_ssim(*(each[..., channel] for each in clipped), 1.0) for channel in range(3)])
    assert ssim(image, reference) == pytest.approx(expected, abs=1e-12)
    half = [np.clip(each[..., :3].astype(float), 0, 0.5) for each in (image, reference)]
    expected = np.mean([direct_ssim(*(each[..., channel] for each in half), 0.5) for channel in range(3)])
    assert ssim(image, reference, (0.0, 0.5)) == pytest.approx(expected, abs=1e-12)
    with pytest.raises(InputError, match=r"at least 11 x 11 px; got shape \(10, 50, 3\)"):
        ssim(noise((10, 50, 3)), noise((10, 50, 3)))


def test_worst_tile() -> None:
    reference = noise((40, 50, 4))
    image = reference.copy()
    image[35:38, 49, 1] = 1.0 - image[35:38, 49, 1]
    squared = ((image - reference)[..., :3].astype(float) ** 2)[32:, 48:]
    found = worst_tile(image, reference)
    assert (found.x, found.y) == (48, 32)
    assert found.rms == pytest.approx(math.sqrt(squared.mean()))  # over the 8 x 2 pixels that there are
    image[3, 20] = reference[3, 20] + 0.9
    assert worst_tile(image, reference, clip=None)[1:] == (48, 32)  # a whole tile thins it out
    assert worst_tile(image, reference, size=1, clip=None) == (pytest.approx(0.9, rel=1e-6), 20, 3)
    whole = worst_tile(image, reference, size=64)
    assert whole == (pytest.approx(rms_error(image, reference)), 0, 0)
    assert worst_tile(reference, reference) == (0.0, 0, 0)
    brute = {
        (x, y): rms_error(image[y : y + 7, x : x + 7], reference[y : y + 7, x : x + 7])
        for y in range(0, 40, 7)
        for x in range(0, 50, 7)
    }
    best = max(brute, key=lambda at: brute[at])
    assert worst_tile(image, reference, size=7) == (pytest.approx(brute[best]), *best)


def test_highlight_energy() -> None:
    reference = np.full((4, 4, 3), 0.5, np.float32)
    assert highlight_energy(reference, reference) == 1.0
    bright = reference.copy()
    bright[1, 1] = (5.0, 1.0, 2.0)  # 4 + 0 + 1 above 1
    assert highlight_energy(reference, bright) == 0.0
    assert highlight_energy(bright, reference) == math.inf
    dimmer = reference.copy()
    dimmer[2, 2] = (3.0, 1.5, 0.0)
    assert highlight_energy(dimmer, bright) == pytest.approx(2.5 / 5.0)


def test_band_of_a_straight_edge() -> None:
    depth = np.full((40, 60), 2.0)
    depth[:, 30:] = 1.0  # CoC -5 px, before the plane in focus
    frame = frame_of(depth)
    assert float(LENS.coc_radius_px(frame.camera, 1.0)) == pytest.approx(-5.0)
    band = silhouette_band(frame, LENS, width_px=2.0)
    expected = np.zeros((40, 60), bool)
    expected[:, 29 - 7 : 30 + 7 + 1] = True  # both pixels at the edge, 5 + 2 px around each
    np.testing.assert_array_equal(band, expected)
    assert not silhouette_band(frame, Lens(0.0, 2.0)).any()  # no blur, no band
    assert not silhouette_band(frame, Lens(0.009, 2.0)).any()  # a step of 0.45 px
    assert silhouette_band(frame, Lens(0.009, 2.0), step_px=0.4).any()
    image, reference = noise((40, 60, 3)), noise((40, 60, 3), 1)
    squared = (image - reference).astype(float) ** 2
    assert silhouette_band_error(image, reference, frame, LENS) == pytest.approx(math.sqrt(squared[band].mean()))
    assert math.isnan(silhouette_band_error(image, reference, frame, Lens(0.0, 2.0)))


def test_band_of_a_pixel_is_a_disc() -> None:
    depth = np.full((61, 61), 2.0)
    depth[30, 30] = 0.5  # CoC -15 px
    rows, columns = np.indices(depth.shape) - 30
    distance = np.hypot(rows, columns)
    band = silhouette_band(frame_of(depth), LENS, width_px=1.0)
    assert band[distance <= 16.0].all()
    # One more for the neighbour across the edge, and an eighth for speed.
    assert not band[distance > 17.0 * 1.125 + 1.0].any()


def test_slants_and_creases_are_no_silhouettes() -> None:
    rows, columns = np.indices((64, 80)).astype(float)
    floor = 1.0 / (0.02 + 0.012 * rows)  # a floor that ends near the horizon: planes are linear in 1 / z
    lens = Lens(1.0, 3.0)
    assert np.abs(np.diff(lens.coc_radius_px(frame_of(floor).camera, floor), axis=0)).min() > 1.0
    assert not silhouette_band(frame_of(floor), lens).any()
    roof = 1.0 / (0.2 + 0.012 * np.minimum(rows, 63 - rows) + 0.004 * columns)
    assert not silhouette_band(frame_of(roof), lens).any()
    cut = floor.copy()
    cut[:, 40:] = 1.0 / (0.52 + 0.012 * rows[:, 40:])
    band = silhouette_band(frame_of(cut), Lens(0.1, 3.0), width_px=0.0)
    assert band[:, 39:41].all() and not band[:, :2].any()


def test_thin_things_and_the_sky_have_silhouettes() -> None:
    depth = np.full((30, 30), np.inf)
    depth[:, 10] = 2.0
    assert silhouette_band(frame_of(depth, alpha=(depth < 9.0) * 1.0), LENS)[:, 9:12].all()
    fence = np.full((30, 30), 2.0)
    fence[:, ::2] = 1.0  # every second pixel
    assert silhouette_band(frame_of(fence), LENS).all()


def test_silhouettes_in_the_guard_band_reach_in() -> None:
    depth = np.full((40, 60), 2.0)
    depth[:, :8] = 1.0
    band = silhouette_band(frame_of(depth, guard_px=10), LENS, width_px=1.0)
    assert band.shape == (20, 40)
    assert band[:, :5].all() and not band[:, 5:].any()  # columns up to 8 + 6 - 10


def test_in_focus_region_leaves_out_what_the_near_side_reaches() -> None:
    depth = np.full((40, 80), 2.0)
    depth[:, 60:] = 1.0  # near, CoC -5
    depth[:20, :20] = 4.0  # far, CoC 2.5
    depth[20:, :20] = 2.08  # CoC 0.19
    frame = frame_of(depth)
    expected = np.ones((40, 80), bool)
    expected[:, 60 - 6 :] = False  # its reach, and one pixel
    expected[:20, :20] = False  # out of focus itself, yet it cannot reach over what is nearer
    np.testing.assert_array_equal(in_focus_region(frame, LENS), expected)
    gaussian = in_focus_region(frame, Lens(0.1, 2.0, aperture="gaussian"))  # type: ignore[arg-type]
    assert gaussian[:, 30:47].all() and not gaussian[:, 60 - 11 :].any()
    assert in_focus_region(frame, Lens(0.0, 2.0)).all()

    image, reference = noise((40, 80, 4)), noise((40, 80, 4), 1)
    squared = (image - reference)[..., :3][expected].astype(float) ** 2
    found = in_focus_error(image, reference, frame, LENS)
    assert found == (pytest.approx(math.sqrt(squared.mean())), pytest.approx(math.sqrt(squared.max())), expected.sum())
    nothing = in_focus_error(image, reference, frame, Lens(0.1, 9.0))
    assert nothing.pixels == 0 and math.isnan(nothing.rms) and math.isnan(nothing.max)


def test_glass_in_focus_does_not_count_and_void_does_not_reach() -> None:
    depth, alpha = np.full((20, 40), 2.0), np.ones((20, 40))
    alpha[:, :10] = 0.4
    depth[:, 30:], alpha[:, 30:] = np.inf, 0.0
    region = in_focus_region(frame_of(depth, alpha=alpha), LENS)
    assert region[:, 10:30].all() and region.sum() == 20 * 20


def disc_image(radius: float, x: float = 40.0, y: float = 40.0, size: int = 81, level: float = 2.0) -> np.ndarray:
    """A disc of light with box-filtered pixels, (size, size, 3)."""
    at = (np.arange(size * 16) + 0.5) / 16.0 - 0.5
    inside = np.hypot(at[None, :] - x, at[:, None] - y) <= radius
    grey = level * inside.reshape(size, 16, size, 16).mean(axis=(1, 3))
    return np.repeat(grey[..., None], 3, axis=2)


@pytest.mark.parametrize(("radius", "x", "y"), [(6.0, 40.0, 40.0), (12.3, 38.4, 41.7), (25.0, 40.5, 39.5)])
def test_psf_of_a_disc(radius: float, x: float, y: float) -> None:
    found = psf_radius(disc_image(radius, x, y))
    assert found.second_moment_radius_px == pytest.approx(radius, rel=2e-3)
    assert found.edge_radius_px == pytest.approx(radius, abs=0.15)
    assert (found.x, found.y) == (pytest.approx(x, abs=1e-2), pytest.approx(y, abs=1e-2))
    assert found.energy == pytest.approx(2.0 * math.pi * radius**2, rel=2e-3)


def test_psf_of_a_gaussian() -> None:
    rows, columns = np.indices((121, 121)) - 60.0
    light = np.exp(-(rows**2 + columns**2) / (2.0 * 7.0**2))
    found = psf_radius(light, pixel_variance_px2=0.0)
    assert found.second_moment_radius_px == pytest.approx(14.0, rel=1e-3)  # sigma is half the aperture's radius
    radius, profile = psf_profile(light)
    np.testing.assert_allclose(profile, np.exp(-(radius**2) / 98.0), atol=3e-3)
    assert (np.diff(radius) > 0.0).all() and radius[-1] <= 60.0


def test_psf_profile_is_the_mean_over_rings() -> None:
    image = disc_image(9.0, 35.0, 44.0)
    radius, profile = psf_profile(image, center=(35.0, 44.0), bin_px=2.0)
    rows, columns = np.indices(image.shape[:2])
    distance = np.hypot(columns - 35.0, rows - 44.0)
    for number in range(4):
        ring = (distance >= 2.0 * number) & (distance < 2.0 * number + 2.0)
        assert radius[number] == pytest.approx(distance[ring].mean())
        assert profile[number] == pytest.approx(image[..., 0][ring].mean())
    assert radius[-1] <= 35.0  # the nearest border


def test_a_point_in_focus_has_no_radius() -> None:
    light = np.zeros((9, 9))
    light[4, 4] = 3.0
    found = psf_radius(light)
    assert found.second_moment_radius_px == 0.0 and found.energy == 3.0
    assert found.edge_radius_px < 1.5
    assert math.isnan(psf_radius(np.ones((9, 9))).edge_radius_px)


def test_compare_has_everything() -> None:
    depth = np.full((40, 60), 2.0)
    depth[:, 30:] = 1.0
    frame = frame_of(depth)
    image, reference = noise((40, 60, 4), high=1.5), noise((40, 60, 4), 1, 1.5)
    found = compare(image, reference, frame, LENS)
    focus, tile = in_focus_error(image, reference, frame, LENS), worst_tile(image, reference)
    assert found == {
        "psnr_db": psnr(image, reference),
        "ssim": ssim(image, reference),
        "rms": rms_error(image, reference),
        "max": float(np.abs(np.clip(image, 0, 1).astype(float) - np.clip(reference, 0, 1))[..., :3].max()),
        "highlight_energy": highlight_energy(image, reference),
        "worst_tile_rms": tile.rms,
        "worst_tile_x": tile.x,
        "worst_tile_y": tile.y,
        "silhouette_band_rms": silhouette_band_error(image, reference, frame, LENS),
        "silhouette_band_pixels": 40 * 16,
        "in_focus_rms": focus.rms,
        "in_focus_max": focus.max,
        "in_focus_pixels": focus.pixels,
    }
    assert all(type(value) is float for value in found.values())
    assert json.loads(json.dumps(found, allow_nan=False)) == found
    assert found["psnr_db"] == pytest.approx(-20.0 * math.log10(found["rms"]))


def test_compare_leaves_out_what_there_is_not() -> None:
    image = noise((5, 6, 4))
    small = compare(image, image * np.float32(0.5))
    assert "ssim" not in small and not any("focus" in name or "band" in name for name in small)
    frame = frame_of(np.full((5, 6), 4.0))
    blurred = compare(image, image * np.float32(0.5), frame, LENS)
    assert blurred["in_focus_pixels"] == blurred["silhouette_band_pixels"] == 0.0
    assert "in_focus_rms" not in blurred and "silhouette_band_rms" not in blurred
    equal = compare(image, image)
    assert equal["psnr_db"] == math.inf and equal["max"] == 0.0


@pytest.mark.parametrize(
    ("call", "says"),
    [
        (lambda: psnr(noise((4, 5, 3)), noise((5, 4, 3))), r"\(4, 5, 3\) and \(5, 4, 3\)"),
        (lambda: psnr(noise((4, 5)), noise((4, 5))), r"image has shape \(4, 5\)"),
        (lambda: psnr(noise((4, 5, 3)), noise((4, 5, 2))), r"reference has shape \(4, 5, 2\)"),
        (lambda: psnr(noise((0, 5, 3)), noise((0, 5, 3))), r"image has shape \(0, 5, 3\)"),
        (lambda: psnr(np.zeros((4, 5, 3), np.uint8), noise((4, 5, 3))), "dtype uint8"),
        (lambda: psnr(noise((4, 5, 3)) * math.nan, noise((4, 5, 3))), "60 NaN"),
        (lambda: psnr(noise(), noise(), (1.0, 1.0)), "clip is"),
        (lambda: psnr(noise(), noise(), (0.0, math.inf)), "clip is"),
        (lambda: worst_tile(noise(), noise(), size=0), "size is 0"),
        (lambda: highlight_energy(noise((4, 5, 3)), noise((4, 6, 3))), r"\(4, 6, 3\)"),
        (lambda: compare(noise(), noise(), lens=LENS), "together"),
        (lambda: compare(noise(), noise(), frame_of(np.ones((4, 5))), LENS), "50x40 px, the frame is 5x4 px"),
        (lambda: in_focus_error(noise(), noise(), frame_of(np.ones((4, 5))), LENS), "the frame is 5x4 px"),
        (lambda: silhouette_band(frame_of(np.ones((4, 5))), LENS, -1.0), "width_px and step_px are -1.0"),
        (lambda: silhouette_band(noise(), LENS), "got ndarray, Lens"),  # type: ignore[arg-type]
        (lambda: silhouette_band_error(noise(), noise(), noise(), LENS), "frame is ndarray"),  # type: ignore[arg-type]
        (lambda: psf_radius(np.zeros((4, 5))), "dark"),
        (lambda: psf_radius(np.zeros((4, 5, 2))), r"shape \(4, 5, 2\)"),
        (lambda: psf_profile(np.ones((4, 5)), bin_px=0.0), "bin_px is 0.0"),
    ],
)
def test_bad_arguments_are_refused(call: Callable[[], object], says: str) -> None:
    with pytest.raises(InputError, match=says):
        call()
