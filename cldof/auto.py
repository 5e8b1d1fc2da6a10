"""``method="auto"``: the cheapest method and setting for an error, or the best for a time.

What each setting costs and how far it errs is measured once per device by ``cldof tune`` (:mod:`cldof.tune`) over the
built-in scenes and kept as :class:`Curves`: over :func:`features` of frame and lens a Gaussian process for the error in
dB and a linear model for the logarithm of the time. A :class:`Chooser` picks by them, frame after frame, corrects its
times by what it measures, and changes its mind only when it has to (docs/auto.md).

Errors are RMS over pixels of linear RGB clipped to [0, 1], against what the lens's own aperture would show; in dB they
are the PSNR of :func:`cldof.metrics.psnr`. A method that simulates another aperture counts with what that costs.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import warnings
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from importlib import resources
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .errors import BudgetWarning, InputError
from .frame import LayeredFrame
from .lens import Lens, checked_number
from .planner import SceneStats

__all__ = [
    "FEATURES",
    "Auto",
    "Budget",
    "Choice",
    "Chooser",
    "Curves",
    "ErrorModel",
    "Setting",
    "features",
    "load_curves",
]

_FORMAT = 3
Vector = NDArray[np.float64]


@dataclass(frozen=True)
class Setting:
    """A method with its options.

    Attributes
    ----------
    method : str
    options : mapping
    samples : int
        Pixels of the frame for one of the image, along x and y: above 1 it takes :attr:`LayeredFrame.finer
        <cldof.LayeredFrame.finer>`, and of each pixel what stands in its middle.
    """

    method: str
    options: Mapping[str, Any] = field(default_factory=dict)
    samples: int = 1

    def __str__(self) -> str:
        options = [f"{name}={value}" for name, value in self.options.items()]
        if self.samples > 1:
            options.append(f"{self.samples}x{self.samples} samples")
        return f"{self.method} ({', '.join(options)})" if options else self.method


# Amounts below these are all the same: (name, amount). Features are logarithms of what is above them.
_FLOORS = {
    "blur": 0.1,
    "blur_rms": 0.1,
    "least_blur": 0.1,
    "sharp": 0.03,
    "contrast": 1e-3,
    "texture": 1e-4,
    "blurred_contrast": 1e-4,
    "silhouettes": 1e-4,
    "near_silhouettes": 1e-4,
    "far_silhouettes": 1e-4,
    "edges": 1e-2,
    "hidden": 1e-4,
    "hidden_contrast": 1e-4,
    "deep": 1e-2,
    "lights": 1e-3,
    "light_tiles": 1e-3,
    "spread_lights": 1e-3,
    "glass": 1e-2,
    "void": 1e-2,
    "luminance": 0.03,
    "near_coc": 0.5,
    "far_coc": 0.5,
    "gloss": 0.1,
}
FEATURES = ("one", "is_disc", "pixels", "peels", *_FLOORS)
"""What models see of a frame; all but the first two are logarithms."""

# CoC radii (px) from which on more of them changes an error no further.
_FULL_TEXTURE_PX, _FULL_SILHOUETTE_PX = 4.0, 8.0
# CoC steps (px) inside a tile that are a silhouette, and CoC below which a tile is sharp.
_STEP_PX, _SHARP_PX = 0.5, 0.5
# HDR values above this count as this.
_BRIGHTEST = 30.0


def features(stats: SceneStats, lens: Lens, frame: LayeredFrame) -> Vector:
    """A frame seen through a lens, in the numbers that errors and times depend on.

    Parameters
    ----------
    stats : SceneStats
        Of the frame, or of one that looks like it; per tile of 16 x 16 pixels.
    lens : Lens
    frame : LayeredFrame

    Returns
    -------
    ndarray, (len(FEATURES),), float64
    """
    c1, c0 = lens.coc_coefficients(frame.camera)
    has = stats.slots[:2] > 0.0
    with np.errstate(invalid="ignore"):
        near = np.where(has, c1 * stats.nearest[:2] + c0, 0.0)
        far = np.where(has, c1 * stats.farthest[:2] + c0, 0.0)
    share = stats.pixels / float(stats.pixels.sum())

    def mean(values: NDArray[Any]) -> float:
        return float((values * share).sum())

    largest = np.maximum(np.abs(near[0]), np.abs(far[0]))
    least = np.where(near[0] * far[0] <= 0.0, 0.0, np.minimum(np.abs(near[0]), np.abs(far[0])))
    step = np.where(has[0], abs(c1) * stats.step[0], 0.0)
    high = np.where(has[..., None], stats.high[:2, ..., :3], 0.0)
    low = np.where(has[..., None], stats.low[:2, ..., :3], 0.0)
    contrast = ((np.minimum(high, 1.0) - np.minimum(low, 1.0)) ** 2).mean(axis=-1)
    occupancy = stats.slots / stats.pixels
    in_front, behind = np.clip(-near[0], 0.0, _FULL_SILHOUETTE_PX), np.clip(far[0], 0.0, _FULL_SILHOUETTE_PX)
    is_edge, is_blurred = step > _STEP_PX, largest > _SHARP_PX
    light = np.clip(high[0].max(axis=-1) - 1.0, 0.0, _BRIGHTEST)
    amounts = {
        "blur": mean(largest),
        "blur_rms": math.sqrt(mean(largest**2)),
        "least_blur": mean(least),
        "sharp": mean(~is_blurred),
        "contrast": mean(contrast[0]),
        "texture": mean(contrast[0] * np.minimum(least, _FULL_TEXTURE_PX)),
        "blurred_contrast": mean(contrast[0] * np.minimum(largest, 1.0)),
        "silhouettes": mean(contrast[0] * np.minimum(step, _FULL_SILHOUETTE_PX)),
        "near_silhouettes": mean(contrast[0] * in_front * is_edge),
        "far_silhouettes": mean(contrast[0] * behind * is_edge),
        "edges": mean(is_edge),
        "hidden": mean(occupancy[1] * in_front * contrast[1]) if len(occupancy) > 1 else 0.0,
        "hidden_contrast": mean(occupancy[1] * contrast[1] * is_edge) if len(occupancy) > 1 else 0.0,
        "deep": mean(occupancy[2:].sum(axis=0)),
        "lights": mean(light * is_blurred),
        "light_tiles": mean((light > 0.0) & is_blurred),
        "spread_lights": mean(light / (1.0 + math.pi * largest**2) * is_blurred),
        "glass": mean(1.0 - stats.solid[0] / np.maximum(stats.slots[0], 1.0)),
        "void": mean(1.0 - np.minimum(1.0, occupancy.max(axis=0))),
        "luminance": mean(stats.luminance[0]),
        "near_coc": max(0.0, -float(near.min())),
        "far_coc": max(0.0, float(far.max())),
        "gloss": frame.lobe_turn_per_m * lens.aperture_radius_m if frame.is_glossy_through(lens) else 0.0,
    }
    is_disc = float(lens.aperture.shape != "gaussian")
    fixed = [1.0, is_disc, math.log10(stats.shape.height * stats.shape.width), math.log10(stats.shape.layers)]
    return np.array(fixed + [math.log10(amounts[name] + floor) for name, floor in _FLOORS.items()])


@dataclass(frozen=True)
class Budget:
    """What a frame may err or take; one of both.

    Attributes
    ----------
    max_rms : float, optional
        RMS error, linear units.
    max_ms : float, optional
        From the call to the image on the host.
    """

    max_rms: float | None = None
    max_ms: float | None = None

    @classmethod
    def of(cls, max_error: float | str | None = None, max_ms: float | None = None) -> Budget:
        """Read what a caller asks for.

        Parameters
        ----------
        max_error : float or str, optional
            ``"35dB"`` or ``"0.018"``; numbers from 5 on are dB, numbers below 1 are linear RMS.
        max_ms : float, optional

        Raises
        ------
        InputError
            Neither or both, or a number that is neither an RMS nor dB.
        """
        if (max_error is None) == (max_ms is None):
            raise InputError("method='auto' needs max_error (such as '35dB') or max_ms (such as 40), one of both.")
        if max_ms is not None:
            milliseconds = checked_number(max_ms, "max_ms")
            if not 0.0 < milliseconds < math.inf:
                raise InputError(f"max_ms is {max_ms!r}; it must be positive and finite.")
            return cls(max_ms=milliseconds)
        text = str(max_error).strip().lower()
        value = checked_number(text.removesuffix("db"), "max_error")
        is_db = text.endswith("db") or value >= 5.0
        if not (0.0 < value < 1.0 or (is_db and 0.0 < value <= 200.0)):
            raise InputError(
                f"max_error is {max_error!r}; give dB such as 35 or '35dB', or a linear RMS below 1 such as 0.018."
            )
        return cls(max_rms=10.0 ** (-value / 20.0) if is_db else value)

    @property
    def min_db(self) -> float | None:
        """The error as PSNR."""
        return None if self.max_rms is None else -20.0 * math.log10(self.max_rms)


@dataclass(frozen=True)
class Auto:
    """Stands where a method stands, until a frame is there to choose one for.

    Parameters
    ----------
    max_error : float or str, optional
        PSNR in dB that a frame must reach (``"35dB"``; numbers from 5 on), or RMS that it may err by, in linear units
        (numbers below 1).
    max_ms : float, optional
        Time for a frame, from the call to the image on the host.
    """

    max_error: float | str | None = None
    max_ms: float | None = None

    name = "auto"
    simulated_aperture = None

    @property
    def budget(self) -> Budget:
        """What was asked for.

        Raises
        ------
        InputError
        """
        return Budget.of(self.max_error, self.max_ms)


@dataclass(frozen=True)
class Choice:
    """What was chosen for a frame, and what is expected of it.

    Attributes
    ----------
    setting : Setting
    predicted_ms : float
        Once programs are built and buffers made; corrected by the frames before.
    predicted_db : float
        PSNR expected against the lens's own aperture; half of all frames do better.
    uncertainty_db : float
        Standard deviation of this prediction: small near what was measured, large for what looks like none of it.
    meets_budget : bool
        Whether the prediction keeps the budget.
    reason : str
    fades_from : Setting or None
        The setting of the frames before, while the image passes from it to this one.
    share : float
        Of this setting in the image.
    """

    setting: Setting
    predicted_ms: float
    predicted_db: float
    uncertainty_db: float
    meets_budget: bool
    reason: str
    fades_from: Setting | None = None
    share: float = 1.0

    @property
    def predicted_rms(self) -> float:
        """The error expected, RMS in linear units."""
        return math.pow(10.0, -self.predicted_db / 20.0)

    def to_dict(self) -> dict[str, Any]:
        """Plain values for reports."""
        return {
            "method": self.setting.method,
            "options": dict(self.setting.options),
            "samples": self.setting.samples,
            "predicted_ms": self.predicted_ms,
            "predicted_db": self.predicted_db,
            "predicted_rms": self.predicted_rms,
            "uncertainty_db": self.uncertainty_db,
            "meets_budget": self.meets_budget,
            "reason": self.reason,
            "fades_from": None if self.fades_from is None else str(self.fades_from),
            "share": self.share,
        }


# Of the errors' model: variances of what is linear in the features and of the bells around cases, the bells' width in
# standard deviations of features (root mean square), and the variance of what no feature tells. Chosen by what models
# of all but one lens, and of all but one scene, say of those left out.
_LINEAR, _BELL, _REACH, _NOISE = 0.3, 1.0, 0.4, 0.02


class ErrorModel:
    """PSNR of each setting, and how sure that is: a Gaussian process through what was measured.

    Its kernel is linear in the features, for what holds in general, plus a bell around each case, for what holds near
    that case (Rasmussen & Williams, Gaussian Processes for Machine Learning, 2006, algorithm 2.1). All settings share
    it; how much each varies follows from its own measurements (maximum likelihood).

    Parameters
    ----------
    feature : ndarray, (N, F)
        Of the cases measured.
    db : ndarray, (N, S)
        What they had.
    """

    def __init__(self, feature: Vector, db: Vector) -> None:
        self.feature, self.db = feature, db
        self.low, self.high = feature.min(axis=0), feature.max(axis=0)
        """Range of the features; beyond it, the ends hold."""
        spread = feature.std(axis=0)
        self._varies = spread > 1e-9
        self._centre, self._spread = feature.mean(axis=0)[self._varies], spread[self._varies]
        self._seen = self._scaled(feature)
        inner = self._kernel(self._seen) + _NOISE * np.eye(len(feature))
        self._inverse = np.linalg.inv(inner)
        self._mean = db.mean(axis=0)
        rest = db - self._mean
        self._weights = self._inverse @ rest
        self._amplitude = np.sqrt(np.maximum((rest * self._weights).mean(axis=0), 1e-6))

    def predict(self, feature: Vector) -> tuple[Vector, Vector]:
        """PSNR in dB expected of each setting for features (F,), and the standard deviation of that, (S,) each."""
        at = self._scaled(feature[None])
        near = self._kernel(at)[0]
        own = _LINEAR * float((at * at).mean()) + _BELL if at.size else _BELL
        variance = max(own - float(near @ self._inverse @ near), 0.0) + _NOISE
        return self._mean + near @ self._weights, math.sqrt(variance) * self._amplitude

    def left_out(self) -> tuple[Vector, Vector]:
        """What models of all other cases predict of each, (N, S): mean and standard deviation in dB (eq. 5.12)."""
        own = np.diag(self._inverse)[:, None]
        return self.db - self._weights / own, np.sqrt(1.0 / own) * self._amplitude

    def _scaled(self, feature: Vector) -> Vector:
        inside = np.clip(feature, self.low, self.high)[:, self._varies]
        scaled: Vector = (inside - self._centre) / self._spread
        return scaled

    def _kernel(self, scaled: Vector) -> Vector:
        """(K, N) between features and those measured."""
        count = max(1, scaled.shape[1])
        product = scaled @ self._seen.T / count
        squares = (scaled**2).sum(axis=1)[:, None] / count + (self._seen**2).sum(axis=1) / count - 2.0 * product
        kernel: Vector = _LINEAR * product + _BELL * np.exp(-0.5 * np.maximum(squares, 0.0) / _REACH**2)
        return kernel


@dataclass(frozen=True, eq=False)
class Curves:
    """Accuracy versus time of each setting on one device, over :data:`FEATURES`.

    Attributes
    ----------
    settings : tuple of Setting
    errors : ErrorModel
    log_time : ndarray, (F, S)
        Weights: features @ log_time is the natural logarithm of the time in copies of 16 MB on the device.
    time_margin : ndarray, (S,)
        Logarithm of the factor over predictions that 95 % of times stay below, for frames that they were not made from.
    source : mapping
        Device, driver, version and when: for people, and to know which curves are whose.
    """

    settings: tuple[Setting, ...]
    errors: ErrorModel
    log_time: Vector
    time_margin: Vector
    source: Mapping[str, Any]

    def copies(self, feature: Vector) -> Vector:
        """Time expected of each setting in copies, (S,)."""
        inside = np.clip(feature, self.errors.low, self.errors.high)
        inside[_SCALING] = feature[_SCALING]
        time: Vector = np.exp(np.clip(inside @ self.log_time, -10.0, 20.0))
        return time

    def to_json(self) -> str:
        """As :meth:`from_json` reads it."""
        data = {
            "format": _FORMAT,
            "features": list(FEATURES),
            "settings": [
                {"method": one.method, "options": dict(one.options), "samples": one.samples} for one in self.settings
            ],
            "measured_feature": _rounded(self.errors.feature),
            "measured_db": _rounded(self.errors.db),
            "log_time": _rounded(self.log_time),
            "time_margin": _rounded(self.time_margin),
            "source": dict(self.source),
        }
        return json.dumps(data, indent=1, allow_nan=False) + "\n"

    @classmethod
    def from_json(cls, text: str) -> Curves:
        """Read what :meth:`to_json` wrote.

        Raises
        ------
        InputError
            Anything about it is not as it should be.
        """
        try:
            data = json.loads(text)
            if data["format"] != _FORMAT or tuple(data["features"]) != FEATURES:
                raise InputError("The curves are of another version of cldof; run `cldof tune` again.")
            settings = tuple(
                Setting(str(one["method"]), dict(one["options"]), int(one["samples"])) for one in data["settings"]
            )
            cases = len(data["measured_db"])
            if cases < 2:
                raise InputError(f"The curves hold {cases} measured cases; two are needed.")
            model = ErrorModel(
                _array(data["measured_feature"], (cases, len(FEATURES))),
                _array(data["measured_db"], (cases, len(settings))),
            )
            return cls(
                settings,
                model,
                _array(data["log_time"], (len(FEATURES), len(settings))),
                _array(data["time_margin"], (len(settings),)),
                dict(data["source"]),
            )
        except InputError:
            raise
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise InputError(f"The curves cannot be read ({type(error).__name__}: {error}).") from error


_SCALING = [FEATURES.index("pixels"), FEATURES.index("peels")]


def _rounded(values: Vector) -> Any:
    return np.vectorize(lambda value: float(f"{value:.6g}"), otypes=[float])(values).tolist()


def _array(values: Any, shape: tuple[int, ...]) -> Vector:
    array = np.array(values, np.float64)
    if array.shape != shape or not np.isfinite(array).all():
        raise InputError(f"The curves hold an array of shape {array.shape} where {shape} is needed, or no numbers.")
    return array


def load_curves(device: str, driver: str, folder: Path | None = None) -> Curves:
    """The curves of a device: those that ``cldof tune`` has kept, or those that come with cldof.

    Parameters
    ----------
    device, driver : str
        The device's name and its driver's version.
    folder : Path, optional
        Where `cldof tune` keeps them; :func:`cache_folder` by default.

    Returns
    -------
    Curves
        A file that is damaged or of another version is warned of and passed over.
    """
    path = (folder or cache_folder()) / curves_name(device, driver)
    try:
        return Curves.from_json(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        pass
    except (OSError, UnicodeDecodeError, InputError) as error:
        warnings.warn(f"{path} is passed over: {error} Run `cldof tune`.", UserWarning, stacklevel=2)
    return shipped_curves()


def cache_folder() -> Path:
    """Where curves are kept: ``CLDOF_CACHE``, else ``cldof`` in the user's cache folder."""
    own = os.environ.get("CLDOF_CACHE")
    if own:
        return Path(own)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "cldof"


