"""The multiview method in float64, from Lee, Eisemann & Seidel 2009 and the choices in docs/methods/multiview.md."""

from itertools import pairwise
from typing import NamedTuple

import numpy as np

NOTHING = np.inf


class Slots(NamedTuple):
    """Peels as columns in CoC space: near end (inf where nothing is) and far end in px, (M, H, W) each."""

    near: np.ndarray
    far: np.ndarray


def slots(inverse_depth: np.ndarray, c1: float, c0: float, scale: int = 1) -> Slots:
    """Near end of each slot, and how far its surface goes on behind it: to the next pixel or beyond, if it slopes.

    ``inverse_depth`` is negative where nothing is.
    """
    there = inverse_depth >= 0.0
    near = np.where(there, c1 * inverse_depth + c0, 1e30)
    far = near.copy()
    for axis in (1, 2):
        steps = []
        for shift in (1, -1):
            step = np.roll(near, shift, axis) - near
            edge = [slice(None)] * 3
            edge[axis] = slice(0, 1) if shift == 1 else slice(-1, None)
            step[tuple(edge)] = np.inf
            steps.append(step)
        least, most = np.minimum(*np.abs(steps)), np.maximum(*np.abs(steps))
        sticks_out = (most <= 2.0) & (np.sign(steps[0]) * np.sign(steps[1]) > 0)
        far += (1 if scale == 1 else scale + 1) * np.where((least > 2.0) | sticks_out, 0.0, least)
    return Slots(np.where(there, near, np.inf), np.where(there, far, -np.inf))


def split(color: np.ndarray, columns: Slots, bounds: np.ndarray) -> np.ndarray:
    """Layers (K, H, W, 4): in each the columns that reach into it, front to back; glass only where it begins."""
    layers = np.zeros((len(bounds) - 1, *color.shape[1:]))
    for layer, low, high in zip(layers, bounds[:-1], bounds[1:], strict=True):
        for rgba, near, far in zip(color, columns.near, columns.far, strict=True):
            reaches = (near < high) & (far >= low)
            is_in = np.where(rgba[..., 3] >= 0.998, reaches, reaches & (near >= low))
            layer += rgba * ((1.0 - layer[..., 3]) * is_in)[..., None]
    return layers


def centres(
    color: np.ndarray, columns: Slots, bounds: np.ndarray, nominal: np.ndarray, least: float, full: float
) -> np.ndarray:
    """C at which each layer is met: the mean of what begins and is seen in it, weighted by the square of its light.

    From a blur of ``full`` px on; below ``least`` px it is the layer's own, in between something between both.
    """
    coc = nominal.copy()
    for layer, (low, high) in enumerate(pairwise(bounds)):
        covered = np.zeros(color.shape[1:3])
        total = weight = 0.0
        for rgba, near, far in zip(color, columns.near, columns.far, strict=True):
            begins = (near < high) & (near >= low)
            reaches = (near < high) & (far >= low)
            pull = (rgba[..., :3].max(axis=-1) ** 2 + 0.01 * rgba[..., 3]) * (1.0 - covered) * begins
            total += (pull * np.where(begins, near, 0.0)).sum()
            weight += pull.sum()
            is_in = np.where(rgba[..., 3] >= 0.998, reaches, begins)
            covered += rgba[..., 3] * (1.0 - covered) * is_in
        away = abs(nominal[layer])
        if weight > 0.0 and away >= least:
            share = 1.0 if away >= full else (away - least) / (full - least)
            coc[layer] += share * (total / weight - coc[layer])
    return coc


def shifts(points: np.ndarray, coc: np.ndarray, scales: np.ndarray, turns: np.ndarray | None = None) -> np.ndarray:
    """What rays take in of each layer, (rays, K, 4, 3): four pixels right and down, and the share of each.

    A ray whose place is within half of the layer's ``turns`` (px) of the line between two pixels takes both in, evenly
    more of one and less of the other.
    """
    to = points[:, None] * (scales * coc)[None, :, None]
    pixel = np.floor(to + 0.5)
    share = np.zeros_like(to)
    if turns is not None:
        share = np.maximum(0.5 - (0.5 - np.abs(to - pixel)) / turns[None, :, None], 0.0)
    side = np.where(to < pixel, -1.0, 1.0)
    taps = []
    for is_over, is_down in ((0, 0), (1, 0), (0, 1), (1, 1)):
        of = (np.array([is_over, is_down]) * share + np.array([1 - is_over, 1 - is_down]) * (1.0 - share)).prod(axis=-1)
        taps.append(np.concatenate([pixel + side * (is_over, is_down), of[..., None]], axis=-1))
    return np.stack(taps, axis=2)


