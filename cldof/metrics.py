"""How far an image is from its reference, and how wide a point is spread.

Conventions, here and nowhere else: images are ``(H, W, 3)`` or ``(H, W, 4)``, linear light; the first three channels
are compared as they are (premultiplied, that is over black) and alpha is left out. Sums are in float64. An image and
its reference are clipped to ``clip``, by default to [0, 1], before they are compared; ``clip=None`` compares them as
they are. RMS and largest errors are over pixels and channels, in linear units.

Depths and circles of confusion are those of the first peel of a frame, guard band included where it reaches in.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .errors import InputError
from .frame import LayeredFrame
from .lens import Lens

__all__ = [
    "InFocusError",
    "PointSpread",
    "WorstTile",
    "compare",
    "highlight_energy",
    "in_focus_error",
    "in_focus_region",
    "psf_profile",
    "psf_radius",
    "psnr",
    "rms_error",
    "silhouette_band",
    "silhouette_band_error",
    "ssim",
    "worst_tile",
]

Clip = tuple[float, float] | None

# SSIM's window: a Gaussian of 1.5 px cut off at 3.5 sigma, 11 x 11, as Wang et al. 2004 have it.
_SSIM_SIGMA, _SSIM_WINDOW = 1.5, 11
# Radii of a band are rounded up to these steps, at most 1/8 too wide, so that few distance transforms do.
_RADIUS_GROWTH = 1.125
# A pixel with this CoC or less counts as in focus.
_IN_FOCUS_PX = 0.5


class InFocusError(NamedTuple):
    """Error inside the region in focus; NaN where ``pixels`` is 0."""

    rms: float
    max: float
    pixels: int


class WorstTile(NamedTuple):
    """The tile with the largest RMS error; ``x``, ``y`` is its top left pixel."""

    rms: float
    x: int
    y: int


class PointSpread(NamedTuple):
    """A point's image: what :func:`psf_radius` measures, in pixels and linear units."""

    second_moment_radius_px: float
    edge_radius_px: float
    x: float
    y: float
    energy: float


def psnr(image: ArrayLike, reference: ArrayLike, clip: Clip = (0.0, 1.0)) -> float:
    """Peak signal-to-noise ratio in dB of linear RGB.

    Parameters
    ----------
    image, reference : array_like, (H, W, 3) or (H, W, 4)
    clip : (low, high) or None
        Both are clipped to it and the peak is ``high - low``; with None nothing is clipped and the peak is 1.

    Returns
    -------
    float
        ``inf`` for images that are equal.

    Raises
    ------
    InputError
        Shapes that differ or are no images, NaN or infinite values, an empty clip range.
    """
    first, second = _pair(image, reference, clip)
    if np.array_equal(first, second):
        return math.inf
    from skimage.metrics import peak_signal_noise_ratio

    return float(peak_signal_noise_ratio(second, first, data_range=_peak(clip)))


def ssim(image: ArrayLike, reference: ArrayLike, clip: Clip = (0.0, 1.0)) -> float:
    """Structural similarity of linear RGB, mean over pixels and channels; 1 for equal images.

    Wang et al. 2004: Gaussian window of 1.5 px (11 x 11), K1 = 0.01, K2 = 0.03, population covariance, data range
    ``high - low`` of ``clip`` (1 without). The 5 px at the border, where the window does not fit, are left out.

    Parameters, errors: as :func:`psnr`; images smaller than 11 x 11 are refused.
    """
    first, second = _pair(image, reference, clip)
    if min(first.shape[:2]) < _SSIM_WINDOW:
        raise InputError(f"ssim needs images of at least 11 x 11 px; got shape {first.shape}.")
    from skimage.metrics import structural_similarity

    return float(
        structural_similarity(
            second,
            first,
            data_range=_peak(clip),
            channel_axis=-1,
            gaussian_weights=True,
            sigma=_SSIM_SIGMA,
            use_sample_covariance=False,
        )
    )


def rms_error(image: ArrayLike, reference: ArrayLike, clip: Clip = (0.0, 1.0)) -> float:
    """Root of the mean squared difference over pixels and channels; parameters and errors as :func:`psnr`."""
    return math.sqrt(float(_squared_error(image, reference, clip).mean()))


