"""The layered method against the accumulation reference through a Gaussian lens, on the scenes that we ship."""

import math

import numpy as np
import pytest

from cldof import Lens, Renderer
from cldof.capture.scenes import builtin_scene, builtin_scenes
from cldof.host.device import DeviceInfo
from tests.opengl import require_opengl

SIZE = 256


def psnr(image: np.ndarray, reference: np.ndarray) -> float:
    """Linear RGB, clipped to [0, 1]."""
    difference = np.clip(image[..., :3], 0, 1).astype(np.float64) - np.clip(reference[..., :3], 0, 1)
    return -10.0 * math.log10(float((difference**2).mean()))


@pytest.mark.parametrize("name", list(builtin_scenes()))
def test_every_scene_is_close_to_its_reference(name: str, device_info: DeviceInfo) -> None:
    """At least 30 dB with the default options; the table of docs/methods/layered.md is made at 512x512."""
    require_opengl()
    from cldof.capture import accumulate, peel

    scene = builtin_scene(name)
    camera = scene.camera_for(SIZE, SIZE)
    assert scene.aperture_radius_m is not None
    assert scene.focus_distance_m is not None
    lens = Lens(scene.aperture_radius_m, scene.focus_distance_m)
    with peel.DepthPeeler(SIZE, SIZE) as peeler:
        frame = peeler.peel(scene, camera, layers=4, lens=lens, guard_px=8)
        reference = accumulate.accumulate(peeler, scene, camera, lens, views=128, shape="gaussian")
    with Renderer("layered", device=device_info.index) as renderer:
        image = renderer.render(frame, lens).image
    reference = getattr(reference, "image", reference)
    assert psnr(image, reference) >= 30.0
    # Closer than no blur at all by far, or the scene would show nothing.
    assert psnr(image, reference) >= psnr(frame.pinhole_image(), reference) + 4.0
