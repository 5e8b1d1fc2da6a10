"""The thin lens: aperture, focus, and the one place where the circle of confusion is derived.

For a point at planar depth ``z`` a thin lens of radius ``R`` focused at ``zf`` spreads light over a disc on the image
plane. With the image plane at ``focal_px`` pixels from the lens (see :attr:`cldof.Camera.focal_px`) its signed radius
in pixels is (Potmesil & Chakravarty 1981, eq. 5, rewritten in inverse depth)

    C(z) = c1 * (1/z - 1/zf) = c1 * w + c0,   c1 = -focal_px * R,   c0 = -c1 / zf,   w = 1/z

negative nearer than focus. It is affine in ``w``, so kernels get ``c1`` and ``c0`` and need one multiply-add; there is
no cancellation at infinity and none for a lens focused at infinity.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .camera import Camera
from .errors import InputError

__all__ = ["GAUSSIAN_SIGMA", "CocCoefficients", "Lens", "lens_samples"]

# Standard deviation of a Gaussian lens in aperture radii: CoC diameter = 4 sigma (Schedl & Wimmer 2012, eq. 10).
GAUSSIAN_SIGMA = 0.5


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

    Raises
    ------
    InputError
        For NaN, a negative radius, a focus distance that is not positive or not beyond the focal length.
    """

    aperture_radius_m: float
    focus_distance_m: float
    focal_length_mm: float | None = None

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

    @classmethod
    def photographic(cls, focal_length_mm: float, f_number: float, focus_distance_m: float) -> Lens:
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
        return cls(focal_length_mm * 1e-3 / (2.0 * f_number), focus_distance_m, focal_length_mm)

    @property
    def f_number(self) -> float | None:
        """Focal length over aperture diameter, or None when the focal length is unknown; ``inf`` for a pinhole."""
        if self.focal_length_mm is None:
            return None
        diameter_mm = 2e3 * self.aperture_radius_m
        return self.focal_length_mm / diameter_mm if diameter_mm > 0.0 else math.inf

    def coc_coefficients(self, camera: Camera) -> CocCoefficients:
        """The two numbers that kernels need; see the module's text."""
        c1 = -camera.focal_px * self.aperture_radius_m
        return CocCoefficients(c1, -c1 / self.focus_distance_m)

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
        """Plain numbers for reports and image metadata; infinity is written as None."""
        return {
            "aperture_radius_m": self.aperture_radius_m,
            "focus_distance_m": self.focus_distance_m if math.isfinite(self.focus_distance_m) else None,
            "focal_length_mm": self.focal_length_mm,
        }


def _positive(value: float, name: str) -> float:
    if not 0.0 < value < math.inf:
        raise InputError(f"{name} is {value!r}; it must be positive and finite.")
    return float(value)


def lens_samples(count: int, shape: str = "disc", seed: int = 0) -> NDArray[np.float64]:
    """Low-discrepancy points on the lens, equally weighted.

    Parameters
    ----------
    count : int
        How many points.
    shape : {"disc", "gaussian"}
        A uniform disc of radius 1, or a Gaussian of :data:`GAUSSIAN_SIGMA`. A Gaussian has no rim: 256 samples reach
        out to 1.8 aperture radii.
    seed : int
        Rotates the pattern: sets with different seeds are independent estimates.

    Returns
    -------
    ndarray, (count, 2), float64
        ``(x, y)`` in units of the aperture radius, mean zero.

    Notes
    -----
    A Vogel spiral: radii at equal steps of the cumulative distribution, angles at the golden angle.
    """
    if count < 1:
        raise InputError(f"lens_samples needs at least 1 sample; got {count}.")
    index = np.arange(count)
    quantile = (index + 0.5) / count
    if shape == "disc":
        radius = np.sqrt(quantile)
    elif shape == "gaussian":
        radius = GAUSSIAN_SIGMA * np.sqrt(-2.0 * np.log1p(-quantile))  # inverse of the Rayleigh distribution
    else:
        raise InputError(f"Lens shape {shape!r} is unknown; use 'disc' or 'gaussian'.")
    angle = index * math.pi * (3.0 - math.sqrt(5.0)) + 2.0 * math.pi * np.random.default_rng(seed).random()
    points = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    return np.asarray(points - points.mean(axis=0), dtype=np.float64)
