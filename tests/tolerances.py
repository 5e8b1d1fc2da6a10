"""How far a pass may be from its float64 twin: one table. A looser row for a device needs a reason and a date."""

from typing import NamedTuple

import numpy as np


class Tolerance(NamedTuple):
    """Absolute and relative error, and the share of pixels that may exceed them where ties decide."""

    atol: float
    rtol: float = 0.0
    outliers: float = 0.0


TOLERANCES = {
    "frame_inverse_depth": Tolerance(0.0, 1e-6),
    # float32 sums of up to 2 * 3 * 16 taps
    "blur_fir": Tolerance(2e-6),
    # against the same sections in float64
    "blur_iir": Tolerance(5e-6),
    # against the exact Gaussian, in 2-D on images in [0, 1]
    "gaussian": Tolerance(1.5e-3),
    # float32 CoC against float64: a slot may fall to the other side of a hard end
    "layered_step": Tolerance(1e-5, outliers=1e-3),
    "layered_under": Tolerance(2e-6),
    "layered_finish": Tolerance(1e-6, 1e-6),
    # a whole frame; a misplaced slot spreads over the blur that follows
    "layered": Tolerance(3e-5, outliers=5e-3),
    "pyramid_flatten": Tolerance(2e-7, 1e-6),
    "pyramid_slope": Tolerance(2e-7),
    # means of 2x2 down to one pixel, and B-splines back
    "pyramid_fill": Tolerance(1e-6),
    # front ramps as narrow as a thousandth of an interval, in float32; published steps a thousandth of that
    "pyramid_matte": Tolerance(2e-4, outliers=1e-3),
    "pyramid_blur": Tolerance(1e-4, outliers=1e-3),
    "pyramid": Tolerance(1e-4, outliers=2e-3),
    # float32 may round a sample to the pixel beside it
    "gather": Tolerance(1e-5, 1e-5),
    # the narrowest lobes (0.01 rad) are only so well resolved by a float32 cosine
    "shading_split": Tolerance(2e-5, 1e-3, outliers=2e-3),
    "multiview_cone": Tolerance(2e-6),
    "multiview_extent": Tolerance(1e-5, 1e-5, outliers=1e-3),
    # float32 CoC against float64: a slot may fall into the next layer
    "multiview": Tolerance(2e-5, outliers=5e-3),
    "lightfield_shrink": Tolerance(2e-6, outliers=1e-3),
    # whole frames: a CoC that rounds to the other side moves a slot by 1/256 px, and now and then by a pixel
    "lightfield": Tolerance(2e-5, 2e-5, outliers=5e-3),
    # Sharp lobes magnify what float32 makes of a normal.
    "lightfield_shaded": Tolerance(1e-4, 2e-3, outliers=2e-2),
}


def assert_close(actual: np.ndarray, expected: np.ndarray, name: str) -> None:
    """Compare within the row `name`; says how far off the worst pixel is."""
    tolerance = TOLERANCES[name]
    assert actual.shape == expected.shape
    assert np.isfinite(actual).all(), f"{name}: {np.count_nonzero(~np.isfinite(actual))} values are not finite"
    error = np.abs(actual.astype(np.float64) - expected)
    bad = error > tolerance.atol + tolerance.rtol * np.abs(expected)
    share = np.count_nonzero(bad) / bad.size
    worst = np.unravel_index(int(error.argmax()), error.shape)
    assert share <= tolerance.outliers, (
        f"{name}: {share:.2%} of values off, worst by {error.max():.3g} at {tuple(map(int, worst))}: "
        f"{actual[worst]} for {expected[worst]}"
    )
