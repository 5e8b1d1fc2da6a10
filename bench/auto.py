"""How ``method="auto"`` keeps an error and a time: the tables of docs/auto.md.

    python -m bench auto                # some ten minutes on an idle 2-core machine
    python -m bench auto --busy         # processor time in place of the clock, for a machine with other work

Errors: 14 built-in scenes x 12 lenses (focus near, on the scene's subject and far; two apertures; disc and Gaussian) at
256x256, each against its own accumulated reference. What is judged is never what was fitted: the measurements in
bench/results/auto-tuning.json are of other lenses and sizes. There are two tables: with what `cldof tune` fits, and
with models that for every scene are made anew from the others, as for a scene that nobody has measured. The device's
times come from the run itself, by a fit that leaves out the lens in the first table and the scene in the second.

Times: frames of 512x512 of every scene, by a renderer of its own for each budget, which is so many of OpenCV's blurs
(:mod:`cldof.benchmark.unit`).
"""

from __future__ import annotations

import json
import math
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cldof import BudgetWarning, LayeredFrame, Lens, Renderer
from cldof.auto import Budget, Chooser, Curves, Setting, cache_folder, features
from cldof.benchmark.unit import Unit, Yardstick
from cldof.capture.peel import DepthPeeler
from cldof.capture.reference_cache import ReferenceCache
from cldof.capture.scene import Scene
from cldof.capture.scenes import builtin_scenes
from cldof.lens import Aperture
from cldof.tune import (
    LADDER,
    ErrorRow,
    TimeRow,
    capture,
    copy_ms,
    fit_curves,
    fit_times,
    frame_ms,
    judged_db,
    make_renderers,
    reference_for,
    sampled,
    setting_renderer,
)

TUNING = Path(__file__).parent / "results" / "auto-tuning.json"
SCENES = (
    "row", "fence", "foliage", "tabletop", "glass", "floating", "silhouettes", "branches", "plane", "lights", "sky",
    "near", "floor", "flat",
)  # fmt: skip
SIZE, LARGE, LOOK = 256, 512, 192
TARGETS_DB = (24, 26, 28, 30, 32, 34)
# Of times, in OpenCV's blurs, and in copies of 16 MB where there is no OpenCV: about the same on most machines.
BUDGETS_BLURS = (0.2, 0.3, 0.5, 1.0, 2.0)
BUDGETS_COPIES = (8.0, 12.0, 20.0, 40.0, 80.0)
# A fixed setting meets a target when it does in this share of the cases.
MOST = 0.95


class Case(NamedTuple):
    """One scene through one lens, with what every setting makes of it."""

    scene: str
    lens: int
    shape: str
    feature: NDArray[np.float64]
    db: NDArray[np.float64]
    ms: NDArray[np.float64]


def judged_lenses(scene: Scene, look: LayeredFrame) -> list[Lens]:
    """12 lenses: none of them is among those that `cldof tune` fits errors to."""
    focus, radius = scene.focus_distance_m, scene.aperture_radius_m
    assert focus is not None and radius is not None
    seen = 1.0 / look.depth[0][np.isfinite(look.depth[0])].astype(np.float64)
    near = min(1.0 / float(np.quantile(seen, 0.9)), 0.8 * focus)
    far = max(1.0 / float(np.quantile(seen, 0.1)), 1.25 * focus)
    return [
        Lens(radius * scale, distance, aperture=Aperture.of(shape))
        for shape in ("disc", "gaussian")
        for distance in (near, focus, far)
        for scale in (0.6, 1.4)
    ]


def tuning_rows() -> list[ErrorRow]:
    """What the shipped curves were fitted to."""
    data = json.loads(TUNING.read_text())
    if data["settings"] != [str(setting) for setting in LADDER]:
        raise SystemExit(f"{TUNING} is of another ladder: make it with `cldof tune --errors --rows {TUNING}`.")
    return [ErrorRow(row["scene"], np.array(row["feature"]), np.array(row["db"])) for row in data["rows"]]


