"""The thin lens against textbook optics in millimetres on a sensor, and at its limits."""

from __future__ import annotations

import json
import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cldof import Camera, InputError, Lens
from cldof.lens import (
    GAUSSIAN_SIGMA,
    Aperture,
    DiscAperture,
    GaussianAperture,
    ImageAperture,
    PolygonAperture,
    lens_samples,
)

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
        "aperture": {"shape": "disc", "ratio": 1.0},
    }


ROWS, COLUMNS = np.indices((65, 65)) - 32.0
RING = ((np.hypot(COLUMNS, ROWS) < 30.0) & (np.hypot(COLUMNS, ROWS) > 12.0)).astype(float)

BOUNDED = [
    DiscAperture(),
    DiscAperture(ratio=1.8),
    PolygonAperture(3),
    PolygonAperture(4, 45.0),
    PolygonAperture(5, rotation_deg=-17.0, curvature=0.4),
    PolygonAperture(6, 10.0, ratio=0.5),
    PolygonAperture(9, 100.0, 1.0),
]


def covariance(points: np.ndarray) -> np.ndarray:
    return np.asarray(np.cov(points.T, bias=True))


def unsqueezed(points: np.ndarray, aperture: Aperture) -> np.ndarray:
    return np.asarray(points / (min(1.0, 1.0 / aperture.ratio), min(1.0, aperture.ratio)))


@pytest.mark.parametrize("count", [1, 2, 3, 5, 17, 256, 4096])
@pytest.mark.parametrize("aperture", BOUNDED, ids=str)
def test_samples_are_centred_and_inside_the_unit_disc(aperture: Aperture, count: int) -> None:
    for seed in range(5):
        points = lens_samples(count, aperture, seed)
        assert points.shape == (count, 2)
        assert np.abs(points.mean(axis=0)).max() < 1e-12
        assert np.hypot(*points.T).max() <= 1.0 + 1e-12


@pytest.mark.parametrize("count", [64, 256, 4096])
def test_second_moment_of_the_disc(count: int) -> None:
    # E[x^2] = E[y^2] = 1/4, and 1/4 of the squared ratio along the squeezed axis.
    assert covariance(lens_samples(count, "disc")) == pytest.approx(np.eye(2) / 4, abs=2.0 / count)
    squeezed = lens_samples(count, DiscAperture(ratio=2.0))
    assert covariance(squeezed) == pytest.approx(np.diag([1 / 16, 1 / 4]), abs=2.0 / count)
    flat = lens_samples(count, DiscAperture(ratio=0.5))
    assert covariance(flat) == pytest.approx(np.diag([1 / 4, 1 / 16]), abs=2.0 / count)


@pytest.mark.parametrize("blades", [3, 4, 5, 6, 9])
@pytest.mark.parametrize("rotation", [0.0, 23.0])
def test_second_moment_of_polygons(blades: int, rotation: float) -> None:
    # Second moment of area of a regular polygon with circumradius 1 over its area: (2 + cos(2 pi / n)) / 12.
    expected = (2.0 + math.cos(2.0 * math.pi / blades)) / 12.0
    points = lens_samples(4096, PolygonAperture(blades, rotation))
    assert covariance(points) == pytest.approx(expected * np.eye(2), abs=5e-4)


@pytest.mark.parametrize("aperture", [a for a in BOUNDED if isinstance(a, PolygonAperture)], ids=str)
def test_polygons_keep_to_their_edges_and_fill_them(aperture: PolygonAperture) -> None:
    points = unsqueezed(lens_samples(8192, aperture), aperture)
    radius, angle = np.hypot(*points.T), np.arctan2(points[:, 1], points[:, 0])
    share = (radius / aperture.rim(angle)) ** 2
    assert share.max() <= 1.0 + 1e-12
    # Area-preserving: the share of area inside each point is uniform, in every blade.
    assert np.abs(np.sort(share) - (np.arange(8192) + 0.5) / 8192).max() < 2e-3
    sector = ((angle - math.radians(aperture.rotation_deg)) % (2.0 * math.pi) * aperture.blades / (2.0 * math.pi)) % 1.0
    blade = ((angle - math.radians(aperture.rotation_deg)) % (2.0 * math.pi)) * aperture.blades // (2.0 * math.pi)
    counts = np.bincount(blade.astype(int), minlength=aperture.blades)
    assert counts == pytest.approx(8192 / aperture.blades, rel=0.02)
    assert sector.mean() == pytest.approx(0.5, abs=5e-3)  # symmetric across a blade


@pytest.mark.parametrize("blades", [3, 5, 8])
def test_straight_blades_are_half_planes(blades: int) -> None:
    points = lens_samples(4096, PolygonAperture(blades, 30.0))
    middles = math.radians(30.0) + (np.arange(blades) + 0.5) * 2.0 * math.pi / blades
    along = points @ np.stack([np.cos(middles), np.sin(middles)])
    apothem = math.cos(math.pi / blades)
    assert along.max() <= apothem + 1e-12
    assert along.max(axis=0) == pytest.approx(apothem, abs=0.02)
    corner = PolygonAperture(blades, 30.0).rim(math.radians(30.0))
    assert corner == pytest.approx(1.0, abs=1e-12)
    assert PolygonAperture(blades).area == pytest.approx(blades / 2 * math.sin(2 * math.pi / blades), rel=1e-9)


