"""The thin lens against textbook optics in millimetres on a sensor, and at its limits."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cldof import Camera, InputError, Lens
from cldof.lens import GAUSSIAN_SIGMA, lens_samples

CAMERA = Camera(1024, 768, yfov_deg=40.0)

radii = st.floats(1e-5, 0.5)
focuses = st.floats(0.05, 1e4)
depths = st.floats(0.01, 1e5)


def potmesil_coc_radius_px(focal_mm: float, f_number: float, focus_mm: float, depth_mm: float, camera: Camera) -> float:
    """Potmesil & Chakravarty 1981, eqs. 1-5: image distances, then the disc on the film, then film to pixels."""
    image_of_focus = focal_mm * focus_mm / (focus_mm - focal_mm)  # where the film is
    image_of_point = focal_mm * depth_mm / (depth_mm - focal_mm)
    diameter_mm = abs(image_of_point - image_of_focus) * focal_mm / (f_number * image_of_point)
    # The pinhole camera of the same view has its film at the image distance, as high as its field of view asks for.
    film_height_mm = 2.0 * image_of_focus * math.tan(math.radians(camera.yfov_deg) / 2.0)
    return diameter_mm / 2.0 / film_height_mm * camera.height


@pytest.mark.parametrize("focal_mm, f_number", [(24.0, 1.4), (50.0, 1.8), (85.0, 2.8), (200.0, 4.0)])
@pytest.mark.parametrize("focus_m", [0.5, 2.0, 30.0])
@pytest.mark.parametrize("depth_m", [0.3, 0.7, 1.999, 5.0, 1e4])
def test_coc_is_potmesils(focal_mm: float, f_number: float, focus_m: float, depth_m: float) -> None:
    lens = Lens.photographic(focal_mm, f_number, focus_m)
    expected = potmesil_coc_radius_px(focal_mm, f_number, focus_m * 1e3, depth_m * 1e3, CAMERA)
    found = float(lens.coc_radius_px(CAMERA, depth_m))
    assert abs(found) == pytest.approx(expected, rel=1e-9, abs=1e-12)
    assert np.sign(found) == np.sign(depth_m - focus_m)


def test_coc_of_a_known_lens() -> None:
    # 50 mm f/2 on a sensor 24 mm high, focused at 2 m, a point at infinity. With the film one image distance
    # v = 51.2821 mm away the disc is A f / (S - f) = 25 * 50 / 1950 = 0.641026 mm wide; this film shows 24 mm.
    v = 50.0 * 2000.0 / 1950.0
    camera = Camera(1500, 1000, yfov_deg=math.degrees(2 * math.atan(12.0 / v)))
    lens = Lens.photographic(50.0, 2.0, 2.0)
    assert float(lens.coc_radius_px(camera, math.inf)) == pytest.approx(0.641026 / 2 / 24 * 1000, rel=1e-6)


@given(radii, focuses)
def test_focus_is_exactly_sharp(radius: float, focus: float) -> None:
    assert Lens(radius, focus).coc_radius_px(CAMERA, focus) == 0.0


@given(radii, focuses, depths, depths)
def test_sign_and_order(radius: float, focus: float, first: float, second: float) -> None:
    lens = Lens(radius, focus)
    near, far = sorted((first, second))
    coc = lens.coc_radius_px(CAMERA, [near, far])
    assert coc[0] <= coc[1]
    assert (coc[0] < 0) == (near < focus) or math.isclose(near, focus)
    assert (coc[1] > 0) == (far > focus) or math.isclose(far, focus)


@given(radii, focuses, depths)
def test_coefficients_say_the_same(radius: float, focus: float, depth: float) -> None:
    lens = Lens(radius, focus)
    c1, c0 = lens.coc_coefficients(CAMERA)
    scale = CAMERA.focal_px * radius * (1 / depth + 1 / focus)
    assert c1 / depth + c0 == pytest.approx(float(lens.coc_radius_px(CAMERA, depth)), abs=1e-12 * scale)


@given(radii, focuses, depths)
def test_depth_of_coc_inverts(radius: float, focus: float, depth: float) -> None:
    lens = Lens(radius, focus)
    coc = float(lens.coc_radius_px(CAMERA, depth))
    assert 1.0 / lens.depth_of_coc_m(CAMERA, coc) == pytest.approx(1.0 / depth, abs=1e-12 * (1 / depth + 1 / focus))


def test_no_depth_is_blurred_more_than_infinity() -> None:
    lens = Lens(0.02, 3.0)
    most = float(lens.coc_radius_px(CAMERA, math.inf))
    assert lens.depth_of_coc_m(CAMERA, most * 1.001) == math.inf
    assert math.isfinite(lens.depth_of_coc_m(CAMERA, most * 0.999))


def test_infinity_is_legal_on_both_sides() -> None:
    far = Lens(0.01, math.inf)
    assert far.coc_radius_px(CAMERA, math.inf) == 0.0
    assert far.coc_radius_px(CAMERA, 2.0) == pytest.approx(-CAMERA.focal_px * 0.01 / 2.0)
    assert far.coc_coefficients(CAMERA).c0 == 0.0
    near = Lens(0.01, 2.0)
    assert near.coc_radius_px(CAMERA, math.inf) == pytest.approx(CAMERA.focal_px * 0.01 / 2.0)


def test_pinhole() -> None:
    lens = Lens(0.0, 2.0)
    assert (lens.coc_radius_px(CAMERA, [0.1, 2.0, math.inf]) == 0.0).all()
    assert lens.depth_of_field_m(CAMERA) == (0.0, math.inf)
    assert lens.hyperfocal_distance_m(CAMERA) == 0.0
    assert lens.depth_of_coc_m(CAMERA, 0.0) == 2.0


@given(radii, focuses, st.floats(0.01, 20.0))
def test_depth_of_field_limits_are_blurred_just_so(radius: float, focus: float, limit: float) -> None:
    lens = Lens(radius, focus)
    near, far = lens.depth_of_field_m(CAMERA, limit)
    assert near < focus < far
    assert float(lens.coc_radius_px(CAMERA, near)) == pytest.approx(-limit, rel=1e-6)
    if math.isfinite(far):
        assert float(lens.coc_radius_px(CAMERA, far)) == pytest.approx(limit, rel=1e-6)
    else:
        assert float(lens.coc_radius_px(CAMERA, math.inf)) <= limit * (1 + 1e-12)


@given(radii, st.floats(0.05, 5.0))
def test_hyperfocal(radius: float, limit: float) -> None:
    distance = Lens(radius, 1.0).hyperfocal_distance_m(CAMERA, limit)
    focused = Lens(radius, distance)
    assert float(focused.coc_radius_px(CAMERA, math.inf)) == pytest.approx(limit, rel=1e-12)
    # The classic rule: then everything from half of it on is sharp.
    assert focused.depth_of_field_m(CAMERA, limit)[0] == pytest.approx(distance / 2, rel=1e-9)


@given(st.floats(0.3, 3.0), radii, focuses, depths)
def test_blur_scales_with_resolution(factor: float, radius: float, focus: float, depth: float) -> None:
    height = max(1, round(768 * factor))
    small, large = Camera(64, 768, 40.0), Camera(64, height, 40.0)
    lens = Lens(radius, focus)
    ratio = height / 768
    assert float(lens.coc_radius_px(large, depth)) == pytest.approx(ratio * float(lens.coc_radius_px(small, depth)))


def test_photographic() -> None:
    lens = Lens.photographic(focal_length_mm=50, f_number=2, focus_distance_m=3)
    assert lens.aperture_radius_m == pytest.approx(0.0125)
    assert lens.f_number == pytest.approx(2.0)
    assert Lens.photographic(50, math.inf, 3).aperture_radius_m == 0.0
    assert Lens.photographic(50, math.inf, 3).f_number == math.inf
    assert Lens(0.01, 3.0).f_number is None


@pytest.mark.parametrize(
    "arguments, says",
    [
        ((-0.01, 2.0), "aperture_radius_m is -0.01"),
        ((math.nan, 2.0), "aperture_radius_m is NaN"),
        ((math.inf, 2.0), "aperture_radius_m is inf"),
        ((0.01, 0.0), "focus_distance_m is 0.0"),
        ((0.01, -1.0), "focus_distance_m is -1.0"),
        ((0.01, math.nan), "focus_distance_m is NaN"),
        (("wide", 2.0), "aperture_radius_m is 'wide'"),
        ((None, 2.0), "aperture_radius_m is None"),
        ((0.01, 2.0, 0.0), "focal_length_mm is 0.0"),
        ((0.01, 2.0, math.nan), "focal_length_mm is NaN"),
        ((0.01, 0.04, 50.0), "inside the focal length"),
        ((0.01, 0.05, 50.0), "inside the focal length"),
    ],
)
def test_bad_lenses_are_refused(arguments: tuple[object, ...], says: str) -> None:
    with pytest.raises(InputError, match=says):
        Lens(*arguments)  # type: ignore[arg-type]


@pytest.mark.parametrize("f_number", [0.0, -2.0, math.nan, "f/2"])
def test_bad_f_numbers_are_refused(f_number: object) -> None:
    with pytest.raises(InputError, match="f_number"):
        Lens.photographic(50.0, f_number, 2.0)  # type: ignore[arg-type]


@pytest.mark.parametrize("depth", [0.0, -1.0, math.nan])
def test_bad_depths_are_refused(depth: float) -> None:
    with pytest.raises(InputError, match="positive depths"):
        Lens(0.01, 2.0).coc_radius_px(CAMERA, [1.0, depth])


@pytest.mark.parametrize("limit", [0.0, -1.0, math.inf, math.nan])
def test_bad_limits_are_refused(limit: float) -> None:
    with pytest.raises(InputError, match="max_coc_radius_px"):
        Lens(0.01, 2.0).hyperfocal_distance_m(CAMERA, limit)


def test_metadata_is_json_without_infinity() -> None:
    assert Lens(0.01, math.inf).to_dict() == {
        "aperture_radius_m": 0.01,
        "focus_distance_m": None,
        "focal_length_mm": None,
    }


@pytest.mark.parametrize("count", [1, 2, 17, 256, 4096])
def test_disc_samples(count: int) -> None:
    points = lens_samples(count, "disc")
    assert points.shape == (count, 2)
    assert np.abs(points.mean(axis=0)).max() < 1e-12
    # The mean is taken out, so a few points may stick out of the disc by that much.
    assert np.hypot(*points.T).max() <= 1.0 + 1.0 / count
    if count >= 256:  # a uniform disc: E[r^2] = 1/2, equal and uncorrelated axes
        assert np.cov(points.T, bias=True) == pytest.approx(np.eye(2) / 4, abs=2.0 / count)


def test_gaussian_samples() -> None:
    points = lens_samples(4096, "gaussian")
    assert np.abs(points.mean(axis=0)).max() < 1e-12
    assert np.cov(points.T, bias=True) == pytest.approx(GAUSSIAN_SIGMA**2 * np.eye(2), abs=3e-3)
    fourth = (points**4).mean(axis=0)
    assert fourth == pytest.approx(3 * GAUSSIAN_SIGMA**4 * np.ones(2), rel=0.02)  # a Gaussian's kurtosis is 3


def test_samples_depend_on_the_seed_alone() -> None:
    assert np.array_equal(lens_samples(64, seed=3), lens_samples(64, seed=3))
    assert not np.allclose(lens_samples(64, seed=3), lens_samples(64, seed=4))


def test_bad_samples_are_refused() -> None:
    with pytest.raises(InputError, match="at least 1"):
        lens_samples(0)
    with pytest.raises(InputError, match="'square'"):
        lens_samples(8, "square")
