"""Exact images of single planes through a lens, in float64: lens rays against a plane that shows a function of place.

In pixels and signed CoC radii C a lens ray through pixel p and lens point v (x right, y up) is straight,
``q = p + C * (-v.x, v.y)``, y down; and C is an affine function of the pixel over any plane, tilted or not.
"""

from collections.abc import Callable

import numpy as np

Shade = Callable[[np.ndarray, np.ndarray], np.ndarray]


def tilted(
    shade: Shade, size: tuple[int, int], middle_coc: float, slope: float, points: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """A plane that recedes along y.

    Parameters
    ----------
    shade : callable
        Light at ``(x, y)`` in pixels, 0 at the first pixel's middle.
    size : (int, int)
        (height, width).
    middle_coc, slope : float
        ``C = middle_coc + slope * (y - (height - 1) / 2)``; ``|slope| * |v.y|`` has to stay below 1.
    points : ndarray, (N, 2)
        On the lens.

    Returns
    -------
    image : ndarray, (height, width)
    reach : ndarray, (height, 2)
        The rows that each row's rays meet, first and last.
    """
    height, width = size
    y, x = np.mgrid[:height, :width].astype(np.float64)
    image = np.zeros(size)
    reach = np.stack([y[:, 0], y[:, 0]], axis=1)
    start = middle_coc - slope * (height - 1) / 2
    for vx, vy in points:
        qy = (y + vy * start) / (1.0 - vy * slope)
        coc = start + slope * qy
        image += shade(x - coc * vx, qy)
        reach[:, 0], reach[:, 1] = np.minimum(reach[:, 0], qy[:, 0]), np.maximum(reach[:, 1], qy[:, 0])
    return image / len(points), reach


def disc_blur(image: np.ndarray, radius: float) -> np.ndarray:
    """Convolution of pixels (as points) with a disc by exact area: each offset weighs as much as the disc covers of it.

    Edges repeat. ``image`` is (H, W) or (H, W, C).
    """
    weights = disc_weights(radius)
    half = len(weights) // 2
    padded = np.pad(image, [(half, half), (half, half)] + [(0, 0)] * (image.ndim - 2), mode="edge")
    out = np.zeros(image.shape)
    height, width = image.shape[:2]
    for dy, dx in np.argwhere(weights > 0):
        out += weights[dy, dx] * padded[dy : dy + height, dx : dx + width]
    return out


def disc_weights(radius: float, fine: int = 32) -> np.ndarray:
    """Share of a disc's area in each pixel around its middle, (2n + 1, 2n + 1)."""
    half = int(np.ceil(radius + 0.5))
    if radius == 0.0:
        return np.ones((1, 1))
    at = (np.arange((2 * half + 1) * fine) + 0.5) / fine - half - 0.5
    inside = np.hypot(at[:, None], at[None, :]) <= radius
    shares = inside.reshape(2 * half + 1, fine, 2 * half + 1, fine).sum(axis=(1, 3)).astype(np.float64)
    if shares.sum() == 0.0:
        shares[half, half] = 1.0
    return shares / shares.sum()
