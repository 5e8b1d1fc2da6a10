"""A small frame, and what every method makes of it on a device that is known to be right.

The frame is made of whole numbers alone, so that it is the same everywhere. ``python -m cldof.doctor.sample`` writes
the expected images anew: a decision, since every driver is judged by them.
"""

from __future__ import annotations

import math
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..camera import Camera
from ..frame import LayeredFrame
from ..lens import Lens
from ..methods import METHODS

__all__ = ["LEAST_DB", "agreement_db", "expected", "sample_frame", "sample_lens"]

_WIDTH, _HEIGHT, _LAYERS = 48, 32, 3
_COC_PX = 4.0
_FILE = "expected.npz"

LEAST_DB = 60.0
"""Two correct drivers agree at 80 dB and better in all methods (docs/devices.md); what is wrong is far below this."""


def sample_frame() -> LayeredFrame:
    """Blocks at different depths, a slope behind them, a pane of glass, and sky."""
    y, x = np.mgrid[0:_HEIGHT, 0:_WIDTH]
    noise = np.stack([(x * 73 + y * 151 + 37 * c + x * y * 7) % 101 for c in range(3)], axis=-1) / 101.0
    color = np.empty((_LAYERS, _HEIGHT, _WIDTH, 4), np.float32)
    depth = np.empty((_LAYERS, _HEIGHT, _WIDTH), np.float32)
    blocks = (x // 9 + y // 7) % 3
    for m in range(_LAYERS):
        color[m, ..., :3] = (0.25 + 0.25 * m) * noise + 0.125 * (blocks == m)[..., None]
        color[m, ..., 3] = 1.0
        depth[m] = (m + 1) * (1.25 + 0.5 * blocks) + x / 64.0
    glass = (blocks == 1) & (y > 16)
    color[0, glass] *= np.float32(0.5)
    depth[-1][blocks == 2] = np.inf
    return LayeredFrame(color, depth, Camera(_WIDTH, _HEIGHT, 40.0))


def sample_lens() -> Lens:
    """A lens that blurs infinity by a few pixels."""
    return Lens(_COC_PX * 2.0 / sample_frame().camera.focal_px, 2.0)


def expected() -> dict[str, NDArray[np.float32]]:
    """The right image of every method, (H, W, 4)."""
    with files(__package__).joinpath(_FILE).open("rb") as file, np.load(file) as stored:
        return {name: stored[name] for name in METHODS}


def agreement_db(image: NDArray[np.float32], right: NDArray[np.float32]) -> float:
    """PSNR over all channels, for a peak of 1; inf for the same bits, -inf where a value is not finite."""
    if image.shape != right.shape or not np.isfinite(image).all():
        return -math.inf
    error = float(np.mean((image.astype(np.float64) - right) ** 2))
    return math.inf if error == 0.0 else -10.0 * math.log10(error)


def _write() -> None:
    from ..renderer import Renderer

    images: dict[str, Any] = {}
    for name in METHODS:
        with Renderer(name) as renderer:
            images[name] = renderer.render(sample_frame(), sample_lens()).image
    np.savez_compressed(Path(__file__).with_name(_FILE), **images)


if __name__ == "__main__":
    _write()
