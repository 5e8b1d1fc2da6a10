"""Images as data URIs: what a run keeps for its page."""

from __future__ import annotations

import base64
import io

import numpy as np
from numpy.typing import NDArray
from PIL import Image as PillowImage

from ..images import srgb8_from_linear

__all__ = ["ERROR_FULL_SCALE", "data_uri", "error_map"]

# The error (linear light, largest channel) that is shown brightest; the scale is a square root, so that 1 % is seen.
ERROR_FULL_SCALE = 0.25
_STOPS = np.array([0.0, 0.25, 0.5, 0.75, 1.0])
_COLORS = np.array([(0, 0, 4), (80, 18, 123), (182, 54, 121), (251, 136, 97), (252, 253, 191)], np.float64)
_QUALITY = 90


def error_map(image: NDArray[np.float32], reference: NDArray[np.float32]) -> NDArray[np.uint8]:
    """(H, W, 3): the largest difference of any channel, dark where there is none."""
    difference = np.abs(np.asarray(image, np.float64) - reference).max(axis=-1)
    level = np.sqrt(np.clip(difference / ERROR_FULL_SCALE, 0.0, 1.0))
    channels = [np.interp(level, _STOPS, _COLORS[:, channel]) for channel in range(3)]
    return np.asarray(np.rint(np.stack(channels, axis=-1)), np.uint8)


def data_uri(image: NDArray[np.float32] | NDArray[np.uint8]) -> str:
    """WebP as a ``data:`` URI; float images are linear light with premultiplied alpha."""
    pixels = image if image.dtype == np.uint8 else srgb8_from_linear(image)
    stream = io.BytesIO()
    PillowImage.fromarray(pixels).save(stream, "WEBP", quality=_QUALITY, method=4)
    return "data:image/webp;base64," + base64.b64encode(stream.getvalue()).decode("ascii")
