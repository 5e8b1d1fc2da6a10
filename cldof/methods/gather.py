"""Gather blur: each pixel averages its own circle of confusion. The plain baseline.

One RGBZ image (all peels composed), no hidden surfaces. It looks at whole pixels that stand still while the lens
moves: at all of a narrow blur, at fewer and fewer of a wider one, each fading in and out, so that the image never
jumps. With ``kernel="disc"`` those in front of the pixel that are too sharp to reach it are left out, so what is in
focus does not bleed into what is blurred behind it. A pixel in focus gathers only from itself, so what is blurred in
front of it keeps a hard edge: gathering cannot do better, and the other methods are there for it. ``kernel="gaussian"``
is the image-space blur that people write first: it looks at no depth but the pixel's own.
"""

from __future__ import annotations

import functools
import itertools
import math
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..frame import LayeredFrame
from ..host.device import Traits
from ..host.passes import Buffer, FrameProgram, Param, Pass, Role, read, write
from ..lens import Lens
from .base import FrameShape, Locality, Plan, struct_scalar
from .pyramid import SIZE as FLATTEN_SIZE

__all__ = ["Gather", "gather_taps"]

_SIZE = np.dtype([(name, np.int32) for name in ("width", "height", "pitch", "guard")])
_MAX_SAMPLES = 4096

_EVEN_PX = 12.0  # blurs wider than this get more samples, no farther apart
_MOST = 4  # times as many
_REACH = {"disc": 1.0, "gaussian": 1.5}  # CoC radii; 3 sigma
_TOTAL = 1024.0  # weights above 1, or what is as dark as float32 goes would be flushed to 0
_GOLDEN_ANGLE = math.pi * (3.0 - math.sqrt(5.0))

_BUILT_PX = 64.0  # taps of wider blurs are made from those of narrower ones

TAP = np.dtype([("dx", "i4"), ("dy", "i4"), ("distance", "f4"), ("weight", "f4"), ("change", "f4")])
"""GatherTap of kernels/gather.cl."""

_PER_OCTAVE = 8
RADII = np.append(np.outer(2.0 ** np.arange(-1, 11), 1.0 + np.arange(_PER_OCTAVE) / _PER_OCTAVE), 2048.0)
"""Ends of the steps of kernels/gather.cl, px: 8 to the octave. A wider blur counts as the last."""


