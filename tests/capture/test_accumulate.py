"""The accumulation reference against closed forms, and against the layers that share its shaders."""

from __future__ import annotations

import dataclasses
import json
import math

import numpy as np
import pytest
from PIL import Image
from scipy.stats import qmc

import cldof.capture.accumulate as accumulate_module
from cldof import Camera, Lens
from cldof.capture.accumulate import accumulate, view_plan
from cldof.capture.peel import DepthPeeler
from cldof.capture.scene import DirectionalLight, Gradient, Material, Node, Scene
from cldof.errors import InputError
from cldof.lens import Aperture, DiscAperture, GaussianAperture, PolygonAperture
from cldof.metrics import PointSpread, psf_radius, psnr

from .conftest import camera_at, flat, quad


def noise_image(size: int = 256) -> Image.Image:
    return Image.fromarray(np.random.default_rng(7).integers(0, 256, (size, size, 3), dtype=np.uint8))


@pytest.mark.parametrize("shape", ["disc", "gaussian"])
@pytest.mark.parametrize("focus", [2.0, 3.3])
def test_what_is_in_focus_keeps_its_bits(peeler: DepthPeeler, shape: str, focus: float) -> None:
    shiny = Material((1.0, 1.0, 1.0, 1.0), noise_image(), roughness=0.2)
    light = DirectionalLight((0.3, -0.4, -1.0))
    scene = Scene("plane", (quad(focus, 1.1, shiny),), lights=(light,), background=None)
    camera = camera_at(128, 96)
    image = accumulate(peeler, scene, camera, Lens(0.2, focus), views=33, shape=shape, view_dependent=False).image
    sharp = peeler.peel(scene, camera).pinhole_image()
    np.testing.assert_array_equal(image, sharp)


def a_point(peeler: DepthPeeler, depth: float, lens: Lens, views: int = 4000) -> tuple[PointSpread, float]:
    """What a point of one pixel at ``depth`` becomes, and its CoC radius by the thin lens."""
    camera = camera_at(192, 192)
    pixel = depth / camera.focal_px
    point = quad(depth, 0.5 * pixel, flat((50.0, 50.0, 50.0)), at=(0.5 * pixel, 0.5 * pixel))
    image = accumulate(peeler, Scene("point", (point,)), camera, lens, views).image
    return psf_radius(image), float(abs(lens.coc_radius_px(camera, depth)))


@pytest.mark.parametrize(("depth", "focus"), [(1.0, 2.0), (4.0, 1.2), (0.8, math.inf)])
def test_a_point_spreads_over_the_disc_of_the_thin_lens(peeler: DepthPeeler, depth: float, focus: float) -> None:
    spread, radius = a_point(peeler, depth, Lens(0.2, focus))
    assert radius > 20.0
    assert spread.second_moment_radius_px == pytest.approx(radius, rel=0.005)
    assert spread.edge_radius_px == pytest.approx(radius, rel=0.015)  # pixels are 1/20 of it and more
    assert spread.energy == pytest.approx(50.0, rel=0.005)  # of one pixel
    assert (spread.x, spread.y) == pytest.approx((96.0, 95.0), abs=0.05)


def test_a_point_shows_the_aperture(peeler: DepthPeeler) -> None:
    """Upright behind focus, turned before it; with the second moment of its shape."""
    triangle = PolygonAperture(3, 90.0)  # a corner at the top
    for depth, up in ((4.0, 1.0), (0.7, -1.0)):
        lens = Lens(0.2, 1.4, aperture=triangle)
        camera = camera_at(192, 192)
        pixel = depth / camera.focal_px
        point = quad(depth, 0.5 * pixel, flat(), at=(0.5 * pixel, 0.5 * pixel))
        rows, columns = np.nonzero(accumulate(peeler, Scene("point", (point,)), camera, lens, 1000).image[..., 0])
        radius = float(abs(lens.coc_radius_px(camera, depth)))
        height, side = up * (95.0 - rows), columns - 96.0
        assert height.max() == pytest.approx(radius, abs=3.0)
        assert height.min() == pytest.approx(-radius / 2.0, abs=1.5)
        assert side.max() == pytest.approx(radius * math.sqrt(0.75), abs=2.5)
        assert np.abs(side[height > 0.7 * radius]).max() < 0.3 * radius
    # Second moments over that of a disc, 1/2: a hexagon, a Gaussian of half the radius, a squeezed disc.
    for aperture, share in (
        (PolygonAperture(6), (2.0 + 0.5) / 6.0),
        (GaussianAperture(), 0.5),
        (DiscAperture(ratio=2.0), (1.0 + 0.25) / 4.0),
    ):
        spread, radius = a_point(peeler, 1.0, Lens(0.12, 2.0, aperture=aperture), 2000)
        assert spread.second_moment_radius_px == pytest.approx(radius * math.sqrt(2.0 * share), rel=0.01)