def silhouette_band(frame: LayeredFrame, lens: Lens, width_px: float = 2.0, step_px: float = 0.5) -> NDArray[np.bool_]:
    """Pixels near depth discontinuities of the first peel, as far as the blur there reaches.

    Two neighbours lie across a discontinuity if their CoC radii differ by more than ``step_px``, and differ by as much
    from what either side's slope would lead to: on a plane, at any slant, ``1/z`` and so the CoC change evenly. The
    band holds all pixels within ``width_px`` plus the larger of the two CoC radii (at most 1/8 more, for speed).

    Parameters
    ----------
    frame : LayeredFrame
    lens : Lens
    width_px, step_px : float
        Pixels; the width at least 0, the step above 0.

    Returns
    -------
    ndarray, (H, W), bool
        Size of the image, guard band cropped; all False for a pinhole.

    Raises
    ------
    InputError
    """
    _check_scene(frame, lens)
    if not 0.0 <= width_px < math.inf or not 0.0 < step_px < math.inf:
        raise InputError(f"width_px and step_px are {width_px} and {step_px}; they must be finite, at least 0.")
    coc = lens.coc_radius_px(frame.camera, frame.depth[0])
    reach = np.zeros_like(coc)  # 0: no discontinuity here
    for axis in (0, 1):
        low, high = _ends(coc, axis)
        jump = _jumps(coc, axis, step_px)
        radius = np.where(jump, np.maximum(np.abs(low), np.abs(high)) + width_px, 0.0)
        for side in _ends(reach, axis):
            np.maximum(side, radius, out=side)
    return _crop(_within_reach(reach, _RADIUS_GROWTH), frame)


def silhouette_band_error(
    image: ArrayLike,
    reference: ArrayLike,
    frame: LayeredFrame,
    lens: Lens,
    width_px: float = 2.0,
    clip: Clip = (0.0, 1.0),
) -> float:
    """RMS error inside :func:`silhouette_band`; NaN where the frame has no such band.

    Raises
    ------
    InputError
        As :func:`psnr`, and for images that are not of the frame's size.
    """
    squared = _squared_error(image, reference, clip, frame)
    band = silhouette_band(frame, lens, width_px)
    return math.sqrt(float(squared[band].mean())) if band.any() else math.nan


def in_focus_region(frame: LayeredFrame, lens: Lens) -> NDArray[np.bool_]:
    """Opaque pixels of the first peel with a CoC radius below 0.5 px that nothing blurred in front of them reaches.

    A nearer pixel reaches as far as its CoC radius plus one pixel. What lies behind cannot reach: light of it on a
    surface in focus is an error that this region is there to find.

    Parameters
    ----------
    frame : LayeredFrame
    lens : Lens
        Its aperture counts as within its radius; a Gaussian reaches farther, so it counts as of twice its radius.

    Returns
    -------
    ndarray, (H, W), bool
    """
    _check_scene(frame, lens)
    coc = lens.coc_radius_px(frame.camera, frame.depth[0])
    alpha = frame.color[0, ..., 3]
    spread = 2.0 if lens.aperture.shape == "gaussian" else 1.0
    near = (coc <= -_IN_FOCUS_PX) & (alpha > 0.0)
    covered = _within_reach(np.where(near, 1.0 - spread * coc, 0.0), _RADIUS_GROWTH)
    return _crop((np.abs(coc) < _IN_FOCUS_PX) & (alpha >= 1.0 - 1e-3) & ~covered, frame)


def in_focus_error(
    image: ArrayLike, reference: ArrayLike, frame: LayeredFrame, lens: Lens, clip: Clip = (0.0, 1.0)
) -> InFocusError:
    """RMS and largest error inside :func:`in_focus_region`; errors as :func:`silhouette_band_error`."""
    squared = _squared_error(image, reference, clip, frame)[in_focus_region(frame, lens)]
    if not squared.size:
        return InFocusError(math.nan, math.nan, 0)
    return InFocusError(math.sqrt(float(squared.mean())), math.sqrt(float(squared.max())), len(squared))


