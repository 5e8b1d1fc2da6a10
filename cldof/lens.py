"""The thin lens: aperture, focus, and the one place where the circle of confusion is derived.

For a point at planar depth ``z`` a thin lens of radius ``R`` focused at ``zf`` spreads light over a disc on the image
plane. With the image plane at ``focal_px`` pixels from the lens (see :attr:`cldof.Camera.focal_px`) its signed radius
in pixels is (Potmesil & Chakravarty 1981, eq. 5, rewritten in inverse depth)

    C(z) = c1 * (1/z - 1/zf) = c1 * w + c0,   c1 = -focal_px * R,   c0 = -c1 / zf,   w = 1/z

negative nearer than focus. It is affine in ``w``, so kernels get ``c1`` and ``c0`` and need one multiply-add; there is
no cancellation at infinity and none for a lens focused at infinity.

What the blur of a point looks like is the shape of the :class:`Aperture`. Points on it are ``(x, y)`` in units of the
aperture radius, x right and y up as seen from behind the camera. A point behind focus shows the shape upright; one
before focus shows it turned by 180 degrees.
"""

from __future__ import annotations

import hashlib
import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field, fields
from functools import cached_property
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .camera import Camera
from .errors import InputError

__all__ = [
    "GAUSSIAN_SIGMA",
    "Aperture",
    "CocCoefficients",
    "DiscAperture",
    "GaussianAperture",
    "ImageAperture",
    "Lens",
    "PolygonAperture",
    "lens_samples",
]

# Standard deviation of a Gaussian lens in aperture radii: CoC diameter = 4 sigma (Schedl & Wimmer 2012, eq. 10).
GAUSSIAN_SIGMA = 0.5

# Angles at which the rim of one blade is tabulated; the largest error of the inverse is 1e-7 of the blade.
_BLADE_STEPS = 2048
# An aperture image may lose this share of its light outside the unit disc (an antialiased rim), not more.
_IMAGE_OUTSIDE = 0.01

# Of the coefficients of the CoC, in px and px m: their products with inverse depths and scales fit float32.
_LARGEST_COEFFICIENT = 1e15

_GOLDEN = (math.sqrt(5.0) - 1.0) / 2.0


@dataclass(frozen=True)
class Aperture(ABC):
    """The shape of the hole that light comes through; base of the family.

    Every shape but a Gaussian lies within the unit disc, so that the CoC radius is the farthest that light spreads.

    Parameters
    ----------
    ratio : float
        Anamorphic ratio, height over width: 2 squeezes the shape to half its width, 0.5 to half its height. The longer
        axis keeps its length. Rotation comes first, so the squeeze is always along the image's axes.

    Raises
    ------
    InputError
        A parameter is out of range.
    """

    shape: ClassVar[str]

    ratio: float = field(default=1.0, kw_only=True)

    def __post_init__(self) -> None:
        object.__setattr__(self, "ratio", checked_number(self.ratio, "Aperture ratio"))
        if not 0.0 < self.ratio < math.inf:
            raise InputError(f"Aperture ratio is {self.ratio}; height over width must be positive and finite.")

    @staticmethod
    def of(what: Aperture | str) -> Aperture:
        """An aperture as it is, or one of those that need no parameters by name: ``"disc"``, ``"gaussian"``."""
        if isinstance(what, Aperture):
            return what
        if what == "disc":
            return DiscAperture()
        if what == "gaussian":
            return GaussianAperture()
        raise InputError(f"Lens shape {what!r} is unknown; use 'disc', 'gaussian' or a cldof.lens.Aperture.")

    def samples(self, count: int, seed: int = 0) -> NDArray[np.float64]:
        """Low-discrepancy points, equally weighted; see :func:`lens_samples`."""
        if isinstance(count, bool) or count != int(count) or count < 1:
            raise InputError(f"lens_samples needs at least 1 sample, a whole number; got {count!r}.")
        if isinstance(seed, bool) or seed != int(seed) or seed < 0:
            raise InputError(f"seed is {seed!r}; it must be a whole number, at least 0.")
        index = np.arange(int(count))
        offset = np.random.default_rng(int(seed)).random(2)
        return self.place((index + offset[0]) / count, (index * _GOLDEN + offset[1]) % 1.0)

    def place(self, u: NDArray[np.float64], v: NDArray[np.float64]) -> NDArray[np.float64]:
        """Map evenly spread points of the unit square to the lens, equal areas to equal light, and centre them.

        Parameters
        ----------
        u, v : ndarray, (N,), float64
            In [0, 1).

        Returns
        -------
        ndarray, (N, 2), float64
            As :func:`lens_samples`.
        """
        return np.asarray(self._place(u, v) * (min(1.0, 1.0 / self.ratio), min(1.0, self.ratio)))

    @abstractmethod
    def _place(self, u: NDArray[np.float64], v: NDArray[np.float64]) -> NDArray[np.float64]:
        """Map points of the unit square to the unsqueezed shape, (N, 2), so that equal areas get equal light."""

    def to_dict(self) -> dict[str, Any]:
        """Plain values for reports and metadata."""
        return {"shape": self.shape} | {f.name: getattr(self, f.name) for f in fields(self)}