def disc_below(t: np.ndarray) -> np.ndarray:
    """Share of a unit disc with x < t: the edge spread function of a lens."""
    t = np.clip(t, -1.0, 1.0)
    return np.asarray(0.5 + (t * np.sqrt(1.0 - t * t) + np.arcsin(t)) / math.pi)


def half_plane(depth: float, color: tuple[float, ...], edge_m: float = 0.0) -> Node:
    """Everything left of x = ``edge_m`` at ``depth``."""
    return quad(depth, 50.0, flat(color), at=(edge_m - 50.0, 0.0))


def columns_px(camera: Camera) -> np.ndarray:
    """Pixel centres from the optical axis, to the right."""
    return np.asarray(np.arange(camera.width) + 0.5 - camera.width / 2.0)


EDGES = {
    "disc": (DiscAperture(), disc_below),
    "squeezed": (DiscAperture(ratio=2.0), lambda t: disc_below(2.0 * t)),
    "gaussian": (GaussianAperture(), np.vectorize(lambda t: 0.5 + 0.5 * math.erf(t * math.sqrt(2.0)))),
    "square": (PolygonAperture(4, 45.0), lambda t: np.clip(0.5 + t * math.sqrt(0.5), 0.0, 1.0)),
    "diamond": (PolygonAperture(4), lambda t: 0.5 + np.sign(t) * (0.5 - 0.5 * (1.0 - np.minimum(np.abs(t), 1.0)) ** 2)),
}


@pytest.mark.parametrize("shape", EDGES)
@pytest.mark.parametrize("depth", [1.0, 4.0])
def test_an_edge_becomes_the_edge_spread_function(peeler: DepthPeeler, shape: str, depth: float) -> None:
    aperture, below = EDGES[shape]
    camera, lens = camera_at(128, 8, yfov_deg=5.0), Lens(0.5, 1.8, aperture=aperture)
    lens = dataclasses.replace(lens, aperture_radius_m=0.5 * 25.0 / abs(float(lens.coc_radius_px(camera, depth))))
    coc = float(lens.coc_radius_px(camera, depth))
    assert abs(coc) == pytest.approx(25.0)
    image = accumulate(peeler, Scene("edge", (half_plane(depth, (1.0, 1.0, 1.0)),)), camera, lens, 1024).image
    expected = below(-columns_px(camera) / abs(coc))  # covered while the edge, moved by v C, lies right of the pixel
    error = image[..., 0] - expected
    assert np.abs(error).max() < 0.01 and math.sqrt(float((error**2).mean())) < 0.0025
    np.testing.assert_array_equal(image[..., 0], image[..., 3])