@dataclass(frozen=True)
class Gather:
    """Options of the gather blur.

    Parameters
    ----------
    samples : int
        Pixels that each blurred pixel looks at, 1 to 4096: as many where its CoC radius is up to 12 px; where it is
        wider up to four times as many (and 4096), so that they stand no farther apart; fewer where its CoC has fewer.
    kernel : {"disc", "gaussian"}
        A disc of the CoC, depth-aware; or a Gaussian of half its radius that looks at no depth, but at 2.25 times as
        many pixels, out to 3 sigma.
    """

    samples: int = 64
    kernel: str = "disc"

    name = "gather"
    simulated_aperture = "disc"

    def __post_init__(self) -> None:
        is_whole = isinstance(self.samples, int) and not isinstance(self.samples, bool)
        if not (is_whole and 1 <= self.samples <= _MAX_SAMPLES):
            raise InputError(
                f"gather: samples is {self.samples!r}; it must be a whole number from 1 to {_MAX_SAMPLES}."
            )
        if self.kernel not in ("disc", "gaussian"):
            raise InputError(f"gather: kernel is {self.kernel!r}; choose one of disc, gaussian.")

    def plan(self, frame: LayeredFrame, lens: Lens) -> Plan:
        """Nothing to decide: the passes are the same for all lenses."""
        c1, c0 = lens.coc_coefficients(frame.camera)
        farthest, nearest = frame.shown_inverse_depths
        summary = {
            "method": self.name,
            **{field.name: getattr(self, field.name) for field in fields(self)},
            "largest_coc_px": max(abs(c1 * farthest + c0), abs(c1 * nearest + c0)),
        }
        return Plan((), {"c1": np.float32(c1), "c0": np.float32(c0)}, summary)

    def locality(self, shape: FrameShape, plan: Plan, traits: Traits, tail: float) -> Locality:
        """Each pixel looks at its own CoC and nothing reaches it from outside; below half a pixel it is itself."""
        widest = _REACH[self.kernel] * (1.0 + 1.0 / _PER_OCTAVE)  # of the step that a CoC is in
        return Locality(
            align_px=16,
            margin_px=math.ceil(widest * plan.summary["largest_coc_px"] + 0.5),
            reach_px=lambda coc: widest * coc + 0.5,
            leak=lambda coc: np.where(coc < 0.5, 0.0, 1.0),
            spreads=False,
            closed_step_px=math.inf,
        )

    def program(self, shape: FrameShape, plan: Plan, traits: Traits) -> FrameProgram:
        """Compose all peels, then gather."""
        pixels, padded = shape.height * shape.width, shape.height * shape.pitch
        taps, first = gather_taps(self.samples, self.kernel)
        items = 1 if traits.is_cpu else min(64, traits.max_work_group_size)
        local_size = (1, 1) if traits.is_cpu else None
        extent = (shape.width, shape.height, shape.pitch)
        flatten_size = struct_scalar(FLATTEN_SIZE, *extent, shape.layers, 1, 0, shape.guard_px)
        size = struct_scalar(_SIZE, *extent, shape.guard_px)
        buffers = [
            Buffer("color", shape.layers * pixels * 16, Role.INPUT),
            Buffer("inv_depth", shape.layers * padded * 4, Role.INPUT),
            Buffer("image", math.prod(shape.output_size) * 16, Role.OUTPUT),
            Buffer("taps", taps.nbytes, Role.CONSTANT, taps),
            Buffer("first", first.nbytes, Role.CONSTANT, first),
            Buffer("flat", padded * 16),
            Buffer("flat_inv", padded * 4),
        ]
        flatten = Pass(
            "pyramid",
            "pyramid_flatten",
            (write("flat"), write("flat_inv"), read("color"), read("inv_depth"), flatten_size),
            (items, shape.height),
            local_size,
            (("PYRAMID_VOID", int(not shape.is_opaque)), ("PYRAMID_ALPHA", 2)),
            traffic_bytes=40 * pixels,
        )
        blur = Pass(
            "gather",
            "gather_blur",
            (
                write("image"),
                read("flat"),
                read("flat_inv"),
                read("taps"),
                read("first"),
                size,
                np.nextafter(np.float32(RADII[-1]), np.float32(0.0)),
                Param("c1", np.dtype(np.float32)),
                Param("c0", np.dtype(np.float32)),
            ),
            (items, shape.output_size[0]),
            local_size,
            (("GATHER_DEPTH_AWARE", int(self.kernel == "disc")),),
            traffic_bytes=36 * pixels,
            flops=25 * self.samples * pixels,
        )
        return FrameProgram.of(buffers, [flatten, blur])


@functools.lru_cache(maxsize=16)
def gather_taps(samples: int, kernel: str = "disc") -> tuple[NDArray[np.void], NDArray[np.int32]]:
    """Taps as kernels/gather.cl takes them.

    Returns
    -------
    taps : ndarray of :data:`TAP`
        Step after step: all that weigh anything at one of its ends.
    first : ndarray, (steps + 1,), int32
        Where each step's taps begin.
    """
    rng = np.random.default_rng(0)
    pixels, stencils = np.zeros((1, 2), np.int64), []
    for radius in RADII[RADII <= _BUILT_PX][::-1]:  # from wide to narrow: each has what is left of the wider ones
        pixels, weights = _stencil(pixels, radius, samples, kernel, rng)
        stencils.append((pixels, weights))
    stencils.reverse()
    while len(stencils) < len(RADII):  # the same twice as wide, moved by a pixel at random, but in pairs
        pixels, weights = stencils[-_PER_OCTAVE]
        off = np.rint(0.9 * np.sin(pixels @ [[12.9, 39.3], [78.2, 27.1]])).astype(np.int64)
        stencils.append((2 * pixels + off, weights))
    steps = []
    for (near, start), (far, end) in itertools.pairwise(stencils):
        places, index = np.unique(np.concatenate([near, far]), axis=0, return_inverse=True)
        both, taps = index.ravel(), np.zeros(len(places), TAP)
        taps["dy"], taps["dx"] = places.T
        taps["distance"] = np.hypot(*places.T)
        taps["weight"] = np.bincount(both[: len(near)], start, len(places))
        taps["change"] = np.bincount(both[len(near) :], end, len(places)) - taps["weight"]
        steps.append(taps[(taps["weight"] != 0.0) | (taps["change"] != 0.0)])
    return np.concatenate(steps), np.cumsum([0, *map(len, steps)]).astype(np.int32)


