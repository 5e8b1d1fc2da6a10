"""What the rows of a record say: accumulation at equal error, tables. No measuring happens here."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from statistics import median
from typing import Any, NamedTuple

import numpy as np

from .ladders import ACCUMULATION
from .record import Record, Row
from .unit import MISSING

__all__ = [
    "Column",
    "EqualError",
    "case_table",
    "columns",
    "equal_error",
    "layered_table",
    "summary_table",
    "text_table",
    "unit_text",
]


class EqualError(NamedTuple):
    """Accumulation that errs as much as a row: milliseconds, views, CPU time; ``bound`` is "<", ">" or ""."""

    ms: float
    views: float
    bound: str
    cpu_ms: float | None = None

    def ratio(self, row: Row) -> float:
        """How many times less a row takes: by processor time where both have it, else by the clock."""
        if self.cpu_ms is not None and row.cpu_ms:
            return self.cpu_ms / row.cpu_ms
        return self.ms / row.total_ms

    def speed_up(self, row: Row) -> str:
        """:meth:`ratio` as text."""
        return f"{self.bound}{self.ratio(row):.2g}x"


# These integrate over the area of a pixel, as a row with supersampling does: the jittered reference judges them.
_INTEGRATE_PIXELS = frozenset({"mitsuba"})


def equal_error(record: Record, row: Row, judge: str | None = None) -> EqualError | None:
    """Accumulation at the PSNR of a row, from the ladder of the same case; straight lines in log time.

    Outside of the ladder it is the nearest end, with ``bound`` telling on which side the truth lies. Without a
    ``judge`` it is the picture for what integrates over pixels, else the method.
    """
    if judge is None:
        judge = "picture" if row.method in _INTEGRATE_PIXELS or row.supersample > 1 else "method"
    wanted = row.error("psnr_db", judge)
    own = _judge_of_accumulation(row, judge)
    points = []
    for one in record.rows_of(row.case):
        psnr = one.error("psnr_db", own)
        if one.method == ACCUMULATION and one.views and psnr is not None:
            points.append((psnr, one.total_ms, one.views, one.cpu_ms))
    if wanted is None or not points or row.method == ACCUMULATION:
        return None
    points.sort(key=lambda point: point[2])
    # More views are never worse: noise of the ladder must not make it turn back.
    levels = np.maximum.accumulate([min(point[0], 1e3) for point in points])
    if wanted > levels[-1] or wanted < levels[0]:
        _, ms, views, cpu_ms = points[-1 if wanted > levels[-1] else 0]
        return EqualError(ms, views, ">" if wanted > levels[-1] else "<", cpu_ms)

    def at(values: list[float]) -> float:
        return math.exp(float(np.interp(wanted, levels, np.log(values))))

    cpu = [point[3] for point in points if point[3] is not None]
    return EqualError(
        at([point[1] for point in points]),
        at([float(point[2]) for point in points]),
        "",
        at(cpu) if len(cpu) == len(points) else None,
    )


def _judge_of_accumulation(row: Row, judge: str) -> str:
    """Under which name an accumulation row holds the error against the same reference."""
    if row.aperture == "gaussian" or row.method == ACCUMULATION:
        return judge
    return {"method": "disc", "picture": "disc picture"}.get(judge, judge)


@dataclass(frozen=True)
class Column:
    """One column: heading, what it means, its value of a row (a number, text or None), and how it is written."""

    head: str
    help: str
    value: Callable[[Record, Row], Any]
    form: str = ""

    def text(self, record: Record, row: Row) -> str:
        """The cell; a dash where there is nothing."""
        value = self.value(record, row)
        if value is None:
            return "-"
        return str(value) if not self.form or isinstance(value, str) else format(value, self.form)


def _median(times: Any) -> float | None:
    return None if times is None else float(times.median)


def _equal(record: Record, row: Row) -> EqualError | None:
    return equal_error(record, row)


def columns(many_devices: bool = True) -> tuple[Column, ...]:
    """All columns of the table of a case."""
    device = (Column("device", "OpenCL device, or what else did the work", lambda _, row: row.device),)
    return (
        Column("method", "", lambda _, row: row.method),
        Column("setting", "", lambda _, row: row.setting),
        *(device if many_devices else ()),
        Column("total ms", "scene to image: capture and steady frame, medians", lambda _, row: row.total_ms, ".1f"),
        Column("cpu ms", "processor time of the same, all cores", lambda _, row: row.cpu_ms, ".0f"),
        Column("capture", "drawing the layers, ms", lambda _, row: _median(row.capture), ".1f"),
        Column("frame", "host arrays to host image, ms", lambda _, row: _median(row.wall), ".1f"),
        Column("least", "the quickest of those frames, ms", lambda _, row: row.wall and row.wall.min, ".1f"),
        Column(
            "IQR", "distance between the quartiles of those frames, ms", lambda _, row: row.wall and row.wall.iqr, ".2f"
        ),
        Column(
            "blurs",
            "frame in OpenCV blurs of sigma 16, 1024x1024, timed between its runs; (cpu): by processor time, as the "
            "machine was not idle",
            lambda _, row: None if row.in_blurs is None else str(row.in_blurs),
        ),
        Column("kernels", "sum of the passes, ms", lambda _, row: _median(row.kernels), ".1f"),
        Column("copies", "kernels in device copies of 16 MB", lambda _, row: row.kernels_in_copies, ".1f"),
        Column("transfer", "upload and download, ms", lambda _, row: _median(row.transfer), ".2f"),
        Column("first +", "what the first frame took longer, ms", lambda _, row: row.build_ms, ".0f"),
        Column(
            "MiB",
            "device memory at its peak",
            lambda _, row: None if row.peak_device_bytes is None else row.peak_device_bytes / 2**20,
            ".0f",
        ),
        Column("PSNR", "dB against the unjittered reference", lambda _, row: row.error("psnr_db"), ".2f"),
        Column("SSIM", "against the unjittered reference", lambda _, row: row.error("ssim"), ".4f"),
        Column("edges", "RMS error along silhouettes", lambda _, row: row.error("silhouette_band_rms"), ".4f"),
        Column("focus", "RMS error of what is in focus", lambda _, row: row.error("in_focus_rms"), ".4f"),
        Column(
            "picture", "PSNR against the jittered reference, dB", lambda _, row: row.error("psnr_db", "picture"), ".2f"
        ),
        Column("disc", "PSNR against a disc lens, dB", lambda _, row: row.error("psnr_db", "disc"), ".2f"),
        Column(
            "own", "PSNR against its own image of 1024 samples, dB", lambda _, row: row.error("psnr_db", "own"), ".2f"
        ),
        Column(
            "equal ms",
            "accumulation of equal PSNR, ms",
            lambda record, row: None if (found := _equal(record, row)) is None else found.ms,
            ".0f",
        ),
        Column(
            "speed-up",
            "over accumulation of equal PSNR, by CPU time if known; > and < where its ladder ends",
            lambda record, row: None if (found := _equal(record, row)) is None else found.speed_up(row),
        ),
    )


def case_table(record: Record, case: str) -> tuple[list[str], list[list[str]]]:
    """Headings and cells of a case; columns that nobody fills are left out."""
    rows = record.rows_of(case)
    many = len({row.device for row in rows if row.kernels is not None}) > 1
    chosen = [
        column
        for column in columns(many)
        if column.head in ("method", "setting") or any(column.value(record, row) is not None for row in rows)
    ]
    return [column.head for column in chosen], [[column.text(record, row) for column in chosen] for row in rows]


def text_table(heads: Sequence[str], cells: Iterable[Sequence[str]]) -> str:
    """Plain text: the first column to the left, numbers to the right."""
    lines = [list(heads), *map(list, cells)]
    widths = [max(len(line[i]) for line in lines) for i in range(len(heads))]
    return "\n".join(
        "  ".join(
            cell.ljust(width) if i < 2 else cell.rjust(width)
            for i, (cell, width) in enumerate(zip(line, widths, strict=True))
        ).rstrip()
        for line in lines
    )


def markdown_table(heads: Sequence[str], cells: Iterable[Sequence[str]]) -> str:
    """A table for docs."""
    lines = ["| " + " | ".join(heads) + " |", "|" + "---|" * len(heads)]
    return "\n".join(lines + ["| " + " | ".join(line) + " |" for line in cells])


def layered_table(record: Record, case: str) -> tuple[list[str], list[list[str]]]:
    """The paper's comparison (Schedl & Wimmer 2012, tables 1-2): layered, cascaded and not, beside accumulation."""
    heads = [
        "method",
        "setting",
        "total ms",
        "CPU ms",
        "frame ms",
        "PSNR dB",
        "SSIM",
        "accumulation of equal PSNR",
        "speed-up",
    ]
    cells = []
    for row in record.rows_of(case):
        if row.method not in ("layered", ACCUMULATION):
            continue
        equal = equal_error(record, row)
        ssim, psnr = row.error("ssim"), row.error("psnr_db")
        cells.append(
            [
                row.method,
                row.setting,
                f"{row.total_ms:.1f}",
                "-" if row.cpu_ms is None else f"{row.cpu_ms:.0f}",
                "-" if row.capture is None or row.wall is None else f"{row.wall.median:.1f}",
                "-" if psnr is None else f"{psnr:.2f}",
                "-" if ssim is None else f"{ssim:.4f}",
                "-" if equal is None else f"{equal.bound}{equal.views:.0f} views, {equal.bound}{equal.ms:.0f} ms",
                "-" if equal is None else equal.speed_up(row),
            ]
        )
    return heads, cells


