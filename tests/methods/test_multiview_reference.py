"""The multiview method against the accumulation reference through a disc, on the scenes that we ship."""

import math

import numpy as np
import pytest

from cldof import Renderer
from cldof.capture.scenes import builtin_scene, builtin_scenes
from cldof.host.device import DeviceInfo
from cldof.metrics import psnr
from tests.references import SIZE, judged

# At this size a pixel of a twig or lamp counts for much more than at 512x512. Twigs in focus and lamps a pixel wide are
# sampled at one point a pixel by the layers, at one a view by the reference: docs/methods/multiview.md, where it errs.
# Scenes whose highlights move with the point on the lens that looks.
GLOSSY = {"floor", "mirrors"}
DEFAULT_DB, LEAST_DB = 33.5, {"tabletop": 30.5, "floor": 30.0, "sky": 25.0, "lights": 23.0}


@pytest.mark.parametrize("name", list(builtin_scenes()))
def test_every_scene_is_close_to_its_reference(name: str, device_info: DeviceInfo) -> None:
    """With default options; the table of docs/methods/multiview.md is made at 512x512."""
    scene = judged(name, "disc", view_dependent=name in GLOSSY)
    with Renderer("multiview", device=device_info.index) as renderer:
        reached = psnr(renderer.render(scene.frame, scene.lens).image, scene.reference)
    assert reached >= LEAST_DB.get(name, DEFAULT_DB)


def test_crossing_branches_stand_apart(device_info: DeviceInfo) -> None:
    """Boughs before and behind the focus that cross in the pinhole image are seen beside each other through a lens.

    Whatever blurs the pinhole image cannot show that, so each part of the picture is compared by itself.
    """
    scene = judged("branches", "disc")
    with Renderer("multiview", device=device_info.index) as renderer:
        image = renderer.render(scene.frame, scene.lens).image
    pinhole = scene.frame.pinhole_image()
    parts = [np.s_[y : y + 32, x : x + 32] for y in range(0, SIZE, 32) for x in range(0, SIZE, 32)]
    through_lens = [psnr(image[part], scene.reference[part]) for part in parts]
    without = [psnr(pinhole[part], scene.reference[part]) for part in parts]
    assert min(through_lens) >= 28.0
    assert min(without) <= 18.0


@pytest.mark.parametrize(
    ("name", "gain_db", "least_db"), [("sky", 3.0, 28.5), ("lights", 3.0, 30.0), ("plane", -1.0, 0.0)]
)
def test_several_samples_a_pixel_show_what_one_cannot(
    name: str, gain_db: float, least_db: float, device_info: DeviceInfo
) -> None:
    """Twigs in focus and lamps a pixel wide, captured three times as large; rays are as many as without.

    Textures far from their own size, as of plane, are no worse for it.
    """
    from cldof.capture.peel import DepthPeeler

    one = judged(name, "disc")
    camera = builtin_scene(name).camera_for(SIZE, SIZE).supersampled(3)
    guard = 3 * one.frame.guard_px
    with DepthPeeler(camera.width, camera.height) as peeler:
        frame = peeler.peel(builtin_scene(name), camera, layers=6, lens=one.lens, guard_px=guard, lod_bias=math.log2(3))
    with Renderer("multiview", device=device_info.index) as renderer:
        single = psnr(renderer.render(one.frame, one.lens).image, one.reference)
    with Renderer("multiview", device=device_info.index, supersample=3, antialias=False) as renderer:
        image = renderer.render(frame, one.lens).image
    assert image.shape == one.reference.shape
    assert psnr(image, one.reference) >= max(least_db, single + gain_db)


def test_view_dependent_shading_shows(device_info: DeviceInfo) -> None:
    """Bar of the issue: 10 dB better than shading from the lens centre, and above 36 dB (the paper: 41.4 and 27.7)."""
    scene = judged("mirrors", "disc", view_dependent=True)
    reached = {}
    for on in (True, False):
        with Renderer("multiview", device=device_info.index, view_dependent=on) as renderer:
            reached[on] = psnr(renderer.render(scene.frame, scene.lens).image, scene.reference)
    assert reached[True] >= 38.5
    assert reached[True] >= reached[False] + 10.0


def test_polished_floors_gain_what_there_is_to_gain(device_info: DeviceInfo) -> None:
    """On floor, shading from the centre costs little beside lamps a pixel wide; all of that is won back."""
    scene, centre = judged("floor", "disc", view_dependent=True), judged("floor", "disc")
    with Renderer("multiview", device=device_info.index) as renderer:
        reached = psnr(renderer.render(scene.frame, scene.lens).image, scene.reference)
        blur_alone = psnr(renderer.render(centre.frame, centre.lens).image, centre.reference)
        without = psnr(renderer.render(centre.frame, centre.lens).image, scene.reference)
    assert reached >= without + 0.5 and reached >= blur_alone - 0.3
