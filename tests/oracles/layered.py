"""The layered method in float64, from Schedl & Wimmer 2012 and the choices in docs/decisions.md."""

from collections.abc import Callable

import numpy as np

from . import gaussian


def over(front: np.ndarray, back: np.ndarray) -> np.ndarray:
    return front + (1.0 - front[..., 3:]) * back


class Anchors:
    """z_k as a CoC, for k = -2 .. K."""

    def __init__(self, coc: np.ndarray, kind: str) -> None:
        self.count = len(coc)
        first, last = coc[1] - coc[0], coc[-1] - coc[-2]
        self._coc = lambda k: (
            coc[k] if 0 <= k < self.count else coc[0] + k * first if k < 0 else coc[-1] + (k - self.count + 1) * last
        )
        self._kind = kind

    def __getitem__(self, k: int) -> float:
        if self._kind == "layer":
            return self._coc(k)
        return 0.5 * (self._coc(k) + self._coc(k + 1))  # eq. 9


def weights(coc: np.ndarray, layers: np.ndarray, kind: str = "layer") -> np.ndarray:
    """Weight of every slot in every layer.

    Parameters
    ----------
    coc : (M, H, W)
        Signed CoC radius of each slot, NaN for slots with nothing in them.
    layers : (K,)
        CoC of each layer.
    """
    count = len(layers)
    result = np.zeros((count, *coc.shape))
    if count == 1:
        result[0] = ~np.isnan(coc)
        return result
    z = Anchors(layers, kind)
    for k in range(count):
        for m in range(len(coc)):
            c = coc[m]
            with np.errstate(invalid="ignore"):
                rise = np.ones_like(c) if k == 0 else np.clip((c - z[k - 2]) / (z[k - 1] - z[k - 2]), 0, 1)
                fall = np.ones_like(c) if k == count - 1 else np.clip((z[k + 1] - c) / (z[k + 1] - z[k]), 0, 1)
                if m > 0 and k < count - 1:
                    before_is_in_layer = coc[m - 1] <= z[k]
                    fall = np.where(before_is_in_layer, fall, (c <= z[k]).astype(float))
                result[k, m] = np.where(np.isnan(c), 0.0, rise * fall)
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
    kind: str = "layer",
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
        image = _compose(color, coc, layers, focus, taps_of, cascade, kind)
        alpha = None
    else:
        covered, surfaces = color.copy(), np.zeros_like(color)
        covered[nothing] = (0, 0, 0, 1)
        covered[-1, ..., 3] = 1.0  # the void behind the last slot stands at its depth
        surfaces[..., 0] = color[..., 3]
        surfaces[..., 3] = covered[..., 3]
        image = _compose(covered, coc, layers, focus, taps_of, cascade, kind)
        alpha = _compose(surfaces, coc, layers, focus, taps_of, cascade, kind)
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
    kind: str,
) -> np.ndarray:
    weight = weights(coc, layers, kind)
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
