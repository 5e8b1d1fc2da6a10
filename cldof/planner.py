"""The planner: looks at a frame through a lens and decides what of the method has to run at all.

Statistics (:class:`SceneStats`) are gathered on the device when a frame arrives there, per tile of 16 x 16 pixels and
peel, in inverse depth: the circle of confusion (CoC) of any lens is linear in it, so a frame is looked at once and not
once a lens. From them and the lens comes a :class:`FramePlan`: the method's plan, what was left out of it, why, and how
much that can change a pixel at most.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Hashable, Iterator, Mapping
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .camera import Camera
from .frame import LayeredFrame
from .host.device import Traits
from .host.passes import Access, Buffer, FrameProgram, Param, Pass, Role, read, read_write, write
from .lens import Lens
from .methods.base import EMPTY, TILE, FrameShape, Method, Plan, struct_scalar

__all__ = [
    "BINS",
    "MAX_CHANGE",
    "TILE",
    "Decision",
    "FramePlan",
    "SceneStats",
    "everything",
    "peels_needed",
    "plan_frame",
]

# As kernels/stats.cl has it.
BINS = 64

# What a plan may change a pixel by when nothing else is asked for, in linear units: one step of an 8-bit image.
MAX_CHANGE = 1.0 / 255.0

# A bin is this much wider than it is: float32 and float64 may disagree about the bin of a slot.
_BIN_SLACK = 1e-3

# Sides whose CoC radius stays below this have no layers in any method.
_NEGLIGIBLE_PX = 1e-3
# In how many ways light from beyond a window may change a pixel: as the light of what is in front and behind, by how
# much that covers, and as light that reaches what is in focus.
_TAIL_USES = 6.0
# Windows that are more of the frame than this are not worth it: cutting out and pasting is work, too.
_LARGEST_SHARE = 0.75
_MOST_WINDOWS = 4
# Layers of one side of two, of all that a method with layers does.
_SIDE_SAVING = 0.45
# Copying the image, whatever else is left out.
_LEAST_SHARE = 0.01
# A gap that no blur bridges, in px.
_FAR = 65535
# Windows begin and end at multiples of this, in px.
_GRID = 32
# Reaches are rounded up to these, in tiles.
_RINGS = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64, 10**6)

_FLOAT = np.dtype(np.float32)
_WINDOW = np.dtype([(name, np.int32) for name in ("x", "y", "x0", "y0", "x1", "y1")])
_SIZE = np.dtype([(name, np.int32) for name in ("width", "height", "pitch", "peels", "tiles_x", "tiles_y")])
_TILE_STATS = np.dtype(
    [
        ("nearest", np.float32),
        ("farthest", np.float32),
        ("slots", np.float32),
        ("solid", np.float32),
        ("bins", np.uint32, (2,)),
        ("luminance", np.float32),
        ("step", np.float32),
        ("low", np.float32, (4,)),
        ("high", np.float32, (4,)),
    ]
)

Array = NDArray[np.float32]


@dataclass(frozen=True)
class SceneStats:
    """What a frame holds, by tile and peel; good for every lens.

    M peels, ``ty`` x ``tx`` tiles of 16 x 16 pixels, guard band included; the last tiles of rows and columns may be
    smaller. Depths are inverse depths, 1/m, 0 = infinitely far. A slot counts when it has a depth and alpha; the void
    behind a scene that is not opaque does not.

    Attributes
    ----------
    shape : FrameShape
    nearest, farthest : ndarray, (M, ty, tx), float32
        Largest and smallest inverse depth; -1 and inf in tiles with nothing.
    slots, solid : ndarray, (M, ty, tx), float32
        How many slots there are, and how many of them let nothing through.
    step : ndarray, (M, ty, tx), float32
        Largest difference in inverse depth between a pixel and the one to its right or below.
    bins : ndarray, (M, ty, tx), uint64
        Bit b: something lies in bin b of 64 between ``first`` and ``last``.
    luminance : ndarray, (M, ty, tx), float32
        Mean over the slots, Rec. 709.
    low, high : ndarray, (M, ty, tx, 4), float32
        Least and greatest value of each channel; inf and 0 in tiles with nothing.
    histogram : ndarray, (M, 64), float64
        Estimated slots per bin, from one row of pixels in 16.
    first, last : float
        Inverse depths that the bins divide.
    """

    shape: FrameShape
    nearest: Array
    farthest: Array
    slots: Array
    solid: Array
    step: Array
    bins: NDArray[np.uint64]
    luminance: Array
    low: Array
    high: Array
    histogram: NDArray[np.float64]
    first: float
    last: float

    @property
    def tiles(self) -> tuple[int, int]:
        """Rows and columns of tiles."""
        return self.nearest.shape[1], self.nearest.shape[2]

    @cached_property
    def pixels(self) -> Array:
        """Pixels in each tile, (ty, tx)."""
        rows = np.minimum(self.shape.height - TILE * np.arange(self.tiles[0]), TILE)
        columns = np.minimum(self.shape.width - TILE * np.arange(self.tiles[1]), TILE)
        return (rows[:, None] * columns).astype(np.float32)

    @cached_property
    def is_closed(self) -> NDArray[np.bool_]:
        """Tiles of each peel of which every pixel is there and opaque, (M, ty, tx)."""
        return np.asarray(self.solid == self.pixels)

    @cached_property
    def brightest(self) -> float:
        """The largest value of any channel of any slot, alpha included."""
        return float(self.high.max())

    @cached_property
    def occupied(self) -> NDArray[np.bool_]:
        """Bins that hold anything, (64,)."""
        bits = int(np.bitwise_or.reduce(self.bins, axis=None))
        return np.array([bool(bits >> bin_ & 1) for bin_ in range(BINS)])

    @property
    def bin_edges(self) -> NDArray[np.float64]:
        """Inverse depths between which the bins lie, (65,)."""
        return np.linspace(self.first, self.last, BINS + 1)

    def coc_histogram(self, lens: Lens, camera: Camera) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Signed CoC radii and how many slots have them.

        Parameters
        ----------
        lens : Lens
        camera : Camera

        Returns
        -------
        coc_px : ndarray, (64,)
            Of the middle of each bin; negative is nearer than the focus.
        slots : ndarray, (64,)
            Estimated, all peels together.
        """
        c1, c0 = lens.coc_coefficients(camera)
        edges = self.bin_edges
        return c1 * (edges[1:] + edges[:-1]) / 2.0 + c0, self.histogram.sum(axis=0)

    def blur_shares(self, lens: Lens, camera: Camera, still_px: float = 0.5) -> tuple[float, float, float]:
        """Shares of what the first peel shows that are blurred in front, within ``still_px`` of focus, and behind."""
        c1, c0 = lens.coc_coefficients(camera)
        middle = (self.bin_edges[1:] + self.bin_edges[:-1]) / 2.0
        coc, count = c1 * middle + c0, self.histogram[0]
        total = max(float(count.sum()), 1.0)
        near, far = float(count[coc < -still_px].sum()), float(count[coc > still_px].sum())
        return near / total, 1.0 - (near + far) / total, far / total

    def highlights(self, lens: Lens, camera: Camera) -> NDArray[np.float64]:
        """Radiance times area of the CoC in px^2, the most of each peel and tile, (M, ty, tx): what shows as discs."""
        coc = self.largest_coc(*lens.coc_coefficients(camera))
        return np.asarray(self.high[..., :3].max(axis=-1) * math.pi * coc**2)

    def largest_coc(self, c1: float, c0: float) -> NDArray[np.float64]:
        """Largest CoC radius in px in each peel and tile, (M, ty, tx), 0 where nothing is; CoC = c1 / z + c0."""
        there = self.slots > 0.0
        nearest, farthest = (
            np.abs(c1 * np.where(there, w, 0.0).astype(np.float64) + c0) for w in (self.nearest, self.farthest)
        )
        return np.where(there, np.maximum(nearest, farthest), 0.0)

    def summary(self) -> dict[str, Any]:
        """A few plain numbers for reports."""
        pixels = float(self.pixels.sum())
        return {
            "peel_occupancy": [float(n) / pixels for n in self.slots.sum(axis=(1, 2))],
            "inverse_depth_range": [self.first, self.last],
            "occupied_bins": int(self.occupied.sum()),
            "brightest": self.brightest,
        }