def worst_tile(image: ArrayLike, reference: ArrayLike, size: int = 16, clip: Clip = (0.0, 1.0)) -> WorstTile:
    """The square tile of ``size`` pixels with the largest RMS error; tiles at the right and bottom may be cut short.

    Tiles lie on a grid from the top left pixel; the first of equals counts. Errors as :func:`psnr`.
    """
    if isinstance(size, bool) or size != int(size) or size < 1:
        raise InputError(f"size is {size!r}; a tile is a whole number of pixels, at least 1.")
    squared = _squared_error(image, reference, clip).mean(axis=2)
    rows, columns = (np.arange(0, length, int(size)) for length in squared.shape)
    sums = np.add.reduceat(np.add.reduceat(squared, rows, axis=0), columns, axis=1)
    heights, widths = (np.diff(at, append=n) for at, n in zip((rows, columns), squared.shape, strict=True))
    means = sums / (heights[:, None] * widths)
    row, column = np.unravel_index(int(means.argmax()), means.shape)
    return WorstTile(math.sqrt(float(means[row, column])), int(columns[column]), int(rows[row]))


def highlight_energy(image: ArrayLike, reference: ArrayLike) -> float:
    """Light above 1 in the image over that in the reference: ``sum(max(rgb - 1, 0))``, never clipped.

    1 is right, less means that highlights are dimmed or spread too far. 1 if neither has any, ``inf`` if only the image
    has. Errors as :func:`psnr`.
    """
    first, second = (float(np.maximum(each - 1.0, 0.0).sum()) for each in _pair(image, reference, None))
    if second == 0.0:
        return 1.0 if first == 0.0 else math.inf
    return first / second


