"""What every registered method promises (DESIGN section 4), through the renderer, with default options."""

import math
from collections.abc import Iterator

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from cldof import Camera, LayeredFrame, Lens, Renderer
from cldof.host.device import DeviceInfo
from cldof.methods import METHODS
from tests.frames import noise_frame, plane_frame


@pytest.fixture(scope="module", params=sorted(METHODS))
def renderer(request: pytest.FixtureRequest, device_info: DeviceInfo) -> Iterator[Renderer]:
    with Renderer(request.param, device=device_info.index) as renderer:
        yield renderer


def lens_for(frame: LayeredFrame, coc_px: float, focus_m: float = 2.0) -> Lens:
    """CoC radius at infinity is ``coc_px / focus_m``."""
    return Lens(coc_px / frame.camera.focal_px, focus_m)


@pytest.mark.parametrize("size", [(1, 1), (1, 23), (29, 1), (37, 21), (64, 48)])
def test_aperture_zero_is_the_pinhole_image(renderer: Renderer, size: tuple[int, int]) -> None:
    image = np.random.default_rng(0).random((size[1], size[0], 4), np.float32)
    image[..., 3] = 1.0
    np.testing.assert_array_equal(renderer.render(plane_frame(image, 3.0), Lens(0.0, 2.0)).image, image)


@pytest.mark.parametrize("depth", [0.4, 1.3, 1.99, 2.0, 2.01, 7.0, math.inf])
def test_a_constant_stays_constant(renderer: Renderer, depth: float) -> None:
    image = np.broadcast_to(np.float32((0.2, 30.0, 0.7, 1.0)), (40, 56, 4))
    frame = plane_frame(image, depth)
    np.testing.assert_allclose(renderer.render(frame, lens_for(frame, 12.0)).image, image, rtol=2e-5)


def test_the_plane_in_focus_stays(renderer: Renderer) -> None:
    image = np.random.default_rng(1).random((31, 70, 4), np.float32)
    image[..., 3] = 1.0
    frame = plane_frame(image, 2.0)
    np.testing.assert_allclose(renderer.render(frame, lens_for(frame, 30.0)).image, image, atol=1e-6)


@pytest.mark.parametrize("degrees", [0.0, 45.0, 85.0])
def test_opaque_stays_opaque(renderer: Renderer, degrees: float) -> None:
    camera = Camera(96, 72, 40.0)
    y = (np.arange(72) + 0.5 - 36) / camera.focal_px
    inverse = np.clip((1.0 - math.tan(math.radians(degrees)) * y) / 2.0, 0.02, 4.0)
    depth = np.broadcast_to(1.0 / inverse[:, None], (72, 96)).astype(np.float32)
    frame = LayeredFrame(np.ones((72, 96, 4), np.float32), depth, camera)
    image = renderer.render(frame, lens_for(frame, 6.0)).image
    assert np.abs(image[..., 3] - 1.0).max() <= 1e-3
    np.testing.assert_allclose(image[..., :3], 1.0, atol=1e-3)


def test_same_input_same_bits(renderer: Renderer) -> None:
    frame = noise_frame(75, 43, seed=3)
    first = renderer.render(frame, lens_for(frame, 8.0)).image
    for _ in range(5):
        np.testing.assert_array_equal(renderer.render(frame, lens_for(frame, 8.0)).image, first)


def test_nothing_stays_nothing(renderer: Renderer) -> None:
    depth = np.full((2, 20, 33), np.inf, np.float32)
    frame = LayeredFrame(np.zeros((2, 20, 33, 4), np.float32), depth, Camera(33, 20, 40.0))
    np.testing.assert_array_equal(renderer.render(frame, lens_for(frame, 9.0)).image, 0.0)


@settings(max_examples=20, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    width=st.integers(1, 60),
    height=st.integers(1, 40),
    layers=st.integers(1, 4),
    seed=st.integers(0, 10**6),
    opaque=st.booleans(),
    aperture_px=st.floats(0.0, 40.0),
    focus=st.floats(0.2, 50.0),
)
def test_random_frames_give_images(
    renderer: Renderer, width: int, height: int, layers: int, seed: int, opaque: bool, aperture_px: float, focus: float
) -> None:
    frame = noise_frame(width, height, layers, seed=seed, opaque=opaque)
    image = renderer.render(frame, lens_for(frame, aperture_px, focus)).image
    assert np.isfinite(image).all()
    assert image.min() >= -2e-3, "recursive Gaussians have tails of -1.7e-4"
    assert image[..., :3].max() <= frame.color[..., :3].max() * 1.01 + 1e-3
    assert image[..., 3].max() <= 1.0 + 1e-5
    if opaque:
        assert image[..., 3].min() >= 1.0 - 1e-3