def _stencil(
    wider: NDArray[np.int64], radius: float, samples: int, kernel: str, rng: np.random.Generator
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Pixels (n, 2) that stand for a CoC, a wider one's that lie in it among them; weights of sum `_TOTAL`."""
    more = min(max(1.0, (radius / _EVEN_PX) ** 2), _MOST) * _REACH[kernel] ** 2
    count, reach = min(round(more * samples), _MAX_SAMPLES), _REACH[kernel] * radius + 0.5
    pixels = wider[np.hypot(*wider.T) < reach]
    area: NDArray[np.float64] = np.array(1.0)
    if math.pi * reach**2 <= 1.2 * count:
        whole = math.ceil(reach)
        square = np.mgrid[-whole : whole + 1, -whole : whole + 1].reshape(2, -1).T.astype(np.int64)
        pixels = square[np.hypot(*square.T) < reach]
    else:
        points = min(16 * count, 8192)
        turn = _GOLDEN_ANGLE * np.arange(points) + rng.uniform(0.0, 2.0 * math.pi)
        out = np.sqrt((np.arange(points) + 0.5) / points)[:, None] * np.stack([np.sin(turn), np.cos(turn)], axis=1)
        places = rng.permutation(np.rint(reach * out).astype(np.int64))  # many are as far from others as the next
        pixels = _fill(pixels, places, reach, count)
        if count <= 512:  # each tap weighs what lies nearest to it; many need no such care
            nearest = _squared_distances((reach - 0.5) * out, pixels).argmin(axis=1)
            area = np.bincount(nearest, minlength=len(pixels)).astype(np.float64)
    distance = np.hypot(*pixels.T)
    if radius == RADII[0]:  # in focus until here
        weights = (distance == 0.0).astype(np.float64)
    elif kernel == "gaussian":
        weights = area * np.exp(-2.0 * (distance / radius) ** 2)
    else:
        weights = _rim(distance, area, 0.5 * (radius**2 - RADII[0] ** 4 / radius**2))
    return pixels, weights * (_TOTAL / weights.sum())


def _fill(pixels: NDArray[np.int64], places: NDArray[np.int64], reach: float, count: int) -> NDArray[np.int64]:
    """Add places in pairs across the middle, each as far from all others as can be, until there are `count`."""
    places = places[np.hypot(*places.T) < reach]
    rim = (2.0 * (reach - np.hypot(*places.T))) ** 2  # half as far from it as from each other
    gap = np.minimum(rim, _squared_distances(places, pixels).min(axis=1))
    added = [pixels]
    for _ in range(len(pixels), count, 2):
        most = gap.argmax()
        if gap[most] <= 0.0:
            break
        pair = np.stack([places[most], -places[most]])
        added.append(pair)
        gap = np.minimum(gap, _squared_distances(places, pair).min(axis=1))
    return np.concatenate(added)


def _rim(distance: NDArray[np.float64], area: NDArray[np.float64], spread: float) -> NDArray[np.float64]:
    """A disc with a rim a pixel wide, of such a radius that the mean squared distance is `spread`."""
    low, high = 0.0, float(distance.max()) + 0.5
    for _ in range(40):
        middle = 0.5 * (low + high)
        weights = area * np.clip(middle + 0.5 - distance, 0.0, 1.0)
        if (weights * distance**2).sum() < spread * weights.sum():
            low = middle
        else:
            high = middle
    return weights


def _squared_distances(a: NDArray[Any], b: NDArray[Any]) -> NDArray[np.float32]:
    """Between all of (n, 2) and all of (m, 2) points, (n, m)."""
    (ay, ax), (by, bx) = a.T.astype(np.float32), b.T.astype(np.float32)
    squares: NDArray[np.float32] = np.subtract.outer(ay, by) ** 2 + np.subtract.outer(ax, bx) ** 2
    return squares
