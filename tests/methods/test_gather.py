"""The gather baseline end to end; tests/methods/test_promises.py has what it shares with all methods."""

import math

import numpy as np
import pytest

from cldof import Camera, InputError, LayeredFrame, Lens, Renderer
from cldof.host.device import DeviceInfo
from cldof.methods.gather import RADII, Gather, gather_taps
from tests.frames import noise_frame, plane_frame
from tests.oracles import gather as oracle
from tests.oracles.pyramid import EMPTY, flatten
from tests.tolerances import assert_close


def render(device_info: DeviceInfo, frame: LayeredFrame, lens: Lens, **options) -> np.ndarray:
    with Renderer("gather", device=device_info.index, **options) as renderer:
        return renderer.render(frame, lens).image


@pytest.mark.parametrize("opaque", [True, False], ids=["opaque", "void"])
@pytest.mark.parametrize("kernel", ["disc", "gaussian"])
def test_meets_the_oracle(device_info: DeviceInfo, opaque: bool, kernel: str) -> None:
    frame = noise_frame(91, 47, opaque=opaque, guard_px=5)
    lens = Lens(9.0 / frame.camera.focal_px, 1.7)
    inverse = 1.0 / frame.depth.astype(np.float64)
    if opaque:
        inverse[np.isinf(frame.depth) & (frame.color[..., 3] == 0)] = EMPTY
    image, inverse, _ = flatten(frame.color.astype(np.float64), inverse, 1, opaque, "true")
    coefficients = lens.coc_coefficients(frame.camera)
    expected = oracle.blur(image[0], inverse[0], *gather_taps(64, kernel), RADII, *coefficients, kernel == "disc")
    assert_close(render(device_info, frame, lens, kernel=kernel), expected[5:-5, 5:-5], "gather")


def point(depth: float) -> tuple[LayeredFrame, Lens]:
    image = np.zeros((81, 81, 4), np.float32)
    image[..., 3] = 1.0
    image[39:42, 39:42, :3] = 100.0
    frame = plane_frame(image, depth)
    return frame, Lens(24.0 / frame.camera.focal_px, 2.0)


@pytest.mark.parametrize("kernel", ["disc", "gaussian"])
def test_a_point_spreads_over_its_coc(device_info: DeviceInfo, kernel: str) -> None:
    frame, lens = point(6.0)
    light = render(device_info, frame, lens, kernel=kernel, samples=256)[..., 0].astype(np.float64)
    assert light.sum() == pytest.approx(900.0, rel=0.02)
    y, _ = np.mgrid[-40:41, -40:41]
    sigma = math.sqrt((light * y**2).sum() / light.sum())
    coc = float(lens.coc_radius_px(frame.camera, 6.0))
    assert sigma == pytest.approx(coc / 2.0, rel=0.06)  # of a uniform disc too
    if kernel == "disc":
        assert light[40, 40 + math.ceil(coc) + 3] == 0.0


def test_a_sharp_thing_does_not_bleed_into_what_is_behind(device_info: DeviceInfo) -> None:
    color = np.zeros((40, 80, 4), np.float32)
    color[..., 3] = 1.0
    color[:, :40, 0] = 1.0
    depth = np.full((40, 80), 20.0, np.float32)
    depth[:, :40] = 2.0
    frame = LayeredFrame(color, depth, Camera(80, 40, 40.0))
    lens = Lens(16.0 / frame.camera.focal_px, 2.0)
    aware, naive = (render(device_info, frame, lens, kernel=kernel)[..., 0] for kernel in ("disc", "gaussian"))
    np.testing.assert_array_equal(aware[:, :40], 1.0)
    assert aware[:, 43:].max() == 0.0
    assert naive[:, 43].min() > 0.05


@pytest.mark.parametrize("kernel", ["disc", "gaussian"])
@pytest.mark.parametrize("samples", [16, 64])
def test_nothing_jumps(device_info: DeviceInfo, kernel: str, samples: int) -> None:
    """Lenses a ten-thousandth apart make images nearly as close: through focus, into blur and from step to step."""
    frame = noise_frame(67, 45, seed=3)
    distances, change = np.geomspace(1.3, 6.0, 48), []
    with Renderer("gather", device=device_info.index, samples=samples, kernel=kernel) as renderer:
        for distance in distances:
            images = [
                renderer.render(frame, Lens(9.0 / frame.camera.focal_px, distance * near)).image for near in (1, 1.0001)
            ]
            change.append(np.abs(images[0] - images[1]).max())
    assert 0.0 < max(change) < 3e-3


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"samples": 0}, "samples is 0"),
        ({"samples": 5000}, "from 1 to 4096"),
        ({"samples": True}, "samples is True"),
        ({"kernel": "box"}, "choose one of disc, gaussian"),
    ],
)
def test_bad_options_are_refused(options: dict, message: str) -> None:
    with pytest.raises(InputError, match=message):
        Gather(**options)
