"""Choosing a method for an error or a time."""

from __future__ import annotations

import json
import math
import warnings
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from cldof import BudgetWarning, Camera, InputError, LayeredFrame, Lens, Renderer
from cldof.auto import (
    FEATURES,
    Budget,
    Chooser,
    Curves,
    ErrorModel,
    Setting,
    _worth,
    cache_folder,
    curves_name,
    features,
    load_curves,
    shipped_curves,
)
from cldof.cli import main
from cldof.host.device import Device, DeviceInfo
from cldof.methods import make_method
from cldof.renderer import frame_stats
from cldof.tune import (
    LADDER,
    ErrorRow,
    TimeRow,
    fit_curves,
    fit_times,
    frame_cases,
    frame_ms,
    sampled,
    save_rows,
    tune,
)
from tests.frames import noise_frame, plane_frame
from tests.opengl import require_opengl

AMOUNT = FEATURES.index("contrast")  # the one feature that the curves below depend on
SETTINGS = (Setting("gather"), Setting("layered"), Setting("layered", {"layers": 6}), Setting("multiview"))


def feature(amount: float = 0.0) -> np.ndarray:
    one = np.zeros(len(FEATURES))
    one[0], one[AMOUNT] = 1.0, amount
    return one


@dataclass(frozen=True)
class Line:
    """In place of an :class:`ErrorModel`: each setting at a PSNR that falls by ``slope`` per unit of the amount."""

    at: np.ndarray
    spread: np.ndarray
    slope: float
    low = np.full(len(FEATURES), -100.0)
    high = np.full(len(FEATURES), 100.0)
    # One case, out of reach: from such a chance is worth the most.
    feature = np.zeros((1, len(FEATURES)))
    db = np.zeros((1, len(SETTINGS)))

    def left_out(self) -> tuple[np.ndarray, np.ndarray]:
        return self.db, np.ones_like(self.db)

    def predict(self, value: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return self.at - self.slope * value[AMOUNT], self.spread


def curves(
    db: Sequence[float],
    copies: Sequence[float],
    slope: float = 0.0,
    spread: float | Sequence[float] = 0.1,
    settings: tuple[Setting, ...] = SETTINGS,
) -> Curves:
    """Each setting at a PSNR, known to ``spread`` dB, and a time."""
    log_time = np.zeros((len(FEATURES), len(settings)))
    log_time[0] = np.log(copies)
    line = Line(np.array(db, np.float64), np.broadcast_to(spread, len(settings)).astype(np.float64), slope)
    return Curves(settings, line, log_time, np.full(len(settings), math.log(1.25)), {})  # type: ignore[arg-type]


def first(given: Curves, budget: Budget, amount: float = 0.0, copy_ms: float = 1.0) -> Setting:
    return Chooser(given, budget, copy_ms).choose(feature(amount)).setting


# Budgets


@pytest.mark.parametrize(
    "given, rms",
    [("20dB", 0.1), ("20 dB", 0.1), (20, 0.1), (40.0, 0.01), ("0.02", 0.02), (0.02, 0.02), ("3dB", 10 ** (-3 / 20))],
)
def test_errors_are_read_as_db_or_linear(given: float | str, rms: float) -> None:
    budget = Budget.of(given)
    assert budget.max_rms == pytest.approx(rms) and budget.max_ms is None
    assert budget.min_db == pytest.approx(-20.0 * math.log10(rms))


@pytest.mark.parametrize(
    "error, ms", [(None, None), (30, 5.0), (2, None), (-0.1, None), (0, None), ("dB", None), (math.nan, None),
                  (None, 0), (None, -1), (None, math.inf), (None, "fast")],
)  # fmt: skip
def test_impossible_budgets_are_refused(error: float | str | None, ms: float | None) -> None:
    with pytest.raises(InputError):
        Budget.of(error, ms)


# Features


def named(frame: LayeredFrame, lens: Lens, device: Device) -> dict[str, float]:
    return dict(zip(FEATURES, features(frame_stats(device, frame), lens, frame), strict=True))


def test_features_of_a_plane(device: Device) -> None:
    image = np.ones((32, 48, 4))
    image[:, ::2, :3] = 0.5
    frame = plane_frame(image, 2.0)
    sharp = named(frame, Lens(0.05, 2.0, aperture="gaussian"), device)
    assert (sharp["one"], sharp["is_disc"], sharp["peels"]) == (1.0, 0.0, 0.0)
    assert 10 ** sharp["pixels"] == pytest.approx(32 * 48)
    assert 10 ** sharp["blur"] == pytest.approx(0.1, abs=1e-5) and 10 ** sharp["sharp"] == pytest.approx(1.03)
    assert 10 ** sharp["contrast"] == pytest.approx(0.25 + 1e-3)
    lens = Lens(0.05, 1.0)
    coc = float(lens.coc_radius_px(frame.camera, 2.0))
    blurred = named(frame, lens, device)
    assert blurred["is_disc"] == 1.0 and 10 ** blurred["sharp"] == pytest.approx(0.03)
    assert 10 ** blurred["blur"] == pytest.approx(coc + 0.1, rel=1e-4)
    assert 10 ** blurred["far_coc"] == pytest.approx(coc + 0.5, rel=1e-4)
    assert 10 ** blurred["near_coc"] == pytest.approx(0.5)
    assert 10 ** blurred["texture"] == pytest.approx(0.25 * min(coc, 4.0) + 1e-4, rel=1e-3)
    assert 10 ** blurred["silhouettes"] == pytest.approx(1e-4, rel=1e-3)  # a plane has none


def test_features_see_silhouettes_lights_glass_and_void(device: Device) -> None:
    lens = Lens(0.05, 1.0)
    image = np.ones((32, 32, 4))
    image[:, 8:, :3] = 0.25
    depth = np.full((32, 32), 1.0, np.float32)
    depth[:, 8:] = 4.0
    camera = Camera(32, 32, 40.0)
    stepped = LayeredFrame(image.astype(np.float32), depth, camera)
    flat = named(plane_frame(image, 4.0), lens, device)
    found = named(stepped, lens, device)
    assert found["silhouettes"] > flat["silhouettes"] + 1.0 and found["far_silhouettes"] > flat["far_silhouettes"] + 1.0
    bright = image.copy()
    bright[20, 20, :3] = 9.0
    lit = named(plane_frame(bright, 4.0), lens, device)
    assert 10 ** lit["lights"] == pytest.approx(8.0 / 4 + 1e-3, rel=1e-3)  # in one of four tiles
    pane = image * 0.5
    glass = named(plane_frame(pane, 4.0), lens, device)
    assert 10 ** glass["glass"] == pytest.approx(1.01, rel=1e-3)
    hole = image.copy()
    hole[:16] = 0.0
    void = named(plane_frame(hole, 4.0), lens, device)
    assert 10 ** void["void"] == pytest.approx(0.51, rel=1e-3)


@pytest.mark.parametrize("opaque", [True, False])
def test_features_are_numbers_for_anything(opaque: bool, device: Device) -> None:
    for size, lens in (((1, 1), Lens(0.1, 1.0)), ((37, 21), Lens(0.0, math.inf)), ((5, 64), Lens(3.0, 0.1))):
        frame = noise_frame(*size, layers=3, seed=1, opaque=opaque)
        assert np.isfinite(features(frame_stats(device, frame), lens, frame)).all()
    nothing = LayeredFrame(np.zeros((8, 8, 4), np.float32), np.full((8, 8), np.inf, np.float32), Camera(8, 8))
    assert np.isfinite(features(frame_stats(device, nothing), Lens(0.1, 1.0), nothing)).all()


# Choosing


def test_the_cheapest_setting_that_is_sure_to_keep_an_error_is_taken() -> None:
    assert first(curves([25, 40, 33, 45], [1, 4, 2, 9]), Budget.of("30dB")) == SETTINGS[2]
    assert first(curves([25, 40, 29, 45], [1, 4, 2, 9]), Budget.of("30dB")) == SETTINGS[1]
    assert first(curves([30.5, 40, 29, 45], [1, 4, 2, 9]), Budget.of("30dB")) == SETTINGS[0]


def test_some_chances_more_are_not_worth_any_time() -> None:
    # 33 dB known to 2 dB are 30 dB with a chance of 0.933, 45 dB always: 640 * 0.067 = 42.8 times the quickest's time.
    for slower, taken in ((44.3, SETTINGS[3]), (45.2, SETTINGS[2])):
        given = curves([20, 20, 33, 45], [1, 4, 2, slower], spread=[0.1, 0.1, 2.0, 0.1])
        assert first(given, Budget.of("30dB")) == taken


def test_a_chance_is_worth_what_keeps_the_cases_that_were_measured() -> None:
    """Where the cheap setting nearly always keeps an error, the rest is not bought; where it seldom does, it is."""
    rng = np.random.default_rng(4)
    feature = np.zeros((200, len(FEATURES)))
    feature[:, 0], feature[:, 2:6] = 1.0, rng.normal(0.0, 1.0, (200, 4))
    db = np.array([33.0, 45.0]) + rng.normal(0.0, [2.0, 0.2], (200, 2))
    log_time = np.zeros((len(FEATURES), 2))
    log_time[0] = 0.0, math.log(40.0)
    given = Curves(SETTINGS[:2], ErrorModel(feature, db), log_time, np.zeros(2), {})
    worths = [_worth(given, target, False) for target in (28.0, 31.0, 60.0)]
    assert worths[0] == 20.0 < worths[1] < 640.0 == worths[2]  # nothing reaches 60 dB
    # 40 times the quickest's time is a lot for the last chances, and little where there is hardly one without.
    assert first(given, Budget.of("28dB")) == SETTINGS[0] and first(given, Budget.of("34dB")) == SETTINGS[1]


def test_cases_are_left_out_as_if_they_had_not_been_measured() -> None:
    """Sundararajan & Keerthi's formula for one against a model made without the case; all else equal."""
    errors, _, _ = rows(6, 30)
    feature, db = np.array([row.feature for row in errors]), np.array([row.db for row in errors])
    model = ErrorModel(feature, db)
    inner = model._kernel(model._seen) + 0.02 * np.eye(30)
    mean, spread = model.left_out()
    for case in (0, 17):
        rest = np.arange(30) != case
        weights = np.linalg.solve(inner[np.ix_(rest, rest)], (db - db.mean(axis=0))[rest])
        assert mean[case] == pytest.approx(db.mean(axis=0) + inner[case, rest] @ weights, rel=1e-9)
        known = np.linalg.solve(inner[np.ix_(rest, rest)], inner[rest, case])
        variance = inner[case, case] - inner[case, rest] @ known
        assert spread[case] == pytest.approx(math.sqrt(variance) * model._amplitude, rel=1e-9)


FINE = (*SETTINGS[:3], Setting("layered", samples=3))


def test_finer_settings_are_taken_where_they_are_needed_and_to_be_had() -> None:
    given = curves([25, 31, 33, 40], [1, 4, 2, 30], settings=FINE)
    for target, taken in (("30dB", FINE[2]), ("36dB", FINE[3])):
        assert Chooser(given, Budget.of(target), 1.0).choose(feature(), has_finer=True).setting == taken
    with pytest.warns(BudgetWarning, match=r"With a finer frame .* layered \(3x3 samples\) is expected to reach 40\.0"):
        choice = Chooser(given, Budget.of("36dB"), 1.0).choose(feature())
    assert choice.setting == FINE[2]
    for has_finer, taken in ((True, FINE[3]), (False, FINE[2])):
        assert Chooser(given, Budget.of(max_ms=100), 1.0).choose(feature(), has_finer).setting == taken


def test_an_image_passes_to_a_finer_setting_and_leaves_it_where_there_is_none() -> None:
    given = curves([25, 31, 33, 60], [1, 4, 2, 30], slope=1.0, settings=FINE)
    chooser = Chooser(given, Budget.of("30dB"), 1.0)
    assert chooser.choose(feature(), has_finer=True).setting == FINE[2]
    choices = [chooser.choose(feature(9.0), has_finer=True) for _ in range(10)]
    assert all(choice.setting == FINE[3] for choice in choices)
    assert [choice.fades_from for choice in choices] == [FINE[2]] * 8 + [None] * 2
    with pytest.warns(BudgetWarning, match="finer frame"):
        left = chooser.choose(feature(9.0))
    assert left.setting == FINE[2] and left.fades_from is None


def test_what_is_less_sure_has_to_promise_more() -> None:
    for spread, taken in ((0.5, SETTINGS[0]), (3.0, SETTINGS[1])):
        given = curves([32, 32, 20, 20], [1, 2, 9, 9], spread=[spread, 0.5, 0.5, 0.5])
        assert first(given, Budget.of("30dB")) == taken


def test_an_error_out_of_reach_takes_the_nearest_and_says_by_how_much() -> None:
    given = curves([25, 39.8, 33, 40], [1, 4, 2, 9])
    with pytest.warns(BudgetWarning, match=r"60\.0 dB; the nearest, layered, is expected to miss it by 20\.2 dB"):
        choice = Chooser(given, Budget.of("60dB"), 1.0).choose(feature())
    # 0.2 dB are not worth twice the time.
    assert choice.setting == SETTINGS[1] and not choice.meets_budget
    assert choice.predicted_db == pytest.approx(39.8) and choice.predicted_rms == pytest.approx(10 ** (-39.8 / 20))


def test_the_least_error_that_fits_is_taken_for_a_time() -> None:
    given = curves([25, 40, 33, 45], [1, 4, 2, 9])
    assert first(given, Budget.of(max_ms=100)) == SETTINGS[3]
    assert first(given, Budget.of(max_ms=9.5)) == SETTINGS[1]  # within the headroom nothing is promised
    assert first(given, Budget.of(max_ms=9.5), copy_ms=2.0) == SETTINGS[2]
    assert first(curves([25, 40, 39.8, 45], [1, 4, 2, 90]), Budget.of(max_ms=20)) == SETTINGS[2]


def test_a_time_out_of_reach_takes_the_quickest_and_says_by_how_much() -> None:
    with pytest.warns(BudgetWarning, match=r"max_ms=0\.5 is 2\.0 times too short for the quickest setting, gather"):
        choice = Chooser(curves([25, 40, 33, 45], [1, 4, 2, 9]), Budget.of(max_ms=0.5), 1.0).choose(feature())
    assert choice.setting == SETTINGS[0] and not choice.meets_budget


def test_a_warning_comes_once_until_something_changes() -> None:
    chooser = Chooser(curves([25, 40, 33, 45], [1, 4, 2, 9], slope=1.0), Budget.of("50dB"), 1.0)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        for amount in (0.0, 0.0, 0.0, -20.0, -20.0, 0.0):
            chooser.choose(feature(amount))
    assert len(caught) == 2


def test_what_runs_goes_on_until_a_gain_lasts() -> None:
    given = curves([35, 45, 20, 20], [1, 4, 9, 9], slope=1.0)
    chooser = Chooser(given, Budget.of("30dB"), 1.0)
    assert chooser.choose(feature(5.0)).setting == SETTINGS[1]
    # From here on the cheaper one would do; now and then it would not.
    for frame in range(40):
        assert chooser.choose(feature(5.0 if frame % 6 == 5 else 0.0)).setting == SETTINGS[1]
    chooser.choose(feature(5.0))
    taken = [chooser.choose(feature(0.0)).setting for _ in range(30)]
    assert taken == [SETTINGS[1]] * 11 + [SETTINGS[0]] * 19


def test_a_budget_that_is_missed_changes_the_setting_at_once() -> None:
    given = curves([35, 45, 20, 20], [1, 4, 9, 9], slope=1.0)
    chooser = Chooser(given, Budget.of("30dB"), 1.0)
    assert chooser.choose(feature(0.0)).setting == SETTINGS[0]
    assert chooser.choose(feature(3.5)).setting == SETTINGS[0]  # hardly worse
    assert chooser.choose(feature(6.0)).setting == SETTINGS[1]


def test_an_image_passes_from_setting_to_setting() -> None:
    given = curves([35, 45, 20, 20], [1, 4, 9, 9], slope=1.0)
    chooser = Chooser(given, Budget.of("30dB"), 1.0)
    assert chooser.choose(feature(0.0)).fades_from is None
    choices = [chooser.choose(feature(6.0 if frame < 3 else 0.0)) for frame in range(9)]
    # One change at a time, also when it is not wanted any longer.
    assert all(choice.setting == SETTINGS[1] for choice in choices)
    assert [choice.share for choice in choices] == pytest.approx([*(np.arange(1, 9) / 9), 1.0])
    assert [choice.fades_from for choice in choices] == [SETTINGS[0]] * 8 + [None]
    assert [choice.predicted_ms for choice in choices] == pytest.approx([5.0] * 8 + [4.0])


def test_a_time_is_kept_while_settings_change() -> None:
    given = curves([35, 45, 40, 20], [1, 4, 2, 9])
    for limit, fades in ((7.0, True), (5.5, True), (4.9, False)):
        chooser = Chooser(given, Budget.of(max_ms=limit), 1.0)
        chooser.choose(feature())
        chooser._current, chooser._ratios[1] = 0, deque([0.0])  # as if the quickest had run, and all is known
        choices = [chooser.choose(feature()) for _ in range(12)]
        assert choices[10].setting == SETTINGS[0] and choices[11].setting == SETTINGS[1]
        assert (choices[11].fades_from == SETTINGS[0]) is fades
        assert choices[11].predicted_ms == pytest.approx(5.0 if fades else 4.0)


def test_times_are_corrected_by_what_frames_took() -> None:
    given = curves([25, 40, 33, 45], [1, 4, 2, 9])
    chooser = Chooser(given, Budget.of(max_ms=20), 1.0)
    choice = chooser.choose(feature())
    assert choice.setting == SETTINGS[3] and choice.predicted_ms == pytest.approx(9.0)
    chooser.observe(choice, feature(), 36.0)
    choice = chooser.choose(feature())
    assert choice.setting == SETTINGS[1]  # of another method, which nothing is known of
    chooser.observe(choice, feature(), 12.0)
    assert chooser.choose(feature()).predicted_ms == pytest.approx(12.0)
    # A method's settings share what is known of one of them; a single frame that was held up does not count.
    for took in (12.0, 500.0, 12.0, 12.0):
        chooser.observe(choice, feature(), took)
    assert chooser.choose(feature()).predicted_ms == pytest.approx(12.0)
    assert chooser._times(feature())[2] == pytest.approx(6.0)


# Files


def test_curves_survive_their_file() -> None:
    given = shipped_curves()
    again = Curves.from_json(given.to_json())
    assert again.settings == given.settings == LADDER
    for name in ("log_time", "time_margin"):
        assert np.array_equal(getattr(again, name), getattr(given, name))
    assert np.array_equal(again.errors.feature, given.errors.feature)
    assert np.array_equal(again.errors.db, given.errors.db)
    assert all(make_method(one.method, **one.options) for one in given.settings)


@pytest.mark.parametrize(
    "damage",
    [
        lambda data: data.update(format=99),
        lambda data: data.update(features=["one"]),
        lambda data: data.pop("measured_db"),
        lambda data: data.update(measured_db=[], measured_feature=[]),
        lambda data: data["log_time"].pop(),
        lambda data: data["measured_db"][0].__setitem__(0, "x"),
        lambda data: data.update(measured_feature=None),
        lambda data: data.update(settings=3),
    ],
)
def test_damaged_curves_are_refused(damage: object) -> None:
    data = json.loads(shipped_curves().to_json())
    damage(data)  # type: ignore[operator]
    with pytest.raises(InputError):
        Curves.from_json(json.dumps(data))


@pytest.mark.parametrize("content", [b"", b"{", b"\xff\xfe", b"[]", b'{"format": 1}', b"null"])
def test_a_damaged_file_is_warned_of_and_passed_over(content: bytes, tmp_path: Path) -> None:
    (tmp_path / curves_name("device", "1.0")).write_bytes(content)
    with pytest.warns(UserWarning, match="passed over"):
        assert load_curves("device", "1.0", tmp_path).source == shipped_curves().source
    assert load_curves("device", "2.0", tmp_path).source == shipped_curves().source  # another driver, another file


def test_the_cache_folder_follows_the_environment(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("CLDOF_CACHE", str(tmp_path))
    assert cache_folder() == tmp_path
    monkeypatch.delenv("CLDOF_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cache_folder() == tmp_path / "cldof"


# Fitting


def rows(seed: int, count: int = 240) -> tuple[list[ErrorRow], list[TimeRow], np.ndarray]:
    """Measurements that follow models of known weights, over features of ordinary size."""
    rng = np.random.default_rng(seed)
    weights = rng.normal(0.0, 1.0, (len(FEATURES), len(LADDER)))
    weights[0] = 30.0
    values = rng.normal(0.0, 1.0, (count, len(FEATURES)))
    values[:, 0], values[:, 1] = 1.0, rng.random(count) > 0.5
    errors = [ErrorRow(f"scene {i % 12}", value, value @ weights) for i, value in enumerate(values)]
    seen = np.zeros(len(FEATURES))
    seen[[FEATURES.index(name) for name in ("one", "pixels", "peels", "blur")]] = 2.0, 0.9, 0.3, 0.1
    times = [TimeRow(value, np.exp(np.full(len(LADDER), value @ seen))) for value in values]
    return errors, times, weights


def test_times_are_fitted_by_what_they_follow() -> None:
    errors, times, _ = rows(3, 500)
    fitted = fit_curves(errors, times, {})
    value = errors[7].feature
    assert fitted.copies(value) == pytest.approx(times[7].copies, rel=0.01)
    # Beyond what was measured the ends hold, except for the size of frames.
    far = value.copy()
    far[AMOUNT] = 99.0
    assert fitted.copies(far) == pytest.approx(fitted.copies(np.minimum(far, fitted.errors.high)))
    assert fitted.errors.predict(far)[0] == pytest.approx(fitted.errors.predict(np.minimum(far, fitted.errors.high))[0])
    far[FEATURES.index("pixels")] += 1.0
    assert fitted.copies(far) == pytest.approx(fitted.copies(value) * math.exp(0.9), rel=0.02)


def test_errors_are_the_gaussian_process_of_the_book() -> None:
    """Equations 2.23 and 2.24 of Rasmussen & Williams, case by case with explicit loops."""
    errors, _, _ = rows(5, 40)
    feature, db = np.array([row.feature for row in errors]), np.array([row.db for row in errors])
    mean, spread = feature.mean(axis=0)[1:], feature.std(axis=0)[1:]  # the first one does not vary

    def kernel(one: np.ndarray, other: np.ndarray) -> float:
        first, second = (one[1:] - mean) / spread, (other[1:] - mean) / spread
        near = math.exp(-0.5 * np.mean((first - second) ** 2) / 0.4**2)
        return float(0.3 * np.mean(first * second) + near)

    inner = np.array([[kernel(a, b) for b in feature] for a in feature]) + 0.02 * np.eye(len(feature))
    at = 0.5 * (feature[3] + feature[8])
    row = np.array([kernel(at, b) for b in feature])
    rest = db - db.mean(axis=0)
    expected = db.mean(axis=0) + row @ np.linalg.solve(inner, rest)
    scale = np.mean(rest * np.linalg.solve(inner, rest), axis=0)
    variance = (kernel(at, at) - row @ np.linalg.solve(inner, row) + 0.02) * scale
    found, deviation = ErrorModel(feature, db).predict(at)
    assert found == pytest.approx(expected, rel=1e-9) and deviation == pytest.approx(np.sqrt(variance), rel=1e-7)


def test_errors_are_sure_near_what_was_measured_and_unsure_elsewhere() -> None:
    rng = np.random.default_rng(2)
    feature = np.zeros((60, len(FEATURES)))
    feature[:, 0], feature[:, 2:6] = 1.0, rng.normal(0.0, 0.3, (60, 4))
    db = 30.0 + 3.0 * np.sin(2.0 * feature[:, 2:3]) + np.zeros((60, 2))
    db[:, 1] += 4.0 * feature[:, 3]
    model = ErrorModel(feature[:50], db[:50])
    predicted = [model.predict(value) for value in feature[50:]]
    missed = np.array([mean for mean, _ in predicted]) - db[50:]
    assert np.sqrt(np.mean(missed**2)) < 0.5 * db[50:].std()
    assert np.mean(np.abs(missed) < 2.0 * np.array([spread for _, spread in predicted])) > 0.85
    corner = np.zeros(len(FEATURES))
    corner[0], corner[2:6] = 1.0, (0.6, -0.6, 0.6, -0.6)
    assert (model.predict(corner)[1] > 1.5 * model.predict(feature[7])[1]).all()


def test_times_follow_no_colours() -> None:
    _, times, _ = rows(4)
    weights, margin = fit_times(times)
    assert ((margin > 0.0) & (margin < 0.1)).all()
    for name in ("contrast", "texture", "luminance", "is_disc"):
        assert not weights[FEATURES.index(name)].any()


# Rendering


def test_auto_renders_what_the_method_that_it_chose_does(device_info: DeviceInfo) -> None:
    frame = noise_frame(64, 48, seed=5)
    for lens in (Lens(0.03, 2.0), Lens(0.03, 2.0, aperture="gaussian")):
        with warnings.catch_warnings(), Renderer("auto", device=device_info.index, max_error="22dB") as renderer:
            warnings.simplefilter("ignore", BudgetWarning)
            result = renderer.render(frame, lens)
        choice = result.choice
        assert choice is not None
        with Renderer(choice.setting.method, device=device_info.index, **choice.setting.options) as renderer:
            assert np.array_equal(result.image, renderer.render(frame, lens).image)


def finer_frame(seed: int, count: list[int] | None = None) -> LayeredFrame:
    """Noise in which nothing is wider than a third of a pixel; counts how often it is captured finer."""
    finer = noise_frame(72, 60, seed=seed, guard_px=6)
    middle = LayeredFrame(
        finer.color[:, 1::3, 1::3], finer.depth[:, 1::3, 1::3], replace(finer.camera, width=24, height=20), guard_px=2
    )

    def captured() -> LayeredFrame:
        if count is not None:
            count.append(1)
        return finer

    return middle.with_finer(captured)


@pytest.mark.parametrize("fine", [Setting("layered", samples=3), Setting("multiview", {"rays": 8}, samples=3)])
def test_auto_renders_finer_frames(fine: Setting, device_info: DeviceInfo, monkeypatch: pytest.MonkeyPatch) -> None:
    captured: list[int] = []
    frame, lens = finer_frame(3, captured), Lens(0.03, 2.0, aperture="gaussian")
    given = curves([25, 31, 33, 40], [1, 4, 2, 30], settings=(*SETTINGS[:3], fine))
    monkeypatch.setattr("cldof.renderer.load_curves", lambda device, driver: given)
    with Renderer("auto", device=device_info.index, max_error="32dB") as renderer:
        assert renderer.render(frame, lens).choice.setting == SETTINGS[2]  # type: ignore[union-attr]
        assert not captured
    with Renderer("auto", device=device_info.index, max_error="36dB") as renderer:
        results = [renderer.render(frame, lens) for _ in range(3)]
        built = renderer.peak_device_bytes
        for seed in range(4, 9):
            assert renderer.render(finer_frame(seed), lens).image.shape == (20, 24, 4)
        assert renderer.peak_device_bytes <= 2 * built  # as many frames as overlap are kept of either kind
    assert len(captured) == 1 and results[0].choice is not None and results[0].choice.setting == fine
    options = {"supersample": 3, "antialias": False, **fine.options}
    with Renderer(fine.method, device=device_info.index, **options) as renderer:
        assert np.array_equal(results[2].image, renderer.render(frame.finer, lens).image)
    # Frames without a finer one are rendered as if there were no such settings.
    with Renderer("auto", device=device_info.index, max_error="36dB") as renderer, pytest.warns(BudgetWarning):
        plain = renderer.render(noise_frame(24, 20, seed=3), lens)
    assert plain.choice is not None and plain.choice.setting == SETTINGS[2]


def test_auto_keeps_to_one_setting_while_nothing_changes(device_info: DeviceInfo) -> None:
    frame = noise_frame(48, 48, seed=6)
    with warnings.catch_warnings(), Renderer("auto", device=device_info.index, max_error="25dB") as renderer:
        warnings.simplefilter("ignore", BudgetWarning)
        found = [renderer.render(frame, Lens(0.02, focus)).choice for focus in np.linspace(1.5, 1.6, 12)]
    assert len({str(choice.setting) for choice in found if choice}) == 1


def test_auto_overlaps_frames_and_counts_only_those_alone(device_info: DeviceInfo) -> None:
    frame = noise_frame(48, 48, seed=7)
    with warnings.catch_warnings(), Renderer("auto", device=device_info.index, max_ms=1e4) as renderer:
        warnings.simplefilter("ignore", BudgetWarning)
        pending = [renderer.render_async(frame, Lens(0.02, 2.0)) for _ in range(3)]
        images = [one.result().image for one in pending]
        assert all(np.array_equal(images[0], image) for image in images[1:])
        assert renderer._automatic is not None and renderer._automatic.under_way == 0
        assert renderer._automatic._chooser is not None and not renderer._automatic._chooser._ratios
        renderer.render(frame, Lens(0.02, 2.0))
        assert renderer._automatic._chooser._ratios


def test_a_change_of_setting_is_a_blend_of_both(device_info: DeviceInfo, monkeypatch: pytest.MonkeyPatch) -> None:
    frame, lens = noise_frame(48, 48, seed=6), Lens(0.03, 2.0, aperture="gaussian")
    given = curves([35, 45, 20, 20], [1, 4, 9, 9])
    monkeypatch.setattr("cldof.renderer.load_curves", lambda device, driver: given)
    amounts = iter([0.0, *[6.0] * 20])
    monkeypatch.setattr(Line, "predict", lambda self, value: (self.at - next(amounts), self.spread))
    with Renderer("auto", device=device_info.index, max_error="30dB") as renderer:
        results = [renderer.render(frame, lens) for _ in range(10)]
    ends = []
    for setting in SETTINGS[:2]:
        with Renderer(setting.method, device=device_info.index, **setting.options) as renderer:
            ends.append(renderer.render(frame, lens).image)
    assert np.array_equal(results[0].image, ends[0]) and np.array_equal(results[-1].image, ends[1])
    for step, result in enumerate(results[1:9]):
        share = (step + 1) / 9
        assert result.image == pytest.approx((1.0 - share) * ends[0] + share * ends[1], abs=1e-6)


@pytest.mark.parametrize(
    "options", [{}, {"max_error": 30, "max_ms": 5}, {"layers": 4, "max_ms": 5}, {"max_error": "good"}]
)
def test_auto_refuses_what_makes_no_sense(options: dict[str, object]) -> None:
    with pytest.raises(InputError):
        Renderer("auto", **options)


# Tuning


def test_finer_frames_tell_times_also_of_frames_that_have_none() -> None:
    frame = noise_frame(20, 16, seed=2, guard_px=2)
    shown = next(frame_cases([frame]))[0]
    for at in ((0, 0), (1, 1), (2, 2)):
        assert np.array_equal(shown.finer.color[:, at[0] :: 3, at[1] :: 3], frame.color)
    assert sampled(shown, Setting("layered")) is shown and sampled(shown, FINE[3]) is shown.finer


def test_tuning_on_frames_is_found_by_renderers(
    device_info: DeviceInfo, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("CLDOF_CACHE", str(tmp_path / "new" / "folder"))
    monkeypatch.chdir(tmp_path)
    noise_frame(40, 32, seed=8).save("one.npz")
    noise_frame(64, 56, layers=2, seed=9).save("two.npz")
    index = str(device_info.index)
    assert main(["tune", "one.npz", "two.npz", "--device", index]) == 0
    found = load_curves(device_info.name, device_info.driver_version)
    assert found.source["device"] == device_info.name and found.source["copy_ms"] > 0.0
    assert str(cache_folder()) in capsys.readouterr().out
    # Errors are the shipped ones, times its own: 600 us to 1 s for such frames on anything that runs tests.
    assert np.allclose(found.errors.db, shipped_curves().errors.db, rtol=1e-4)
    frame = noise_frame(40, 32, seed=8)
    with Renderer(device=device_info.index) as renderer:
        value = features(renderer.stats(frame), Lens(0.02, 2.0), frame)
        measured = frame_ms(renderer, frame, Lens(0.02, 2.0))
    predicted = float(found.copies(value)[LADDER.index(Setting("layered"))]) * float(found.source["copy_ms"])
    assert predicted == pytest.approx(measured, rel=20.0)


def test_errors_are_measured_against_references(
    device_info: DeviceInfo, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    require_opengl()
    monkeypatch.setenv("CLDOF_CACHE", str(tmp_path))
    for name, value in {
        "_ERROR_SIZES": (32,),
        "_TIME_SIZES": (32, 48),
        "_LENSES": 2,
        "_FEWEST_VIEWS": 16,
        "_MOST_VIEWS": 32,
    }.items():
        monkeypatch.setattr(f"cldof.tune.{name}", value)
    found, path = tune(
        device_info.index, errors=True, scene_names=["plane", "silhouettes"], rows=tmp_path / "rows.json"
    )
    assert path.exists() and Curves.from_json(path.read_text()).source == found.source
    data = json.loads((tmp_path / "rows.json").read_text())
    assert [row["scene"] for row in data["rows"]] == ["plane"] * 2 + ["silhouettes"] * 2
    db = np.array([row["db"] for row in data["rows"]])
    assert ((db > 15.0) & (db <= 50.0)).all()
    # A blur of one image lacks what is hidden.
    gather, layered = LADDER.index(Setting("gather", {"samples": 16})), LADDER.index(Setting("layered"))
    assert db[2:, layered].mean() > db[2:, gather].mean() + 1.0


def test_rows_are_kept_whole(tmp_path: Path) -> None:
    errors, _, _ = rows(1, 5)
    save_rows(errors, tmp_path / "rows.json")
    data = json.loads((tmp_path / "rows.json").read_text())
    assert len(data["rows"]) == 5 and data["settings"] == [str(one) for one in LADDER]
    assert np.allclose(data["rows"][2]["db"], errors[2].db, atol=0.01)


# The command line


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("CLDOF_CACHE", str(tmp_path / "cache"))
    noise_frame(40, 32, seed=8).save("frame.npz")
    return tmp_path


def test_the_command_line_reports_the_choice(
    device_info: DeviceInfo, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    base = ["render", "frame.npz", "--device", str(device_info.index), "--method", "auto", "--report", "r.json"]
    assert main([*base, "-o", "a.npy", "--max-error", "20dB"]) == 0
    out = capsys.readouterr().out
    choice = json.loads(Path("r.json").read_text())["settings"]["choice"]
    assert f"auto    {choice['method']}" in out and "expected" in out
    assert main([*base, "-o", "a.npy", "--max-ms", "1e-3"]) == 0
    assert "times too short" in capsys.readouterr().out


def test_the_command_line_captures_again_where_pixels_are_too_coarse(
    device_info: DeviceInfo, folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    require_opengl()
    given = curves([25, 31, 33, 40], [1, 4, 2, 30], settings=FINE)
    monkeypatch.setattr("cldof.renderer.load_curves", lambda device, driver: given)
    base = ["--size", "48x48", "--device", str(device_info.index), "--method", "auto", "--report", "r.json"]
    for target, samples in (("30dB", 1), ("36dB", 3)):
        assert main(["render", "floating", "-o", "a.png", *base, "--max-error", target]) == 0
        report = json.loads(Path("r.json").read_text())
        assert report["settings"]["choice"]["samples"] == samples
        assert ("finer capture" in report["timings"]["steps_s"]) == (samples > 1)
        assert ("captured again 3 times larger" in capsys.readouterr().out) == (samples > 1)
    sequence = ["sequence", "floating", "-o", "#.png", "--frames", "2", *base, "--max-error", "36dB"]
    assert main(sequence) == 0 and "captured again 3 times larger" in capsys.readouterr().out


def test_the_command_line_captures_for_auto(
    device_info: DeviceInfo, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    require_opengl()
    base = ["--size", "48x48", "--device", str(device_info.index), "--method", "auto"]
    assert main(["render", "floating", "-o", "a.png", *base, "--max-error", "20dB"]) == 0
    assert "auto    " in capsys.readouterr().out
    assert main(["sequence", "floating", "-o", "#.png", "--frames", "2", *base, "--max-ms", "1e4"]) == 0
    assert (folder / "1.png").exists()


@pytest.mark.parametrize(
    "options, says",
    [
        (["--method", "auto"], "needs --max-error"),
        (["--method", "auto", "--max-error", "30", "--max-ms", "3"], "one of both"),
        (["--method", "auto", "--max-error", "30", "--layers", "3"], "leave out --layers"),
        (["--method", "auto", "--max-error", "2"], "give dB"),
        (["--max-ms", "3"], "for --method auto only"),
    ],
)
def test_impossible_requests_are_refused(
    folder: Path, capsys: pytest.CaptureFixture[str], options: list[str], says: str
) -> None:
    assert main(["render", "frame.npz", "-o", "a.png", *options]) == 2
    assert says in capsys.readouterr().err
    assert not (folder / "a.png").exists()


def test_tune_refuses_what_it_cannot_do(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["tune", "--rows", "r.json"]) == 2
    assert "give both" in capsys.readouterr().err
    assert main(["tune", "frame.npz", "--errors"]) == 2
    assert "built-in scenes" in capsys.readouterr().err
    assert replace(shipped_curves(), source={}).source == {}
