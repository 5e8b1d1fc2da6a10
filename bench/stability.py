"""Make docs/stability.md from what tests/hard_cases measured: ``python -m bench.stability``.

``make stability`` records first, on every device of the machine.
"""

from __future__ import annotations

import json
from collections import defaultdict
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
RECORD = ROOT / "bench" / "results" / "stability.json"
PAGE = ROOT / "docs" / "stability.md"

FAMILIES = {
    "depth": "Depth",
    "lens": "Lens",
    "radiance": "Radiance",
    "alpha": "Alpha",
    "size": "Size",
    "filters": "Filters",
    "time": "Time",
    "random": "Random frames and lenses",
    "differential": "Methods against exact images and each other",
}

INTRODUCTION = """\
# Numerical stability

Made by `python -m bench.stability` from `bench/results/stability.json`; `make stability` measures again. Each row is
an invariant of a hard case (`tests/hard_cases/`, one file per family) and the **largest value seen** for each method
and driver, over all parameters of the case: sizes, blurs, lenses. A test fails where a value exceeds its bound. 0
means that nothing was off by a single bit. Where bounds differ from method to method, a wide one is a known limit of
the method, explained where the test sets it and on the method's page.

Variants: *iir* recursive filters throughout, *single* layers blurred one by one, *paper* as published, *atomic* views
by atomic minima, *peels* rays through the peels themselves. A dash: not measured on that driver; one number alone: the
same on all drivers of the table. The tests run in full on PoCL and Intel's runtime; rusticl, on which Mesa compiles for
minutes, has methods without variants, and not of all families. `make test-devices ARGS=figures` measures both again.
"""


def table(rows: list[list]) -> str:
    """One family's table: a line per case and invariant, a cell per subject."""
    drivers = sorted({row[4] for row in rows})
    cells: dict[tuple[str, str], dict[str, dict[str, float]]] = defaultdict(lambda: defaultdict(dict))
    bounds: dict[tuple[str, str], dict[str, float]] = defaultdict(dict)
    for _, case, invariant, subject, driver, value, bound in rows:
        cells[case, invariant][subject][driver] = value
        bounds[case, invariant][subject] = max(bound, bounds[case, invariant].get(subject, bound))
    lines = [f"Values: {' / '.join(drivers)}.", "", "| case | invariant | worst seen | bound |"]
    lines.append("|---|---|---|---|")
    for (case, invariant), subjects in sorted(cells.items()):
        # Subjects that all of whose drivers measured nothing share a line.
        parts, quiet = [], []
        for subject, values in sorted(subjects.items()):
            if not any(values.values()):
                quiet.append(subject)
                continue
            numbers = [_number(values[driver]) if driver in values else "-" for driver in drivers]
            shown = numbers[0] if len(set(numbers)) == 1 else " / ".join(numbers)
            parts.append(f"{subject} {shown}")
        if quiet:
            parts.append("0: " + (", ".join(quiet) if parts else "all"))
        distinct = bounds[case, invariant]
        if len(set(distinct.values())) == 1:
            limit = _number(next(iter(distinct.values())))
        else:
            usual = min(distinct.values())
            wide = ", ".join(f"{name} {_number(n)}" for name, n in sorted(distinct.items()) if n != usual)
            limit = f"{_number(usual)}; {wide}"
        lines.append(f"| {case} | {invariant.replace('|', 'abs')} | {'<br>'.join(parts)} | {limit} |")
    return "\n".join(lines) + "\n"


def _number(value: float) -> str:
    return f"{value:.2g}"


def page(record: dict) -> str:
    """The whole page."""
    families: dict[str, list[list]] = defaultdict(list)
    for row in record["rows"]:
        families[row[0]].append(row)
    parts = [INTRODUCTION]
    for name in [*FAMILIES, *sorted(set(families) - set(FAMILIES))]:
        if name in families:
            parts.append(f"## {FAMILIES.get(name, name.capitalize())}\n{table(families[name])}")
    return "\n".join(parts)


def main() -> None:
    """Write the page."""
    PAGE.write_text(page(json.loads(RECORD.read_text())))


if __name__ == "__main__":
    main()