def shipped_curves() -> Curves:
    """Curves measured with PoCL on a 2-core x86-64 CPU, as shipped."""
    return Curves.from_json((resources.files(__package__) / "curves" / "pocl.json").read_text(encoding="utf-8"))


def curves_name(device: str, driver: str) -> str:
    """Name of the file that holds a device's curves."""
    from . import __version__

    key = hashlib.sha256(f"{device}\n{driver}\n{__version__}\n{_FORMAT}".encode()).hexdigest()[:16]
    plain = "".join(letter if letter.isalnum() else "-" for letter in device)[:40]
    return f"curves-{plain}-{key}.json"


# How sure it is to keep an error is weighed against time: certainty is worth so many times the quickest setting's time,
# the least of these by which so large a share of the measured cases is kept, each judged by models of all others. Their
# lenses open up to twice as wide as scenes suggest; of ordinary ones 95 % and more are kept then.
_WORTHS, _KEPT = tuple(20.0 * math.pow(2.0, step / 2.0) for step in range(11)), 0.93
# Nothing that is less likely than this to keep an error is taken while something else is.
_LIKELY = 0.5
# Where no setting is likelier than this to keep an error, the one that comes nearest is taken.
_HOPELESS = 0.1
# What a time has to hold: so much of the margin for a setting that has not run, less of it where another of its method
# has, and this factor once it has run itself.
_UNKNOWN, _RELATED, _KNOWN = 1.0, 0.5, 1.08
# Frames of a setting whose median time corrects the model: one that was held up does not count.
_REMEMBERED = 5
# Frames in a row for which another setting has to be better by this much before it is taken.
_PATIENCE, _CHEAPER, _BETTER_DB = 12, 0.8, 1.0
# Frames in which an image passes from one setting to the next, so that the change does not show.
_FADE = 8
# What runs may be expected to be this much worse than what would be taken anew.
_LENIENCE_DB = 1.0
# Settings within this of the least error are as good, and the cheapest of them is taken.
_AS_GOOD_DB = 0.5


