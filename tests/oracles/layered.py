"""The layered method in float64, from Schedl & Wimmer 2012 and the choices in docs/decisions.md."""

import math
from collections.abc import Callable

import numpy as np

from . import gaussian


def over(front: np.ndarray, back: np.ndarray) -> np.ndarray:
    return front + (1.0 - front[..., 3:]) * back


class Anchors:
    """z_k as a CoC, for k = -2 .. K."""

    def __init__(self, coc: np.ndarray, midpoint: bool) -> None:
        self._coc, self._midpoint = coc, midpoint

    def __getitem__(self, k: int) -> float:
        if self._midpoint:
            return 0.5 * (self._layer(k) + self._layer(k + 1))  # eq. 9
        return self._layer(k)

    def _layer(self, k: int) -> float:
        coc, count = self._coc, len(self._coc)
        if k < 0:
            return coc[0] + k * (coc[1] - coc[0])
        if k >= count:
            return coc[-1] + (k - count + 1) * (coc[-1] - coc[-2])
        return coc[k]


def slope(coc: np.ndarray, silhouette: float) -> np.ndarray:
    """Change of the CoC from pixel to pixel, (H, W): the lesser of two sides, the greater of two directions.

    Steps above `silhouette` do not count.
    """
    steps = []
    for axis in (0, 1):
        step = np.abs(np.diff(coc, axis=axis))
        step[~(step <= silhouette)] = np.nan
        ahead, behind = np.full_like(coc, np.nan), np.full_like(coc, np.nan)
        at = [slice(None)] * 2
        at[axis] = slice(None, -1)
        ahead[tuple(at)] = step
        at[axis] = slice(1, None)
        behind[tuple(at)] = step
        steps.append(np.nan_to_num(np.fmin(ahead, behind)))
    return np.maximum(*steps)


def breadth(coc: np.ndarray, radius: int, step: float) -> np.ndarray:
    """Share of eight pixels around each that belong to its surface or hide it, (H, W)."""
    height, width = coc.shape
    y, x = np.mgrid[:height, :width]
    near = max(1, radius * 7 // 10)
    found = np.zeros(coc.shape)
    for dx, dy in ((radius, 0), (0, radius), (near, near), (-near, near)):
        ends = []
        for row, column in ((y - dy, x - dx), (y + dy, x + dx)):
            inside = (row >= 0) & (row < height) & (column >= 0) & (column < width)
            end = coc[np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)]
            ends.append(np.where(inside, end, coc - step))  # beyond the frame surfaces go on, and may slope
        for end, opposite in (ends, ends[::-1]):  # all of what lies on a plane, none of what is a step farther
            found += np.nan_to_num(np.clip(1.0 - (end - coc - np.fmax(coc - opposite, 0.0)) / step, 0.0, 1.0))
    return found / 8


def weights(coc: np.ndarray, alpha: np.ndarray, layers: np.ndarray, paper: bool) -> np.ndarray:
    """Weight of every slot in every layer.

    Parameters
    ----------
    coc, alpha : (M, H, W)
        Signed CoC radius of each slot, NaN for slots with nothing in them; its alpha.
    layers : (K,)
        CoC of each layer.

    Returns
    -------
    (K, M, H, W)
    """
    count = len(layers)
    result = np.zeros((count, *coc.shape))
    if count == 1:
        result[0] = ~np.isnan(coc)
        return result
    z = Anchors(layers, midpoint=paper)
    sigma = np.abs(layers) / 2.0
    for k in range(count):
        rise_width, fall_width = z[k - 1] - z[k - 2], z[k + 1] - z[k]
        widest = max(sigma[k], sigma[k - 1]) if k else sigma[k]
        for m in range(len(coc)):
            c = coc[m]
            before = coc[m - 1] if m else np.full_like(c, -np.inf)
            rising = np.full_like(c, np.inf) if k == 0 else (c - z[k - 2]) / rise_width
            falling = np.full_like(c, np.inf) if k == count - 1 else (z[k + 1] - c) / fall_width
            fall = np.clip(falling, 0, 1)
            if paper:
                rise = np.clip(rising, 0, 1)
                if m:
                    fall = (falling >= 1).astype(float)
            else:
                part = np.clip(slope(c, rise_width) / rise_width * 2.0 * widest, 1e-3, 1.0)
                early = np.clip(1.0 + (rising - 1.0) / part, 0, 1)
                if k > 0 and m == 0:
                    broad = breadth(c, max(1, math.ceil(widest)), z[k] - z[k - 1])
                    early = early * np.clip(2.0 * broad - 1.0, 0, 1)
                rise = np.where(rising >= 1, 1.0, early)
                may_fall = np.full(c.shape, k == count - 1) | (before <= z[k])
                fall = np.where(may_fall, fall, (falling >= 1).astype(float))
            weight = rise * fall
            if not paper:
                into = np.ones_like(c)  # how far the slot is into the layer's own interval
                if k > 0:
                    into = np.where(before <= z[k - 1], np.clip((c - z[k - 1]) / (z[k] - z[k - 1]), -np.inf, 1), 1.0)
                if k > 0 and m == 0:
                    others = 1 - (1 - into) * broad
                    is_own = (rising >= 1) & (falling >= 1) & (into < 1)
                    weight = np.where(is_own, np.where(others > 1e-3, into / np.maximum(others, 1e-3), 1.0), weight)
                with np.errstate(divide="ignore", invalid="ignore"):
                    shared = np.where(falling < 1, weight, into / np.maximum(1 - (1 - into) * alpha[m], 1e-3))
                weight = np.where(alpha[m] < 0.998, np.where(rising >= 1, shared, 0.0), weight)
            result[k, m] = np.where(np.isnan(c), 0.0, weight)
    return result


