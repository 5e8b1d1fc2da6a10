"""What is glossy, shaded as the lens sees it by the methods that can."""

from __future__ import annotations

import numpy as np
import pytest

from cldof import Ambient, Environment, LayeredFrame, Lens, Lighting, Renderer
from cldof.host.device import DeviceInfo
from cldof.methods.multiview import Multiview, ray_sets
from tests.shaded import LIGHTS, colored_frame, environment, mirrored_by, shaded_frame

LENS = Lens(0.08, 1.5)


def render(info: DeviceInfo, frame: LayeredFrame, lens: Lens = LENS, **options: object) -> np.ndarray:
    with Renderer("multiview", device=info.index, rays=32, **options) as renderer:
        return renderer.render(frame, lens).image


def without_specular(frame: LayeredFrame) -> LayeredFrame:
    surface = {**frame.surface, "specular": np.zeros_like(frame.surface["specular"])}
    return LayeredFrame(
        frame.color, frame.depth, frame.camera, guard_px=frame.guard_px, lighting=frame.lighting, **surface
    )


def flat_frame(frame: LayeredFrame, depth_m: float) -> LayeredFrame:
    """The first layer, opaque, at one depth; colours without what surfaces mirror are grey."""

    surface = {name: array[:1] for name, array in frame.surface.items()}
    color = np.full((1, frame.height, frame.width, 4), 0.5, np.float32)
    color[..., 3] = 1.0
    depth = np.full(color.shape[:3], depth_m, np.float32)
    flat = LayeredFrame(color, depth, frame.camera, guard_px=frame.guard_px, lighting=frame.lighting, **surface)
    return colored_frame(flat)


@pytest.mark.parametrize(
    "lighting", [LIGHTS, Lighting(LIGHTS.lights, environment=environment())], ids=["lights", "map"]
)
@pytest.mark.parametrize("options", [{}, {"jitter": True}, {"traversal": "peels"}], ids=["rays", "jitter", "peels"])
def test_in_focus_the_mean_over_the_eyes(device_info: DeviceInfo, lighting: Lighting, options: dict) -> None:
    """A plane in focus does not move, so each pixel is grey and the mean of what it mirrors to all groups."""

    frame = flat_frame(shaded_frame(53, 22, lighting, guard_px=2), 1.5)
    method = Multiview(rays=32, eyes=8, **options)
    layers = method.plan(frame, LENS).structure
    assert layers.eyes == 8 and layers.total == 1
    eyes = ray_sets(method, LENS.aperture, 8).eyes * LENS.aperture_radius_m
    expected = 0.5 + np.mean([mirrored_by(frame, eye)[0] for eye in eyes], axis=0)
    image = render(device_info, frame, eyes=8, **options)
    # Narrow lobes: see the tolerance of shading_split.
    error = np.abs(image[..., :3] - expected[2:-2, 2:-2]) / (1.0 + expected[2:-2, 2:-2])
    assert np.quantile(error, 0.995) < 1e-3 and (image[..., 3] == 1.0).all()


def test_eyes_fill_the_lens() -> None:

    method = Multiview(rays=64, eyes=16, highlights=False)
    rays = ray_sets(method, LENS.aperture, 16)
    points = LENS.aperture.samples(64, 0)
    assert rays.ranges.shape[0] == 16 and (rays.ranges[..., 1] >= 1).all()
    assert (rays.ranges[:, -1, 1] == 4).all()
    # Every ray of every set belongs to one group, and groups of equal weight keep the centre and the spread.
    sums = rays.ranges[..., 1].sum(axis=0)
    assert sums[0] == 16 and sums[-1] == 64
    np.testing.assert_allclose(rays.eyes.mean(axis=0), points.mean(axis=0), atol=1e-9)
    assert 0.8 < rays.eyes.std() / points.std() < 1.0