def cone(image: np.ndarray, first: int, taps: int, edge: float, scale: int = 1) -> np.ndarray:
    """Means over square windows; beyond the image its edge goes on.

    Windows have ``taps`` whole pixels from ``first`` on, counted from every ``scale``-th pixel, and ``edge`` of one
    more at either side.
    """
    weights = np.array([edge, *[1.0] * taps, edge])
    weights /= weights.sum()
    for axis in (0, 1):
        count = image.shape[axis]
        start = np.arange(0, count, scale) + first - 1
        image = sum(w * np.take(image, np.clip(start + i, 0, count - 1), axis) for i, w in enumerate(weights))
    return image


def past(color: np.ndarray, scale: int = 1) -> np.ndarray:
    """How much of the void is known to be seen, (H, W)."""
    through = np.prod(1.0 - color[..., 3], axis=0)
    known = ((through > 1e-3) | (color[-1, ..., 3] == 0.0)).astype(float)
    height, width = known.shape
    return known.reshape(height // scale, scale, width // scale, scale).mean(axis=(1, 3))


def pinhole(color: np.ndarray) -> np.ndarray:
    image = np.zeros(color.shape[1:])
    for layer in color[::-1]:
        image = layer + (1.0 - layer[..., 3:]) * image
    return image


def trace(layers: np.ndarray, shifts: np.ndarray, color: np.ndarray, void: np.ndarray | None = None) -> np.ndarray:
    """All rays of all pixels.

    Parameters
    ----------
    layers : (K, H, W, 4)
    shifts : (rays, K, 4, 3)
        As ``shifts`` has them.
    color : (M, H, W, 4)
        The peels at the middle of each pixel: what pixels without rays show.
    void : (H, W), optional
        For frames that are not opaque.

    Returns
    -------
    (H, W, 4)
    """
    height, width = layers.shape[1:3]
    y, x = np.mgrid[:height, :width]
    total, known = np.zeros((height, width, 4)), np.zeros((height, width))
    for ray in shifts:
        left = np.ones((height, width))
        for layer, taps in zip(layers, ray, strict=True):
            places = []
            met, blocks = np.zeros((height, width, 4)), np.zeros((height, width))
            for dx, dy, share in taps:
                at_x, at_y = (np.clip(v, 0, n - 1).astype(int) for v, n in ((x + dx, width), (y + dy, height)))
                places.append((at_y, at_x, share * ((at_x == x + dx) & (at_y == y + dy))))
                met += places[-1][2][..., None] * layer[at_y, at_x]
                blocks += share * layer[at_y, at_x, 3]
            total += left[..., None] * met
            left = left * (1.0 - blocks)
        if void is not None:
            known += left * sum(share * void[at_y, at_x] for at_y, at_x, share in places)
    return finish(total, known, len(shifts), color, void is None)


def trace_peels(
    color: np.ndarray,
    columns: Slots,
    bounds: np.ndarray,
    limits: np.ndarray,
    points: np.ndarray,
    steps: int,
    void: np.ndarray | None = None,
) -> np.ndarray:
    """All rays of all pixels, layer by layer through the peels: binary search for where each ray meets a layer.

    Parameters
    ----------
    color : (M, H, W, 4)
    columns : Slots
    bounds, limits : (K + 1,)
        Where layers begin in px of C; ``limits`` end, and are what is halved.
    points : (rays, 2)
        Right and down, per px of C.
    steps : int
        Times that the way through a layer is halved, at least 1.
    void : (H, W), optional
        For frames that are not opaque.

    Returns
    -------
    (H, W, 4)
    """
    height, width = color.shape[1:3]
    y, x = np.mgrid[:height, :width]

    def at(point: np.ndarray, c: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        column, row = (np.floor(p * c + 0.5).astype(int) + place for p, place in zip(point, (x, y), strict=True))
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        return np.clip(row, 0, height - 1), np.clip(column, 0, width - 1), inside

    total, known = np.zeros((height, width, 4)), np.zeros((height, width))
    for point in points:
        left = np.ones((height, width))
        for bound, limit in zip(pairwise(bounds), pairwise(limits), strict=True):
            low, high = (np.full((height, width), end) for end in limit)
            has_hit = np.ones((height, width), bool)
            for step in range(steps):
                middle = (low + high) / 2.0
                row, column, _ = at(point, middle)
                near, far = columns.near[:, row, column], columns.far[:, row, column]
                first = np.where((near < bound[1]) & (far >= bound[0]), near, np.inf).min(axis=0)
                if step == 0:
                    has_hit = np.isfinite(first)
                low, high = np.where(first < middle, low, middle), np.where(first < middle, middle, high)
            row, column, inside = at(point, (low + high) / 2.0)
            met = np.zeros((height, width, 4))
            for rgba, near, far in zip(color, columns.near, columns.far, strict=True):
                rgba, near, far = rgba[row, column], near[row, column], far[row, column]
                reaches = has_hit & (near < bound[1]) & (far >= bound[0])
                is_in = np.where(rgba[..., 3] >= 0.998, reaches, reaches & (near >= bound[0]))
                met += rgba * ((1.0 - met[..., 3]) * is_in)[..., None]
            total += np.where(inside, left, 0.0)[..., None] * met
            left = left * (1.0 - met[..., 3])
        if void is not None:
            row, column, inside = at(point, (limits[-2] + limits[-1]) / 2.0)
            known += np.where(inside, left * void[row, column], 0.0)
    return finish(total, known, len(points), color, void is None)


def finish(total: np.ndarray, known: np.ndarray, rays: int, color: np.ndarray, opaque: bool) -> np.ndarray:
    """The image from what rays met; ``known`` is that of rays that met the void."""
    known = known + total[..., 3]
    enough = known > 1e-4 * rays
    result = total / np.where(enough, known, 1.0)[..., None]
    if opaque:
        result[..., 3] = 1.0
    return np.where(enough[..., None], result, pinhole(color))


def render(
    color: np.ndarray,
    inverse_depth: np.ndarray,
    c1: float,
    c0: float,
    bounds: np.ndarray,
    nominal: np.ndarray,
    windows: list,
    points: np.ndarray,
    scales: np.ndarray,
    turns: np.ndarray,
    *,
    opaque: bool,
    guard: int = 0,
    scale: int = 1,
    least: float = 0.0,
    full: float = 0.0,
    halvings: int = 0,
    limits: np.ndarray | None = None,
) -> np.ndarray:
    """A whole frame with the same rays at every pixel; peels have ``scale`` times its pixels along x and y.

    With ``halvings``, the search of ``trace_peels`` in the layers between ``limits``.
    """
    color = color.astype(np.float64)
    columns = slots(inverse_depth, c1, c0, scale)
    coc = centres(color, columns, bounds, nominal, least, full)
    inner = slice(guard, -guard or None)
    if halvings:
        image = trace_peels(color, columns, bounds, limits, points, halvings, None if opaque else past(color))
        return image[inner, inner]
    layers = split(color, columns, bounds)
    cones = [cone(one, *window, scale) if window else one for one, window in zip(layers, windows, strict=True)]
    middle = color[:, scale // 2 :: scale, scale // 2 :: scale]
    image = trace(np.stack(cones), shifts(points, coc, scales, turns), middle, None if opaque else past(color, scale))
    return image[inner, inner]


class Hits(NamedTuple):
    """What each pixel's ray meets first: peel, row and column, or -1; and its signed CoC radius in px."""

    peel: np.ndarray
    row: np.ndarray
    column: np.ndarray
    coc: np.ndarray


def march(columns: Slots, point: np.ndarray, step_px: float) -> Hits:
    """Brute force: follow one ray per pixel in small steps of C until it is inside a column.

    Parameters
    ----------
    columns : Slots
    point : (2,)
        Where the ray moves per px of C, right and down.
    step_px : float
        In C.
    """
    height, width = columns.near.shape[1:]
    y, x = np.mgrid[:height, :width]
    there = np.isfinite(columns.near)
    hits = Hits(*(np.full((height, width), -1) for _ in range(3)), np.full((height, width), np.nan))
    start, end = columns.near[there].min(), columns.far[there].max()
    for c in np.arange(start - step_px, end + step_px, step_px):
        at_x = np.floor(x + point[0] * c + 0.5).astype(int)
        at_y = np.floor(y + point[1] * c + 0.5).astype(int)
        inside = (at_x >= 0) & (at_x < width) & (at_y >= 0) & (at_y < height) & (hits.peel < 0)
        at_x, at_y = np.clip(at_x, 0, width - 1), np.clip(at_y, 0, height - 1)
        for m in range(len(columns.near)):
            near, far = columns.near[m][at_y, at_x], columns.far[m][at_y, at_x]
            met = inside & (near < c + step_px / 2) & (far >= c - step_px / 2) & (hits.peel < 0)
            for field, value in zip(hits, (m, at_y, at_x, near), strict=True):
                np.copyto(field, value, where=met, casting="unsafe")
    return hits


def nbuffer(cells: np.ndarray, levels: int) -> np.ndarray:
    """Union over squares of 2^level cells from each cell on, cut by the frame; (levels, rows, columns)."""
    out = np.zeros((levels, *cells.shape), cells.dtype)
    for level in range(levels):
        for j in range(cells.shape[0]):
            for i in range(cells.shape[1]):
                square = cells[j : j + (1 << level), i : i + (1 << level)]
                out[level, j, i] = np.bitwise_or.reduce(square.ravel())
    return out


def false_position(columns: Slots, bounds: np.ndarray, point: np.ndarray, steps: int = 3) -> Hits:
    """The paper's own search (section 4.3): in every layer, steps of false position through its height field.

    Layers hold the nearest slot between their bounds, with 10 % of overlap. Empty texels stand at the bound that puts
    the first intersection inside the layer.
    """
    height, width = columns.near.shape[1:]
    y, x = np.mgrid[:height, :width]
    hits = Hits(*(np.full((height, width), -1) for _ in range(3)), np.full((height, width), np.nan))
    for low, high in pairwise(bounds):
        field, peel = np.full((height, width), np.inf), np.full((height, width), -1)
        for m, near in enumerate(columns.near):
            nearer = (near >= low) & (near < high + 0.1 * (high - low)) & (near < field)
            field, peel = np.where(nearer, near, field), np.where(nearer, m, peel)

        def fetch(c: np.ndarray, field: np.ndarray = field) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
            column = np.clip(np.floor(x + point[0] * c + 0.5).astype(int), 0, width - 1)
            row = np.clip(np.floor(y + point[1] * c + 0.5).astype(int), 0, height - 1)
            return field[row, column], row, column

        start, end = np.full((height, width), low), np.full((height, width), high)
        first, last = fetch(start)[0], fetch(end)[0]
        first, last = np.where(np.isfinite(first), first, high), np.where(np.isfinite(last), last, low)
        found = [np.full((height, width), -1) for _ in range(3)]
        for _ in range(steps):
            slope = (end - start) - (last - first)
            share = np.where(np.abs(slope) > 1e-9, (first - start) / np.where(np.abs(slope) > 1e-9, slope, 1.0), 0.5)
            middle = start + np.clip(share, 0.0, 1.0) * (end - start)
            value, row, column = fetch(middle)
            there = np.isfinite(value)
            for old, new in zip(found, (peel[row, column], row, column), strict=True):
                np.copyto(old, new, where=there)
            before = there & (value < middle)
            first = np.where(there & ~before, value, first)
            last, end = np.where(before, value, last), np.where(before, middle, end)
            start = np.where(before, start, middle)
        is_new = (found[0] >= 0) & (hits.peel < 0)
        coc = columns.near[np.maximum(found[0], 0), found[1], found[2]]
        for old, new in zip(hits, (*found, coc), strict=True):
            np.copyto(old, new, where=is_new)
    return hits