def compose_layer(color: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Eq. 2: the weighted peels of one layer, front to back."""
    layer = np.zeros(color.shape[1:])
    for slot, w in zip(color, weight, strict=True):
        layer = over(layer, slot * w[..., np.newaxis])
    return layer


def render(
    color: np.ndarray,
    depth: np.ndarray,
    c1: float,
    c0: float,
    layers: np.ndarray,
    focus: int,
    taps_of: Callable[[int], np.ndarray],
    *,
    cascade: bool = True,
    paper: bool = False,
    opaque: bool = True,
    guard: int = 0,
) -> np.ndarray:
    """The whole frame.

    Parameters
    ----------
    color, depth
        As in :class:`cldof.LayeredFrame`.
    layers : (K,)
        CoC of each layer, `focus` the index of the one in focus.
    taps_of : callable
        Filter of a layer: the step after it (cascade) or its whole blur.
    """
    color = color.astype(np.float64)
    nothing = np.isinf(depth) & (color[..., 3] == 0)
    coc = c1 / depth.astype(np.float64) + c0
    if opaque:
        coc[nothing] = np.nan
        image = _compose(color, coc, layers, focus, taps_of, cascade, paper)
        alpha = None
    else:
        covered, surfaces = color.copy(), np.zeros_like(color)
        covered[nothing] = (0, 0, 0, 1)
        covered[-1, ..., 3] = 1.0  # the void behind the last slot stands at its depth
        surfaces[..., 0] = color[..., 3]
        surfaces[..., 3] = covered[..., 3]
        image = _compose(covered, coc, layers, focus, taps_of, cascade, paper)
        alpha = _compose(surfaces, coc, layers, focus, taps_of, cascade, paper)
    coverage = image[..., 3:]
    known = coverage > 1e-4
    safe = np.where(known, coverage, 1.0)
    result = np.where(known, image / safe, 0.0)
    if alpha is not None:
        result[..., 3] = np.where(known[..., 0], np.minimum(alpha[..., 0] / safe[..., 0], 1.0), 0.0)
    inner = slice(guard, -guard or None)
    return result[inner, inner]


def _compose(
    color: np.ndarray,
    coc: np.ndarray,
    layers: np.ndarray,
    focus: int,
    taps_of: Callable[[int], np.ndarray],
    cascade: bool,
    paper: bool,
) -> np.ndarray:
    weight = weights(coc, color[..., 3], layers, paper)
    parts = [compose_layer(color, weight[k]) for k in range(len(layers))]
    if not cascade:
        image = np.zeros(color.shape[1:])
        for k, part in enumerate(parts):
            image = over(image, gaussian.blur(part, taps_of(k)))
        return image
    front = back = np.zeros(color.shape[1:])
    for k in range(focus):  # eq. 13
        front = gaussian.blur(over(front, parts[k]), taps_of(k))
    for k in range(len(layers) - 1, focus, -1):
        back = gaussian.blur(over(parts[k], back), taps_of(k))
    return over(front, over(parts[focus], back))  # eq. 12
