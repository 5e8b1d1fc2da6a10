"""The gather blur in float64, sample by sample."""

import numpy as np


def blur(
    image: np.ndarray, inverse: np.ndarray, samples: np.ndarray, c1: float, c0: float, depth_aware: bool
) -> np.ndarray:
    """Gather around every pixel.

    Parameters
    ----------
    image : (H, W, 4)
    inverse : (H, W)
        1/m.
    samples : (N, 3)
        x, y and distance from the middle in CoC radii.
    c1, c0 : float
        CoC radius in px = c1 * inverse + c0.
    """
    height, width = inverse.shape
    y, x = np.mgrid[:height, :width]
    coc = c1 * inverse + c0
    radius = np.abs(coc)
    total, weights = np.zeros(image.shape), np.zeros(inverse.shape)
    for dx, dy, distance in samples:
        # to the nearest pixel, halves towards the right and down
        qx = np.clip(np.trunc(x + radius * dx + 0.5), 0, width - 1).astype(int)
        qy = np.clip(np.trunc(y + radius * dy + 0.5), 0, height - 1).astype(int)
        weight = np.ones(inverse.shape)
        if depth_aware:
            theirs = coc[qy, qx]
            weight = np.where(theirs > coc, 1.0, np.clip(np.abs(theirs) - radius * distance + 1.0, 0.0, 1.0))
        total += weight[..., None] * image[qy, qx]
        weights += weight
    gathered = total / np.maximum(weights, 1e-3)[..., None]
    return np.where(((radius < 0.5) | (weights <= 1e-3))[..., None], image, gathered)
