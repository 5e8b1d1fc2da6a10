"""Which settings of each method are measured. A method joins the benchmark with one line in :data:`LADDERS`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from ..methods import METHODS

__all__ = ["ACCUMULATION", "LADDERS", "Rung", "accumulation_views", "rungs"]

ACCUMULATION = "accumulate"
_VIEWS = (8, 16, 32, 64, 128, 256, 512, 1024)
_QUICK_VIEWS = (8, 32, 64)


@dataclass(frozen=True)
class Rung:
    """One setting of one method.

    Parameters
    ----------
    name : str
        As tables show it; unique within the method.
    options : mapping
        Of the method (``Renderer(method, **options)``).
    peels : int
        Layers captured at most.
    supersample : int
        Captured this many times larger and box-filtered after the blur.
    quick : bool
        Also part of the quick run.
    shown : bool
        Its images are kept for the page.
    """

    name: str
    options: Mapping[str, Any] = field(default_factory=dict)
    peels: int = 4
    supersample: int = 1
    quick: bool = False
    shown: bool = False


# Every method in cldof.methods.METHODS is measured; one without a line here with its defaults.
LADDERS: dict[str, tuple[Rung, ...]] = {
    "layered": (
        Rung("default", quick=True, shown=True),
        Rung("1 peel", peels=1, quick=True),
        Rung("2 peels", peels=2),
        Rung("3 peels", peels=3),
        Rung("6 peels", peels=6),
        Rung("K=6", {"layers": 6}, quick=True),
        Rung("K=12", {"layers": 12}),
        Rung("step 0.5", {"sigma_step": 0.5}),
        Rung("step 2", {"sigma_step": 2.0}, quick=True),
        Rung("no cascade", {"cascade": False}, quick=True),
        Rung("no cascade, K=6", {"cascade": False, "layers": 6}),
        Rung("FIR only", {"engine": "fir"}),
        Rung("IIR only", {"engine": "iir"}),
        Rung("paper's matting", {"matting": "paper"}),
        Rung("supersample 2", supersample=2, quick=True),
    ),
    "pyramid": (
        Rung("1 peel", peels=1, quick=True, shown=True),
        Rung("4 peels", peels=4),
        Rung("paper's matting", {"matting": "paper"}, peels=1),
        Rung("paper's radius", {"radius": "paper"}, peels=1),
    ),
    "gather": (
        Rung("16 samples", {"samples": 16}, peels=1),
        Rung("64 samples", peels=1, quick=True, shown=True),
        Rung("256 samples", {"samples": 256}, peels=1),
    ),
    "multiview": (
        Rung("16 rays", {"rays": 16}),
        Rung("64 rays", quick=True, shown=True),
        Rung("256 rays", {"rays": 256}),
        Rung("64 rays, 8 peels", peels=8),
        Rung("64 rays, jitter", {"jitter": True}),
        Rung("64 rays, no cones", {"cone": False}),
        Rung("64 rays, shaded from the centre", {"view_dependent": False}),
        Rung("64 rays, shaded from 64 points", {"eyes": 64}),
    ),
    "lightfield": (
        Rung("16 views", {"views": 16}),
        Rung("default", quick=True, shown=True),
        Rung("64 views", {"views": 64}),
        Rung("128 views", {"views": 128}),
        Rung("1 peel", peels=1),
        Rung("2 peels", peels=2),
        Rung("2x2 support", {"support": "2x2"}),
        Rung("no mip levels", {"mip": False}),
        Rung("shaded from the centre", {"view_dependent": False}),
        Rung(
            "paper's form",
            {"support": "2x2", "lookup": "winner", "dither": False, "pattern": "halton", "view_dependent": False},
            peels=1,
        ),
    ),
}


def rungs(method: str, quick: bool = False) -> tuple[Rung, ...]:
    """The settings of a method that are to be measured.

    Raises
    ------
    KeyError
        There is no such method.
    """
    if method not in METHODS:
        raise KeyError(method)
    ladder = LADDERS.get(method, (Rung("default", quick=True, shown=True),))
    return tuple(rung for rung in ladder if rung.quick) if quick else ladder


def accumulation_views(quick: bool = False) -> tuple[int, ...]:
    """The ladder of the accumulation reference."""
    return _QUICK_VIEWS if quick else _VIEWS
