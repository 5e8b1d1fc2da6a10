"""What planning is worth: the time of scenes that call for little, as ratios to one that calls for everything.

Scenes are textured walls with boxes before them and windows through them. Times are processor time of the passes, all
threads together, the least of several frames, so that other work on the machine does not count (on a GPU the clock's).
Units are those of :mod:`cldof.benchmark.unit`, between the frames: OpenCV's blur, and a copy of 16 MB on the device.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from cldof import Camera, LayeredFrame, Lens, Renderer
from cldof.benchmark.times import Times
from cldof.benchmark.unit import MISSING, Measured, Yardstick, opencv_blur
from cldof.methods import METHODS

__all__ = ["CASES", "least", "make_frame", "measure", "milliseconds", "report"]

Box = tuple[float, float, float, float, float]

# All over the frame, and on no grid of tiles.
_SPOTS = [(0.03 + 0.16 * (n % 6) + 0.011 * (n // 6), 0.02 + 0.16 * (n // 6) + 0.013 * (n % 6)) for n in range(36)]
# Boxes as x0, y0, x1, y1 in shares of the frame and depth in metres; depth of the wall; focus distance.
CASES: dict[str, tuple[list[Box], float, float]] = {
    "full": ([(0.0, 0.0, 0.33, 1.0, 1.0), (0.33, 0.0, 0.67, 1.0, 2.0)], 8.0, 2.0),
    "all in focus": ([], 2.0, 2.0),
    "only far blur": ([(0.0, 0.0, 0.5, 1.0, 2.0)], 8.0, 2.0),
    "10 % of tiles": ([(0.36, 0.36, 0.64, 0.64, 1.0)], 2.0, 2.0),
    "36 spots": ([(x, y, x + 0.047, y + 0.047, 8.0) for x, y in _SPOTS], 2.0, 2.0),
}
# Of the nearest box, in px for 1024 px.
_COC_PX = 20.0
_PEELS = 4


def make_frame(size: int, boxes: list[Box], wall_m: float) -> LayeredFrame:
    """A wall with boxes before it, behind which the second peel is the wall, and holes in it; two peels are empty."""
    rng = np.random.default_rng(0)

    def paint() -> np.ndarray:
        cells = rng.random((size // 4 + 1, size // 4 + 1, 3), np.float32)
        color = np.ones((size, size, 4), np.float32)
        color[..., :3] = cells.repeat(4, 0).repeat(4, 1)[:size, :size]
        return color

    color = np.zeros((_PEELS, size, size, 4), np.float32)
    depth = np.full((_PEELS, size, size), np.inf, np.float32)
    color[0], depth[0] = paint(), wall_m
    for x0, y0, x1, y1, at in boxes:
        place = (slice(int(y0 * size), int(y1 * size)), slice(int(x0 * size), int(x1 * size)))
        if at < wall_m:
            color[1][place], depth[1][place] = color[0][place], depth[0][place]
        color[0][place], depth[0][place] = paint()[place], at
    return LayeredFrame(color, depth, Camera(size, size, 40.0))


def measure(method: str, device: str | None, size: int, times: int) -> list[dict[str, Any]]:
    """One row per case: milliseconds planned and not, for a frame known already and for a new one, and the unit's."""
    rows = []
    out = np.empty((size, size, 4), np.float32)
    with (
        Renderer(method, device=device) as on,
        Renderer(method, device=device, planned=False) as off,
        Yardstick(on.device) as yardstick,
    ):
        # What comes after the passes: the image on its way to the host.
        target = on.device.pool.acquire(out.nbytes)
        for case, (boxes, wall, focus) in CASES.items():
            frame = make_frame(size, boxes, wall)
            lens = Lens(_COC_PX * size / 1024 * 2.0 / frame.camera.focal_px, focus)
            plan = on.render(frame, lens).plan
            change = float(np.abs(on.render(frame, lens).image - off.render(frame, lens).image).max())

            def known(renderer: Renderer, frame: LayeredFrame = frame, lens: Lens = lens) -> Callable[[], Any]:
                return lambda: renderer.render(frame, lens, out=out)

            def new(renderer: Renderer, frame: LayeredFrame = frame, lens: Lens = lens) -> Callable[[], Any]:
                fresh = []
                for _ in range(times + 1):
                    one = LayeredFrame(frame.color, frame.depth, frame.camera)
                    _ = one.is_opaque, one.has_glass, one.inverse_depth_range
                    fresh.append(one)
                return lambda: renderer.render(fresh.pop(), lens, out=out)

            measured = yardstick.measure(
                {
                    "download": lambda: on.device.pool.download(target, out).wait(),
                    "planned_ms": known(on),
                    "everything_ms": known(off),
                    "planned_new_ms": new(on),
                    "everything_new_ms": new(off),
                },
                times,
            )
            rows.append(
                {
                    "method": method,
                    "case": case,
                    "unit": asdict(measured.unit),
                    **milliseconds(measured),
                    "windows": plan.summary["windows"],
                    "error_bound": plan.error_bound,
                    "change": change,
                }
            )
    return rows


def milliseconds(measured: Measured) -> dict[str, float | None]:
    """The least of everything: processor time, or the clock's on a device that is no CPU; downloads are taken off."""
    unit, times = measured.unit, dict(measured.times)
    download = least(times.pop("download"))
    return {
        "blur_ms": least(unit.blur, times["planned_ms"].cpu is not None) if unit.blur else None,
        "copy_ms": least(unit.copy) if unit.copy else None,
        **{name: least(one) - download for name, one in times.items()},
    }


def least(times: Times, by_processor: bool = True) -> float:
    """Processor time, all threads together, where it is known and wanted; else the clock's."""
    return times.min if times.cpu_min is None or not by_processor else times.cpu_min


def report(device: str | None, size: int, times: int, output: str | None) -> None:
    """Measure every method, print a table, and keep the numbers."""
    if opencv_blur()[0] is None:
        print(MISSING)
    rows = [row for method in sorted(METHODS) for row in measure(method, device, size, times)]
    print(
        "| method | scene | blurs | copies | of the full scene | of everything on "
        "| new frame: blurs | new frame: copies | new frame: of everything on |\n|---|---|---|---|---|---|---|---|---|"
    )
    for row in rows:
        full = next(one for one in rows if one["method"] == row["method"] and one["case"] == "full")
        cells = (
            f"`{row['method']}`",
            row["case"],
            _over(row["planned_ms"], row["blur_ms"], ".3f"),
            _over(row["planned_ms"], row["copy_ms"], ".1f"),
            f"{row['planned_ms'] / full['planned_ms']:.0%}",
            f"{row['planned_ms'] / row['everything_ms']:.0%}",
            _over(row["planned_new_ms"], row["blur_ms"], ".3f"),
            _over(row["planned_new_ms"], row["copy_ms"], ".1f"),
            f"{row['planned_new_ms'] / row['everything_new_ms']:.0%}",
        )
        print("| " + " | ".join(cells) + " |")
    largest = max(rows, key=lambda row: row["change"])
    print(f"\nLargest change of a pixel: {largest['change']:.1g} ({largest['method']}, {largest['case']}).")
    if output:
        Path(output).write_text(json.dumps(rows, indent=2) + "\n", encoding="utf-8")


def _over(ms: float, unit_ms: float | None, form: str) -> str:
    return format(ms / unit_ms, form) if unit_ms else "-"