@dataclass(frozen=True)
class Decision:
    """One thing that a frame might have needed.

    Attributes
    ----------
    effect : str
        For instance ``"near side"``.
    kept : bool
        Whether it is computed.
    reason : str
        Why, in numbers.
    error : float
        What leaving it out can change a pixel by at most, linear units; 0 for nothing at all.
    saving : float
        Share of the work of everything that is saved, as predicted.
    saved_bytes : int
        Memory traffic saved, as predicted.
    """

    effect: str
    kept: bool
    reason: str
    error: float = 0.0
    saving: float = 0.0
    saved_bytes: int = 0

    @property
    def error_db(self) -> float:
        """The bound as PSNR against a white of 1, in dB; inf for no error."""
        return -20.0 * math.log10(self.error) if self.error > 0.0 else math.inf


@dataclass(frozen=True)
class FramePlan(Plan):
    """A method's plan and what was left out of it.

    Attributes
    ----------
    decisions : tuple of Decision
    error_bound : float
        All decisions together change no pixel by more than this, linear units. Holds for the frame that the statistics
        are of.
    share : float
        Predicted work as a share of that for everything.
    about : str
        What is planned, in one line.
    gaps : ndarray, (rows of tiles, columns of tiles), uint16, optional
        Where single tiles are made: the least distance in px from each tile to one of those, 0 in them.
    """

    decisions: tuple[Decision, ...] = ()
    error_bound: float = 0.0
    share: float = 1.0
    about: str = ""
    gaps: NDArray[np.uint16] | None = field(default=None, compare=False, repr=False)

    def explain(self) -> str:
        """The plan in words, for people who have never seen the code."""
        wide = max((len(one.effect) for one in self.decisions), default=0)
        lines = [self.about, ""]
        for one in self.decisions:
            text = one.reason
            if not one.kept:
                change = f"changes a pixel by at most {one.error:.2g}" if one.error > 0.0 else "changes nothing"
                saving = f", saves about {one.saving:.0%}" if one.saving >= 0.005 else ""
                text += f" ({change}{saving})"
            head = f"  {'needed  ' if one.kept else 'left out'}  {one.effect:<{wide}}  "
            lines.append(textwrap.fill(text, 110, initial_indent=head, subsequent_indent=" " * len(head)))
        lines.append("")
        if self.error_bound > 0.0:
            steps = self.error_bound * 255.0
            lines.append(
                f"No pixel differs from the full computation by more than {self.error_bound:.2g} in linear light "
                f"({-20.0 * math.log10(self.error_bound):.0f} dB, {steps:.1f} of 255 steps)."
            )
        else:
            lines.append("Every pixel is the same as in the full computation, but for rounding.")
        if self.summary.get("statistics") == "last":
            lines.append("Judged by the frame before: this holds as far as this frame looks the same.")
        lines.append(f"Expected work: {self.share:.0%} of that for everything.")
        return "\n".join(lines)

    def to_dict(self) -> dict[str, Any]:
        """Plain values for reports."""
        decisions = [
            {**{entry.name: getattr(one, entry.name) for entry in fields(one)}, "error_db": one.error_db}
            for one in self.decisions
        ]
        return {
            "about": self.about,
            "decisions": decisions,
            "error_bound": self.error_bound,
            "expected_share_of_work": self.share,
            **self.summary,
        }


class Window(NamedTuple):
    """A part of the frame, guard band included, that the method is run on; all in px."""

    x: int
    y: int
    width: int
    height: int
    inner: tuple[int, int, int, int]
    """x0, y0, x1, y1 of what its result is used for."""


class Layout(NamedTuple):
    """What shapes the passes of a planned frame."""

    inner: Hashable  # the method's own
    peels: int
    windows: tuple[tuple[int, int], ...] | None  # widths and heights; None: the whole frame, with no window
    is_sparse: bool = False  # single tiles of the whole frame