def psf_profile(
    image: ArrayLike, center: tuple[float, float] | None = None, bin_px: float = 1.0
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Mean light of a point's image over the distance from its centre.

    Parameters
    ----------
    image : array_like, (H, W), (H, W, 3) or (H, W, 4)
        A point blurred over black, nothing else; RGB is averaged.
    center : (x, y), optional
        In pixels, the centre of the top left pixel at (0, 0); the centroid by default.
    bin_px : float
        Width of the rings.

    Returns
    -------
    radius_px, light : ndarray, (bins,), float64
        Mean distance of the pixels in each ring and their mean light, out to the nearest border; empty rings are left
        out.

    Raises
    ------
    InputError
        No image, or none of it lit.
    """
    light = _point_image(image)
    if not 0.0 < bin_px < math.inf:
        raise InputError(f"bin_px is {bin_px}; it must be positive and finite.")
    x, y = center if center is not None else _centroid(light)
    height, width = light.shape
    limit = min(x, y, width - 1 - x, height - 1 - y)
    rows, columns = np.indices(light.shape)
    distance = np.hypot(columns - x, rows - y)
    inside = distance <= max(limit, 0.0)
    number = (distance[inside] / bin_px).astype(np.intp)
    pixels = np.bincount(number)
    filled = pixels > 0
    return (
        (np.bincount(number, distance[inside])[filled] / pixels[filled]),
        (np.bincount(number, light[inside])[filled] / pixels[filled]),
    )


def psf_radius(image: ArrayLike, pixel_variance_px2: float = 1.0 / 6.0) -> PointSpread:
    """Radius of a point's image in two ways that agree for a uniform disc, centre and energy.

    The second-moment radius is ``sqrt(2 E[r^2])`` about the centroid, less what pixels add; for a Gaussian lens
    (sigma = half the radius) it is the aperture's radius in pixels as well. The edge radius is where the radial profile
    (:func:`psf_profile`, rings of half a pixel) falls to half its mean level inside half the second-moment radius.

    Parameters
    ----------
    image : array_like, (H, W), (H, W, 3) or (H, W, 4)
        As :func:`psf_profile`.
    pixel_variance_px2 : float
        What the pixels add to ``E[r^2]``: 1/12 on each axis for a box or for a point that moves in whole pixels.

    Raises
    ------
    InputError
        No image, or none of it lit.
    """
    light = _point_image(image)
    x, y = _centroid(light)
    energy = float(light.sum())
    rows, columns = np.indices(light.shape)
    squared = (columns - x) ** 2 + (rows - y) ** 2
    variance = float((light * squared).sum()) / energy - pixel_variance_px2
    moment = math.sqrt(2.0 * max(variance, 0.0))
    radius, profile = psf_profile(light, (x, y), 0.5)
    core = squared <= max(0.5 * moment, 1.0) ** 2
    half = 0.5 * float(light[core].mean())
    below = np.flatnonzero((profile < half) & (radius > 0.5 * moment))
    if below.size and below[0] > 0:
        after = int(below[0])
        step = profile[after - 1] - profile[after]
        share = (profile[after - 1] - half) / step if step > 0.0 else 0.0
        edge = float(radius[after - 1] + share * (radius[after] - radius[after - 1]))
    else:
        edge = math.nan  # the border comes first
    return PointSpread(moment, edge, x, y, energy)


def compare(
    image: ArrayLike,
    reference: ArrayLike,
    frame: LayeredFrame | None = None,
    lens: Lens | None = None,
    width_px: float = 2.0,
    clip: Clip = (0.0, 1.0),
) -> dict[str, float]:
    """All measures of an image against its reference as plain floats.

    Parameters
    ----------
    image, reference : array_like, (H, W, 3) or (H, W, 4)
    frame, lens : LayeredFrame and Lens, optional
        Both or neither; they tell where silhouettes are and what is in focus.
    width_px, clip
        As :func:`silhouette_band_error`, :func:`psnr`.

    Returns
    -------
    dict of str to float
        ``psnr_db``, ``ssim``, ``rms``, ``max``, ``highlight_energy``, ``worst_tile_rms``, ``worst_tile_x``,
        ``worst_tile_y``; with a frame also ``silhouette_band_rms``, ``silhouette_band_pixels``, ``in_focus_rms``,
        ``in_focus_max``, ``in_focus_pixels``. What there is not is left out, so that all values but two are finite: the
        SSIM of images smaller than its window, the errors of a region without pixels. The PSNR of equal images and the
        energy of highlights that only the image has are ``inf``, which strict JSON has no word for.

    Raises
    ------
    InputError
    """
    if (frame is None) != (lens is None):
        raise InputError("compare takes a frame and a lens together, or neither.")
    first, second = _pair(image, reference, clip)
    squared = np.square(first - second)
    tile = worst_tile(image, reference, clip=clip)
    found: dict[str, float] = {
        "psnr_db": psnr(image, reference, clip),
        "rms": math.sqrt(float(squared.mean())),
        "max": math.sqrt(float(squared.max())),
        "highlight_energy": highlight_energy(image, reference),
        "worst_tile_rms": tile.rms,
        "worst_tile_x": float(tile.x),
        "worst_tile_y": float(tile.y),
    }
    if min(first.shape[:2]) >= _SSIM_WINDOW:
        found["ssim"] = ssim(image, reference, clip)
    if frame is not None and lens is not None:
        _check_size(squared, frame)
        band, region = silhouette_band(frame, lens, width_px), in_focus_region(frame, lens)
        for name, mask in (("silhouette_band", band), ("in_focus", region)):
            found[f"{name}_pixels"] = float(np.count_nonzero(mask))
            if mask.any():
                found[f"{name}_rms"] = math.sqrt(float(squared[mask].mean()))
        if region.any():
            found["in_focus_max"] = math.sqrt(float(squared[region].max()))
    return found


def _peak(clip: Clip) -> float:
    return 1.0 if clip is None else clip[1] - clip[0]


def _pair(image: ArrayLike, reference: ArrayLike, clip: Clip) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Both as clipped float64 RGB, checked."""
    if clip is not None and not (len(clip) == 2 and -math.inf < clip[0] < clip[1] < math.inf):
        raise InputError(f"clip is {clip!r}; it must be (low, high) with low < high, both finite, or None.")
    arrays = []
    for name, value in (("image", image), ("reference", reference)):
        array = np.asarray(value)
        if array.ndim != 3 or array.shape[2] not in (3, 4) or array.size == 0:
            raise InputError(f"{name} has shape {array.shape}; it must be (height, width, 3 or 4).")
        if array.dtype.kind != "f":
            raise InputError(f"{name} has dtype {array.dtype}; images are compared in linear light, as floats.")
        rgb = array[..., :3].astype(np.float64)
        if not np.isfinite(rgb).all():
            raise InputError(f"{name} has {np.count_nonzero(~np.isfinite(rgb))} NaN or infinite values.")
        arrays.append(rgb)
    first, second = arrays
    if first.shape != second.shape:
        raise InputError(f"image and reference have shapes {np.shape(image)} and {np.shape(reference)}.")
    if clip is not None:
        for array in arrays:
            np.clip(array, *clip, out=array)
    return first, second


def _squared_error(
    image: ArrayLike, reference: ArrayLike, clip: Clip, frame: LayeredFrame | None = None
) -> NDArray[np.float64]:
    first, second = _pair(image, reference, clip)
    if frame is not None:
        _check_size(first, frame)
    first -= second
    return np.square(first, out=first)


def _check_size(array: NDArray[np.float64], frame: LayeredFrame) -> None:
    if not isinstance(frame, LayeredFrame):
        raise InputError(f"frame is {type(frame).__name__}; it must be a cldof.LayeredFrame.")
    size = (frame.camera.height, frame.camera.width)
    if array.shape[:2] != size:
        raise InputError(f"The images are {array.shape[1]}x{array.shape[0]} px, the frame is {size[1]}x{size[0]} px.")


def _check_scene(frame: LayeredFrame, lens: Lens) -> None:
    if not isinstance(frame, LayeredFrame) or not isinstance(lens, Lens):
        raise InputError(f"This takes a LayeredFrame and a Lens; got {type(frame).__name__}, {type(lens).__name__}.")


def _crop(mask: NDArray[np.bool_], frame: LayeredFrame) -> NDArray[np.bool_]:
    guard = frame.guard_px
    inner = slice(guard, -guard or None)
    return mask[inner, inner]


def _ends(array: NDArray[np.float64], axis: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Views of all but the last and all but the first along an axis: the two sides of each pair of neighbours."""
    lines = array if axis == 0 else array.T
    low, high = lines[:-1], lines[1:]
    return (low, high) if axis == 0 else (low.T, high.T)


def _jumps(coc: NDArray[np.float64], axis: int, step_px: float) -> NDArray[np.bool_]:
    """Pairs of neighbours that lie across a discontinuity."""
    low, high = _ends(coc, axis)
    difference = high - low
    # The slope on either side; none beyond the border.
    padding = [(1, 1) if axis == 0 else (0, 0), (0, 0) if axis == 0 else (1, 1)]
    padded = np.pad(difference, padding)
    length = difference.shape[axis]
    before, after = (np.take(padded, range(start, start + length), axis=axis) for start in (0, 2))
    least = np.minimum(np.abs(difference - before), np.abs(difference - after))
    return np.asarray((np.abs(difference) > step_px) & (least > step_px))


def _within_reach(reach_px: NDArray[np.float64], growth: float) -> NDArray[np.bool_]:
    """Pixels no farther from some pixel than that pixel's ``reach_px`` (0: none), rounded up to steps of ``growth``."""
    covered = np.zeros(reach_px.shape, np.bool_)
    if not (reach_px > 0.0).any():
        return covered
    from skimage.morphology import isotropic_dilation

    # Levels below 8 px are whole pixels; distances between pixels that matter there are no finer.
    level = np.where(reach_px > 8.0, np.ceil(np.log(np.maximum(reach_px, 8.0) / 8.0) / math.log(growth)) + 8.0, 0.0)
    level = np.where((reach_px > 0.0) & (level == 0.0), np.ceil(reach_px), level)
    for number in np.unique(level[level > 0.0]):
        radius = number if number <= 8.0 else 8.0 * growth ** (number - 8.0)
        covered |= isotropic_dilation(level == number, radius)
    return covered


def _point_image(image: ArrayLike) -> NDArray[np.float64]:
    array = np.asarray(image)
    if array.ndim == 3 and array.shape[2] in (3, 4):
        array = array[..., :3].mean(axis=2, dtype=np.float64)
    if array.ndim != 2 or array.size == 0:
        raise InputError(f"image has shape {np.shape(image)}; it must be (height, width), or with 3 or 4 channels.")
    light = array.astype(np.float64)
    if not np.isfinite(light).all() or not light.sum() > 0.0:
        raise InputError("image must be finite and show a point of light over black; it is dark or has NaN.")
    return light


def _centroid(light: NDArray[np.float64]) -> tuple[float, float]:
    total = light.sum()
    rows, columns = np.indices(light.shape)
    return float((light * columns).sum() / total), float((light * rows).sum() / total)