def test_a_half_plane_before_a_plane_blends_by_what_the_lens_sees_past_it(peeler: DepthPeeler) -> None:
    """Partial occlusion: a near edge over a wall that has a step of its own, in focus and out of focus."""
    camera = camera_at(128, 8, yfov_deg=5.0)
    near, left, right = np.array((2.0, 0.1, 0.0)), np.array((0.0, 0.7, 0.2)), np.array((0.1, 0.2, 0.9))
    wall = 3.0
    nodes = (half_plane(1.0, tuple(near)), half_plane(wall, tuple(left), 0.003), quad(wall + 1e-4, 60.0, flat(right)))
    x = columns_px(camera)
    for focus in (wall, 1.7, 8.0):
        lens = Lens(0.03, focus)
        front, back = (float(c) for c in lens.coc_radius_px(camera, [1.0, wall]))
        step = 0.003 / wall * camera.focal_px
        # Lens points, by their x: the near plane is hit where v * front > x, the left of the wall where
        # step + v * back > x. Two half-planes of the lens, so shares are differences of one cumulative function.
        covered = disc_below(-x / abs(front))  # v < x / front, front negative
        if back == 0.0:
            sees_left = (1.0 - covered) * (x < step)
        elif back < 0.0:  # v < (x - step) / back
            sees_left = np.maximum(disc_below((x - step) / back) - covered, 0.0)
        else:  # v > (x - step) / back, and v > x / front
            sees_left = 1.0 - disc_below(np.maximum((x - step) / back, x / front))
        sees_right = 1.0 - covered - sees_left
        expected = covered[:, None] * near + sees_left[:, None] * left + sees_right[:, None] * right
        image = accumulate(peeler, Scene("occlusion", nodes), camera, lens, 1024).image
        error = image[..., :3] - expected
        assert np.abs(error).max() < 0.02 and math.sqrt(float((error**2).mean())) < 0.004
        assert (image[..., 3] == 1.0).all()


def test_few_views_differ_from_many_by_their_noise_floor(peeler: DepthPeeler) -> None:
    """N = 64 against N = 1024: the floor tells the difference, within 2.5 dB; so does that of 256 from 64."""
    cards = [flat(base_color_texture=noise_image(8 + at)) for at in range(6)]
    nodes = [quad(1.0 + 0.6 * n, 0.3, card, at=(0.35 * n - 0.9, 0.2 * (n % 3) - 0.2)) for n, card in enumerate(cards)]
    scene, camera, lens = Scene("cards", (*nodes, quad(6.0, 9.0, cards[0]))), camera_at(96, 72), Lens(0.08, 2.2)
    for jitter in (False, True):
        many = accumulate(peeler, scene, camera, lens, 1024, jitter=jitter, seed=5)
        few, some = (accumulate(peeler, scene, camera, lens, n, jitter=jitter) for n in (64, 256))
        one_pattern = accumulate(peeler, scene, camera, lens, 64, jitter=jitter, noise_floor=False)
        floors = [made.noise_floor_db for made in (few, some, many)]
        assert floors[0] is not None and floors[1] is not None and floors[2] is not None
        assert floors[0] + 5.0 < floors[1] < floors[2] - 5.0
        assert psnr(few.image, many.image) == pytest.approx(floors[0], abs=2.5)
        assert psnr(some.image, many.image) == pytest.approx(floors[1], abs=2.5)
        assert one_pattern.noise_floor_db is None
        assert psnr(one_pattern.image, many.image) > floors[0] - 2.5


class Zeros:
    """A generator that scrambles nothing."""

    def integers(self, low: int, high: int, size: tuple[int, ...] | None = None) -> np.ndarray | int:
        return np.zeros(size, np.int64) if size else 0


def test_jittered_views_are_sobols(monkeypatch: pytest.MonkeyPatch) -> None:
    points = accumulate_module._scrambled_sobol(64, 5)
    assert not np.array_equal(points, accumulate_module._scrambled_sobol(64, 6))
    np.testing.assert_array_equal(points[:40], accumulate_module._scrambled_sobol(40, 5))
    # However it is scrambled: any 64 points have one in each 64th of an axis, and one in each 8x8 of the first two.
    np.testing.assert_array_equal(np.sort(np.floor(points * 64.0), axis=0), np.arange(64)[:, None] * np.ones(4))
    cells = np.floor(points[:, :2] * 8.0) @ (8.0, 1.0)
    np.testing.assert_array_equal(np.sort(cells), np.arange(64))
    monkeypatch.setattr(np.random, "default_rng", lambda seed: Zeros())
    plain, expected = accumulate_module._scrambled_sobol(64, 5), qmc.Sobol(4, scramble=False).random(64)
    np.testing.assert_array_equal(plain[np.lexsort(plain.T)], expected[np.lexsort(expected.T)])


