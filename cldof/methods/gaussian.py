"""Gaussian filters as numbers: FIR taps and recursive sections, in float64. No OpenCL here.

Both engines approximate the normalised sampled Gaussian ``g(n) ~ exp(-n^2 / (2 sigma^2))``.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

__all__ = ["fir_radius", "fir_taps", "fir_variance", "half_taps", "iir_sections"]

# exp(-x^2 / 2) ~ sum of Re((a - ib) exp(-(l - iw) x)), rows (a, b, l, w): Deriche's form ("Recursively implementing the
# Gaussian and its derivatives", INRIA 1893, 1993) with three terms, fitted minimax on 0..10; |error| <= 2e-6. Two terms
# reach 1.7e-4, and the published least-squares values 9e-4: rings around a bright lamp.
_DERICHE = np.array(
    [
        (3.0808231107137107, 6.772514844211151, 2.1529209255095862, 0.5240048576084904),
        (-2.2245791536863786, -0.7240403212946103, 2.118601156731118, 1.6091628921818526),
        (0.14375410503084474, -0.059856623469667844, 2.040240831363261, 2.8479566934125593),
    ]
)


def fir_radius(sigma: float, cutoff: float = 3.0) -> int:
    """Taps on either side of the middle one, ``ceil(cutoff * sigma)``."""
    return math.ceil(cutoff * sigma)


def fir_taps(sigma: float, cutoff: float = 3.0) -> NDArray[np.float64]:
    """Taps of a Gaussian cut off at ``cutoff`` sigma, (2 * radius + 1,), summing to 1.

    Cut at 3 sigma a unit step errs by at most 1.4e-3, at 3.3 sigma by 5e-4.
    """
    radius = fir_radius(sigma, cutoff)
    if radius == 0:
        return np.ones(1)
    taps = np.exp(-0.5 * (np.arange(-radius, radius + 1) / sigma) ** 2)
    return np.asarray(taps / taps.sum())


def fir_variance(taps: NDArray[np.float64]) -> float:
    """Variance in px^2 of normalised, centred taps: what they add to a cascade of blurs."""
    radius = len(taps) // 2
    return float((taps * np.arange(-radius, radius + 1) ** 2).sum())


def half_taps(taps: NDArray[np.float64]) -> NDArray[np.float32]:
    """Symmetric taps as kernels/fir.clh reads them: float32, from the middle one outwards."""
    return taps[len(taps) // 2 :].astype(np.float32)


def iir_sections(sigma: float) -> NDArray[np.float32]:
    """Recursive Gaussian as complex one-pole sections for kernels/blur.cl.

    Returns
    -------
    ndarray, (sections, 6), float32
        Pole, gain and resting state ``1 / (1 - pole)``, each as real and imaginary part, so that
        ``h(n) = sum Re(gain * pole^|n|)`` sums to 1.
    """
    a, b, decay, frequency = _DERICHE.T
    poles = np.exp((-decay + 1j * frequency) / sigma)
    gains = a - 1j * b
    total = (gains * (1.0 + poles) / (1.0 - poles)).real.sum()
    gains = gains / total
    rest = 1.0 / (1.0 - poles)
    parts = [part for value in (poles, gains, rest) for part in (value.real, value.imag)]
    return np.ascontiguousarray(np.stack(parts, axis=1), dtype=np.float32)
