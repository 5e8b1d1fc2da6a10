"""The layered method against the accumulation reference through a Gaussian lens, on the scenes that we ship."""

import pytest

from cldof import Renderer
from cldof.capture.scenes import builtin_scenes
from cldof.host.device import DeviceInfo
from cldof.metrics import psnr
from tests.references import judged

# What is asked of each scene, in dB. Rods close to the lens should cut dark lines into the discs of the lamps behind
# them; blurs of layers, each by itself, cannot (docs/methods/layered.md). At this size the twigs before the sky are
# thinner than a pixel; at 512x512 they reach 30 dB too.
DEFAULT_DB, LEAST_DB = 30.0, {"lights": 24.0, "sky": 26.0}


@pytest.mark.parametrize("name", list(builtin_scenes()))
def test_every_scene_is_close_to_its_reference(name: str, device_info: DeviceInfo) -> None:
    """With default options and four peels; docs/methods/layered.md has the table at 512x512."""
    scene = judged(name, "gaussian")
    frame = scene.with_peels(4)
    with Renderer("layered", device=device_info.index) as renderer:
        reached = psnr(renderer.render(frame, scene.lens).image, scene.reference)
    without = psnr(frame.pinhole_image(), scene.reference)
    assert reached >= LEAST_DB.get(name, DEFAULT_DB)
    # Much closer than no blur at all, unless there is none to simulate.
    assert reached >= without + 4.0 or without > 40.0
