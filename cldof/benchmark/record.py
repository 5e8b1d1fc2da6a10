"""The JSON document of a run: plain numbers, written whole after every row, and all that a report needs.

==============  ==========================================================================================
``schema``      2; 1 is read as well, and has no OpenCV blurs
``run``         commit, versions, seed, runs, whether quick, OpenGL renderer
``devices``     traits of each OpenCL device by label, with the copy measured when it was opened
``cases``       scene, size, lens, camera, largest blur, by key
``references``  views, noise floor and seconds, by ``case|aperture|jittered or not``
``rows``        one per case, method, setting and device, by key; see :class:`Row`
``skipped``     what was asked for and is not here, and why
``images``      data URIs by ``case|what``, for the page
==============  ==========================================================================================

JSON knows no infinity (the PSNR of equal images): it is written as the string ``"inf"``.
"""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

from ..errors import InputError
from ..files import atomic_write, read_json
from .times import Times
from .unit import Ratio, Unit

__all__ = ["SCHEMA", "Record", "Row", "Times"]

SCHEMA = 2
# Records of schema 1 have no unit but copies of 16 MB.
_READABLE = (1, SCHEMA)


@dataclass(frozen=True)
class Row:
    """One method with one setting on one case and device.

    Attributes
    ----------
    key, case, method, setting, device : str
        ``key`` is unique; ``device`` is a label of the record's devices, or what else did the work.
    aperture : str
        Whose reference judges it: ``"gaussian"`` or ``"disc"``.
    total_ms : float
        Median of everything from the scene to the image: capture and ``wall``, or a peer's render.
    errors : mapping
        ``"method"`` against the reference without jitter, ``"picture"`` against the one with it, ``"disc"`` for
        Gaussian methods against the disc without jitter, ``"own"`` for a path tracer against its own image of many
        samples; each a mapping of metrics.
    options : mapping
    peels, views, supersample : int, optional
    capture, transfer, kernels, wall : Times, optional
        ``wall`` is one steady frame from host arrays to host image, transfer included, profiling off; ``kernels`` is
        the sum of the passes' events, profiling on.
    build_ms : float, optional
        What the first frame took longer than a steady one; the drivers' own caches are left as they are.
    kernels_in_copies : float, optional
        ``kernels`` in copies of 16 MB measured on the same device in the same run (medians).
    unit : Unit, optional
        What speeds are judged by: OpenCV's blur and the copy, timed between the runs of ``wall``. Older records have
        none.
    peak_device_bytes, input_bytes : int, optional
        Memory that the renderer allocated; the frame's arrays, which a CPU device reads where they are.
    note : str
    """

    key: str
    case: str
    method: str
    setting: str
    device: str
    aperture: str
    total_ms: float
    errors: dict[str, dict[str, float]]
    options: dict[str, Any] = field(default_factory=dict)
    peels: int | None = None
    views: int | None = None
    supersample: int = 1
    capture: Times | None = None
    transfer: Times | None = None
    kernels: Times | None = None
    wall: Times | None = None
    build_ms: float | None = None
    kernels_in_copies: float | None = None
    unit: Unit | None = None
    peak_device_bytes: int | None = None
    input_bytes: int | None = None
    note: str = ""

    @property
    def cpu_ms(self) -> float | None:
        """Processor time of what ``total_ms`` counts, where all of it was measured."""
        parts = [times.cpu for times in (self.capture, self.wall) if times is not None]
        known = [part for part in parts if part is not None]
        return sum(known) if known and len(known) == len(parts) else None

    @property
    def in_blurs(self) -> Ratio | None:
        """``wall`` in blurs of :mod:`cldof.benchmark.unit`; None in older records and without OpenCV."""
        return self.unit.ratio(self.wall) if self.unit and self.wall else None

    def error(self, metric: str, judge: str = "method") -> float | None:
        """One metric, or None where it was not measured."""
        return self.errors.get(judge, {}).get(metric)

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> Row:
        """Read what :meth:`Record.save` wrote of a row."""
        known = {one.name for one in fields(cls)}
        values = {name: value for name, value in data.items() if name in known}
        values["errors"] = _decoded(values["errors"])
        for name in ("capture", "transfer", "kernels", "wall"):
            if values.get(name) is not None:
                values[name] = Times(**values[name])
        if values.get("unit") is not None:
            values["unit"] = Unit.from_dict(values["unit"])
        return cls(**values)


@dataclass
class Record:
    """A run; see the module's text."""

    run: dict[str, Any] = field(default_factory=dict)
    devices: dict[str, dict[str, Any]] = field(default_factory=dict)
    cases: dict[str, dict[str, Any]] = field(default_factory=dict)
    references: dict[str, dict[str, Any]] = field(default_factory=dict)
    rows: dict[str, Row] = field(default_factory=dict)
    skipped: dict[str, str] = field(default_factory=dict)
    images: dict[str, str] = field(default_factory=dict)

    def rows_of(self, case: str) -> list[Row]:
        """Rows of a case, in the order measured."""
        return [row for row in self.rows.values() if row.case == case]

    def save(self, path: str | Path) -> None:
        """Write the document; it is always whole on disk."""
        data = {
            "schema": SCHEMA,
            "run": self.run,
            "devices": self.devices,
            "cases": self.cases,
            "references": self.references,
            "rows": [asdict(row) for row in self.rows.values()],
            "skipped": self.skipped,
            "images": self.images,
        }
        text = json.dumps(_encoded(data), indent=1, allow_nan=False)
        with atomic_write(path) as stream:
            stream.write(text.encode() + b"\n")

    @classmethod
    def load(cls, path: str | Path) -> Record:
        """Read a document.

        Raises
        ------
        InputError
            If it cannot be read or is not one of ours.
        """
        try:
            data = read_json(path, str(path))
            if data["schema"] not in _READABLE:
                readable = " and ".join(map(str, _READABLE))
                raise InputError(f"{path} has schema {data['schema']!r}; this cldof reads {readable}.")
            rows = [Row.from_dict(row) for row in data["rows"]]
            parts = {name: dict(data[name]) for name in ("run", "devices", "cases", "references", "skipped", "images")}
            parts["references"] = _decoded(parts["references"])
        except InputError:
            raise
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise InputError(f"{path} holds no benchmark results ({type(error).__name__}: {error}).") from error
        return cls(rows={row.key: row for row in rows}, **parts)


def _encoded(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(key): _encoded(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_encoded(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return {math.inf: "inf", -math.inf: "-inf"}.get(value)  # NaN is null
    return value


def _decoded(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _decoded(item) for key, item in value.items()}
    return {"inf": math.inf, "-inf": -math.inf}.get(value, value) if isinstance(value, str) else value
