"""Lenses: pinholes, hair's breadths, enormous apertures, odd foci, and blur that grows from nothing."""

from __future__ import annotations

import math

import numpy as np
import pytest

from cldof import Camera, InputError, LayeredFrame, Lens
from tests.frames import noise_frame

from .conftest import Subject
from .promises import CAMERA, keep_promises, lens_at, one_plane

H, W = CAMERA.height, CAMERA.width


def few_panes(frame: LayeredFrame) -> np.ndarray:
    """Pixels with at most two panes of glass: the light field keeps no more apart."""
    alpha = frame.color[..., 3]
    return ((alpha > 0) & (alpha < 0.999)).sum(axis=0) <= 2


@pytest.mark.parametrize("opaque", [True, False], ids=["opaque", "void"])
def test_a_pinhole(subject: Subject, opaque: bool) -> None:
    frame = noise_frame(W, H, opaque=opaque, seed=5)
    for focus_m in (1e-3, 2.0, math.inf):
        image = subject.render(frame, Lens(0.0, focus_m))
        pinhole = frame.pinhole_image()
        changed = np.abs(image - pinhole)[few_panes(frame)].max()
        subject.check("aperture 0", "differs from the pinhole image by", changed, 2e-6)


@pytest.mark.parametrize("opaque", [True, False], ids=["opaque", "void"])
def test_a_nanometre(method: Subject, opaque: bool) -> None:
    frame = noise_frame(W, H, opaque=opaque, seed=5)
    image = method.render(frame, Lens(1e-9, 2.0))
    keep_promises(method, "aperture 1e-9 m", frame, image)
    changed = np.abs(image - frame.pinhole_image())[few_panes(frame)].max()
    method.check("aperture 1e-9 m", "differs from the pinhole image by", changed, 1e-4)


@pytest.mark.parametrize("coc_px", [90.0, 1e3, 1e5, 1e7])
@pytest.mark.parametrize("opaque", [True, False], ids=["opaque", "void"])
def test_enormous(subject: Subject, coc_px: float, opaque: bool) -> None:
    """A circle of confusion larger than the image."""
    case = "CoC of 90 to 1e7 px"
    frame = noise_frame(W, H, opaque=opaque, seed=6)
    image = subject.render(frame, Lens(coc_px / CAMERA.focal_px, 1.7))
    keep_promises(subject, case, frame, image)
    white = one_plane(np.where(np.arange(W) < 30, 1.0, 4.0), np.ones((H, W, 4), np.float32))
    image = subject.render(white, Lens(coc_px / CAMERA.focal_px, 1.7))
    subject.check(case, "white stays white", np.abs(image - 1.0).max(), 1e-3)


@pytest.mark.parametrize("radius_m", [1e10, 1e12])
def test_absurd(method: Subject, radius_m: float) -> None:
    frame = one_plane(np.where(np.arange(W) < 30, 1.0, 4.0), np.ones((H, W, 4), np.float32))
    image = method.render(frame, Lens(radius_m, 1.7))
    method.check("aperture 1e10 and 1e12 m", "white stays white", np.abs(image - 1.0).max(), 1e-3)


@pytest.mark.parametrize("lens", [Lens(1e16, 1.7), Lens(1.0, 1e-30), Lens(1e307, 1.7), Lens(0.1, 5e-324)], ids=str)
def test_beyond_float32(method: Subject, lens: Lens) -> None:
    """What float32 cannot hold is refused, and the next frame is well."""
    frame = one_plane(3.0)
    with pytest.raises(InputError, match="smaller aperture"):
        method.render(frame, lens)
    assert np.isfinite(method.render(frame, Lens(0.01, 2.0))).all()