def everything(method: Method, frame: LayeredFrame, lens: Lens) -> FramePlan:
    """The plan that leaves nothing out."""
    widen = getattr(method, "plan_both_sides", method.plan)
    base = widen(frame, lens)
    summary = {**base.summary, "error_bound": 0.0, "peels_used": frame.layer_count, "windows": None}
    return FramePlan(
        Layout(base.structure, frame.layer_count, None),
        base.params,
        summary,
        (Decision("everything", True, "planning is off"),),
        about=f"{method.name}: {frame!r}",
    )


def plan_frame(
    method: Method,
    frame: LayeredFrame,
    lens: Lens,
    stats: SceneStats,
    traits: Traits,
    max_change: float = MAX_CHANGE,
    is_last: bool = False,
) -> FramePlan:
    """Decide what to compute.

    Parameters
    ----------
    method : Method
    frame : LayeredFrame
        For its camera and its range of depths.
    lens : Lens
    stats : SceneStats
        Of this frame, or with ``is_last`` of the one before.
    traits : Traits
        Of the device.
    max_change : float
        What may change a pixel at most, linear units. 0 leaves out only what changes nothing.
    is_last : bool
        Allow for some motion: a tile more around everything, and no peel left out. The bound then holds where the frame
        looks like the one before.

    Returns
    -------
    FramePlan
    """
    base = method.plan(frame, lens)
    return _Planner(method, base, frame, lens, stats, traits, max_change, is_last).plan()


