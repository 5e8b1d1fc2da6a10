"""What every method promises of every image (DESIGN section 4), as numbers against bounds."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from cldof import Camera, LayeredFrame, Lens

if TYPE_CHECKING:
    from .conftest import Subject

__all__ = ["CAMERA", "checkered", "keep_promises", "lens_at", "one_plane", "textured"]

CAMERA = Camera(61, 47, 40.0)

# Shares of the brightest light in the frame that rounding may add or take away.
_NEGATIVE = 0.0
_BRIGHTER = 2e-5
_ALPHA = 1e-5
_OPAQUE = 1e-3
# As published the pyramid has seams that division by coverage would repair.
_OPAQUE_OF = {"pyramid paper": 0.1}


def lens_at(coc_px: float, depth_m: float, focus_m: float, camera: Camera = CAMERA, **more: object) -> Lens:
    """A lens that blurs a depth by a CoC radius."""
    return Lens(abs(coc_px / (camera.focal_px * (1.0 / depth_m - 1.0 / focus_m))), focus_m, **more)


def textured(height: int, width: int, seed: int = 0) -> np.ndarray:
    """Opaque white noise, (height, width, 4)."""
    image = np.random.default_rng(seed).random((height, width, 4), np.float32)
    image[..., 3] = 1.0
    return image


def checkered(height: int, width: int, side: int = 6) -> np.ndarray:
    """Opaque black and white squares."""
    y, x = np.mgrid[:height, :width] // side
    image = np.ones((height, width, 4), np.float32)
    image[..., :3] = ((x + y) % 2)[..., None]
    return image


def one_plane(depth_m: float | np.ndarray, image: np.ndarray | None = None, camera: Camera = CAMERA) -> LayeredFrame:
    """A plane, noisy unless told otherwise, at one depth or many."""
    image = textured(camera.height, camera.width) if image is None else image
    depth = np.broadcast_to(np.float32(depth_m), (camera.height, camera.width))
    return LayeredFrame(image, np.ascontiguousarray(depth), camera)


def keep_promises(subject: Subject, case: str, frame: LayeredFrame, image: np.ndarray) -> None:
    """No light below 0 or above the brightest in the frame; alpha within 0 and 1, and 1 where all is opaque.

    Asked of the image, and if the last :meth:`Subject.render` made it, of what that rendered without a plan.
    """
    paint = frame.color[..., :3] / np.where(frame.color[..., 3:] > 0, frame.color[..., 3:], 1.0)
    scale = float(paint.max()) or 1.0
    for one in (image,) if subject.full is None or subject.shown is not image else (image, subject.full):
        _keep(subject, case, one, scale, frame.is_opaque)


def _keep(subject: Subject, case: str, image: np.ndarray, scale: float, is_opaque: bool) -> None:
    alpha = image[..., 3]
    above = (image[..., :3] - (1.0 + _BRIGHTER) * scale * alpha[..., None]).max()
    subject.check(case, "light below 0 / brightest", max(0.0, -image[..., :3].min()) / scale, _NEGATIVE)
    subject.check(case, "light above alpha * brightest / brightest", max(0.0, above) / scale, _BRIGHTER)
    subject.check(case, "alpha outside 0..1", max(0.0, -alpha.min(), alpha.max() - 1.0), _ALPHA)
    if is_opaque:
        subject.check(case, "opaque: 1 - alpha", 1.0 - alpha.min(), _OPAQUE_OF.get(subject.name, _OPAQUE))