@dataclass(frozen=True)
class DiscAperture(Aperture):
    """A uniform disc of radius 1."""

    shape: ClassVar[str] = "disc"

    def _place(self, u: NDArray[np.float64], v: NDArray[np.float64]) -> NDArray[np.float64]:
        return _centred(_polar(np.sqrt(u), 2.0 * math.pi * v), u, np.ones_like)


@dataclass(frozen=True)
class GaussianAperture(Aperture):
    """A Gaussian of standard deviation :data:`GAUSSIAN_SIGMA`. It has no rim: 256 samples reach about 1.8 radii."""

    shape: ClassVar[str] = "gaussian"

    def _place(self, u: NDArray[np.float64], v: NDArray[np.float64]) -> NDArray[np.float64]:
        # Inverse of the Rayleigh distribution.
        points = _polar(GAUSSIAN_SIGMA * np.sqrt(-2.0 * np.log1p(-u)), 2.0 * math.pi * v)
        return np.asarray(points - points.mean(axis=0))


@dataclass(frozen=True)
class PolygonAperture(Aperture):
    """A regular polygon with its corners on the unit circle, as the blades of an iris leave it.

    Parameters
    ----------
    blades : int
        Corners, 3 to 64.
    rotation_deg : float
        Counter-clockwise; at 0 a corner lies on the x axis, to the right.
    curvature : float, 0 to 1
        Of the blades: each is an arc through its two corners, from straight (0) to that of the disc (1).
    """

    shape: ClassVar[str] = "polygon"

    blades: int = 6
    rotation_deg: float = 0.0
    curvature: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        blades = checked_number(self.blades, "Aperture blades")
        if isinstance(self.blades, bool) or not 3 <= blades <= 64 or blades != int(blades):
            raise InputError(f"Aperture blades is {self.blades!r}; it must be a whole number, 3 to 64.")
        object.__setattr__(self, "blades", int(blades))
        for name in ("rotation_deg", "curvature"):
            object.__setattr__(self, name, checked_number(getattr(self, name), f"Aperture {name}"))
        if not math.isfinite(self.rotation_deg):
            raise InputError(f"Aperture rotation_deg is {self.rotation_deg}; it must be finite.")
        if not 0.0 <= self.curvature <= 1.0:
            raise InputError(f"Aperture curvature is {self.curvature}; it must lie between 0 (straight) and 1 (disc).")

    def rim(self, angle_rad: ArrayLike) -> NDArray[np.float64]:
        """Distance of the rim from the centre at angles counter-clockwise from the x axis, before the squeeze.

        Notes
        -----
        With ``a`` and ``s`` cosine and sine of half a blade's angle, an arc of curvature ``c`` through the two corners
        has its centre at ``a - q/c`` on the blade's normal, ``q = sqrt(1 - c^2 s^2)``. A ray at angle ``t`` from the
        normal meets it where ``c r^2 + 2 (q - c a) cos(t) r = 2 a q - c (a^2 - s^2)``, which is solved in the form
        that holds for ``c = 0`` too.
        """
        half, c = math.pi / self.blades, self.curvature
        a, s = math.cos(half), math.sin(half)
        q = math.sqrt(1.0 - (c * s) ** 2)
        turned = np.asarray(angle_rad, dtype=np.float64) - math.radians(self.rotation_deg)
        b = (q - c * a) * np.cos(turned % (2.0 * half) - half)
        e = 2.0 * a * q - c * (a * a - s * s)
        return np.asarray(e / (b + np.sqrt(b * b + c * e)))

    @property
    def area(self) -> float:
        """Of the shape before the squeeze; pi for the disc."""
        return float(self.blades * self._blade[1][-1])

    @cached_property
    def _blade(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Angles across one blade from its first corner, and the area swept up to each."""
        angle = np.linspace(0.0, 2.0 * math.pi / self.blades, _BLADE_STEPS + 1)
        middle = (angle[1:] + angle[:-1]) / 2.0
        turn = math.radians(self.rotation_deg)
        density = [0.5 * self.rim(at + turn) ** 2 for at in (angle, middle)]
        steps = (density[0][1:] + density[0][:-1] + 4.0 * density[1]) * (angle[1] / 6.0)  # Simpson
        return angle, np.concatenate([[0.0], np.cumsum(steps)])

    def _place(self, u: NDArray[np.float64], v: NDArray[np.float64]) -> NDArray[np.float64]:
        angles, areas = self._blade
        blade, within = np.divmod(v * self.blades, 1.0)
        angle = np.interp(within * areas[-1], areas, angles) + blade * angles[-1] + math.radians(self.rotation_deg)
        return _centred(_polar(np.sqrt(u) * self.rim(angle), angle), u, self.rim)


@dataclass(frozen=True)
class ImageAperture(Aperture):
    """A picture of the hole.

    Parameters
    ----------
    image : array_like, (H, W)
        Transmittance, at least 0, in any scale; row 0 is the top, pixels are square. The longer side spans the diameter
        of the unit disc, outside of which nothing is let through.

    Raises
    ------
    InputError
        If the picture has another shape, negative or NaN values, no light, or more than 1 % of its light outside the
        unit disc: pad it until its shape fits into the inscribed circle.
    """

    shape: ClassVar[str] = "image"

    image: NDArray[np.float64] = field(compare=False, repr=False)
    digest: str = field(init=False)

    def __post_init__(self) -> None:
        super().__post_init__()
        try:
            image = np.array(self.image, dtype=np.float64)
        except (TypeError, ValueError):
            raise InputError("Aperture image must be an array of numbers.") from None
        if image.ndim != 2 or image.size == 0:
            raise InputError(f"Aperture image has shape {image.shape}; it must be (height, width), greyscale.")
        if not (np.isfinite(image).all() and (image >= 0.0).all()):
            raise InputError("Aperture image has negative, NaN or infinite values; they are transmittances.")
        rows, columns = np.indices(image.shape) + 0.5
        height, width = image.shape
        inside = np.hypot(columns - width / 2.0, rows - height / 2.0) <= max(height, width) / 2.0
        light, outside = float(image.sum()), float(image[~inside].sum())
        if not light > 0.0:
            raise InputError("Aperture image is black: no light comes through.")
        if outside > _IMAGE_OUTSIDE * light:
            raise InputError(
                f"Aperture image has {outside / light:.1%} of its light outside the inscribed circle of its longer "
                "side; pad it with black until its shape fits."
            )
        image = np.where(inside, image / image.max(), 0.0)
        image.setflags(write=False)
        object.__setattr__(self, "image", image)
        digest = hashlib.sha256(f"{image.shape}".encode() + image.astype("<f8").tobytes()).hexdigest()
        object.__setattr__(self, "digest", digest[:32])

    def to_dict(self) -> dict[str, Any]:
        """Plain values; the picture is named by its size and digest."""
        size = list(self.image.shape)
        return {"shape": self.shape, "ratio": self.ratio, "image_size": size, "image_sha256": self.digest}

    def _place(self, u: NDArray[np.float64], v: NDArray[np.float64]) -> NDArray[np.float64]:
        # Inverse of the distribution: first over rows, then along the row that was met.
        height, width = self.image.shape
        row, down = _invert(self.image.sum(axis=1), u)
        across = np.empty_like(v)
        for number in np.unique(row):
            here = row == number
            column, part = _invert(self.image[number], v[here])
            across[here] = column + part
        scale = 2.0 / max(height, width)
        points = np.stack([(across - width / 2.0) * scale, (height / 2.0 - row - down) * scale], axis=1)
        # A pixel whose centre is inside may stick out by its corner.
        return np.asarray(points / np.maximum(1.0, np.hypot(*points.T))[:, None])


def checked_number(value: Any, name: str) -> float:
    """``value`` as a float; an InputError that names it otherwise."""
    try:
        return float(value)
    except (TypeError, ValueError):
        raise InputError(f"{name} is {value!r}; it must be a number.") from None


def _polar(radius: NDArray[np.float64], angle: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)


def _centred(
    points: NDArray[np.float64],
    quantile: NDArray[np.float64],
    rim: Callable[[NDArray[np.float64]], NDArray[np.float64]],
) -> NDArray[np.float64]:
    """Take the mean out, most in the middle and nothing at the rim, so that points stay inside the shape.

    ``quantile`` is the share of the shape's area that lies nearer to the centre than each point, in units of the rim.
    """
    share = 1.0 - quantile
    points = points - points.mean(axis=0) * (share / share.mean())[:, None]
    # The mean of a handful of points may be so far off that some would leave all the same: a smaller pattern then.
    excess = np.hypot(*points.T) / rim(np.arctan2(points[:, 1], points[:, 0]))
    return np.asarray(points / max(1.0, float(excess.max())))


def _invert(density: NDArray[np.float64], quantile: NDArray[np.float64]) -> tuple[NDArray[Any], NDArray[np.float64]]:
    """The bin that holds each quantile of a histogram, and where inside it, 0 to 1. Empty bins are never met."""
    edges = np.concatenate([[0.0], np.cumsum(density)])
    target = quantile * edges[-1]
    found = np.searchsorted(edges, target, side="right") - 1
    found = np.minimum(found, int(np.flatnonzero(density)[-1]))
    return found, np.clip((target - edges[found]) / density[found], 0.0, 1.0)


class CocCoefficients(NamedTuple):
    """``C = c1 * (1/z) + c0``, signed CoC radius in pixels at full resolution."""

    c1: float
    c0: float


@dataclass(frozen=True)
class Lens:
    """A thin lens.

    Parameters
    ----------
    aperture_radius_m : float
        Radius of the aperture in metres; 0 is a pinhole.
    focus_distance_m : float
        Planar distance of the plane in focus, in metres from the lens; ``inf`` is legal.
    focal_length_mm : float, optional
        Only remembered, for :attr:`f_number` and for metadata: the blur depends on the radius alone.
    aperture : Aperture
        The shape, within a circle of ``aperture_radius_m``; a disc by default. References take it; a method that
        simulates one shape only says so in its documentation.

    Raises
    ------
    InputError
        For NaN, a negative radius, a focus distance that is not positive or not beyond the focal length.
    """

    aperture_radius_m: float
    focus_distance_m: float
    focal_length_mm: float | None = None
    aperture: Aperture = field(default_factory=DiscAperture)

    def __post_init__(self) -> None:
        names = ["aperture_radius_m", "focus_distance_m"]
        if self.focal_length_mm is not None:
            names.append("focal_length_mm")
        for name in names:
            value = getattr(self, name)
            try:
                number = float(value)
            except (TypeError, ValueError):
                raise InputError(f"Lens {name} is {value!r}; it must be a number.") from None
            if math.isnan(number):
                raise InputError(f"Lens {name} is NaN; it must be a number.")
            object.__setattr__(self, name, number)
        if not 0.0 <= self.aperture_radius_m < math.inf:
            raise InputError(
                f"Lens aperture_radius_m is {self.aperture_radius_m}; it must be finite, at least 0 (a pinhole)."
            )
        if self.focus_distance_m <= 0.0:
            raise InputError(
                f"Lens focus_distance_m is {self.focus_distance_m}; it must be positive (inf focuses at infinity)."
            )
        if self.focal_length_mm is not None:
            if not 0.0 < self.focal_length_mm < math.inf:
                raise InputError(f"Lens focal_length_mm is {self.focal_length_mm}; it must be positive and finite.")
            if self.focus_distance_m * 1e3 <= self.focal_length_mm:
                raise InputError(
                    f"Lens focus_distance_m is {self.focus_distance_m} m, inside the focal length of "
                    f"{self.focal_length_mm} mm: no real image forms there. Focus beyond that."
                )
        object.__setattr__(self, "aperture", Aperture.of(self.aperture))

    @classmethod
    def photographic(
        cls,
        focal_length_mm: float,
        f_number: float,
        focus_distance_m: float,
        aperture: Aperture | str = "disc",
    ) -> Lens:
        """A lens as photographers name it: ``aperture radius = focal length / (2 f_number)``.

        The field of view stays the camera's (:meth:`cldof.Camera.from_sensor` derives one from a focal length).
        An ``f_number`` of ``inf`` is a pinhole.
        """
        try:
            focal_length_mm, f_number = float(focal_length_mm), float(f_number)
        except (TypeError, ValueError):
            raise InputError(
                f"Lens focal_length_mm and f_number are {focal_length_mm!r} and {f_number!r}; both must be numbers."
            ) from None
        if not f_number > 0.0:
            raise InputError(f"Lens f_number is {f_number}; it must be positive.")
        radius_m = focal_length_mm * 1e-3 / (2.0 * f_number)
        return cls(radius_m, focus_distance_m, focal_length_mm, Aperture.of(aperture))

    @property
    def f_number(self) -> float | None:
        """Focal length over aperture diameter, or None when the focal length is unknown; ``inf`` for a pinhole."""
        if self.focal_length_mm is None:
            return None
        diameter_mm = 2e3 * self.aperture_radius_m
        return self.focal_length_mm / diameter_mm if diameter_mm > 0.0 else math.inf

    def coc_coefficients(self, camera: Camera) -> CocCoefficients:
        """The two numbers that kernels need; see the module's text.

        Raises
        ------
        InputError
            If one of them is so large that products with it overflow in float32.
        """
        c1 = -camera.focal_px * self.aperture_radius_m
        c0 = -c1 / self.focus_distance_m
        if not (abs(c1) <= _LARGEST_COEFFICIENT and abs(c0) <= _LARGEST_COEFFICIENT):
            raise InputError(
                f"Lens of aperture_radius_m {self.aperture_radius_m:g} focused at {self.focus_distance_m:g} m blurs by "
                f"up to {max(abs(c0), abs(c1)):.1g} px through a camera of {camera.focal_px:.3g} px focal length; use "
                f"a smaller aperture (limit {_LARGEST_COEFFICIENT:g} px)."
            )
        return CocCoefficients(c1, c0)

    def coc_radius_px(self, camera: Camera, depth_m: ArrayLike) -> NDArray[np.float64]:
        """Signed CoC radius in pixels, negative nearer than focus.

        Parameters
        ----------
        camera : Camera
        depth_m : array_like
            Planar depths in metres, positive; ``inf`` is legal.

        Returns
        -------
        ndarray of float64
            Same shape as ``depth_m``; exactly 0 at the focus distance.
        """
        depth = np.asarray(depth_m, dtype=np.float64)
        if not (depth > 0.0).all():
            raise InputError("coc_radius_px needs positive depths in metres; got zero, negative or NaN ones.")
        c1 = -camera.focal_px * self.aperture_radius_m
        return np.asarray(c1 * (1.0 / depth - 1.0 / self.focus_distance_m))

    def depth_of_coc_m(self, camera: Camera, coc_radius_px: float) -> float:
        """The depth whose signed CoC radius is ``coc_radius_px`` (Schedl & Wimmer eqs. 6-7).

        ``inf`` when no depth is blurred that much (eq. 8), or for a pinhole and a CoC that is not nearer than focus.
        """
        c1 = -camera.focal_px * self.aperture_radius_m
        if c1 == 0.0:
            return self.focus_distance_m if coc_radius_px == 0.0 else (0.0 if coc_radius_px < 0.0 else math.inf)
        inverse = 1.0 / self.focus_distance_m + coc_radius_px / c1
        return 1.0 / inverse if inverse > 0.0 else math.inf

    def depth_of_field_m(self, camera: Camera, max_coc_radius_px: float = 0.5) -> tuple[float, float]:
        """Nearest and farthest depth in metres whose CoC radius stays within ``max_coc_radius_px``."""
        limit = _positive(max_coc_radius_px, "max_coc_radius_px")
        return self.depth_of_coc_m(camera, -limit), self.depth_of_coc_m(camera, limit)

    def hyperfocal_distance_m(self, camera: Camera, max_coc_radius_px: float = 0.5) -> float:
        """The nearest focus distance in metres at which infinity is still within ``max_coc_radius_px``."""
        return camera.focal_px * self.aperture_radius_m / _positive(max_coc_radius_px, "max_coc_radius_px")

    def to_dict(self) -> dict[str, Any]:
        """Plain values for reports and image metadata; infinity is written as None."""
        return {
            "aperture_radius_m": self.aperture_radius_m,
            "focus_distance_m": self.focus_distance_m if math.isfinite(self.focus_distance_m) else None,
            "focal_length_mm": self.focal_length_mm,
            "aperture": self.aperture.to_dict(),
        }


def _positive(value: float, name: str) -> float:
    if not 0.0 < value < math.inf:
        raise InputError(f"{name} is {value!r}; it must be positive and finite.")
    return float(value)


def lens_samples(count: int, shape: Aperture | str = "disc", seed: int = 0) -> NDArray[np.float64]:
    """Low-discrepancy points on the lens, equally weighted.

    Parameters
    ----------
    count : int
        How many points.
    shape : Aperture or {"disc", "gaussian"}
    seed : int, at least 0
        Shifts the pattern at random: sets with different seeds are independent, unbiased estimates.

    Returns
    -------
    ndarray, (count, 2), float64
        ``(x, y)`` in units of the aperture radius, within the shape; mean zero, except that those of an
        :class:`ImageAperture` gather around the picture's centroid.

    Raises
    ------
    InputError

    Notes
    -----
    A rank-1 lattice, ``((i + a) / count, frac(i * golden + b))`` with random ``a`` and ``b``, mapped so that equal
    areas get equal numbers of points; on the disc that is Vogel's spiral (1979). Of the patterns tried (R2,
    Owen-scrambled Sobol, polar and concentric) it has the smallest error for edges, about ``count ** -0.75``.
    """
    return Aperture.of(shape).samples(count, seed)
