"""Differential: methods against exact convolutions where theory says equal, against each other, against their twins."""

from __future__ import annotations

import math

import numpy as np
import pytest

from cldof import Camera, LayeredFrame
from cldof.lens import GAUSSIAN_SIGMA
from tests.oracles import gaussian as gaussian_oracle
from tests.oracles import plane as plane_oracle

from .conftest import Subject
from .promises import lens_at, one_plane

CAMERA = Camera(97, 83, 40.0)


def smooth() -> np.ndarray:
    """Light that changes over 9 pixels and more: methods differ in how they sample, not in what they blur."""
    y, x = np.mgrid[: CAMERA.height, : CAMERA.width].astype(float)
    image = np.ones((CAMERA.height, CAMERA.width, 4))
    for channel, (fx, fy, phase) in enumerate(((9.0, 23.0, 0.1), (17.0, 11.0, 1.0), (31.0, 13.0, 2.0))):
        image[..., channel] = 0.5 + 0.5 * np.sin(2 * math.pi * x / fx + phase) * np.cos(2 * math.pi * y / fy)
    return image.astype(np.float32)


# RMS error on one plane against the exact convolution.
EXACT = {
    "gather": 0.01,
    "layered": 0.01,
    "layered paper": 0.04,
    "lightfield": 0.01,
    "multiview": 0.015,
    "pyramid": 0.06,
    "pyramid paper": 0.06,
}


@pytest.mark.parametrize("coc_px", [0.6, 1.5, 4.0, 9.0])
@pytest.mark.parametrize("side", [-1.0, 1.0], ids=["before", "behind"])
def test_one_plane_is_a_convolution(subject: Subject, coc_px: float, side: float) -> None:
    """With the disc for methods of discs, with the Gaussian of the same width for the others."""
    image, depth = smooth(), 1.0 if side < 0 else 4.0
    out = subject.render(one_plane(depth, image, CAMERA), lens_at(coc_px, depth, 2.0, CAMERA))
    if subject.is_gaussian:
        expected = gaussian_oracle.blur(image, gaussian_oracle.exact_taps(GAUSSIAN_SIGMA * coc_px))
    else:
        expected = plane_oracle.disc_blur(image.astype(np.float64), coc_px)
    inner = (slice(14, -14), slice(14, -14))
    error = np.sqrt(((out - expected)[inner][..., :3] ** 2).mean())
    bound = EXACT.get(subject.name, EXACT[subject.method])
    subject.check("one plane", "RMS against the exact convolution", error, bound)


@pytest.mark.parametrize("coc_px", [2.0, 7.0])
def test_methods_agree(subjects, device_info, coc_px: float) -> None:  # type: ignore[no-untyped-def]
    """On two planes, a thing before a wall in focus, methods of one lens see the same."""
    image = np.stack([smooth(), smooth()[::-1].copy()])
    depth = np.full(image.shape[:3], 2.0, np.float32)
    y, x = np.mgrid[: CAMERA.height, : CAMERA.width]
    where = np.hypot(x - 48, y - 41) < 22
    depth[0][where] = 1.0
    image[0][~where] = image[1][~where]
    image[1][~where], depth[1][~where] = 0.0, np.inf
    frame = LayeredFrame(image, depth, CAMERA)
    lens = lens_at(coc_px, 1.0, 2.0, CAMERA)
    out = {name: subjects(name).render(frame, lens)[10:-10, 10:-10, :3] for name in ("lightfield", "multiview")}
    error = np.sqrt(((out["lightfield"] - out["multiview"]) ** 2).mean())
    subjects("lightfield").check("two planes", "RMS against multiview", error, 0.015)
    out = {name: subjects(name).render(frame, lens)[10:-10, 10:-10, :3] for name in ("layered", "pyramid")}
    error = np.sqrt(((out["layered"] - out["pyramid"]) ** 2).mean())
    subjects("pyramid").check("two planes", "RMS against layered", error, 0.06)


PAIRS = [
    ("layered", "layered iir", 3e-3),
    ("layered", "layered single", 0.06),
    ("lightfield", "lightfield atomic", 0.0),
    ("multiview", "multiview peels", 0.03),
]


@pytest.mark.parametrize(("one", "other", "bound"), PAIRS)
def test_engines_agree(subjects, one: str, other: str, bound: float) -> None:  # type: ignore[no-untyped-def]
    """FIR and recursive filters, cascade and single blurs, warps with and without atomics, layers and peels."""
    from tests.frames import noise_frame

    frame = noise_frame(CAMERA.width, CAMERA.height, seed=4)
    worst = 0.0
    for coc_px in (1.0, 6.0, 15.0):
        lens = lens_at(coc_px, 0.8, 1.7, CAMERA)
        images = [subjects(name).render(frame, lens) for name in (one, other)]
        worst = max(worst, float(np.sqrt(((images[0] - images[1]) ** 2).mean())))
    subjects(other).check("engines and traversals", f"RMS against {one}", worst, bound)
