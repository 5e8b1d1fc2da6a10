"""Light: fourteen decades in one image, one blinding pixel, darkness, denormals, constants."""

from __future__ import annotations

import math

import numpy as np
import pytest

from cldof import Camera, LayeredFrame, Lens

from .conftest import Subject
from .promises import CAMERA, keep_promises, lens_at, one_plane

H, W = CAMERA.height, CAMERA.width


def decades(seed: int = 0) -> np.ndarray:
    """Opaque light from 1e-8 to 1e6, evenly over its logarithm."""
    image = np.ones((H, W, 4), np.float32)
    image[..., :3] = 10.0 ** np.random.default_rng(seed).uniform(-8.0, 6.0, (H, W, 3))
    return image


@pytest.mark.parametrize("coc_px", [0.0, 0.7, 4.0, 25.0])
def test_fourteen_decades(subject: Subject, coc_px: float) -> None:
    case = "1e-8..1e6 in one image"
    frame = one_plane(4.0, decades())
    image = subject.render(frame, lens_at(coc_px, 4.0, 2.0))
    keep_promises(subject, case, frame, image)
    darkest = float(frame.color[..., :3].min())
    subject.check(case, "darker than the darkest, share", max(0.0, 1.0 - image[..., :3].min() / darkest), 1e-3)


def test_the_dark_in_focus_before_glare(subject: Subject) -> None:
    """Light of 1e6 far behind focus does not reach into a dark thing in focus, whose pixels hide it."""
    case = "1e-8 in focus beside 1e6 behind"
    left = np.arange(W) < W // 2
    color = np.ones((H, W, 4), np.float32)
    color[..., :3] = np.where(left, 1e-8, 1e6)[None, :, None]
    frame = one_plane(np.where(left, 2.0, 20.0), color)
    image = subject.render(frame, Lens(6.0 * 2.0 / CAMERA.focal_px, 2.0))
    keep_promises(subject, case, frame, image)
    dark = image[:, left][:, :-1, :3]
    subject.check(case, "dark side off by, share", np.abs(dark / 1e-8 - 1.0).max(), 1e-3)


POINT = Camera(161, 161, 40.0)


def lamp(coc_px: float, background: float = 0.0, power: float = 1e6) -> tuple[LayeredFrame, Lens]:
    """One bright pixel of a plane behind focus."""
    image = np.ones((161, 161, 4), np.float32)
    image[..., :3] = background
    image[80, 80, :3] = power
    return one_plane(4.0, image, POINT), lens_at(coc_px, 4.0, 2.0, POINT)


@pytest.mark.parametrize("coc_px", [1.0, 3.0, 7.0, 14.0, 26.0])
def test_one_blinding_pixel(subject: Subject, coc_px: float) -> None:
    """A pixel of 1e6 in the dark: its energy within 0.5 %, nothing negative, no ring and no rectangle."""
    case = "one pixel of 1e6"
    frame, lens = lamp(coc_px)
    image = subject.render(frame, lens)
    keep_promises(subject, case, frame, image)
    light = image[..., 0] / 1e6
    subject.check(case, "energy off by, share", abs(light.sum() - 1.0), 0.005)
    y, x = np.mgrid[:161, :161] - 80
    if not subject.is_gaussian:
        beyond = light[np.hypot(x, y) > 1.25 * coc_px + 2.0].sum()
        subject.check(case, "light beyond the disc, share", beyond, 1e-6)
        return
    peak = light.max()
    along, across = light[80, 80:], np.diag(light)[80:]
    for ray in (along, light[80:, 80], across, np.diag(light[::-1])[80:]):
        subject.check(case, "rises outwards (a ring) / peak", max(0.0, np.diff(ray).max()) / peak, 1e-6)
    # Round where it would be seen: down to light of 1, or where filters end early, to a tenth of the peak.
    axis = np.interp(np.arange(len(across)) * math.sqrt(2.0), np.arange(len(along)), np.log(along + 1e-30))
    least = 0.1 * peak if subject.method == "pyramid" or subject.name == "layered single" else 1e-6
    seen = (across > least) & (np.arange(len(across)) * math.sqrt(2.0) <= 80)
    ratio = np.abs(np.log(across[seen]) - axis[seen]).max()
    bound = 1.0 if subject.method == "pyramid" else 0.7
    subject.check(case, "not round (a rectangle), log ratio", ratio, bound)


@pytest.mark.parametrize("coc_px", [0.0, 3.0, 30.0])
def test_darkness_stays_dark(method: Subject, coc_px: float) -> None:
    frame = one_plane(np.where(np.arange(W) < 20, 1.0, 4.0), np.broadcast_to(np.float32((0, 0, 0, 1)), (H, W, 4)))
    image = method.render(frame, lens_at(coc_px, 4.0, 2.0))
    method.check("black", "light", np.abs(image[..., :3]).max(), 0.0)
    keep_promises(method, "black", frame, image)


@pytest.mark.parametrize("coc_px", [0.0, 3.0, 30.0])
def test_denormals(method: Subject, coc_px: float) -> None:
    """Kept or flushed to zero, never anything else."""
    image = np.ones((H, W, 4), np.float32)
    image[..., :3] = np.random.default_rng(1).uniform(0.0, 1e-38, (H, W, 3)).astype(np.float32)
    frame = one_plane(np.where(np.arange(W) < 20, 1.0, 4.0), image)
    out = method.render(frame, lens_at(coc_px, 4.0, 2.0))
    method.check("denormals", "light below 0", max(0.0, -out[..., :3].min()), 0.0)
    method.check("denormals", "brightest light", out[..., :3].max(), 1.01e-38)
    method.check("denormals", "opaque: 1 - alpha", np.abs(out[..., 3] - 1.0).max(), 1e-3)


@pytest.mark.parametrize("value", [1e-8, 1.0, 1e6])
@pytest.mark.parametrize("coc_px", [0.5, 5.0, 60.0, 400.0])
def test_a_constant(subject: Subject, value: float, coc_px: float) -> None:
    """At any depths, a constant image stays itself."""
    image = np.full((H, W, 4), value, np.float32)
    image[..., 3] = 1.0
    y, x = np.mgrid[:H, :W]
    for depth in (np.full((H, W), 4.0), 1.0 / (0.05 + 0.02 * x), np.where((x // 9 + y // 9) % 2, 1.0, 8.0)):
        frame = one_plane(depth, image)
        out = subject.render(frame, lens_at(coc_px, 4.0, 2.0))
        subject.check("constant", "off by, share", np.abs(out[..., :3] / np.float32(value) - 1.0).max(), 1e-4)
        keep_promises(subject, "constant", frame, out)