LENSES = {
    "focus at infinity": Lens(0.05, math.inf),
    "focus at the near plane": Lens(2e-3, 0.05),
    "focus just beyond the focal length": Lens.photographic(50.0, 2.0, np.nextafter(0.05, 1.0)),
    "f/0.5": Lens.photographic(50.0, 0.5, 2.0),
    "f/1.4": Lens.photographic(50.0, 1.4, 2.0),
    "f/64": Lens.photographic(50.0, 64.0, 2.0),
    "f/1e6": Lens.photographic(50.0, 1e6, 2.0),
    "focus at 1e-6 m": Lens(1e-6, 1e-6),
    "focus at 1e30 m": Lens(0.05, 1e30),
}


@pytest.mark.parametrize("name", LENSES)
def test_odd_lenses(method: Subject, name: str) -> None:
    for opaque in (True, False):
        frame = noise_frame(W, H, opaque=opaque, seed=7)
        image = method.render(frame, LENSES[name])
        keep_promises(method, name, frame, image)
    white = LayeredFrame(np.ones_like(frame.color), frame.depth, CAMERA)
    bound = 1e-3
    method.check(name, "white stays white", np.abs(method.render(white, LENSES[name]) - 1.0).max(), bound)


SWEEP = Camera(48, 24, 40.0)
STEPS_PX = np.arange(0.0, 3.005, 0.01)


def sweep(subject: Subject, side: float) -> np.ndarray:
    """Images of a white half beside a black one while their blur grows from 0 to 3 px."""
    image = np.ones((24, 48, 4), np.float32)
    image[:, :24, :3] = 0.0
    frame = one_plane(1.0 if side < 0 else 4.0, image, SWEEP)
    return np.stack([subject.render(frame, lens_at(coc, float(frame.depth[0, 0, 0]), 2.0, SWEEP)) for coc in STEPS_PX])


# The most that a pixel beside an edge of contrast 1 changes when the CoC radius grows by 0.01 px. A disc that grows
# evenly changes it by at most 0.01. Methods of samples take steps of a sample, and those of layers steps of a layer.
JUMP = {"gather": 0.012, "layered": 0.01, "lightfield": 0.01, "multiview": 0.01, "pyramid": 0.01, "pyramid paper": 0.25}
# How far the blur may be from the CoC radius, px. Between two sub-images a pyramid mixes sharp and blurred.
OFF = {
    "multiview": 0.2,
    "multiview peels": 0.2,
    "layered": 0.2,
    "layered single": 0.4,
    "layered paper": 0.7,
    "pyramid": 0.85,
    "pyramid paper": 2.4,
}


@pytest.mark.parametrize("side", [-1.0, 1.0], ids=["before", "behind"])
def test_blur_grows_evenly(subject: Subject, side: float) -> None:
    """CoC 0 to 3 px in steps of 0.01: continuous, never sharper again, opaque, as wide as it should be."""
    case = "CoC 0..3 px in steps of 0.01"
    images = sweep(subject, side)
    subject.check(case, "opaque: 1 - alpha", np.abs(images[..., 3] - 1.0).max(), 1e-5)
    rows = images[:, 4:-4, 4:-4, 0].mean(axis=1)  # samples differ from row to row in no method
    jump = np.abs(np.diff(images[:, 4:-4, 4:-4, 0], axis=0)).max()
    subject.check(case, "largest change in a step", jump, JUMP.get(subject.name, JUMP[subject.method]))
    # As a distribution over x the edge's derivative has the variance C^2 / 4 of a disc and of its Gaussian.
    profile = np.diff(rows, axis=1)
    x = np.arange(profile.shape[1]) - (profile.shape[1] - 1) / 2
    total = profile.sum(axis=1)
    subject.check(case, "edge loses contrast", np.abs(total - 1.0).max(), 2e-2)
    mean = (profile * x).sum(axis=1) / total
    subject.check(case, "edge moves by px", np.abs(mean).max(), 0.15)
    variance = (profile * x**2).sum(axis=1) / total - mean**2
    width = 2.0 * np.sqrt(np.maximum(variance, 0.0))
    subject.check(case, "gets sharper again by px", (np.maximum.accumulate(width) - width).max(), 0.05)
    subject.check(case, "CoC radius off by px", np.abs(width - STEPS_PX).max(), OFF.get(subject.name, 0.6))