class _Planner:
    """One frame through one lens."""

    def __init__(
        self,
        method: Method,
        base: Plan,
        frame: LayeredFrame,
        lens: Lens,
        stats: SceneStats,
        traits: Traits,
        max_change: float,
        is_last: bool,
    ) -> None:
        self.method, self.base, self.stats, self.max_change = method, base, stats, max_change
        self.frame = frame
        self.shape = stats.shape
        self.is_last = is_last
        self.c1, self.c0 = lens.coc_coefficients(frame.camera)
        # Half of what is allowed is for what lies beyond windows, half for what is taken to be in focus.
        self.contrast = max(stats.brightest, 1e-6)
        tail = max_change / 2.0 / (_TAIL_USES * self.contrast)
        self.locality = method.locality(self.shape, base, traits, tail)
        # The device computes CoC from float32 numbers.
        largest = max(abs(w) for w in frame.inverse_depth_range)
        self.slack_px = 4e-7 * (abs(self.c1) * largest + abs(self.c0))

    def plan(self) -> FramePlan:
        """Everything decided."""
        decisions = list(self._sides())
        windows, tiles, focus = self._in_focus()
        decisions.append(focus)
        peels, which = self._peels(windows)
        decisions += which
        decisions += self._of_the_method(windows)
        bound = sum(one.error for one in decisions)
        params: dict[str, Any] = dict(self.base.params)
        sizes = None
        if windows is not None:
            sizes = tuple((window.width, window.height) for window in windows)
            if not windows:
                params = {}
            for number, window in enumerate(windows):
                params[f"window_{number}"] = struct_scalar(_WINDOW, window.x, window.y, *window.inner)
        summary = {
            **self.base.summary,
            "error_bound": bound,
            "peels_used": peels if windows != () else 0,
            "windows": sizes,
            "tiles": None if tiles is None else int(tiles.sum()),
            "statistics": "last" if self.is_last else "frame",
            "scene": self.stats.summary(),
        }
        inner = self.base.structure if windows is None or windows else None
        share = 1.0
        for one in decisions:
            share *= 1.0 if one.kept else 1.0 - one.saving
        return FramePlan(
            Layout(inner, peels, sizes, tiles is not None),
            params,
            summary,
            tuple(decisions),
            bound,
            max(share, _LEAST_SHARE),
            self._about(),
            None if tiles is None else self._gaps(tiles),
        )

    def _about(self) -> str:
        shape = self.shape
        low, high = self.seen
        nearest, farthest = (float(v[np.isfinite(v)].max(initial=0.0)) for v in (-low, high))
        blur = []
        if nearest > _NEGLIGIBLE_PX:
            blur.append(f"up to {nearest:.1f} px in front of it")
        if farthest > _NEGLIGIBLE_PX:
            blur.append(f"up to {farthest:.1f} px behind it")
        distance = -self.c0 / self.c1 if self.c1 else math.nan
        focus = (
            "a pinhole"
            if not self.c1
            else f"focus at {1.0 / distance:.3g} m"
            if distance > 0.0
            else "focus at infinity"
        )
        return (
            f"{self.method.name}: {shape.width}x{shape.height} px, {_count(shape.layers, 'peel')}; {focus}; "
            f"blur radius {' and '.join(blur) or 'nowhere above 0'}"
        )

    # --- sides ---

    def _coc(self, inverse: Array) -> NDArray[np.float64]:
        return np.asarray(self.c1 * inverse.astype(np.float64) + self.c0)

    @cached_property
    def near_px(self) -> NDArray[np.float64]:
        """By how much the nearest slot of each tile is out of focus in front, (ty, tx); 0 for none."""
        nearest = self.stats.nearest.max(axis=0)
        return np.where(nearest >= 0.0, np.maximum(-self._coc(nearest), 0.0), 0.0)

    @cached_property
    def seen(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Least and greatest signed CoC of what a tile shows, (ty, tx), whatever its peel; inf, -inf for nothing."""
        stats = self.stats
        closed = stats.is_closed[0]
        nearest = np.where(closed, stats.nearest[0], stats.nearest.max(axis=0))
        farthest = np.where(closed, stats.farthest[0], stats.farthest.min(axis=0))
        if not self.shape.is_opaque:  # the void is a surface at infinity
            is_open = ~stats.is_closed.any(axis=0)
            farthest = np.where(is_open, 0.0, farthest)
            nearest = np.where(is_open, np.maximum(nearest, 0.0), nearest)
        something = farthest <= nearest
        # A lens with c1 = 0 blurs nothing; 0 * inf is not a number.
        low = np.where(something, self._coc(np.where(something, nearest, 0.0)), np.inf)
        high = np.where(something, self._coc(np.where(something, farthest, 0.0)), -np.inf)
        return low, high

    def _sides(self) -> Iterator[Decision]:
        stats = self.stats
        coc = self.c1 * (stats.bin_edges[1:] + stats.bin_edges[:-1]) / 2.0 + self.c0
        visible = max(float(stats.histogram[0].sum()), 1.0)
        low, high = self.seen
        sided = "focus_layer" in self.base.summary or "first_sub_image" in self.base.summary
        ends = (("near side", low, coc < 0.0, "in front of"), ("far side", high, coc > 0.0, "behind"))
        for name, extreme, side, where in ends:
            extreme = extreme[np.isfinite(extreme)]
            reach = max(0.0, float((-extreme if name == "near side" else extreme).max(initial=0.0)))
            share = float(stats.histogram[0][side & (np.abs(coc) > 0.5)].sum()) / visible
            kept = reach > _NEGLIGIBLE_PX
            if kept:
                reason = (
                    f"up to {reach:.1f} px of blur {where} the focus; {share:.0%} of the picture has over half a pixel"
                )
            elif reach > 0.0:
                reason = f"nothing {where} the focus is blurred by more than {reach:.1g} px"
            else:
                reason = f"nothing {where} the focus is blurred"
            yield Decision(name, kept, reason, saving=0.0 if kept or not sided else _SIDE_SAVING)

    # --- tiles ---

    def _in_focus(self) -> tuple[tuple[Window, ...] | None, NDArray[np.bool_] | None, Decision]:
        """Windows of the frame that have to be computed, None for all of it; or of all of it the tiles that have to."""
        name = "tiles in focus"
        if getattr(self.method, "supersample", 1) > 1:
            return None, None, Decision("whole frame", True, "the method averages the samples of a pixel by itself")
        if self.c1 == 0.0:
            return (), None, Decision(name, False, "a pinhole blurs nothing: its image is copied", 0.0, 1.0)
        if self.locality is None:
            return None, None, Decision("whole frame", True, "what a pixel shows depends on its place in the image")
        bound = self._bounds()
        allowed = self.max_change / 2.0
        active = bound > allowed
        rim = math.ceil(self.locality.rim_px / TILE) + self.is_last
        if rim:
            active = _spread(active, rim) > 0.0
        share = float((active * self.stats.pixels).sum() / self.stats.pixels.sum())
        error = float(bound[~active].max(initial=0.0))
        if not active.any():
            reason = f"all {active.size} tiles of {TILE} x {TILE} px show what a pinhole sees: they are copied"
            return (), None, Decision(name, False, reason, error, 1.0)
        full = self.shape.width * self.shape.height
        windows = self._windows(active)
        area = sum(window.width * window.height for window in windows)
        work = area / full
        floor = self.locality.tiles_floor
        if floor is not None and floor + (1.0 - floor) * share < min(work, _LARGEST_SHARE):
            work = floor + (1.0 - floor) * share
            reason = (
                f"{1.0 - share:.0%} of the tiles show what a pinhole sees; the other {int(active.sum())} are made by "
                f"themselves, of what can reach them"
            )
            return None, active, Decision(name, False, reason, error, 1.0 - work)
        if work > _LARGEST_SHARE:
            reason = f"{share:.0%} of the tiles are blurred or within reach of a blur, too many to treat by themselves"
            return None, None, Decision("whole frame", True, reason)
        if not self._may_cut(windows):
            reason = f"{share:.0%} of the tiles are blurred, but what they hide has to be guessed from all around"
            return None, None, Decision("whole frame", True, reason)
        if self.locality.tail > 0.0:
            error += _TAIL_USES * self.locality.tail * self.contrast
        parts = f"{len(windows)} window{'s' if len(windows) > 1 else ''} of {work:.0%} of the frame"
        reason = f"{1.0 - share:.0%} of the tiles show what a pinhole sees; the rest is done in {parts}"
        slots = self.shape.layers * 20
        return windows, None, Decision(name, False, reason, error, 1.0 - work, int((full - area) * slots))

    def _gaps(self, tiles: NDArray[np.bool_]) -> NDArray[np.uint16]:
        """Least distances in px from each tile to one of those that are made."""
        gaps = np.where(tiles, 0, _FAR).astype(np.uint16)
        farthest = float(self.stats.largest_coc(self.c1, self.c0).max())
        assert self.locality is not None
        reach = float(self.locality.reach_px(np.array([farthest]))[0])
        near = tiles.astype(np.float64)
        for ring in range(1, min(math.ceil(reach / TILE) + 2, max(tiles.shape) + 1)):
            near = _spread(near, 1)
            gaps = np.where((near > 0.0) & (gaps == _FAR), TILE * (ring - 1) + 1, gaps).astype(np.uint16)
        return gaps

    def _bounds(self) -> NDArray[np.float64]:
        """What showing the pinhole's pixels can change, tile by tile, (ty, tx)."""
        locality, stats = self.locality, self.stats
        assert locality is not None
        low, high = self.seen
        own = np.maximum(np.where(np.isfinite(low), np.abs(low), 0.0), np.where(np.isfinite(high), np.abs(high), 0.0))
        own = np.where(own > 0.0, own + self.slack_px, 0.0)
        slope = abs(self.c1) * stats.step.max(axis=0) if locality.counts_slopes else 0.0
        leak = locality.leak(own + np.where(own > 0.0, slope, 0.0))
        if not locality.spreads:
            return np.asarray(leak * self.contrast, np.float64)
        near = np.where(self.near_px > 0.0, self.near_px + self.slack_px, 0.0)
        rings = np.where(near > 0.0, np.ceil(locality.reach_px(near) / TILE), 0.0)
        near_leak = np.where(near > 0.0, locality.leak(near + np.where(near > 0.0, slope, 0.0)), 0.0)
        inner = 0
        for ring in _RINGS:
            those = (rings > inner) & (rings <= ring)
            inner = ring
            if those.any():
                leak = np.maximum(leak, _spread(np.where(those, near_leak, 0.0), ring))
        farthest_reach = float(locality.reach_px(np.array([max(float(own.max()), float(near.max()))]))[0])
        contrast = self._contrast(math.ceil(farthest_reach / TILE) + 1)
        return np.asarray(np.minimum(2.0 * leak, 1.0) * contrast)

    def _contrast(self, radius: int) -> NDArray[np.float64]:
        """How much two colours within so many tiles differ, (ty, tx)."""
        stats = self.stats
        # Glass adds its light to that of what is behind it.
        high = stats.high.sum(axis=0) if self.shape.has_glass else stats.high.max(axis=0)
        low = stats.low.min(axis=0)
        is_gap = ~stats.is_closed[0] & (self.shape.has_glass | ~stats.is_closed.any(axis=0))
        low = np.where(is_gap[..., None], 0.0, low)
        most, least_below = np.split(_spread(np.moveaxis(np.concatenate((high, -low), axis=-1), -1, 0), radius), 2)
        return np.asarray(np.maximum(most + least_below, 0.0).max(axis=0), np.float64)

    def _may_cut(self, windows: tuple[Window, ...]) -> bool:
        """Whether nothing has to be guessed near the windows."""
        assert self.locality is not None
        if self.locality.guesses_nearer_than_px == -math.inf:
            return True
        shape, edge = self.shape, self.locality.guesses_at_edges_px
        for window in windows:
            x0, y0, x1, y1 = window.inner
            x0, y0 = max(x0, shape.guard_px), max(y0, shape.guard_px)
            x1, y1 = min(x1, shape.width - shape.guard_px), min(y1, shape.height - shape.guard_px)
            if min(x0, y0, shape.width - x1, shape.height - y1) < edge:
                return False
        # An opaque slot that is far enough is not culled, and then there is nothing to guess.
        return self._is_known(windows)

    def _is_known(self, windows: tuple[Window, ...]) -> bool:
        return all(bool(self._known[_tiles_of(window)].all()) for window in windows)

    @cached_property
    def _known(self) -> NDArray[np.bool_]:
        """Tiles in which every pixel has something opaque that the method never culls, (ty, tx)."""
        assert self.locality is not None
        limit = self.locality.guesses_nearer_than_px
        nearest = self.frame.farthest_opaque
        for axis in (0, 1):
            nearest = np.maximum.reduceat(nearest, range(0, nearest.shape[axis], TILE), axis=axis)
        return np.asarray(
            (nearest < np.inf) & (self._coc(np.where(nearest < np.inf, nearest, 0.0)) >= limit + self.slack_px)
        )

    def _windows(self, active: NDArray[np.bool_]) -> tuple[Window, ...]:
        assert self.locality is not None
        boxes = _boxes(active, _MOST_WINDOWS, self._gap_tiles)
        return tuple(self._window(box) for box in boxes)

    @property
    def _gap_tiles(self) -> int:
        """Empty tiles from which on two windows are less work than one."""
        assert self.locality is not None
        return math.ceil((2 * self.locality.margin_px + self.locality.align_px) / TILE) + 1

    def _window(self, box: tuple[int, int, int, int]) -> Window:
        assert self.locality is not None
        width, height, margin = self.shape.width, self.shape.height, self.locality.margin_px
        # A coarse grid, so that a focus in motion keeps to few sizes.
        grid = max(self.locality.align_px, _GRID)
        x0, y0, x1, y1 = (n * TILE for n in box)
        x1, y1 = min(x1, width), min(y1, height)
        left, top = max(x0 - margin, 0) // grid * grid, max(y0 - margin, 0) // grid * grid
        right, bottom = (min(-(-(n + margin) // grid) * grid, side) for n, side in ((x1, width), (y1, height)))
        return Window(left, top, right - left, bottom - top, (x0, y0, x1, y1))

    # --- peels ---

    def _peels(self, windows: tuple[Window, ...] | None) -> tuple[int, list[Decision]]:
        stats, layers = self.stats, self.shape.layers
        if windows == ():
            return layers, []
        where = [(slice(None), slice(None))] if windows is None else [_tiles_of(window) for window in windows]
        revealed = self._revealed()
        peels = 1
        for peel in range(1, layers):
            if any(bool(revealed[(peel, *tiles)].any()) for tiles in where):
                peels = peel + 1
        decisions = []
        pixels = self.shape.width * self.shape.height
        for peel in range(1, layers):
            share = float(stats.slots[peel].sum()) / pixels
            kept = peel < peels
            if kept:
                bare = float((revealed[peel] * stats.pixels).sum()) / pixels
                reason = f"covers {share:.1%} of the frame; a blur may reach it in {bare:.0%} of the tiles"
            elif share == 0.0:
                reason = "nothing is in it"
            else:
                reason = f"covers {share:.1%} of the frame, always behind what lets nothing through"
            saved = 0 if kept else pixels * 20
            decisions.append(Decision(f"peel {peel + 1}", kept, reason, 0.0, 0.0 if kept else 0.5 / layers, saved))
        return peels, decisions

    def _revealed(self) -> NDArray[np.bool_]:
        """Tiles in which a peel may show, (M, ty, tx)."""
        stats, locality = self.stats, self.locality
        there = (stats.slots > 0.0) | self.is_last
        if not self.shape.is_opaque:
            there[1:] |= there[:-1]  # where a peel has nothing the void begins, and hides what is behind
        if self.is_last or locality is None or (not self.shape.is_opaque and locality.spreads):
            return there
        if locality.spreads:
            # Where several layers lie behind one another light may come from as far as both are spread.
            low, high = self.seen
            ends = np.array([np.abs(v[np.isfinite(v)]).max(initial=0.0) for v in (low, high)])
            deepest = self._coc(np.where(stats.slots > 0, stats.farthest, 1.0 / 1e30))
            ends = np.append(ends, np.abs(deepest[stats.slots > 0]).max(initial=0.0))
            radius = math.ceil(2.0 * float(locality.reach_px(ends).max()) / TILE) + 1
        else:
            radius = 0
        hidden = np.zeros(stats.tiles, bool)
        revealed = there.copy()
        for peel in range(1, self.shape.layers):
            smooth = stats.is_closed[peel - 1] & (abs(self.c1) * stats.step[peel - 1] <= locality.closed_step_px)
            if radius:
                smooth = _spread((~smooth).astype(np.float64), radius) == 0.0
            hidden |= smooth
            revealed[peel] &= ~hidden
        return revealed

    # --- what only the method knows ---

    def _of_the_method(self, windows: tuple[Window, ...] | None) -> Iterator[Decision]:
        """What the method's own plan says."""
        if windows == ():
            return
        says = self.base.summary
        largest = max(float(np.abs(v[np.isfinite(v)]).max(initial=0.0)) for v in self.seen)
        if says.get("focus_layer") is not None and says.get("sigma_step") is not None:
            total, step = says["layers"], says["sigma_step"]
            yield Decision("depth layers", True, f"{total} of at most 32, the blur growing by {step:.2g} px a layer")
            yield from self._empty_layers(total)
            if self.locality is not None and self.locality.engines:
                yield Decision("blur engines", True, self.locality.engines)
        if "first_sub_image" in says:
            first, last = says["first_sub_image"], says["last_sub_image"]
            yield Decision(
                "sub-images", True, f"{_count(last - first + 1, 'sub-image')}, {-first} in front, {last} behind"
            )
            yield self._disocclusion(windows)
        if "mip_levels" in says:
            levels = says["mip_levels"]
            reason = (
                f"{_count(levels, 'level')} for blurs of {largest:.1f} px"
                if levels
                else (
                    f"with {_count(says['views'], 'view')}, rays stand closer than pixels at blurs of {largest:.1f} px"
                )
            )
            yield Decision("coarser images (mips)", levels > 0, reason)
        if "cone" in says and "rays" in says:
            room = math.sqrt(math.pi * max(largest, 1e-6) ** 2 / says["rays"])
            reason = f"{says['rays']} rays stand up to {room:.1f} px apart"
            yield Decision(
                "thick rays (cones)", room > 1.0, reason + ("" if room > 1.0 else ", no more than pixels do")
            )
        if "rays" in says:
            fewer = (
                ", fewer where all that a cell of 16 x 16 px can see is in focus or nearly" if says["adaptive"] else ""
            )
            yield Decision("rays", True, f"up to {says['rays']} a pixel{fewer}")
        if says.get("highlights"):
            # Layers may be blurred more than what they hold.
            least = says["highlight_coc_px"] - says["delta_px"]
            yield self._highlights(says["highlight_above"], least, says["highlight_rays"])
        if "jitter" in says:
            reason = "asked for" if says["jitter"] else "thick rays leave no pattern to hide; jitter=True asks for it"
            yield Decision("jitter", bool(says["jitter"]), reason)
        if "samples" in says:
            yield Decision(
                "samples",
                True,
                f"up to {says['samples']} per blurred pixel, more from 12 px of blur on, 1 below half a pixel",
            )
        if "eyes" in says:
            if says["eyes"]:
                reason = f"glossy surfaces are shaded from {_count(says['eyes'], 'point')} of the lens"
            elif self.shape.is_glossy:
                reason = "highlights turn by less over the lens than can be seen"
            else:
                reason = "nothing is glossy: all surfaces look the same from all of the lens"
            yield Decision("view-dependent light", says["eyes"] > 0, reason)

    def _empty_layers(self, total: int) -> Iterator[Decision]:
        """How many depth layers nothing lies in."""
        edges = np.sort(self.c1 * self.stats.bin_edges + self.c0)
        coc = np.array(self.base.summary["layer_coc_px"])
        used = self.stats.occupied[::-1] if self.c1 < 0.0 else self.stats.occupied
        empty = 0
        for k in range(total):
            low = coc[k - 1] if k > 0 else -np.inf
            high = coc[k + 1] if k + 1 < total else np.inf
            low = coc[k - 2] if k > 1 else low  # surfaces that slope into a layer enter it early
            empty += not bool((used & (edges[1:] >= low) & (edges[:-1] <= high)).any())
        if empty:
            reason = f"{empty} of {total} hold nothing, but their blur steps belong to the layers beyond them"
            yield Decision("empty depth layers", True, reason)

    def _highlights(self, above: float, coc_px: float, rays: int) -> Decision:
        """Whether bright light is blurred enough to take more rays."""
        stats = self.stats
        light = stats.high[..., :3].max(axis=-1)
        coc = stats.largest_coc(self.c1, self.c0)
        shown = (light > above) & (coc >= coc_px)
        if not shown.any():
            return Decision("more rays for lights", False, f"no light above {above:g} is blurred by {coc_px:.2g} px")
        share = float((shown.any(axis=0) * stats.pixels).sum() / stats.pixels.sum())
        reason = (
            f"light of up to {light[shown].max():.3g} in {share:.1%} of the tiles is blurred by up to "
            f"{coc[shown].max():.1f} px: {rays} rays where it may be seen"
        )
        return Decision("more rays for lights", True, reason)

    def _disocclusion(self, windows: tuple[Window, ...] | None) -> Decision:
        reason = "what is taken away is filled from the peel behind it, and where there is none from around it"
        if windows is not None and self._is_known(windows):
            reason = "a peel stands behind all that is taken away; only what lies beyond the edges is guessed"
        return Decision("disocclusion", True, reason)


def peels_needed(stats: SceneStats, lens: Lens, camera: Camera, max_change: float = MAX_CHANGE) -> tuple[int, str]:
    """How many peels of a scene a blur may reveal: what to ask a capture for.

    Parameters
    ----------
    stats : SceneStats
        Of a frame of the scene with as many peels as might be of use; it may be a small one.
    lens : Lens
    camera : Camera
        Of that frame.
    max_change : float
        A surface counts as closed if its CoC changes by so little from one pixel to the next that no more light than
        this gets past it.

    Returns
    -------
    peels : int
    reason : str
        In numbers.

    Notes
    -----
    A slot in peel m+1 is seen by some point of the lens only if the surface before it ends, or opens, within as many
    pixels as both are blurred. What is too small for the frame at hand is not known of.
    """
    c1, c0 = lens.coc_coefficients(camera)
    layers = stats.shape.layers
    if c1 == 0.0 and not stats.shape.has_glass:
        return 1, "a pinhole sees the first surface only"
    there = stats.slots > 0.0
    ends = [
        c1 * float(w) + c0 for w in (stats.farthest[there].min(initial=np.inf), stats.nearest.max()) if np.isfinite(w)
    ]
    reach = sum(abs(coc) for coc in ends)
    radius = math.ceil(reach / TILE) + 1
    step_px = max_change / 2.0 / max(stats.brightest, 1e-6)
    is_hidden = np.zeros(stats.tiles, bool)
    needed = 1
    for peel in range(1, layers):
        closed = stats.is_closed[peel - 1] & (abs(c1) * stats.step[peel - 1] <= step_px)
        is_hidden |= _spread((~closed).astype(np.float64), radius) == 0.0
        if bool((there[peel] & ~is_hidden).any()):
            needed = peel + 1
    shares = stats.slots.sum(axis=(1, 2)) / stats.pixels.sum()
    if needed == layers:
        return needed, f"a blur of {reach:.1f} px may reveal all of {_count(layers, 'peel')}"
    rest = float(shares[needed:].max())
    what = (
        "hold nothing"
        if rest == 0.0
        else f"cover {rest:.1%} of the view and cannot be revealed by {reach:.1f} px of blur"
    )
    return needed, f"the peels after {needed} {what}"


def planned_program(method: Method, shape: FrameShape, plan: FramePlan, traits: Traits) -> FrameProgram:
    """The passes of a planned frame; depends on ``plan.structure`` only."""
    layout = plan.structure
    assert isinstance(layout, Layout)
    used = shape._replace(layers=layout.peels, is_sparse=layout.is_sparse)
    if layout.windows is None and not layout.is_sparse:
        return method.program(used, Plan(layout.inner, plan.params, {}), traits)
    out_height, out_width = shape.output_size
    one = (1,) if traits.is_cpu else None
    two = (1, 1) if traits.is_cpu else None
    extent = (np.int32(shape.width), np.int32(shape.height))
    guard = np.int32(shape.guard_px)
    # The pinhole image takes all peels: what glass lets through shows without any blur.
    inputs = {"color": Buffer("color", shape.layers * shape.height * shape.width * 16, Role.INPUT)}
    buffers = [Buffer("image", out_height * out_width * 16, Role.OUTPUT)]
    passes = [
        Pass(
            "plan",
            "plan_pinhole",
            (write("image"), read("color"), *extent, np.int32(shape.layers), guard),
            (out_height,),
            one,
            traffic_bytes=out_height * out_width * 32,
        )
    ]
    if layout.is_sparse:
        program = method.program(used, Plan(layout.inner, plan.params, {}), traits)
        inputs |= {name: one for name, one in program.buffers.items() if one.role is Role.INPUT and name != "color"}
        own = [one for name, one in program.buffers.items() if name not in inputs and name != "image"]
        return FrameProgram.of([*inputs.values(), *buffers, *own], [*passes, *program.passes])
    for number, (width, height) in enumerate(layout.windows or ()):
        window = Param(f"window_{number}", _WINDOW)
        part = used._replace(width=width, height=height, guard_px=0)
        program = method.program(part, Plan(layout.inner, plan.params, {}), traits)
        names = {name: f"{number}_{name}" for name in program.buffers}
        for buffer in program.buffers.values():
            role = Role.TRANSIENT if buffer.role in (Role.INPUT, Role.OUTPUT) else buffer.role
            buffers.append(replace(buffer, name=names[buffer.name], role=role))
            if buffer.role is not Role.INPUT:
                continue
            pitches, channels, fill = _input_layout(buffer.name, shape.width, shape.pitch, part.width, part.pitch)
            size = shape.layers * shape.height * pitches[0] * channels * 4
            inputs[buffer.name] = Buffer(buffer.name, size, Role.INPUT)
            passes.append(
                Pass(
                    "plan",
                    "plan_window",
                    (
                        write(names[buffer.name]),
                        read(buffer.name),
                        np.int32(pitches[0]),
                        np.int32(shape.height),
                        np.int32(width),
                        np.int32(pitches[1]),
                        np.int32(height),
                        np.int32(channels),
                        np.float32(fill),
                        window,
                    ),
                    (height, used.layers),
                    two,
                    traffic_bytes=2 * buffer.nbytes,
                )
            )
        for step in program.passes:
            args = tuple(
                replace(arg, buffer=names[arg.buffer]) if isinstance(arg, Access) else arg for arg in step.args
            )
            passes.append(replace(step, args=args))
        passes.append(
            Pass(
                "plan",
                "plan_paste",
                (
                    read_write("image"),
                    read(names["image"]),
                    *extent,
                    guard,
                    np.int32(width),
                    np.int32(height),
                    window,
                ),
                (height,),
                one,
                traffic_bytes=width * height * 32,
            )
        )
    return FrameProgram.of([*inputs.values(), *buffers], passes)


def _input_layout(
    name: str, width: int, pitch: int, part_width: int, part_pitch: int
) -> tuple[tuple[int, int], int, float]:
    """Pitches of an input of the frame and of a window in px, its channels, and what stands past the rows."""
    if name == "inv_depth":
        return (pitch, part_pitch), 1, EMPTY
    return (width, part_width), {"color": 4, "normal": 3, "albedo": 3}.get(name, 1), 0.0


def _count(number: int, what: str) -> str:
    return f"{number} {what}{'' if number == 1 else 's'}"


def _tiles_of(window: Window) -> tuple[slice, slice]:
    """Rows and columns of tiles that a window touches."""
    return (
        slice(window.y // TILE, -(-(window.y + window.height) // TILE)),
        slice(window.x // TILE, -(-(window.x + window.width) // TILE)),
    )


def _spread(values: NDArray[Any], radius: int) -> NDArray[np.float64]:
    """Maximum over a square of so many tiles on each side, (..., ty, tx)."""
    result = np.asarray(values, np.float64)
    for _ in ("columns", "rows"):
        count = result.shape[-2]
        reach = min(radius, count - 1)
        if reach > 0:
            window = np.full((*result.shape[:-2], count + 2 * reach, result.shape[-1]), -np.inf)
            window[..., reach : reach + count, :] = result
            size = 1
            while 2 * size <= 2 * reach + 1:
                window = np.maximum(window[..., :-size, :], window[..., size:, :])
                size *= 2
            rest = 2 * reach + 1 - size
            result = np.maximum(window[..., :count, :], window[..., rest : rest + count, :])
        result = result.swapaxes(-1, -2)
    return np.ascontiguousarray(result)


def _boxes(active: NDArray[np.bool_], most: int, gap: int) -> list[tuple[int, int, int, int]]:
    """Boxes (x0, y0, x1, y1) around what is set, cut along empty rows and columns at least ``gap`` wide."""
    boxes = [_around(active, (0, 0, active.shape[1], active.shape[0]))]
    while len(boxes) < most:
        cuts = [(*_widest_gap(active, box), box) for box in boxes]
        width, axis, start, box = max(cuts, key=lambda cut: cut[0])
        if width < gap:
            break
        x0, y0, x1, y1 = box
        halves = (
            ((x0, y0, start, y1), (start + width, y0, x1, y1))
            if axis
            else ((x0, y0, x1, start), (x0, start + width, x1, y1))
        )
        boxes.remove(box)
        boxes += [_around(active, half) for half in halves]
    return sorted(boxes)


def _around(active: NDArray[np.bool_], box: tuple[int, int, int, int]) -> tuple[int, int, int, int]:
    x0, y0, x1, y1 = box
    part = active[y0:y1, x0:x1]
    columns, rows = np.flatnonzero(part.any(axis=0)), np.flatnonzero(part.any(axis=1))
    return x0 + int(columns[0]), y0 + int(rows[0]), x0 + int(columns[-1]) + 1, y0 + int(rows[-1]) + 1


def _widest_gap(active: NDArray[np.bool_], box: tuple[int, int, int, int]) -> tuple[int, int, int]:
    """Width, axis (1: columns) and place of the widest run of empty rows or columns in a box."""
    x0, y0, x1, y1 = box
    part = active[y0:y1, x0:x1]
    found = (0, 0, 0)
    for axis, first in ((0, y0), (1, x0)):
        lines = np.flatnonzero(part.any(axis=1 - axis))
        if len(lines) > 1:
            gaps = np.diff(lines) - 1
            at = int(gaps.argmax())
            found = max(found, (int(gaps[at]), axis, first + int(lines[at]) + 1))
    return found


def bin_scale(frame: LayeredFrame) -> tuple[float, float]:
    """First inverse depth of the bins, and bins per 1/m."""
    first, last = frame.inverse_depth_range
    return first, BINS / (last - first) if last > first else 0.0


def stats_params(frame: LayeredFrame) -> dict[str, np.float32]:
    """Parameters of :func:`stats_passes` for a frame."""
    first, scale = bin_scale(frame)
    return {"first_bin": np.float32(first), "bin_scale": np.float32(scale)}


def stats_passes(shape: FrameShape, is_cpu: bool) -> tuple[list[Buffer], list[Pass]]:
    """Passes that read ``color`` and ``depth`` and write the outputs ``inv_depth``, ``tiles`` and ``histogram``.

    Their parameters are those of :func:`stats_params`.
    """
    tiles_y, tiles_x = shape.tiles
    size = struct_scalar(_SIZE, shape.width, shape.height, shape.pitch, shape.layers, tiles_x, tiles_y)
    bins = (Param("first_bin", _FLOAT), Param("bin_scale", _FLOAT))
    slots = shape.layers * shape.height * shape.width
    tile_bytes = shape.layers * tiles_y * tiles_x * _TILE_STATS.itemsize
    bin_bytes = shape.layers * tiles_y * BINS * 4
    buffers = [Buffer("tiles", tile_bytes, Role.OUTPUT), Buffer("histogram", bin_bytes, Role.OUTPUT)]
    passes = [
        Pass(
            "stats",
            "stats_tiles",
            (write("inv_depth"), write("tiles"), read("depth"), read("color"), size, shape.nothing, *bins),
            (tiles_x, tiles_y, shape.layers),
            (1, 1, 1) if is_cpu else None,
            traffic_bytes=slots * 24 + tile_bytes,
        ),
        Pass(
            "stats",
            "stats_histogram",
            (write("histogram"), read("inv_depth"), read("color"), size, *bins),
            (tiles_y, shape.layers),
            (1, 1) if is_cpu else None,
            traffic_bytes=slots * 20 // TILE + bin_bytes,
        ),
    ]
    return buffers, passes


def read_stats(
    shape: FrameShape, tiles: NDArray[np.uint8], histogram: NDArray[np.int32], first: float, scale: float
) -> SceneStats:
    """What the passes wrote, as :class:`SceneStats`.

    Parameters
    ----------
    shape : FrameShape
    tiles, histogram : ndarray
        Contents of the two buffers.
    first, scale : float
        As the passes got them.
    """
    tiles_y, tiles_x = shape.tiles
    records = tiles.view(_TILE_STATS).reshape(shape.layers, tiles_y, tiles_x)
    slots = records["slots"].copy()
    is_empty = slots == 0.0
    farthest, low = records["farthest"].copy(), records["low"].copy()
    farthest[is_empty] = np.inf
    low[is_empty] = np.inf
    words = records["bins"].astype(np.uint64)
    counted = histogram.reshape(shape.layers, tiles_y, BINS).astype(np.float64)
    # The one row of a tile stands for all of its rows.
    rows = np.minimum(shape.height - TILE * np.arange(tiles_y), TILE)
    return SceneStats(
        shape=shape,
        nearest=records["nearest"].copy(),
        farthest=farthest,
        slots=slots,
        solid=records["solid"].copy(),
        step=records["step"].copy(),
        bins=words[..., 0] | words[..., 1] << np.uint64(32),
        luminance=records["luminance"] / np.maximum(slots, 1.0),
        low=low,
        high=records["high"].copy(),
        histogram=(counted * rows[:, None]).sum(axis=1),
        first=first,
        last=first + BINS / scale if scale else first,
    )


def buffer_sizes(shape: FrameShape) -> Mapping[str, tuple[int, type]]:
    """Elements and dtype of the two buffers, to read them back."""
    tiles_y, tiles_x = shape.tiles
    return {
        "tiles": (shape.layers * tiles_y * tiles_x * _TILE_STATS.itemsize, np.uint8),
        "histogram": (shape.layers * tiles_y * BINS, np.int32),
    }
