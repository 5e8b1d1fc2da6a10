"""The gather blur in float64, tap by tap."""

import numpy as np


def blur(
    image: np.ndarray,
    inverse: np.ndarray,
    taps: np.ndarray,
    first: np.ndarray,
    radii: np.ndarray,
    c1: float,
    c0: float,
    depth_aware: bool,
) -> np.ndarray:
    """Gather around every pixel.

    Parameters
    ----------
    image : (H, W, 4)
    inverse : (H, W)
        1/m.
    taps, first
        What :func:`cldof.methods.gather.gather_taps` gives out.
    radii : (steps + 1,)
        Ends of the steps, px.
    c1, c0 : float
        CoC radius in px = c1 * inverse + c0.
    """
    height, width = inverse.shape
    coc = c1 * inverse + c0
    radius = np.minimum(np.abs(coc), radii[-1])
    steps = np.minimum(np.searchsorted(radii, radius, side="right") - 1, len(radii) - 2)
    result = image.copy()
    for step in np.unique(steps[steps >= 0]):
        y, x = np.nonzero(steps == step)
        own, ends = radius[y, x], radii[step : step + 2]
        total, weights = np.zeros((len(y), 4)), np.zeros(len(y))
        for tap in taps[first[step] : first[step + 1]]:
            there = np.clip(y + tap["dy"], 0, height - 1), np.clip(x + tap["dx"], 0, width - 1)
            weight = np.interp(own, ends, (tap["weight"], float(tap["weight"]) + float(tap["change"])))
            if depth_aware:
                theirs = coc[there]
                reach = np.clip(np.abs(theirs) - np.minimum(np.hypot(tap["dx"], tap["dy"]), own) + 1.0, 0.0, 1.0)
                weight = weight * np.where(theirs > coc[y, x], 1.0, reach)
            total += weight[:, None] * image[there]
            weights += weight
        result[y, x] = total / weights[:, None]
    return result
