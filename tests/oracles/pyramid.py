"""The pyramid method in float64, from Kraus & Strengert 2007 and the choices in docs/methods/pyramid.md."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize_scalar

from tests.oracles.layered import breadth

# Inverse depth where there is nothing, or a hole.
EMPTY = -1.0


class Stack(NamedTuple):
    """RGBZ images one behind the other: colour (S, H, W, 4), alpha 1 or 0; inverse depth and slope (S, H, W)."""

    color: np.ndarray
    inverse: np.ndarray
    slope: np.ndarray


def flatten(color: np.ndarray, inverse: np.ndarray, sources: int, opaque: bool, alpha: str = "one") -> Stack:
    """What is seen from slot s on, for s below `sources`, with the depth of the slot that makes most of it.

    Parameters
    ----------
    color, inverse : (M, H, W, 4), (M, H, W)
    opaque : bool
        False: where nothing is, there is void at infinity.
    alpha : {"one", "true", "red"}
        Coverage in the alpha channel; the true alpha there; or alpha as red over black.
    """
    count = len(color)
    images, depths = np.zeros((sources, *color.shape[1:])), np.full((sources, *inverse.shape[1:]), EMPTY)
    for s in range(sources):
        image = np.zeros(color.shape[1:])
        depth = np.full(inverse.shape[1:], EMPTY)
        nearest = depth.copy()
        for m in range(s, count):
            image = image + (1 - image[..., 3:]) * color[m]
            there = (inverse[m] >= 0) & (color[m, ..., 3] > 0)
            nearest = np.where((nearest < 0) & there, inverse[m], nearest)
            depth = np.where((depth < 0) & there & (image[..., 3] >= 0.5), inverse[m], depth)
        if opaque:
            known = image[..., 3] >= 0.5
            image = np.where(known[..., None], image / np.where(known, image[..., 3], 1)[..., None], 0)
            depth = np.where(known, depth, EMPTY)
        else:
            known = np.ones(depth.shape, bool)
            depth = np.where(depth >= 0, depth, np.where(nearest >= 0, nearest, 0.0))
        if alpha == "one":
            image[..., 3] = known
        elif alpha == "red":
            image = np.stack([image[..., 3], 0 * depth, 0 * depth, known.astype(float)], axis=-1)
        images[s], depths[s] = image, depth
    return Stack(images, depths, slope(depths))


def slope(inverse: np.ndarray) -> np.ndarray:
    """Change of inverse depth per pixel: the lesser of two sides, the greater of two directions; 0 where unknown."""
    w = np.where(inverse < 0, np.nan, inverse)
    result = np.zeros_like(w)
    for axis in (-2, -1):
        step = np.abs(np.diff(w, axis=axis))
        ends = [(0, 0)] * w.ndim
        before, after = list(ends), list(ends)
        before[axis], after[axis] = (1, 0), (0, 1)
        sides = np.fmin(np.pad(step, before, constant_values=np.nan), np.pad(step, after, constant_values=np.nan))
        result = np.maximum(result, np.nan_to_num(sides))
    return result


# --- the three pyramids -------------------------------------------------------------------------------------------


def pull(color: np.ndarray, inverse: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A coarser level: the mean of those of 2x2 pixels that are no holes; a hole where all four are."""
    height, width = inverse.shape
    pad = [(0, height % 2), (0, width % 2)]
    inverse = np.pad(inverse, pad, constant_values=EMPTY)
    color = np.pad(color, [*pad, (0, 0)])
    known = (inverse >= 0).astype(float)
    parts = [(slice(y, None, 2), slice(x, None, 2)) for y in (0, 1) for x in (0, 1)]
    count = sum(known[p] for p in parts)
    safe = np.maximum(count, 1)
    mean = sum(color[p] * known[p][..., None] for p in parts) / safe[..., None]
    depth = np.where(count > 0, sum(inverse[p] * known[p] for p in parts) / safe, EMPTY)
    return mean, depth


