"""The accumulation reference: the scene drawn from many points on the lens, and averaged.

Haeberli & Akeley 1990, "The Accumulation Buffer". Each view's frustum is sheared so that the plane in focus stays where
it is, to the last bit (shaders/projection.glsl). It is drawn by the passes that also make the layers, so a method that
is compared with it differs by its blur alone. docs/reference.md tells how it was proven.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..camera import Camera
from ..errors import InputError
from ..lens import Aperture, Lens, lens_samples
from .peel import DepthPeeler, Progress
from .scene import Scene

__all__ = ["Reference", "accumulate"]

# Where alpha is coverage, this many surfaces one behind the other count; an opaque one ends the pixel earlier.
_MAX_BLENDED = 16
# Halves of fewer views say nothing: their points are mostly where centring has put them.
_FEWEST_TO_HALVE = 8
# Degree, coefficients and first direction numbers of the primitive polynomials of Sobol's first four axes.
_SOBOL: tuple[tuple[int, int, tuple[int, ...]], ...] = ((0, 0, ()), (1, 0, (1,)), (2, 1, (1, 3)), (3, 1, (1, 3, 1)))


@dataclass(frozen=True, eq=False)
class Reference:
    """An accumulated image, and how far its own noise reaches.

    Attributes
    ----------
    image : ndarray, (H, W, 4), float32
        Linear light, premultiplied: the mean over all views, summed in float64.
    views : int
        How many were drawn.
    noise_rms : float or None
        RMS error that is left in ``image``, estimated from two independent halves of the views: RGB clipped to [0, 1],
        ``rms(half1 - half2) / 2``. 0 where one view is exact, None for a single
        pattern, which fewer than 8 views always are.
    seconds : float
        Wall time that it took to draw.
    is_cached : bool
        Read from disk; ``seconds`` is then that of the run that made it.
    """

    image: NDArray[np.float32]
    views: int
    noise_rms: float | None
    seconds: float
    is_cached: bool = False

    @property
    def noise_floor_db(self) -> float | None:
        """PSNR (peak 1) of the image against the exact one as far as noise goes; ``inf`` for an exact image.

        A method that comes closer to the image than this cannot be told from a perfect one.
        """
        if self.noise_rms is None:
            return None
        return -20.0 * math.log10(self.noise_rms) if self.noise_rms > 0.0 else math.inf

    def to_dict(self) -> dict[str, Any]:
        """All but the image, for reports; an exact image has a ``noise_rms`` of 0 and no ``noise_floor_db``."""
        floor = self.noise_floor_db
        return {
            "views": self.views,
            "noise_rms": self.noise_rms,
            "noise_floor_db": None if floor is None or math.isinf(floor) else floor,
            "seconds": self.seconds,
        }


def accumulate(
    peeler: DepthPeeler,
    scene: Scene,
    camera: Camera,
    lens: Lens,
    views: int = 256,
    shape: Aperture | str | None = None,
    jitter: bool = False,
    seed: int = 0,
    progress: Progress | None = None,
    noise_floor: bool = True,
    view_dependent: bool = True,
) -> Reference:
    """Depth of field by brute force.

    Parameters
    ----------
    peeler : DepthPeeler
        Its context, uploads and framebuffers are used.
    scene : Scene
    camera : Camera
        No guard band is needed: each view draws what it sees.
    lens : Lens
    views : int
        Points on the lens; the error falls about with ``views ** -0.75``. A pinhole without jitter needs one, and gets
        one.
    shape : Aperture or {"disc", "gaussian"}, optional
        In place of the lens's own aperture.
    jitter : bool
        Also move each view inside the pixel (seeded): edges become those of box-filtered pixels, which judges the
        picture. Layers have hard edges: leave it off to judge the method.
    seed : int, at least 0
        The same one gives the same bits.
    progress : callable, optional
        Called with (views done, views).
    noise_floor : bool
        Draw two independent halves, which tell the noise of their mean. Without, all views are points of one pattern,
        whose error is 1 to 2 dB smaller but unknown.
    view_dependent : bool
        Each view shades what is glossy as its own lens point sees it, as a lens does. False: as the lens centre sees
        it, which judges the blur of a method that knows no more than that.

    Returns
    -------
    Reference

    Raises
    ------
    InputError, SceneError, CaptureError
    """
    start = time.perf_counter()
    plan = view_plan(lens, views, shape, jitter, seed, noise_floor)
    total = sum(len(points) for points, _ in plan)
    sums: list[NDArray[np.float64]] = []
    done = 0
    with peeler.current():
        for points, shifts in plan:
            part = np.zeros((camera.height, camera.width, 4))
            for image in _draw(peeler, scene, camera, lens, points, shifts, view_dependent):
                part += image  # float32 into float64 in place: 2 ms a megapixel, a few per cent of drawing a view
                done += 1
                if progress is not None:
                    progress(done, total)
            sums.append(part)
    noise_rms = 0.0 if _is_exact(lens, jitter) else None
    if len(sums) == 2:
        first, second = (len(points) for points, _ in plan)
        noise_rms = _rms_difference(sums[0] / first, sums[1] / second) * math.sqrt(first * second) / total
        sums[0] += sums[1]
    # Sums of equal float32 values are exact in float64, so what is in focus comes out with its bits.
    image = (sums[0] / total).astype(np.float32)
    return Reference(image, total, noise_rms, time.perf_counter() - start)


def view_plan(
    lens: Lens, views: int, shape: Aperture | str | None, jitter: bool, seed: int, noise_floor: bool
) -> list[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Lens points in metres and shifts in pixels, (N, 2) each, of one or two independent sets of views.

    Raises
    ------
    InputError
    """
    if isinstance(views, bool) or views != int(views) or views < 1:
        raise InputError(f"views is {views!r}; it must be a whole number, at least 1.")
    if isinstance(seed, bool) or seed != int(seed) or seed < 0:
        raise InputError(f"seed is {seed!r}; it must be a whole number, at least 0.")
    views, seed = int(views), int(seed)
    aperture = lens.aperture if shape is None else Aperture.of(shape)
    if _is_exact(lens, jitter):
        views = 1
    counts = [views - views // 2, views // 2] if noise_floor and views >= _FEWEST_TO_HALVE else [views]
    plan = []
    for half, count in enumerate(counts):
        number = 2 * seed + half
        if jitter:
            # Lens and pixel make a 4-D integral; points that are even in each of the two alone resonate in it.
            square = _scrambled_sobol(count, number)
            points, shifts = aperture.place(square[:, 0], square[:, 1]), square[:, 2:] - square[:, 2:].mean(axis=0)
        else:
            points, shifts = lens_samples(count, aperture, number), np.zeros((count, 2))
        plan.append((points * lens.aperture_radius_m, shifts))
    return plan


def _is_exact(lens: Lens, jitter: bool) -> bool:
    """Whether all views are the same, so that one is enough."""
    return lens.aperture_radius_m == 0.0 and not jitter


def _draw(
    peeler: DepthPeeler,
    scene: Scene,
    camera: Camera,
    lens: Lens,
    points: NDArray[np.float64],
    shifts: NDArray[np.float64],
    view_dependent: bool,
) -> Iterator[NDArray[np.float32]]:
    """Draw view after view, inside :meth:`DepthPeeler.current`. An image is overwritten by the next."""
    from .draw import PassOptions, View

    # Each view culls what it sees from behind itself; a surface is blended only where alpha says so.
    options = PassOptions(lens_reach_m=0.0, stop_at_opaque=scene.has_blending)
    layers = _MAX_BLENDED if scene.has_blending else 1
    image = np.empty((camera.height, camera.width, 4), np.float32)
    layer = np.empty_like(image) if layers > 1 else image
    for point, shift in zip(points, shifts, strict=True):
        view = View(camera, (point[0], point[1]), lens.focus_distance_m, (shift[0], shift[1]), view_dependent)
        is_empty = True
        for target in peeler.passes(scene, view, layers, options):
            if is_empty:
                target.read(0, image)
                is_empty = False
            else:
                target.read(0, layer)
                layer *= 1.0 - image[..., 3:]
                image += layer
        if is_empty:
            image.fill(0.0)
        yield image


def _rms_difference(first: NDArray[np.float64], second: NDArray[np.float64]) -> float:
    """Of RGB clipped to [0, 1], as metrics.psnr compares images."""
    difference = np.clip(first[..., :3], 0.0, 1.0) - np.clip(second[..., :3], 0.0, 1.0)
    return math.sqrt(float(np.square(difference, out=difference).mean()))


def _scrambled_sobol(count: int, seed: int) -> NDArray[np.float64]:
    """(count, 4) points in [0, 1): Sobol's sequence (Joe & Kuo 2008), digits scrambled at random (Matousek 1998)."""
    bits = 32
    random = np.random.default_rng([seed, 1])
    place = np.uint64(1) << np.arange(bits, dtype=np.uint64)[::-1]  # value of the binary digits, first one first
    index = np.arange(count, dtype=np.uint64)
    points = np.empty((count, 4))
    for axis, (degree, coefficients, first) in enumerate(_SOBOL):
        directions = np.zeros((bits, bits), np.int64)  # row k: binary digits of direction number k
        for k in range(bits):
            if degree == 0:
                directions[k, k] = 1
            elif k < degree:
                directions[k, : k + 1] = [first[k] >> (k - digit) & 1 for digit in range(k + 1)]
            else:
                directions[k] = directions[k - degree]
                directions[k, degree:] ^= directions[k - degree, : bits - degree]
                for back in range(1, degree):
                    if coefficients >> (degree - 1 - back) & 1:
                        directions[k] ^= directions[k - back]
        scramble = np.tril(random.integers(0, 2, (bits, bits)), -1) + np.eye(bits, dtype=np.int64)
        numbers = ((directions @ scramble.T) % 2).astype(np.uint64) @ place
        value = np.full(count, random.integers(0, 1 << bits), np.uint64)
        for k in range(max(1, (count - 1).bit_length())):
            value ^= np.where((index >> np.uint64(k)) & np.uint64(1), numbers[k], np.uint64(0))
        points[:, axis] = value / 2.0**bits
    return points