def measured_cases(device: Any, busy: bool, scenes: tuple[str, ...], size: int) -> Iterator[Case]:
    """Render everything once."""
    renderers = make_renderers(device)
    cache = ReferenceCache(cache_folder() / "references")
    try:
        with DepthPeeler() as peeler:
            for name in scenes:
                scene = builtin_scenes()[name].make()
                camera = scene.camera_for(size, size)
                look = peeler.peel(scene, scene.camera_for(LOOK, LOOK), layers=2)
                for number, lens in enumerate(judged_lenses(scene, look)):
                    reference = reference_for(cache, peeler, scene, camera, lens, seed=1)
                    frame = capture(peeler, scene, camera, lens, look)
                    ms, db = [], []
                    for renderer, setting in zip(renderers, LADDER, strict=True):
                        taken = sampled(frame, setting)
                        ms.append(frame_ms(renderer, taken, lens, 2, busy))
                        db.append(judged_db(renderer.render(taken, lens).image, reference))
                    feature = features(renderers[0].stats(frame), lens, frame)
                    yield Case(name, number, lens.aperture.shape, feature, np.array(db), np.array(ms))
                print(f"  {name}", flush=True)
    finally:
        for renderer in renderers:
            renderer.close()


def chosen(curves: Curves, budget: Budget, unit_ms: float, feature: NDArray[np.float64]) -> int:
    """The setting that a renderer takes for its first frame."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", BudgetWarning)
        choice = Chooser(curves, budget, unit_ms).choose(feature, has_finer=True)
    return curves.settings.index(choice.setting)


def error_table(cases: list[Case], picks: dict[int, list[int]], which: str) -> list[str]:
    """Rows of the table for max_error over the cases with an aperture, or all."""
    rows = np.array([index for index, case in enumerate(cases) if which in (case.shape, "both")])
    db, ms = (np.array([getattr(cases[index], name) for index in rows]) for name in ("db", "ms"))
    lines = []
    for target, pick in picks.items():
        took = np.array(pick)[rows]
        at = np.arange(len(rows))
        can = (db >= target).any(axis=1)
        met = db[at, took] >= target
        good = [(float(ms[can, i].mean()), i) for i in range(len(LADDER)) if (db[can, i] >= target).mean() >= MOST]
        best = min(good) if good else None
        oracle = np.where(db >= target, ms, np.inf).min(axis=1)[can].mean()
        mean = ms[at, took][can].mean()
        fixed = f"{LADDER[best[1]]}, {best[0]:.2f}" if best else "none"
        ratio = f"{mean / best[0]:.2f}" if best else "-"
        lines.append(
            f"| {which} | {target} | {can.mean():.1%} | {met.mean():.1%} | {met[can].mean():.1%} | {mean:.2f} | {fixed}"
            f" | {ratio} | {oracle:.2f} |"
        )
    return lines


def judge_errors(cases: list[Case], unit_ms: float, left_out: bool) -> list[str]:
    """The table for max_error; with ``left_out`` no scene is known to the models that it is judged by."""
    tuning = tuning_rows()
    picks: dict[int, list[int]] = {target: [0] * len(cases) for target in TARGETS_DB}
    parts = [case.scene if left_out else case.lens for case in cases]
    for part in dict.fromkeys(parts):
        times = [TimeRow(case.feature, case.ms / unit_ms) for case, of in zip(cases, parts, strict=True) if of != part]
        curves = fit_curves([row for row in tuning if row.scene != part], times, {})
        for index, case in enumerate(cases):
            if parts[index] == part:
                for target in TARGETS_DB:
                    picks[target][index] = chosen(curves, Budget.of(f"{target}dB"), unit_ms, case.feature)
    lines = [
        "| aperture | max_error, dB | attainable | met, of all | met, of attainable | ms, auto | best fixed setting, ms"
        " | auto / fixed | ms, oracle |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for which in ("disc", "gaussian", "both"):
        lines += error_table(cases, picks, which)
    return lines


def budgets(unit: Unit, busy: bool) -> dict[str, float]:
    """Milliseconds of each budget, and how the table calls it; ``busy`` as for frames: a blur that has the machine."""
    if unit.blur is None:
        assert unit.copy is not None
        return {f"{copies:g} copies": copies * unit.copy.min for copies in BUDGETS_COPIES}
    alone = unit.blur.cpu_min / unit.threads if busy and unit.blur.cpu_min else unit.blur.median
    return {f"{blurs:g}": blurs * alone for blurs in BUDGETS_BLURS}


def judge_times(device: Any, busy: bool, unit: Unit, scenes: tuple[str, ...]) -> list[str]:
    """The table for max_ms: the first choice alone, and after ten frames that it learns from."""
    lines = [
        "| max_ms, blurs | attainable | kept, first choice | kept, after 10 frames | mean share of the time used |",
        "|---|---|---|---|---|",
    ]
    with DepthPeeler() as peeler:  # open as long as frames may ask for finer ones
        shots = list(_shots(peeler, scenes))
        quickest = [min(_setting_ms(device, one, frame, lens, busy) for one in LADDER[:4]) for frame, lens in shots]
        for name, budget in budgets(unit, busy).items():
            first, later, used = [], [], []
            for (frame, lens), least in zip(shots, quickest, strict=True):
                if least > budget:
                    continue
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore", BudgetWarning)
                    with Renderer("auto", device=device, max_ms=budget) as renderer:
                        setting = renderer.render(frame, lens).choice.setting
                        first.append(_setting_ms(device, setting, frame, lens, busy) <= budget)
                        for _ in range(9):
                            setting = renderer.render(frame, lens).choice.setting
                took = _setting_ms(device, setting, frame, lens, busy)
                later.append(took <= budget)
                used.append(took / budget)
            if first:
                lines.append(
                    f"| {name} ({budget:.1f} ms) | {len(first)} of {len(shots)} | {np.mean(first):.0%} | "
                    f"{np.mean(later):.0%} | {np.mean(used):.0%} |"
                )
    return lines


def _shots(peeler: DepthPeeler, scenes: tuple[str, ...]) -> Iterator[tuple[LayeredFrame, Lens]]:
    """Every scene, large, through one of its lenses."""
    for number, name in enumerate(scenes):
        scene = builtin_scenes()[name].make()
        look = peeler.peel(scene, scene.camera_for(LOOK, LOOK), layers=2)
        lens = judged_lenses(scene, look)[(2, 9)[number % 2]]
        yield capture(peeler, scene, scene.camera_for(LARGE, LARGE), lens, look), lens


def _setting_ms(device: Any, setting: Setting, frame: LayeredFrame, lens: Lens, busy: bool) -> float:
    return _time(setting_renderer(setting, device), sampled(frame, setting), lens, busy)


def _time(renderer: Renderer, frame: LayeredFrame, lens: Lens, busy: bool) -> float:
    with renderer:
        return frame_ms(renderer, frame, lens, 5, busy)


def report(
    device: Any = None,
    busy: bool = False,
    scenes: tuple[str, ...] = SCENES,
    output: str | None = None,
    size: int = SIZE,
) -> None:
    """Measure and print the tables."""
    with Renderer(device=device) as renderer, Yardstick(renderer.device) as yardstick:
        unit = yardstick.measure({}, 20).unit
        # What predictions are in, as in a renderer that has no OpenCV; it cancels out here.
        unit_ms = copy_ms(renderer.device, busy)
        print(f"{renderer.device.info}\n{unit}")
    cases = list(measured_cases(device, busy, scenes, size))
    if output:
        rows = [
            {
                "scene": c.scene,
                "lens": c.lens,
                "shape": c.shape,
                "feature": c.feature.tolist(),
                "db": c.db.tolist(),
                "ms": c.ms.tolist(),
            }
            for c in cases
        ]
        Path(output).write_text(json.dumps({"settings": [str(one) for one in LADDER], "cases": rows}) + "\n")
    _, margin = fit_times([TimeRow(case.feature, case.ms / unit_ms) for case in cases])
    most = ", ".join(f"{one} {math.exp(each):.1f}" for one, each in zip(LADDER, margin, strict=True))
    print(f"\n95 % of the times of scenes that are left out stay below so many times the prediction: {most}.\n")
    print("Scenes that are known, through other lenses:\n")
    print("\n".join(judge_errors(cases, unit_ms, left_out=False)))
    print("\nScenes that are not known:\n")
    print("\n".join(judge_errors(cases, unit_ms, left_out=True)))
    print("\nmax_ms:\n")
    print("\n".join(judge_times(device, busy, unit, scenes)))