def expand(image: np.ndarray, height: int, width: int) -> np.ndarray:
    """Twice the size by quadratic B-spline subdivision: weights 9, 3, 3, 1 of 16; edges repeated."""
    for axis, size in ((0, height), (1, width)):
        image = np.moveaxis(image, axis, 0)
        fine = np.arange(size)
        near = fine // 2
        far = np.clip(near + np.where(fine % 2, 1, -1), 0, len(image) - 1)
        image = np.moveaxis(0.75 * image[near] + 0.25 * image[far], 0, axis)
    return image


def reduce(image: np.ndarray) -> np.ndarray:
    """Half the size by a 4x4 box; edges repeated. For even sizes."""
    for axis in (0, 1):
        image = np.moveaxis(image, axis, 0)
        size = len(image)
        first = np.arange(size // 2) * 2 - 1
        image = sum(image[np.clip(first + t, 0, size - 1)] for t in range(4)) / 4
        image = np.moveaxis(image, 0, axis)
    return image


def fill(color: np.ndarray, inverse: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pyramidal pull-push interpolation of colour and inverse depth, only into holes (inverse depth below 0)."""
    if inverse.shape == (1, 1):
        return color, inverse
    coarse_color, coarse_inverse = fill(*pull(color, inverse))
    height, width = inverse.shape
    hole = inverse < 0
    color = np.where(hole[..., None], expand(coarse_color, height, width), color)
    return color, np.where(hole, expand(coarse_inverse, height, width), inverse)


def blur(image: np.ndarray, steps: int) -> np.ndarray:
    """`steps` reduce and as many expand steps."""
    sizes = []
    for _ in range(steps):
        sizes.append(image.shape[:2])
        image = reduce(image)
    for height, width in reversed(sizes):
        image = expand(image, height, width)
    return image


# --- matting ------------------------------------------------------------------------------------------------------


class Matting(NamedTuple):
    """What a sub-image takes of a pixel: rise(inverse, slope, broad) times fall(inverse). Rise 0: culled.

    `broad(inverse)`: how much of the surface of each pixel of the first source is left around it; else 1.
    """

    rise: Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]
    fall: Callable[[np.ndarray], np.ndarray]
    broad: Callable[[np.ndarray], np.ndarray]


def ones(inverse: np.ndarray, *_: np.ndarray) -> np.ndarray:
    return np.ones_like(inverse)


def paper_matting(i: int, first: int, last: int, z: Callable[[int], float]) -> Matting:
    """w(i)(z) of section 3.3; `z` gives z(i), inf where it is ill-defined."""

    def depth(inverse: np.ndarray) -> np.ndarray:
        return 1.0 / np.maximum(inverse, 1e-20)

    def ramp(inverse: np.ndarray, start: float, end: float) -> np.ndarray:
        return np.clip((depth(inverse) - start) / (end - start), 0.0, 1.0)

    def rise(inverse: np.ndarray, *_: np.ndarray) -> np.ndarray:
        if i == first:
            return np.ones_like(inverse)
        if np.isinf(z(i - 2)):
            return np.zeros_like(inverse)
        if i == last or np.isinf(z(i - 1)):
            return (depth(inverse) >= z(i - 2)).astype(float)
        return ramp(inverse, z(i - 2), z(i - 1))

    def fall(inverse: np.ndarray) -> np.ndarray:
        if i == last or np.isinf(z(i)) or np.isinf(z(i + 1)):
            return np.ones_like(inverse)
        return 1.0 - ramp(inverse, z(i), z(i + 1))

    return Matting(rise, fall, ones)


def seamless_matting(
    i: int, first: int, last: int, radius: Callable[[int], float], c1: float, c0: float, sigma: Callable[[int], float]
) -> Matting:
    """Linear in the CoC. Full weight for what is broad, a share for what is thin; early only where it slopes in."""
    scale = 0.5  # sigma of the lens per CoC radius

    def blur_of(inverse: np.ndarray) -> np.ndarray:
        return scale * (c1 * inverse + c0)

    def rise(inverse: np.ndarray, slope: np.ndarray, broad: np.ndarray) -> np.ndarray:
        if i == first:
            return np.ones_like(inverse)
        start, end = radius(i - 2), radius(i - 1)
        rising = (blur_of(inverse) - start) / (end - start)
        reach = 2.0 * max(sigma(i), sigma(i - 1))
        steep = scale * abs(c1) * slope / (end - start)
        part = np.clip(np.where(steep > 1.0, 0.0, steep) * reach, 1e-3, 1.0)
        early = np.clip((rising - 1.0) / part + 1.0, 0.0, 1.0) * np.clip(24.0 * broad - 23.0, 0.0, 1.0)
        into = np.clip((blur_of(inverse) - end) / (radius(i) - end), 0.0, 1.0)
        others = 1.0 - (1.0 - into) * broad
        own = np.where(others > 1e-3, into / np.maximum(others, 1e-3), 1.0)
        return np.where(rising < 1.0, early, own)

    def broad(inverse: np.ndarray) -> np.ndarray:
        blur = np.where(inverse < 0, np.nan, blur_of(inverse))
        result = np.ones_like(inverse)
        for j in range(first + 1, last + 1):
            near, far = radius(j - 1), radius(j)
            around = max(1, math.ceil(max(sigma(j), sigma(j - 1))))
            own = (blur >= near) & (blur < far)
            rings = 0.6 * breadth(blur, around, far - near) + 0.35 * breadth(blur, 2 * around, far - near)
            result = np.where(own, 0.05 + rings, result)
        return result

    def fall(inverse: np.ndarray) -> np.ndarray:
        if i == last:
            return np.ones_like(inverse)
        return np.clip((radius(i + 1) - blur_of(inverse)) / (radius(i + 1) - radius(i)), 0.0, 1.0)

    return Matting(rise, fall, broad)


# Sigma of the Gaussian that fits `blur` best, by steps; `fitted_sigma` measures it.
FITTED = (0.0, 1.537, 3.367, 6.837, 13.724, *(0.8587 * 2.0**n for n in range(5, 16)))


def radius(i: int, perceived_blur: float | None = None) -> float:
    """Signed standard deviation of a sub-image's blur: eq. 13, or without a factor the fitted one."""
    if i == 0:
        return 0.0
    n = abs(i)
    return float(np.sign(i)) * (FITTED[n] if perceived_blur is None else perceived_blur * 0.85 * 2 ** (n - 1))


def gaussian_fit(profile: np.ndarray, at: float) -> float:
    """Sigma of the Gaussian around `at` that fits a profile best, by least squares."""
    y = np.arange(len(profile)) - at
    profile = profile / profile.sum()

    def error(sigma: float) -> float:
        bell = np.exp(-0.5 * (y / sigma) ** 2)
        return float(((profile - bell / bell.sum()) ** 2).sum())

    return float(minimize_scalar(error, bounds=(0.3, len(profile) / 4), method="bounded").x)


def fitted_sigma(steps: int) -> tuple[float, float, float]:
    """Least, mean and largest sigma of `blur` over all positions of a point in the pyramid."""
    reach = 4 * 2**steps
    sigmas = []
    for at in range(reach - 2**steps // 2, reach + 2**steps // 2):
        line = np.zeros((2 * reach, 2**steps))
        line[at] = 1.0
        sigmas.append(gaussian_fit(blur(line, steps)[:, 0], at))
    return min(sigmas), float(np.mean(sigmas)), max(sigmas)


def mattings(
    first: int, last: int, rule_last: int, c1: float, c0: float, *, paper: bool, perceived_blur: float | None
) -> dict[int, Matting]:
    """Matting functions of sub-images `first` to `last`; `rule_last` is imax."""
    if c1 == 0.0:
        return {i: Matting(ones, ones, ones) for i in range(first, last + 1)}

    def r(i: int) -> float:
        return radius(i, perceived_blur)

    def z(i: int) -> float:
        if i == 0 and c0 == 0.0:
            return 1e3 * z(-1)
        inverse = (2.0 * r(i) - c0) / c1
        return 1.0 / inverse if inverse > 0 else np.inf

    if paper:
        return {i: paper_matting(i, first, rule_last, z) for i in range(first, last + 1)}
    return {
        i: seamless_matting(i, first, rule_last, r, c1, c0, lambda i: abs(radius(i))) for i in range(first, last + 1)
    }


# --- sub-images ---------------------------------------------------------------------------------------------------


def margin(steps: int) -> int:
    """Pixels by which a sub-image reaches beyond the frame on each side."""
    return max(16, 2**steps) if steps else 0


def extended(size: int, steps: int) -> int:
    """Width or height of a sub-image."""
    unit = 2**steps
    return -(-size // unit) * unit + 2 * margin(steps)


def embed(array: np.ndarray, steps: int, value: float) -> np.ndarray:
    """Put a frame into the larger sub-image."""
    height, width = array.shape[:2]
    result = np.full((extended(height, steps), extended(width, steps), *array.shape[2:]), value)
    at = margin(steps)
    result[at : at + height, at : at + width] = array
    return result


def cull(stack: Stack, matting: Matting, first: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Colour, inverse depth and rise of each pixel's first source, from `first` on, that is not culled."""
    rise = np.zeros(stack.inverse.shape[1:])
    color, inverse = np.zeros(stack.color.shape[1:]), np.full(rise.shape, EMPTY)
    for number, (c, w, s) in enumerate(zip(*stack, strict=True), first):
        r = np.where(w < 0, 0.0, matting.rise(w, s, matting.broad(w) if number == 0 else np.ones_like(w)))
        take = (rise <= 0) & (r > 0)
        rise, inverse = np.where(take, r, rise), np.where(take, w, inverse)
        color = np.where(take[..., None], c, color)
    return color, inverse, rise


def matte(stack: Stack, matting: Matting, steps: int) -> np.ndarray:
    """A sub-image before the blur: culled, disoccluded and weighted, at its own size."""
    color, inverse, rise = cull(stack, matting)
    behind = embed(seen_behind(stack, matting), steps, 0.0)
    color, inverse, rise = embed(color, steps, 0.0), embed(inverse, steps, EMPTY), embed(rise, steps, 0.0)
    hole = inverse < 0
    color, inverse = fill(color, inverse)
    rise = np.where(hole, matting.rise(inverse, np.zeros_like(inverse), np.ones_like(inverse)), rise)
    weight = np.where(inverse < 0, 0.0, rise * matting.fall(inverse))
    return color * weight[..., None] + behind


def seen_behind(stack: Stack, matting: Matting) -> np.ndarray:
    """What the first source lets through, where it has only a share of its weight, of the next that is not culled."""
    first, slope = stack.inverse[0], stack.slope[0]
    rise = np.where(first < 0, 0.0, matting.rise(first, slope, matting.broad(first)))
    lets = np.where(rise > 0, 1.0 - rise, 0.0) * (matting.broad is not ones)
    color, inverse, behind = cull(Stack(*(part[1:] for part in stack)), matting, first=1)
    return color * (lets * behind * np.where(inverse < 0, 0.0, matting.fall(inverse)))[..., None]


def sub_image(stack: Stack, matting: Matting, steps: int) -> np.ndarray:
    """A sub-image as it is blended, (H, W, 4)."""
    height, width = stack.inverse.shape[1:]
    at = margin(steps)
    return blur(matte(stack, matting, steps), steps)[at : at + height, at : at + width]


def blend(images: list[np.ndarray]) -> np.ndarray:
    """Eq. 14, nearest first."""
    result = np.zeros_like(images[0])
    for image in images:
        result = result + (1.0 - result[..., 3:]) * image
    return result


def render(
    color: np.ndarray,
    inverse: np.ndarray,
    mattings: dict[int, Matting],
    *,
    sources: int,
    opaque: bool,
    divide: bool = True,
    guard: int = 0,
) -> np.ndarray:
    """The whole frame from its layers; `mattings` by sub-image index."""

    def run(alpha: str) -> np.ndarray:
        stack = flatten(color, inverse, sources, opaque, alpha)
        return blend([sub_image(stack, mattings[i], abs(i)) for i in sorted(mattings)])

    image = run("one")
    coverage = image[..., 3]
    known = coverage > 1e-4
    scale = np.where(known, 1.0 / np.where(known, coverage, 1.0), 0.0) if divide else np.ones_like(coverage)
    result = image * scale[..., None]
    if not opaque:
        result[..., 3] = np.minimum(run("red")[..., 0] * scale, 1.0)
    inner = slice(guard, -guard or None)
    return result[inner, inner]