def test_what_a_reference_says_of_itself(peeler: DepthPeeler) -> None:
    scene, camera = Scene("edge", (half_plane(1.0, (1.0, 1.0, 1.0)),)), camera_at(32, 8, yfov_deg=10.0)
    made = accumulate(peeler, scene, camera, Lens(0.2, 2.0), 9)
    assert made.views == 9 and made.seconds > 0.0 and not made.is_cached
    assert made.noise_rms is not None and 0.0 < made.noise_rms < 0.3
    assert made.noise_floor_db == pytest.approx(-20.0 * math.log10(made.noise_rms))
    assert json.loads(json.dumps(made.to_dict()))["noise_floor_db"] == made.noise_floor_db
    # The same from the points on the lens: each view moves the edge by its x times the CoC.
    coc = float(Lens(0.2, 2.0).coc_radius_px(camera, 1.0))
    halves = [points[:, 0] / 0.2 for points, _ in view_plan(Lens(0.2, 2.0), 9, None, False, 0, True)]
    assert [len(half) for half in halves] == [5, 4]
    shares = [(columns_px(camera)[:, None] < half * coc).mean(axis=1) for half in halves]
    np.testing.assert_allclose(made.image[3, :, 0], (5.0 * shares[0] + 4.0 * shares[1]) / 9.0, atol=1e-6)
    expected = math.sqrt(float(((shares[0] - shares[1]) ** 2).mean())) * math.sqrt(20.0) / 9.0
    assert made.noise_rms == pytest.approx(expected)

    pinhole = accumulate(peeler, scene, camera, Lens(0.0, 2.0), 7)
    assert (pinhole.views, pinhole.noise_rms, pinhole.noise_floor_db) == (1, 0.0, math.inf)
    assert pinhole.to_dict()["noise_floor_db"] is None
    assert accumulate(peeler, scene, camera, Lens(0.2, 2.0), 7).noise_floor_db is None
    in_focus = accumulate(peeler, scene, camera, Lens(0.2, 1.0), 8)
    assert in_focus.noise_rms == 0.0
    assert accumulate(peeler, scene, camera, Lens(0.0, 2.0), 6, jitter=True).views == 6


def test_the_lens_brings_its_aperture(peeler: DepthPeeler) -> None:
    scene, camera = Scene("edge", (half_plane(1.0, (1.0, 1.0, 1.0)),)), camera_at(32, 8, yfov_deg=10.0)
    blades = PolygonAperture(5, 10.0)

    def image(lens: Lens, shape: Aperture | str | None = None) -> np.ndarray:
        return accumulate(peeler, scene, camera, lens, 20, shape).image

    plain, bladed = Lens(0.2, 2.0), Lens(0.2, 2.0, aperture=blades)
    np.testing.assert_array_equal(image(plain), image(plain, "disc"))
    np.testing.assert_array_equal(image(bladed), image(plain, blades))
    assert (image(bladed) != image(plain)).any()
    np.testing.assert_array_equal(image(bladed, "gaussian"), image(plain, GaussianAperture()))


def test_the_sky_at_infinity_blurs_as_a_thing_at_infinity(peeler: DepthPeeler) -> None:
    camera = camera_at(64, 64)
    sky = Gradient((3.0, 0.0, 0.0), (0.0, 0.0, 1.0))
    scene = Scene("sky", (), background=sky)
    sharp = peeler.peel(scene, camera).color[0]
    image = accumulate(peeler, scene, camera, Lens(0.05, 1.0), views=64, shape="disc").image
    np.testing.assert_allclose(image, sharp, atol=2e-2)  # smooth, so a blur hardly shows
    np.testing.assert_array_equal(accumulate(peeler, scene, camera, Lens(0.05, math.inf), views=9).image, sharp)
    # One view from the right edge of the lens sees the sky shifted by the CoC at infinity.
    far = quad(1e6, 1e6, flat(base_color_texture=noise_image(8)))
    blurred = accumulate(peeler, Scene("far", (far,)), camera, Lens(0.05, 1.0), views=64, shape="disc").image
    assert blurred[20:44, 20:44, 0].std() < 0.5 * peeler.peel(Scene("far", (far,)), camera).color[0, 20:44, 20:44].std()


