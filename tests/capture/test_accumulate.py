"""The accumulation reference against closed forms, and against the layers that share its shaders."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from PIL import Image

from cldof import Lens
from cldof.capture.accumulate import accumulate
from cldof.capture.peel import DepthPeeler
from cldof.capture.scene import DirectionalLight, Gradient, Material, Scene
from cldof.errors import InputError

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
    image = accumulate(peeler, scene, camera, Lens(0.2, focus), views=33, shape=shape)
    sharp = peeler.peel(scene, camera).pinhole_image()
    np.testing.assert_array_equal(image, sharp)


@pytest.mark.parametrize(("depth", "focus"), [(1.0, 2.0), (4.0, 2.0), (3.0, math.inf)])
def test_a_point_spreads_over_the_disc_of_the_thin_lens(peeler: DepthPeeler, depth: float, focus: float) -> None:
    camera = camera_at(256, 256)
    pixel = depth / camera.focal_px
    lens = Lens(0.1, focus)
    radius = float(abs(lens.coc_radius_px(camera, depth)))
    point = quad(depth, 0.5 * pixel, flat((50.0, 50.0, 50.0)), at=(0.5 * pixel, 0.5 * pixel))
    views = 1500
    image = accumulate(peeler, Scene("point", (point,)), camera, lens, views=views, shape="disc")
    light = image[..., 0].astype(np.float64)
    assert light.sum() == pytest.approx(50.0, rel=0.01)  # energy of one pixel
    rows, columns = np.indices(light.shape)
    # The mean squared radius of a uniform disc is half its radius squared; each pixel adds its own 1/12 twice.
    x, y = columns - 128.0, rows - 127.0
    spread = (light * (x**2 + y**2)).sum() / light.sum() - 1.0 / 6.0
    assert math.sqrt(2.0 * spread) == pytest.approx(radius, rel=0.01)
    assert math.hypot((light * x).sum(), (light * y).sum()) / light.sum() < 0.1


def test_the_sky_at_infinity_blurs_as_a_thing_at_infinity(peeler: DepthPeeler) -> None:
    camera = camera_at(64, 64)
    sky = Gradient((3.0, 0.0, 0.0), (0.0, 0.0, 1.0))
    scene = Scene("sky", (), background=sky)
    sharp = peeler.peel(scene, camera).color[0]
    image = accumulate(peeler, scene, camera, Lens(0.05, 1.0), views=64, shape="disc")
    np.testing.assert_allclose(image, sharp, atol=2e-2)  # smooth, so a blur hardly shows
    np.testing.assert_array_equal(accumulate(peeler, scene, camera, Lens(0.05, math.inf), views=9), sharp)
    # One view from the right edge of the lens sees the sky shifted by the CoC at infinity.
    far = quad(1e6, 1e6, flat(base_color_texture=noise_image(8)))
    blurred = accumulate(peeler, Scene("far", (far,)), camera, Lens(0.05, 1.0), views=64, shape="disc")
    assert blurred[20:44, 20:44, 0].std() < 0.5 * peeler.peel(Scene("far", (far,)), camera).color[0, 20:44, 20:44].std()


def test_a_pinhole_is_the_pinhole_image(peeler: DepthPeeler) -> None:
    pane = flat((0.9, 0.5, 0.1, 0.4), alpha_mode="blend")
    nodes = (quad(2.0, 0.3, pane), quad(2.5, 0.4, pane), quad(3.0, 0.6, flat(base_color_texture=noise_image(32))))
    for background in (None, Gradient((0.3, 0.4, 0.9), (0.2, 0.2, 0.2))):
        scene = Scene("panes", nodes, background=background)
        camera = camera_at(80, 60)
        calls: list[tuple[int, int]] = []
        image = accumulate(peeler, scene, camera, Lens(0.0, 2.0), progress=lambda *done, to=calls: to.append(done))
        np.testing.assert_allclose(image, peeler.peel(scene, camera, layers=9).pinhole_image(), atol=1e-6)
        assert calls == [(1, 1)]


def test_a_blended_pane_out_of_focus_keeps_its_transmittance(peeler: DepthPeeler) -> None:
    pane = flat((1.0, 1.0, 1.0, 0.25), alpha_mode="blend")
    scene = Scene("pane", (quad(1.0, 5.0, pane), quad(2.0, 9.0, flat((0.0, 0.8, 0.0)))))
    image = accumulate(peeler, scene, camera_at(), Lens(0.1, 2.0), views=16)
    np.testing.assert_allclose(image, np.broadcast_to((0.25, 0.85, 0.25, 1.0), image.shape), rtol=1e-5)


def test_shading_does_not_follow_the_view_over_the_lens(peeler: DepthPeeler) -> None:
    mirror = Material((0.9, 0.9, 0.9, 1.0), metallic=1.0, roughness=0.15)
    scene = Scene("shine", (quad(2.0, 9.0, mirror),), lights=(DirectionalLight((0.0, -0.3, -1.0), (3.0, 3.0, 3.0)),))
    camera = camera_at(64, 64)
    image = accumulate(peeler, scene, camera, Lens(0.5, 2.0), views=8, shape="disc")
    np.testing.assert_array_equal(image, peeler.peel(scene, camera).color[0])


def test_back_faces_are_culled_for_each_view(peeler: DepthPeeler) -> None:
    front = dataclasses.replace(flat(), double_sided=False)
    turned = dataclasses.replace(quad(2.0, 9.0, front), transform=np.diag([-1.0, 1.0, 1.0, 1.0]))
    seen = accumulate(peeler, Scene("seen", (turned,)), camera_at(), Lens(0.1, 3.0), views=4)
    assert (seen[..., 3] == 1.0).all()  # a mirroring transform does not turn a face round
    about = np.diag([-1.0, 1.0, -1.0, 1.0])
    about[2, 3] = -4.0
    away = dataclasses.replace(turned, transform=about)
    assert not accumulate(peeler, Scene("away", (away,)), camera_at(), Lens(0.1, 3.0), views=4).any()


def test_jitter_smooths_edges_and_is_seeded(peeler: DepthPeeler) -> None:
    scene, camera, lens = Scene("edge", (quad(2.0, 0.3),)), camera_at(48, 48), Lens(0.0, 2.0)
    hard = accumulate(peeler, scene, camera, lens)
    smooth = accumulate(peeler, scene, camera, lens, views=64, jitter=True)
    assert set(np.unique(hard[..., 3])) == {0.0, 1.0}
    assert len(np.unique(smooth[..., 3])) > 5
    assert smooth[..., 3].sum() == pytest.approx((0.6 * camera.focal_px / 2.0) ** 2, rel=0.02)
    np.testing.assert_array_equal(smooth, accumulate(peeler, scene, camera, lens, views=64, jitter=True))
    assert (smooth != accumulate(peeler, scene, camera, lens, views=64, jitter=True, seed=1)).any()


def test_bad_arguments_are_refused(peeler: DepthPeeler) -> None:
    scene, lens = Scene("one", (quad(2.0),)), Lens(0.1, 2.0)
    with pytest.raises(InputError, match="views is 0"):
        accumulate(peeler, scene, camera_at(), lens, views=0)
    with pytest.raises(InputError, match="shape 'star'"):
        accumulate(peeler, scene, camera_at(), lens, shape="star")