class Chooser:
    """Picks settings for a budget, frame after frame.

    Parameters
    ----------
    curves : Curves
    budget : Budget
    copy_ms : float
        What a copy of 16 MB takes on the device now.
    """

    def __init__(self, curves: Curves, budget: Budget, copy_ms: float) -> None:
        self.curves, self.budget, self.copy_ms = curves, budget, copy_ms
        self._is_coarse = np.array([setting.samples == 1 for setting in curves.settings])
        self._current: int | None = None
        self._fading: tuple[int, int] | None = None  # from which setting, and for how many frames so far
        self._wished_for = 0
        # Logarithms of measured over predicted time of the last frames, by setting; one that has not run yet takes over
        # those of its method's others.
        self._ratios: dict[int, deque[float]] = {}
        self._warned: int | None = None

    def choose(self, feature: Vector, has_finer: bool = False) -> Choice:
        """The setting for a frame.

        Parameters
        ----------
        feature : ndarray
            Of :func:`features`.
        has_finer : bool
            The frame is to be had finer; else settings that take several samples a pixel are out of the question.

        Warns
        -----
        BudgetWarning
            No setting is expected to keep the budget: by how much. Once, until it changes.
        """
        (all_errors, spread), times = self.curves.errors.predict(feature), self._times(feature)
        offered = self._is_coarse | has_finer
        errors, times = np.where(offered, all_errors, -np.inf), np.where(offered, times, np.inf)
        before = self._current
        if before is not None and not offered[before]:
            before = self._current = self._fading = None
        if self._fading is not None and not offered[self._fading[0]]:
            self._fading = None
        if self._fading is not None and before is not None:  # one change at a time
            taken, reason = before, "kept from the frame before"
        else:
            worth = 0.0 if self.budget.min_db is None else _worth(self.curves, self.budget.min_db, has_finer)
            taken, reason = self._next(errors, spread, times, worth)
        if before is not None and taken != before:
            fits = self.budget.max_ms is None or times[taken] + times[before] <= self.budget.max_ms
            self._fading = (before, 0) if fits else None
        self._current = taken
        fades_from, share, cost = None, 1.0, float(times[taken])
        if self._fading is not None:
            old, done = self._fading
            fades_from, share = self.curves.settings[old], (done + 1) / (_FADE + 1)
            cost += float(times[old])
            self._fading = (old, done + 1) if done + 1 < _FADE else None
        choice = Choice(
            self.curves.settings[taken],
            cost,
            float(errors[taken]),
            float(spread[taken]),
            self._meets(taken, errors, times),
            reason,
            fades_from,
            share,
        )
        self._warn(taken, choice, np.where(offered, -np.inf, all_errors))
        return choice

    def _next(self, errors: Vector, spread: Vector, times: Vector, worth: float) -> tuple[int, str]:
        """The setting to take: another one when the one that runs fails, or when a gain has lasted."""
        wished, reason = self._wish(errors, spread, times, worth)
        current = self._current
        if current is None or wished == current or not self._keeps(current, wished, errors, spread, times, worth):
            self._wished_for = 0
            return wished, reason
        if self.budget.max_ms is None:
            gains = times[wished] < _CHEAPER * times[current]
        else:
            gains = errors[wished] > errors[current] + _BETTER_DB
        self._wished_for = self._wished_for + 1 if gains else 0
        if self._wished_for < _PATIENCE:
            return current, "kept from the frame before"
        self._wished_for = 0
        return wished, reason

    def observe(self, choice: Choice, feature: Vector, ms: float) -> None:
        """Learn from what a frame took, programs and buffers left out; its choice is one of :meth:`choose`."""
        index = self.curves.settings.index(choice.setting)
        predicted = float(self.curves.copies(feature)[index]) * self.copy_ms
        self._ratios.setdefault(index, deque(maxlen=_REMEMBERED)).append(math.log(max(ms, 1e-6) / predicted))

    def _times(self, feature: Vector) -> Vector:
        known = {index: median(ratios) for index, ratios in self._ratios.items()}
        corrections = np.zeros(len(self.curves.settings))
        for index, setting in enumerate(self.curves.settings):
            family = [known[other] for other in known if self.curves.settings[other].method == setting.method]
            corrections[index] = known.get(index, sum(family) / len(family) if family else 0.0)
        return np.asarray(self.curves.copies(feature) * self.copy_ms * np.exp(corrections))

    def _wish(self, errors: Vector, spread: Vector, times: Vector, worth: float) -> tuple[int, str]:
        if self.budget.min_db is None:
            return self._best_for_time(errors, times)
        chance = _chances(errors, spread, self.budget.min_db)
        if chance.max() < _HOPELESS:
            return int(_picks(errors[None], times[None], chance[None], worth)[0]), "the least error there is"
        best = int(_prices(times, chance, worth, min(_LIKELY, chance.max())).argmin())
        return best, f"{chance[best]:.0%} sure to keep the error, the most for the time"

    def _best_for_time(self, errors: Vector, times: Vector) -> tuple[int, str]:
        assert self.budget.max_ms is not None
        fits = np.flatnonzero(times * self._headroom() <= self.budget.max_ms)
        if not fits.size:
            return int(times.argmin()), "the quickest there is"
        as_good = fits[errors[fits] >= errors[fits].max() - _AS_GOOD_DB]
        return int(as_good[times[as_good].argmin()]), f"the least error of {fits.size} settings that fit"

    def _headroom(self) -> Vector:
        """Factors on expected times, for what the model does not know, (S,)."""
        methods = {self.curves.settings[index].method for index in self._ratios}
        parts = [_RELATED if setting.method in methods else _UNKNOWN for setting in self.curves.settings]
        factors: Vector = np.maximum(_KNOWN, np.exp(np.array(parts) * self.curves.time_margin))
        factors[list(self._ratios)] = _KNOWN
        return factors

    def _keeps(self, index: int, wished: int, errors: Vector, spread: Vector, times: Vector, worth: float) -> bool:
        """Whether a setting that runs may go on: the budget with less margin than a new one needs."""
        if self.budget.max_ms is not None:
            return bool(times[index] <= self.budget.max_ms)
        assert self.budget.min_db is not None
        if times[wished] <= times[index]:
            return True
        chances = _chances(errors, spread, self.budget.min_db)
        prices = _prices(times, chances, worth)
        lenient = _chances(errors, spread, self.budget.min_db - _LENIENCE_DB)
        lenient = _prices(times, lenient, worth, min(_LIKELY, chances.max()))
        return bool(lenient[index] <= prices[wished])

    def _meets(self, index: int, errors: Vector, times: Vector) -> bool:
        if self.budget.max_ms is not None:
            return bool(times[index] <= self.budget.max_ms)
        assert self.budget.min_db is not None
        return bool(errors[index] >= self.budget.min_db)

    def _warn(self, index: int, choice: Choice, finer_errors: Vector) -> None:
        if choice.meets_budget:
            self._warned = None
            return
        if self._warned == index:
            return
        self._warned = index
        if self.budget.max_ms is not None:
            what = (
                f"max_ms={self.budget.max_ms:g} is {choice.predicted_ms / self.budget.max_ms:.1f} times too short for "
                f"the quickest setting, {choice.setting}: {choice.predicted_ms:.1f} ms expected"
            )
        else:
            assert self.budget.min_db is not None
            what = (
                f"no setting is sure to reach {self.budget.min_db:.1f} dB; the nearest, {choice.setting}, is expected "
                f"to miss it by {self.budget.min_db - choice.predicted_db:.1f} dB ({choice.predicted_db:.1f} dB)"
            )
            best = int(finer_errors.argmax())
            if finer_errors[best] > choice.predicted_db + _BETTER_DB:
                what += (
                    f". With a finer frame (LayeredFrame.with_finer) {self.curves.settings[best]} is expected to reach "
                    f"{finer_errors[best]:.1f} dB"
                )
        warnings.warn(f"{what}.", BudgetWarning, stacklevel=4)


