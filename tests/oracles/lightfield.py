"""The light-field method in whole numbers and float64, from Yu, Wang & Yu 2010 and docs/methods/lightfield.md.

Positions are whole 1/256 px, made from one float32 product each, as kernels/lightfield.cl has it: what covers which
pixel is then the same to the last bit. Everything else is in float64.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

NONE = 0xFFFFFFFF
UNKNOWN = -128  # the surface ends on this side, nobody knows where in the pixel
SAME_SURFACE, STEEP, STRAIGHT = 1.0, 7.5, 0.25
OPAQUE = np.float32(0.999)


class Slots(NamedTuple):
    """All slots to warp, in the order of memory; one entry each."""

    at: np.ndarray  # (peel * height + y) * pitch + x
    x: np.ndarray
    y: np.ndarray
    key: np.ndarray  # uint32, smaller is nearer
    coc: np.ndarray  # float32, 1/256 px
    edges: np.ndarray  # (N, 4) left, right, above, below: signed bytes, see `edges`
    plane: np.ndarray


def coc(inv_depth: np.ndarray, c1: float, c0: float) -> np.ndarray:
    """float32, rounded once."""
    return (np.float64(np.float32(c1)) * inv_depth + np.float64(np.float32(c0))).astype(np.float32)


def depth_key(inv_depth: np.ndarray) -> np.ndarray:
    bits = np.ascontiguousarray(inv_depth, np.float32).view(np.uint32)
    return np.where(bits >> 31 != 0, bits, ~(bits | np.uint32(0x80000000)))


def edges(inv_depth: np.ndarray, c: np.ndarray) -> np.ndarray:
    """What is on the four sides of each slot, (M, H, W, 4) of signed bytes.

    CoC to the neighbour in 1/16 px; where the surface ends, 128 + level as a byte, where levels 1 to 7 put the end
    0 to 1/2 px beyond the pixel, -1 to -7 before it, and 0 (:data:`UNKNOWN`) says no more.
    """
    peels, height, width = inv_depth.shape
    result = np.full((peels, height, width, 4), UNKNOWN)

    def at(m: int, y: int, x: int) -> float | None:
        if 0 <= m < peels and 0 <= y < height and 0 <= x < width and inv_depth[m, y, x] >= 0:
            return float(c[m, y, x])
        return None

    for m, y, x in np.ndindex(peels, height, width):
        own = at(m, y, x)
        if own is None:
            continue
        for side, (dx, dy) in enumerate(((-1, 0), (1, 0), (0, -1), (0, 1))):
            there = [at(k, y + dy, x + dx) for k in range(peels)]
            steps = [None if one is None else float(np.float32(np.float32(one) - np.float32(own))) for one in there]
            d, elsewhere = steps[m], [one for k, one in enumerate(steps) if k != m and one is not None]
            if d is not None and abs(d) <= SAME_SURFACE:
                pass
            elif elsewhere and abs(min(elsewhere, key=abs)) <= SAME_SURFACE:
                d = min(elsewhere, key=abs)
            else:
                beyond, behind = at(m, y + 2 * dy, x + 2 * dx), at(m, y - dy, x - dx)
                if (
                    d is None
                    or abs(d) > STEEP
                    or beyond is None
                    or behind is None
                    or abs(beyond - own - 2 * d) > STRAIGHT * abs(d)
                    or abs(behind - own + d) > STRAIGHT * abs(d)
                ):
                    d = None
            if d is None:
                level = _end_level(c, inv_depth, (m, y, x), (dy, dx))
                result[m, y, x, side] = (128 + level + 128) % 256 - 128
            else:
                result[m, y, x, side] = int(d * 16 + (-0.5 if d < 0 else 0.5))
    return result


def _end_level(c: np.ndarray, inv_depth: np.ndarray, slot: tuple[int, int, int], out: tuple[int, int]) -> int:
    """Where the silhouette on one side of a slot runs, from its staircase along the other axis."""
    m, y, x = slot
    height, width = c.shape[1:]

    def is_on(v: int, u: int) -> bool:
        if not (0 <= v < height and 0 <= u < width):
            return False
        return bool(((inv_depth[:, v, u] >= 0) & (np.abs(c[:, v, u] - c[m, y, x]) <= SAME_SURFACE)).any())

    def ends_at(v: int, u: int) -> bool:
        inside = 0 <= v + out[0] < height and 0 <= u + out[1] < width
        return inside and is_on(v, u) and not is_on(v + out[0], u + out[1])

    if not (0 <= y + out[0] < height and 0 <= x + out[1] < width):
        return 0
    if inv_depth[m, y + out[0], x + out[1]] > inv_depth[m, y, x]:
        return 0
    along = (abs(out[1]), abs(out[0]))
    stairs = [0]  # how far out the silhouette stands on both sides together, at growing distance
    at, slope, is_regular = {-1: 0, 1: 0}, 0, True
    for k in range(1, 17):
        for side in (-1, 1):
            steps = [at[side] + step for step in (0, -1, 1)]
            found = [
                j for j in steps if ends_at(y + side * k * along[0] + j * out[0], x + side * k * along[1] + j * out[1])
            ]
            if not found:
                break
            at[side] = found[0]
        else:
            if abs(at[-1] + at[1]) <= 1:
                stairs.append(at[-1] + at[1])
                slope = at[1] if k == 1 else slope
                is_regular &= at[1] == k * slope and at[-1] == -k * slope
                if k >= 6 and at[-1] and at[1]:
                    break
                continue
        break
    if is_regular:
        return 0
    n = len(stairs)
    mean = sum((n - k) * out_by for k, out_by in enumerate(stairs))  # over n * n
    level = min(abs(mean) * 14 // (n * n) + 1, 7)
    return -level if mean < 0 else level


def end_reach(edge: np.ndarray, place: int) -> tuple[np.ndarray, np.ndarray]:
    """Whether a surface ends on this side, and how far beyond its half pixel, in 1/256 px."""
    level = (edge & 255) - 128
    known = np.sign(level) * (np.abs(level) * 18 - 9) + place
    return (np.abs(level) <= 7), np.where(level == 0, 0, known)


def slots(
    inv_depth: np.ndarray, alpha: np.ndarray, pitch: int, c1: float, c0: float, planes: int, support: str
) -> Slots:
    """List the slots of layers (M, H, W), where -1 is an empty slot."""
    height = inv_depth.shape[1]
    c = coc(inv_depth, c1, c0)
    all_edges = edges(inv_depth, c) if support == "surface" else np.zeros((*c.shape, 4), int)
    m, y, x = np.nonzero(inv_depth >= 0)
    glass = (alpha > 0) & (alpha < OPAQUE)
    again = (m > 0) & (inv_depth[m, y, x] == 0) & (inv_depth[m - 1, y, x] == 0) & ~(glass[m - 1, y, x] & (planes > 1))
    m, y, x = m[~again], y[~again], x[~again]
    rank = np.minimum(np.cumsum(glass[::-1], axis=0)[::-1], planes - 1)
    plane = np.where(glass & (planes > 1), rank, 0)
    return Slots(
        (m * height + y) * pitch + x,
        x,
        y,
        depth_key(inv_depth)[m, y, x],
        c[m, y, x] * np.float32(256),
        all_edges[m, y, x],
        plane[m, y, x],
    )


def _product(a: np.ndarray, b: float) -> np.ndarray:
    return (a.astype(np.float32) * np.float32(b)).astype(np.int64)


def _span(position: np.ndarray, low: np.ndarray, high: np.ndarray, support: str) -> tuple[np.ndarray, np.ndarray]:
    if support == "none":
        first = (position + 128) >> 8
        return first, first + 1
    if support == "2x2":
        return position >> 8, (position + 511) >> 8
    if support == "3x3":
        first = (position - 128) >> 8
        return first, first + 3
    return (position + 127 - low) >> 8, (position + 383 + high) >> 8


def footprints(some: Slots, view: np.ndarray, guard: int, support: str) -> tuple[np.ndarray, ...]:
    """Columns x0 to before x1 and rows y0 to before y1 of every slot in a view (vx, vy, place x, place y)."""
    spans = []
    for axis, place in ((0, some.x), (1, some.y)):
        v = float(view[axis])
        position = 256 * (place - guard) + _product(some.coc, v) + int(view[2 + axis])
        own, across = some.edges[:, 2 * axis : 2 * axis + 2], some.edges[:, 2 - 2 * axis : 4 - 2 * axis]
        widest = np.where(end_reach(across, 0)[0], 0, np.abs(across)).max(axis=1)
        shear = _product(widest, abs(np.float32(8) * np.float32(v)))
        moved = _product(own, np.float32(8) * np.float32(v))
        ends, reach = end_reach(own[:, 0], int(view[2 + axis]))
        low = np.where(ends, reach, -moved[:, 0] + shear + 8)
        ends, reach = end_reach(own[:, 1], -int(view[2 + axis]))
        high = np.where(ends, reach, moved[:, 1] + shear + 8)
        spans += _span(position, low, high, support)
    return tuple(spans)


def warp(some: Slots, view: np.ndarray, size: tuple[int, int], planes: int, guard: int, support: str) -> np.ndarray:
    """Winners of one view, (planes, height, width) of uint64: order of depth above, source below."""
    height, width = size
    winners = np.full((planes, height, width), np.uint64(0xFFFFFFFFFFFFFFFF))
    x0, x1, y0, y1 = footprints(some, view, guard, support)
    value = some.key.astype(np.uint64) << np.uint64(32) | some.at.astype(np.uint64)
    for dy in range(max(0, int((y1 - y0).max(initial=0)))):
        for dx in range(max(0, int((x1 - x0).max(initial=0)))):
            x, y = x0 + dx, y0 + dy
            hit = (x < x1) & (y < y1) & (x >= 0) & (x < width) & (y >= 0) & (y < height)
            np.minimum.at(winners, (some.plane[hit], y[hit], x[hit]), value[hit])
    return winners


def cells(inv_depth: np.ndarray, alpha: np.ndarray, c1: float, c0: float) -> np.ndarray:
    """Whether a pixel and those right, below and both are one surface, (M, H, W)."""
    height, width = inv_depth.shape[1:]
    result = np.zeros(inv_depth.shape, bool)
    c, opaque = coc(inv_depth, c1, c0), alpha >= OPAQUE
    own = np.s_[:, : height - 1, : width - 1]
    result[own] = inv_depth[own] >= 0
    limit = 0.5 + 0.125 * np.abs(c[own])
    for dy, dx in ((0, 1), (1, 0), (1, 1)):
        other = np.s_[:, dy : height - 1 + dy, dx : width - 1 + dx]
        result[own] &= (inv_depth[other] >= 0) & (np.abs(c[other] - c[own]) <= limit) & (opaque[other] == opaque[own])
    return result


class Hits(NamedTuple):
    """Where the rays of a view meet the layers, (H, W) each; what holes have means nothing."""

    m: np.ndarray
    y: np.ndarray
    x: np.ndarray
    inv_depth: np.ndarray
    coc: np.ndarray
    ray_x: np.ndarray  # 1/256 px
    ray_y: np.ndarray


def _hits(
    inv_depth: np.ndarray, winner: np.ndarray, view: np.ndarray, c1: float, c0: float, pitch: int, guard: int
) -> Hits:
    rows = inv_depth.shape[1]
    height, width = winner.shape
    source = (winner & np.uint64(NONE)).astype(np.int64)
    line, x = source // pitch, source % pitch
    m, y, x = (np.where(source == NONE, 0, n) for n in (line // rows, line % rows, x))
    w = inv_depth[m, y, x]
    c = coc(w, c1, c0)
    gy, gx = np.mgrid[:height, :width]
    ray_x = 256 * (gx + guard) - _product(c, np.float32(256) * view[0])
    ray_y = 256 * (gy + guard) - _product(c, np.float32(256) * view[1])
    return Hits(m, y, x, w, c, ray_x, ray_y)


def beyond(inv_depth: np.ndarray, hits: Hits, view: np.ndarray, c1: float, guard: int) -> np.ndarray:
    """Rays that came in over an edge of the layers behind a surface that ends there; as ``is_beyond``."""
    _, rows, columns = inv_depth.shape
    gy, gx = np.mgrid[: hits.inv_depth.shape[0], : hits.inv_depth.shape[1]].astype(float)
    time = np.full(hits.inv_depth.shape, np.inf)
    places = []
    for axis, middle, count in ((0, gx + guard, columns), (1, gy + guard, rows)):
        v = float(view[axis])
        hit, speed = middle - float(view[2 + axis]) / 256.0 - hits.coc * v, -c1 * v
        # The distance to the edge that lies towards the lens.
        room = hit + 0.5 if speed < 0 else count - 0.5 - hit
        if abs(speed) > 1e-12:
            time = np.minimum(time, np.maximum((room - 1.0 / 32.0) / abs(speed), 0.0))
        places.append((hit, speed, count))
    leaves = np.where(time < 1e12, time, 0.0)
    x, y = (np.clip(np.trunc(hit + leaves * speed + 0.5).astype(int), 0, n - 1) for hit, speed, n in places)
    return (time < 1e12) & (inv_depth[:, y, x] > hits.inv_depth + leaves).any(axis=0)


def _look_up(
    color: np.ndarray, inv_depth: np.ndarray, winner: np.ndarray, view: np.ndarray, c1: float, c0: float,
    pitch: int, guard: int, lookup: str, glass: bool,
) -> np.ndarray:  # fmt: skip
    """Colours of the rays of a view, (H, W, 4)."""
    rows, columns = inv_depth.shape[1:]
    m, y, x, w, c, ray_x, ray_y = _hits(inv_depth, winner, view, c1, c0, pitch, guard)
    base = color[m, y, x]
    if lookup == "winner":
        return base
    step_x, step_y = np.where(ray_x < 256 * x, -1, 1), np.where(ray_y < 256 * y, -1, 1)
    fx = np.minimum(np.abs(ray_x - 256 * x), 256)[..., None] / 256
    fy = np.minimum(np.abs(ray_y - 256 * y), 256)[..., None] / 256

    def tap(dx: np.ndarray, dy: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        u, v = x + dx, y + dy
        inside = (u >= 0) & (u < columns) & (v >= 0) & (v < rows)
        u, v = np.clip(u, 0, columns - 1), np.clip(v, 0, rows - 1)
        other, found = inv_depth[m, v, u], color[m, v, u]
        close = np.abs(other - w) * abs(c1) <= 0.5 + 0.125 * np.abs(c)
        kind = (found[..., 3] >= OPAQUE) == (base[..., 3] >= OPAQUE)
        return inside & (other >= 0) & close, kind | (not glass), found

    zero = np.zeros_like(step_x)
    has_x, kind_x, beside = tap(step_x, zero)
    has_y, kind_y, below = tap(zero, step_y)
    has_both, _, far = tap(step_x, step_y)
    beside = np.where((has_x & kind_x)[..., None], beside, base)
    below = np.where((has_y & kind_y)[..., None], below, base)
    far = np.where(has_both[..., None], far, np.where(has_y[..., None], below, beside))
    if glass:
        far = np.where(((far[..., 3] >= OPAQUE) == (base[..., 3] >= OPAQUE))[..., None], far, base)
    one, two = base + fx * (beside - base), below + fx * (far - below)
    return one + fy * (two - one)


def render(
    color: np.ndarray, inv_depth: np.ndarray, views: np.ndarray, c1: float, c0: float, *, pitch: int, guard: int,
    glass: bool, void: bool = False, support: str = "surface", lookup: str = "bilinear", cos4: float = 0.0,
    mirrored: Callable[[Hits, np.ndarray], np.ndarray] | None = None, matte: np.ndarray | None = None,
) -> np.ndarray:  # fmt: skip
    """A whole frame without mip levels; layers (M, H, W, 4) and (M, H, W) with -1 where nothing is.

    With ``mirrored`` rays look up ``matte`` and add what is mirrored where they hit, (H, W, 3), towards a view.
    """

    def seen_by(winner: np.ndarray, view: np.ndarray) -> np.ndarray:
        hits = _hits(inv_depth, winner, view, c1, c0, pitch, guard)
        return (winner & np.uint64(NONE) != NONE) & ~beyond(opaque_depth, hits, view, c1, guard)

    def rays(winner: np.ndarray, view: np.ndarray) -> np.ndarray:
        looked_at = color if matte is None else matte
        found = _look_up(looked_at, inv_depth, winner, view, c1, c0, pitch, guard, lookup, glass)
        if mirrored is not None:
            found = found.copy()
            found[..., :3] += found[..., 3:] * mirrored(_hits(inv_depth, winner, view, c1, c0, pitch, guard), view)
        return found

    alpha = color[..., 3].astype(np.float32)
    opaque_depth = np.where(alpha >= OPAQUE, inv_depth, -1.0)
    planes = 1 + int(((alpha > 0) & (alpha < OPAQUE)).sum(axis=0).max()) if glass else 1
    size = (color.shape[1] - 2 * guard, color.shape[2] - 2 * guard)
    color = color.astype(np.float64)
    some = slots(inv_depth, color[..., 3].astype(np.float32), pitch, c1, c0, planes, support)
    total, seen = np.zeros((*size, 4)), np.zeros(size)
    for view in views:
        weight = 1.0 / (1.0 + cos4 * (float(view[0]) ** 2 + float(view[1]) ** 2)) ** 2
        winners = warp(some, view, size, planes, guard, support)
        solid = winners[0]
        has_hit = seen_by(solid, view)
        image = np.zeros((*size, 4))
        for winner in np.sort(winners[1:], axis=0):
            there = seen_by(winner, view) & (winner < np.where(has_hit, solid, np.uint64(2**64 - 1)))
            found = rays(winner, view)
            image += np.where(there[..., None], (1.0 - image[..., 3:]) * found, 0.0)
        there = has_hit
        found = rays(solid, view)
        image += np.where(there[..., None], (1.0 - image[..., 3:]) * found, 0.0)
        total += weight * image
        # Behind the last peel's glass no slot stands for the void.
        seen += weight * np.where(there | (void & (image[..., 3] > 0)), 1.0, image[..., 3])
    inner = color[:, guard : guard + size[0], guard : guard + size[1]]
    pinhole = np.zeros((*size, 4))
    for layer in inner:
        pinhole += (1.0 - pinhole[..., 3:]) * layer
    known = seen > 1e-4
    result = np.where(known[..., None], total / np.where(known, seen, 1.0)[..., None], pinhole)
    result[..., 3] = np.minimum(result[..., 3], 1.0)
    return result


def shrink(color: np.ndarray, inv_depth: np.ndarray, c1: float, c0: float) -> tuple[np.ndarray, np.ndarray]:
    """One level of the pyramid of one peel, (H, W, 4) and (H, W): a 3x3 Gaussian over the middle pixel's surface."""
    height, width = inv_depth.shape
    y, x = np.mgrid[: (height + 1) // 2, : (width + 1) // 2] * 2
    w = inv_depth[y, x]
    limit = 0.5 + 0.125 * np.abs(c1 * w + c0)
    total, weights = np.zeros((*w.shape, 4)), np.zeros(w.shape)
    for j in (-1, 0, 1):
        for i in (-1, 0, 1):
            v, u = np.clip(y + j, 0, height - 1), np.clip(x + i, 0, width - 1)
            close = (inv_depth[v, u] >= 0) & (abs(c1) * np.abs(inv_depth[v, u] - w) <= limit)
            weight = np.where(close, (0.25 if i else 0.5) * (0.25 if j else 0.5), 0.0)
            total += weight[..., None] * color[v, u]
            weights += weight
    return np.where(weights[..., None] > 0, total / np.maximum(weights, 1e-30)[..., None], 0.0), w