@pytest.mark.parametrize("curvature", [0.0, 1e-6, 0.3, 0.8, 1.0])
def test_curved_blades_are_arcs_through_the_corners(curvature: float) -> None:
    aperture = PolygonAperture(5, 0.0, curvature)
    angle = np.linspace(0.0, 2.0 * math.pi / 5, 101)
    rim = aperture.rim(angle)
    assert rim[[0, -1]] == pytest.approx(1.0)
    x, y = rim * np.cos(angle), rim * np.sin(angle)
    if curvature > 1e-3:  # all at one distance, 1 / curvature, from a point on the blade's normal
        half = math.pi / 5
        centre = math.cos(half) - math.sqrt(1.0 / curvature**2 - math.sin(half) ** 2)
        cx, cy = centre * math.cos(half), centre * math.sin(half)
        assert np.hypot(x - cx, y - cy) == pytest.approx(1.0 / curvature)
    else:
        assert x * math.cos(math.pi / 5) + y * math.sin(math.pi / 5) == pytest.approx(math.cos(math.pi / 5), abs=1e-6)


def test_full_curvature_is_the_disc() -> None:
    disc, polygon = lens_samples(500, "disc", 3), lens_samples(500, PolygonAperture(7, 0.0, 1.0), 3)
    assert polygon == pytest.approx(disc, abs=1e-6)
    assert PolygonAperture(7, 12.0, 1.0).area == pytest.approx(math.pi, rel=1e-12)


def test_rotation_comes_before_the_squeeze() -> None:
    turned = PolygonAperture(4, 45.0, ratio=2.0)  # an upright square, squeezed to a tall rectangle
    points = np.abs(lens_samples(4096, turned))
    assert points.max(axis=0) == pytest.approx([math.sqrt(0.5) / 2, math.sqrt(0.5)], abs=0.01)


def test_gaussian_samples() -> None:
    points = lens_samples(4096, "gaussian")
    assert np.abs(points.mean(axis=0)).max() < 1e-12
    assert covariance(points) == pytest.approx(GAUSSIAN_SIGMA**2 * np.eye(2), abs=3e-3)
    fourth = (points**4).mean(axis=0)
    assert fourth == pytest.approx(3 * GAUSSIAN_SIGMA**4 * np.ones(2), rel=0.02)  # a Gaussian's kurtosis is 3
    squeezed = lens_samples(4096, GaussianAperture(ratio=2.0))
    assert covariance(squeezed) == pytest.approx(np.diag([1 / 16, 1 / 4]), abs=3e-3)


def test_image_apertures_let_light_through_by_weight() -> None:
    image = np.zeros((8, 8))
    image[2, 3], image[5, 4], image[4, 1] = 1.0, 2.0, 5.0
    points = lens_samples(4000, ImageAperture(image))
    column, row = np.floor((points[:, 0] + 1.0) * 4.0), np.floor((1.0 - points[:, 1]) * 4.0)
    for (y, x), share in {(2, 3): 1 / 8, (5, 4): 2 / 8, (4, 1): 5 / 8}.items():
        assert np.mean((row == y) & (column == x)) == pytest.approx(share, abs=2e-3)
    centroid = np.array([[3.5, 2.5], [4.5, 5.5], [1.5, 4.5]]).T @ [1 / 8, 2 / 8, 5 / 8]
    assert points.mean(axis=0) == pytest.approx([centroid[0] / 4 - 1, 1 - centroid[1] / 4], abs=2e-3)


def test_image_of_a_ring() -> None:
    aperture = ImageAperture(RING)
    points = lens_samples(4096, aperture, 2)
    radius = np.hypot(*points.T)
    assert radius.max() <= 30.7 / 32.5 and radius.min() >= 11.3 / 32.5
    outer, inner = 30 / 32.5, 12 / 32.5
    assert covariance(points) == pytest.approx((outer**2 + inner**2) / 4 * np.eye(2), abs=3e-3)
    wide = ImageAperture(np.pad(RING, ((0, 0), (20, 20))))  # the longer side spans the diameter
    assert np.hypot(*lens_samples(4096, wide, 2).T).max() <= 30.7 / 52.5
    squeezed = lens_samples(4096, ImageAperture(RING, ratio=2.0), 2)
    assert squeezed == pytest.approx(points * (0.5, 1.0))


def test_a_disc_as_an_image_is_the_disc() -> None:
    rows, columns = np.indices((257, 257)) - 128.0
    points = lens_samples(4096, ImageAperture(np.hypot(columns, rows) <= 128.4))
    assert covariance(points) == pytest.approx(np.eye(2) / 4, abs=2e-3)
    assert np.hypot(*points.T).max() <= 1.0 + 1e-12