def test_a_pinhole_is_the_pinhole_image(peeler: DepthPeeler) -> None:
    pane = flat((0.9, 0.5, 0.1, 0.4), alpha_mode="blend")
    nodes = (quad(2.0, 0.3, pane), quad(2.5, 0.4, pane), quad(3.0, 0.6, flat(base_color_texture=noise_image(32))))
    for background in (None, Gradient((0.3, 0.4, 0.9), (0.2, 0.2, 0.2))):
        scene = Scene("panes", nodes, background=background)
        camera = camera_at(80, 60)
        calls: list[tuple[int, int]] = []
        image = accumulate(
            peeler, scene, camera, Lens(0.0, 2.0), progress=lambda *done, to=calls: to.append(done)
        ).image
        np.testing.assert_allclose(image, peeler.peel(scene, camera, layers=9).pinhole_image(), atol=1e-6)
        assert calls == [(1, 1)]


def test_a_blended_pane_out_of_focus_keeps_its_transmittance(peeler: DepthPeeler) -> None:
    pane = flat((1.0, 1.0, 1.0, 0.25), alpha_mode="blend")
    scene = Scene("pane", (quad(1.0, 5.0, pane), quad(2.0, 9.0, flat((0.0, 0.8, 0.0)))))
    image = accumulate(peeler, scene, camera_at(), Lens(0.1, 2.0), views=16).image
    np.testing.assert_allclose(image, np.broadcast_to((0.25, 0.85, 0.25, 1.0), image.shape), rtol=1e-5)


def test_shading_follows_the_view_over_the_lens_unless_told_otherwise(peeler: DepthPeeler) -> None:
    mirror = Material((0.9, 0.9, 0.9, 1.0), metallic=1.0, roughness=0.15)
    scene = Scene("shine", (quad(2.0, 9.0, mirror),), lights=(DirectionalLight((0.0, -0.3, -1.0), (3.0, 3.0, 3.0)),))
    camera = camera_at(64, 64)
    pinhole = peeler.peel(scene, camera).color[0]
    centre = accumulate(peeler, scene, camera, Lens(0.5, 2.0), views=8, shape="disc", view_dependent=False).image
    np.testing.assert_array_equal(centre, pinhole)
    own = accumulate(peeler, scene, camera, Lens(0.5, 2.0), views=8, shape="disc").image
    assert np.abs(own - pinhole).max() > 0.1


def test_back_faces_are_culled_for_each_view(peeler: DepthPeeler) -> None:
    front = dataclasses.replace(flat(), double_sided=False)
    turned = dataclasses.replace(quad(2.0, 9.0, front), transform=np.diag([-1.0, 1.0, 1.0, 1.0]))
    seen = accumulate(peeler, Scene("seen", (turned,)), camera_at(), Lens(0.1, 3.0), views=4).image
    assert (seen[..., 3] == 1.0).all()  # a mirroring transform does not turn a face round
    about = np.diag([-1.0, 1.0, -1.0, 1.0])
    about[2, 3] = -4.0
    away = dataclasses.replace(turned, transform=about)
    assert not accumulate(peeler, Scene("away", (away,)), camera_at(), Lens(0.1, 3.0), views=4).image.any()


def test_jitter_smooths_edges_and_is_seeded(peeler: DepthPeeler) -> None:
    scene, camera, lens = Scene("edge", (quad(2.0, 0.3),)), camera_at(48, 48), Lens(0.0, 2.0)
    hard = accumulate(peeler, scene, camera, lens).image
    smooth = accumulate(peeler, scene, camera, lens, views=64, jitter=True).image
    assert set(np.unique(hard[..., 3])) == {0.0, 1.0}
    assert len(np.unique(smooth[..., 3])) > 5
    assert smooth[..., 3].sum() == pytest.approx((0.6 * camera.focal_px / 2.0) ** 2, rel=0.02)
    np.testing.assert_array_equal(smooth, accumulate(peeler, scene, camera, lens, views=64, jitter=True).image)
    assert (smooth != accumulate(peeler, scene, camera, lens, views=64, jitter=True, seed=1).image).any()


def test_bad_arguments_are_refused(peeler: DepthPeeler) -> None:
    scene, lens = Scene("one", (quad(2.0),)), Lens(0.1, 2.0)
    with pytest.raises(InputError, match="views is 0"):
        accumulate(peeler, scene, camera_at(), lens, views=0)
    with pytest.raises(InputError, match="seed is -1"):
        accumulate(peeler, scene, camera_at(), lens, seed=-1)
    with pytest.raises(InputError, match="shape 'star'"):
        accumulate(peeler, scene, camera_at(), lens, shape="star")