def test_groups_add_up_to_all_rays(device_info: DeviceInfo) -> None:
    """Where all eyes see the same, the picture is that of one group, at any number of eyes."""
    frame = shaded_frame(70, 41, Lighting((), Ambient((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))), layers=3)
    plain = render(device_info, frame, view_dependent=False, adaptive=False)
    for eyes in (1, 5, 32):
        np.testing.assert_allclose(render(device_info, frame, eyes=eyes, adaptive=False), plain, atol=2e-5)


def test_voids_behind_glossy_things(device_info: DeviceInfo) -> None:
    frame = shaded_frame(70, 41, Lighting((), Ambient((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))), layers=3, opaque=False)
    assert not frame.is_opaque
    for traversal in ("layers", "peels"):
        plain = render(device_info, frame, view_dependent=False, adaptive=False, traversal=traversal)
        shaded = render(device_info, frame, adaptive=False, traversal=traversal)
        np.testing.assert_allclose(shaded, plain, atol=2e-5)


def test_matte_surfaces_keep_their_bits(device_info: DeviceInfo) -> None:
    matte = without_specular(shaded_frame(64, 40))
    np.testing.assert_array_equal(render(device_info, matte), render(device_info, matte, view_dependent=False))


def test_a_pinhole_shows_what_was_captured(device_info: DeviceInfo) -> None:
    frame = shaded_frame(64, 40, guard_px=3)
    pinhole = Lens(0.0, 1.5)
    image = render(device_info, frame, pinhole)
    np.testing.assert_array_equal(image, render(device_info, frame, pinhole, view_dependent=False))
    np.testing.assert_allclose(image, frame.pinhole_image(), atol=1e-5)
    # A lens next to a pinhole, too small for anyone to see, meets it but for rounding.
    close = render(device_info, frame, Lens(1e-7, 1.5))
    np.testing.assert_allclose(close, frame.pinhole_image(), atol=1e-5)


def test_a_highlight_out_of_sight_of_the_centre_appears(device_info: DeviceInfo) -> None:
    """The lens centre sees none of it, so that only shading from the lens's points can show it."""
    frame = shaded_frame(64, 40)
    off = render(device_info, frame, view_dependent=False)
    on = render(device_info, frame)
    assert np.abs(on - off).max() > 0.05 and (on >= 0.0).all() and np.isfinite(on).all()


@pytest.mark.parametrize("brightness", [0.0, 1.0])
def test_under_a_constant_environment(device_info: DeviceInfo, brightness: float) -> None:
    """All directions mirror the same; what is left is Fresnel's change over the lens, which is small."""
    around = Environment(np.full((4, 8, 3), brightness, np.float32))
    frame = shaded_frame(64, 40, Lighting((), environment=around))
    on, off = render(device_info, frame), render(device_info, frame, view_dependent=False)
    assert np.abs(on - off).mean() < 5e-3 * brightness + 2e-6


def test_nothing_glossy_costs_nothing(device_info: DeviceInfo) -> None:
    """A frame whose highlights are too wide for the lens takes the passes of one without surface buffers."""
    frame = shaded_frame(64, 40)
    with Renderer("multiview", device=device_info.index) as renderer:
        small = Lens(0.05 / frame.lobe_turn_per_m, 1.5)
        assert renderer.render(frame, small).plan.summary["eyes"] == 0
        assert renderer.render(frame, LENS).plan.summary["eyes"] == 16


def test_several_samples_a_pixel(device_info: DeviceInfo) -> None:
    """Groups add up to all rays there too, and glossy frames change."""
    dark = shaded_frame(70, 42, Lighting((), Ambient((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))), layers=3)
    plain = render(device_info, dark, view_dependent=False, adaptive=False, supersample=2, centred=False)
    assert plain.shape == (21, 35, 4)
    shaded = render(device_info, dark, adaptive=False, supersample=2, centred=False)
    np.testing.assert_allclose(shaded, plain, atol=2e-5)
    lit = shaded_frame(70, 42, layers=3)
    on = render(device_info, lit, supersample=2)
    assert np.abs(on - render(device_info, lit, supersample=2, view_dependent=False)).max() > 0.05