@pytest.mark.parametrize("aperture", [*BOUNDED, GaussianAperture(), ImageAperture(RING)], ids=str)
def test_samples_depend_on_the_seed_alone(aperture: Aperture) -> None:
    assert np.array_equal(lens_samples(64, aperture, seed=3), lens_samples(64, aperture, seed=3))
    assert not np.allclose(lens_samples(64, aperture, seed=3), lens_samples(64, aperture, seed=4))


def half_plane_errors(count: int, seed: int) -> np.ndarray:
    """Share of a disc on one side of lines, sampled less exact: the error of the blur of an edge."""
    t, angle = np.meshgrid(np.linspace(-0.95, 0.95, 39), np.arange(12) * math.pi / 6)
    x, y = lens_samples(count, "disc", seed).T
    sampled = (np.cos(angle)[..., None] * x + np.sin(angle)[..., None] * y < t[..., None]).mean(axis=-1)
    return np.asarray(sampled - 0.5 - (t * np.sqrt(1.0 - t * t) + np.arcsin(t)) / math.pi).ravel()


def test_seeds_are_independent_estimates_and_better_than_random() -> None:
    errors = np.array([half_plane_errors(64, seed) for seed in range(60)])
    rms = math.sqrt(float((errors**2).mean()))
    assert rms < 0.014  # random points: sqrt(p (1 - p) / 64), 0.05 on average
    assert math.sqrt(float((errors.mean(axis=0) ** 2).mean())) < 2.0 * rms / math.sqrt(60)  # unbiased
    pairs = (errors[::2] * errors[1::2]).mean() / rms**2
    assert abs(pairs) < 0.15  # so half the difference of two tells the error of their mean
    assert math.sqrt(float(np.mean([half_plane_errors(1024, seed) ** 2 for seed in range(9)]))) < rms / 6.0


def test_apertures_of_a_lens() -> None:
    assert Lens(0.1, 2.0).aperture == DiscAperture()
    assert Lens(0.1, 2.0, aperture="gaussian").aperture == GaussianAperture()  # type: ignore[arg-type]
    blades = PolygonAperture(7, 5.0, 0.2, ratio=1.5)
    lens = Lens.photographic(50.0, 2.0, 3.0, blades)
    assert lens.aperture is blades
    assert lens.to_dict()["aperture"] == {
        "shape": "polygon",
        "ratio": 1.5,
        "blades": 7,
        "rotation_deg": 5.0,
        "curvature": 0.2,
    }
    with pytest.raises(InputError, match="shape 'star'"):
        Lens(0.1, 2.0, aperture="star")  # type: ignore[arg-type]


def test_image_apertures_are_equal_by_content() -> None:
    first, second = ImageAperture(RING), ImageAperture(3.0 * RING)
    assert first == second and hash(first) == hash(second)
    assert first != ImageAperture(np.roll(RING, 1, 0)) and first != ImageAperture(RING, ratio=2.0)
    data = Lens(0.1, 2.0, aperture=first).to_dict()["aperture"]
    assert json.loads(json.dumps(data)) == data and data["image_size"] == [65, 65]
    with pytest.raises(ValueError, match="read-only"):
        first.image[0, 0] = 1.0


@pytest.mark.parametrize(
    "make, says",
    [
        (lambda: DiscAperture(ratio=0.0), "ratio is 0.0"),
        (lambda: GaussianAperture(ratio=math.nan), "ratio is nan"),
        (lambda: PolygonAperture(2), "blades is 2"),
        (lambda: PolygonAperture(5.5), "blades is 5.5"),  # type: ignore[arg-type]
        (lambda: PolygonAperture(math.nan), "blades is nan"),  # type: ignore[arg-type]
        (lambda: PolygonAperture(65), "blades is 65"),
        (lambda: PolygonAperture("six"), "blades is 'six'"),  # type: ignore[arg-type]
        (lambda: PolygonAperture(6, math.inf), "rotation_deg is inf"),
        (lambda: PolygonAperture(6, 0.0, 1.1), "curvature is 1.1"),
        (lambda: PolygonAperture(6, 0.0, -0.1), "curvature is -0.1"),
        (lambda: ImageAperture(np.zeros((4, 4))), "black"),
        (lambda: ImageAperture(np.ones((4, 4, 3))), r"shape \(4, 4, 3\)"),
        (lambda: ImageAperture(np.zeros((0, 4))), r"shape \(0, 4\)"),
        (lambda: ImageAperture(-RING), "negative"),
        (lambda: ImageAperture(RING * math.nan), "negative, NaN"),
        (lambda: ImageAperture(np.ones((64, 64))), "outside the inscribed circle"),
        (lambda: ImageAperture("ring"), "array of numbers"),  # type: ignore[arg-type]
    ],
)
def test_bad_apertures_are_refused(make: Callable[[], Aperture], says: str) -> None:
    with pytest.raises(InputError, match=says):
        make()


def test_bad_samples_are_refused() -> None:
    with pytest.raises(InputError, match="at least 1"):
        lens_samples(0)
    with pytest.raises(InputError, match="seed is -1"):
        lens_samples(8, seed=-1)
    with pytest.raises(InputError, match="'square'"):
        lens_samples(8, "square")
