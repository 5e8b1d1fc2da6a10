"""Worst values that the hard cases measure, kept for docs/stability.md.

With ``CLDOF_STABILITY=FILE.json`` a run of ``tests/hard_cases`` adds what it measured to the file: per family, case,
invariant, subject (method and variant) and driver the largest value and its bound. ``python -m bench.stability`` makes
the page of it.
"""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import NamedTuple

from cldof.files import atomic_write
from cldof.host.device import DeviceInfo

__all__ = ["VARIABLE", "Key", "Measurements", "driver_of"]

VARIABLE = "CLDOF_STABILITY"


class Key(NamedTuple):
    """What a value is the worst of."""

    family: str
    case: str
    invariant: str
    subject: str
    driver: str


class Measurements:
    """Largest values and their bounds."""

    def __init__(self) -> None:
        self.worst: dict[Key, tuple[float, float]] = {}

    def add(self, key: Key, value: float, bound: float) -> None:
        """Keep the value if it is the worst against its bound so far; NaN is the worst of all."""
        old = self.worst.get(key)
        if old is None or value != value or (old[0] == old[0] and value - bound > old[0] - old[1]):
            self.worst[key] = (value, bound)

    def save(self, path: Path) -> None:
        """Put them into a file, in place of what it has of the same keys."""
        rows = {}
        if path.exists():
            rows = {Key(*row[:5]): (row[5], row[6]) for row in json.loads(path.read_text())["rows"]}
        rows.update(self.worst)
        lines = ",\n".join(json.dumps([*key, *map(_rounded, values)]) for key, values in sorted(rows.items()))
        columns = json.dumps([*Key._fields, "value", "bound"])
        with atomic_write(path) as stream:
            stream.write(f'{{"columns": {columns},\n"rows": [\n{lines}\n]}}\n'.encode())

    @staticmethod
    def target() -> Path | None:
        """The file that the environment names."""
        name = os.environ.get(VARIABLE)
        return Path(name) if name else None


def driver_of(info: DeviceInfo) -> str:
    """A driver's short name and version."""
    names = {"Portable": "PoCL", "Intel": "Intel", "rusticl": "rusticl"}
    name = next((name for mark, name in names.items() if mark in info.platform), info.platform)
    version = ".".join(info.driver_version.split()[0].split(".")[:2])
    return f"{name} {version}"


def _rounded(value: float) -> float:
    return float(f"{value:.3g}")
