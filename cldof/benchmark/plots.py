"""Accuracy versus time: PSNR over milliseconds, one plot per case (matplotlib, an optional extra)."""

from __future__ import annotations

import io
import math
from pathlib import Path
from typing import Any

from ..errors import InputError
from ..files import atomic_write
from .ladders import ACCUMULATION
from .record import Record, Row

__all__ = ["accuracy_plot", "has_matplotlib", "save_plots"]

_COLORS = ("#0b6e99", "#c2410c", "#4d7c0f", "#7c3aed", "#be185d", "#0f766e", "#a16207", "#475569")
_MARKERS = "osD^vPX*"
# Labels nearer to each other than this, in decades of time and in dB, would overlap.
_LABEL_DECADES, _LABEL_DB = 0.25, 0.7


def has_matplotlib() -> bool:
    """Whether plots can be drawn."""
    try:
        import matplotlib  # noqa: F401
    except ImportError:
        return False
    return True


def accuracy_plot(record: Record, case: str, judge: str = "method") -> bytes:
    """A PNG of one case.

    Parameters
    ----------
    record : Record
    case : str
    judge : {"method", "picture"}
        Reference without or with sub-pixel jitter.

    Raises
    ------
    InputError
        matplotlib is not installed.
    """
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError:
        raise InputError("Plots need matplotlib: pip install 'cldof[bench]'.") from None
    figure = Figure(figsize=(8.0, 4.8), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    rows = record.rows_of(case)
    told: list[tuple[float, float]] = []
    groups: dict[tuple[str, str], list[Row]] = {}
    for row in rows:
        groups.setdefault((row.method, row.device), []).append(row)
    several = {method for method, device in groups if sum(m == method for m, _ in groups) > 1}
    for number, ((method, device), members) in enumerate(groups.items()):
        color = _COLORS[number % len(_COLORS)]
        name = f"{method} ({device.split(':')[0]})" if method in several else method
        if method == ACCUMULATION:
            lenses = (("gaussian", judge), ("disc", "disc" if judge == "method" else "disc picture"))
            for style, (lens, own) in zip(("-", ":"), lenses, strict=True):
                line = _points(members, own)
                axes.plot(*line, style, color="#64748b", marker=".", label=f"accumulation, {lens} lens", zorder=1)
                if style == "-":
                    for row, x, y in zip(members, *line, strict=False):
                        _tell(axes, str(row.views), x, y, "#64748b")
            continue
        kept = [row for row in members if _finite(row.error("psnr_db", judge))]
        times, levels = _points(members, judge)
        marker = _MARKERS[number % len(_MARKERS)]
        axes.scatter(
            times, levels, color=color, marker=marker, s=34, label=name, zorder=3, edgecolors="white", linewidths=0.6
        )
        for row, at, level in zip(kept, times, levels, strict=True):
            # Of labels that would lie on each other the first one stays.
            if all(abs(math.log10(at / x)) > _LABEL_DECADES or abs(level - y) > _LABEL_DB for x, y in told):
                told.append((at, level))
                _tell(axes, row.setting, at, level, color)
    kind = "not jittered" if judge == "method" else "jittered"
    axes.set_xscale("log")
    axes.set_xlabel("milliseconds from scene to image (capture included)")
    axes.set_ylabel("PSNR in dB, more is better")
    facts = record.references.get(f"{case}|gaussian|{kind}", {})
    floor = facts.get("noise_floor_db")
    title = f"{case}, reference {kind}"
    if floor is not None:
        title += f" ({facts['views']} views, own noise {floor:.1f} dB)"
    axes.set_title(title.replace("$", r"\$"), fontsize=10, loc="left")  # text, not mathematics
    axes.grid(True, which="both", color="#e2e8f0", linewidth=0.6)
    axes.spines[["top", "right"]].set_visible(False)
    axes.margins(x=0.12, y=0.1)
    if groups:
        axes.legend(fontsize=7.5, frameon=False, loc="best")
    stream = io.BytesIO()
    figure.savefig(stream, format="png", metadata={"Software": None})
    return stream.getvalue()


def save_plots(record: Record, folder: Path) -> list[Path]:
    """Write a PNG per case and judge; returns the files."""
    written = []
    for number, case in enumerate(record.cases, 1):
        for judge in ("method", "picture"):
            safe = "".join(letter if letter.isalnum() else "-" for letter in case)
            target = folder / f"accuracy-{number:02d}-{safe}-{judge}.png"
            with atomic_write(target) as stream:
                stream.write(accuracy_plot(record, case, judge))
            written.append(target)
    return written


def _finite(value: Any) -> bool:
    return isinstance(value, int | float) and math.isfinite(value)


def _points(rows: list[Row], judge: str) -> tuple[list[float], list[float]]:
    found = [(row.total_ms, psnr) for row in rows if _finite(psnr := row.error("psnr_db", judge))]
    return [x for x, _ in found], [float(y or 0.0) for _, y in found]


def _tell(axes: Any, text: str, x: float, y: float, color: str) -> None:
    axes.annotate(
        text.replace("$", r"\$"), (x, y), xytext=(4, 3), textcoords="offset points", fontsize=6.5, color=color
    )