def _chances(errors: Vector, spread: Vector, min_db: float) -> Vector:
    """How likely each setting is to keep the error."""
    chances: Vector = 0.5 * _erfc((min_db - errors) / (math.sqrt(2.0) * spread))
    return chances


_erfc = np.vectorize(math.erfc, otypes=[np.float64])


def _prices(times: Vector, chances: Vector, worth: float, least: float = 0.0) -> Vector:
    """What settings cost, what they may miss included, in times of the quickest; settings along the last axis.

    Those whose chance is not even ``least`` cannot be had.
    """
    prices: Vector = times / times.min(axis=-1, keepdims=True) - worth * chances
    return np.where(chances >= least, prices, np.inf)


def _picks(errors: Vector, times: Vector, chances: Vector, worth: float) -> NDArray[np.intp]:
    """Settings for the error, (N,): the best of chance and time, or the cheapest of the nearest where none has any."""
    nearest = np.where(errors >= errors.max(axis=1, keepdims=True) - _AS_GOOD_DB, times, np.inf).argmin(axis=1)
    best = _prices(times, chances, worth).argmin(axis=1)
    picks: NDArray[np.intp] = np.where(chances.max(axis=1) < _HOPELESS, nearest, best)
    return picks


@lru_cache(maxsize=16)
def _worth(curves: Curves, min_db: float, has_finer: bool) -> float:
    """What certainty to keep an error is worth, in times of the quickest setting: see :data:`_WORTHS`."""
    offered = [index for index, setting in enumerate(curves.settings) if setting.samples == 1 or has_finer]
    model = curves.errors
    errors, spread = (each[:, offered] for each in model.left_out())
    times = np.array([curves.copies(feature)[offered] for feature in model.feature])
    kept, chances = model.db[:, offered] >= min_db, _chances(errors, spread, min_db)
    for worth in _WORTHS:
        if np.take_along_axis(kept, _picks(errors, times, chances, worth)[:, None], axis=1).mean() >= _KEPT:
            break
    return worth