def summary_table(record: Record, unlit: bool = False) -> tuple[list[str], list[list[str]]]:
    """Medians over all cases of one size and kind, per method, setting and device."""
    heads = [
        "method",
        "setting",
        "size",
        "scenes",
        "total ms",
        "CPU ms",
        "frame ms",
        "blurs",
        "PSNR dB",
        "worst",
        "SSIM",
        "picture dB",
        "speed-up",
    ]
    many = len({row.device for row in record.rows.values() if row.kernels is not None}) > 1
    if many:
        heads.insert(2, "device")
    groups: dict[tuple[str, str, str, str], list[Row]] = {}
    for row in record.rows.values():
        case = record.cases[row.case]
        if bool(case["unlit"]) == unlit:
            size = f"{case['width']}x{case['height']}"
            groups.setdefault((row.method, row.setting, size, row.device), []).append(row)
    cells = []
    for (method, setting, size, device), rows in groups.items():
        found = [(equal, row) for row in rows if (equal := equal_error(record, row)) is not None]
        ratios = [equal.ratio(row) for equal, row in found]
        bound = {equal.bound for equal, _ in found}
        cells.append(
            [
                method,
                setting,
                *([device] if many else []),
                size,
                str(len(rows)),
                _middle([row.total_ms for row in rows], ".1f"),
                _middle(_known(row.cpu_ms for row in rows), ".0f"),
                _middle([row.wall.median for row in rows if row.wall], ".1f"),
                _middle([row.in_blurs.value for row in rows if row.in_blurs], ".3g"),
                _middle(_known(row.error("psnr_db") for row in rows), ".2f"),
                _least(_known(row.error("psnr_db") for row in rows), ".2f"),
                _middle(_known(row.error("ssim") for row in rows), ".4f"),
                _middle(_known(row.error("psnr_db", "picture") for row in rows), ".2f"),
                (("" if bound <= {""} else "~") + f"{median(ratios):.2g}x") if ratios else "-",
            ]
        )
    return heads, cells


def unit_text(record: Record) -> str:
    """What speeds of a record are judged by, and how far that scattered from row to row."""
    units = [row.unit for row in record.rows.values() if row.unit and row.unit.blur]
    if not units:
        if record.rows and all(row.unit is None for row in record.rows.values()):
            return (
                "An older record: speeds in copies of 16 MB alone, which scatter by a factor of four on some machines."
            )
        return MISSING + "."
    wall = [unit.blur.median for unit in units if unit.blur]
    cpu = [unit.blur.cpu for unit in units if unit.blur and unit.blur.cpu]
    busy = sum(not unit.is_quiet for unit in units)
    text = f"Unit: {units[0].what}. Medians of {len(units)} rows: {min(wall):.1f} to {max(wall):.1f} ms by the clock"
    if cpu:
        text += f", {min(cpu):.1f} to {max(cpu):.1f} ms of processor time"
    return f"{text}; the machine was not idle in {busy} of them, which are judged by processor time."


def _known(values: Iterable[float | None]) -> list[float]:
    return [value for value in values if value is not None]


def _middle(values: list[float], form: str) -> str:
    return format(median(values), form) if values else "-"


def _least(values: list[float], form: str) -> str:
    return format(min(values), form) if values else "-"
