"""The planner: looks at a frame through a lens and decides what of the method has to run at all.

Statistics (:class:`SceneStats`) are gathered on the device when a frame arrives there, per tile of 16 x 16 pixels and
peel, in inverse depth: the circle of confusion (CoC) of any lens is linear in it, so a frame is looked at once and not
once a lens. From them and the lens comes a :class:`FramePlan`: the method's plan, what was left out of it, why, and how
much that can change a pixel at most.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .camera import Camera
from .frame import LayeredFrame
from .host.passes import Buffer, Param, Pass, Role, read, write
from .lens import Lens
from .methods.base import FrameShape, Plan, struct_scalar

__all__ = ["BINS", "MAX_CHANGE", "TILE", "Decision", "FramePlan", "SceneStats"]

# Constants of kernels/stats.cl.
TILE = 16
BINS = 64

# What a plan may change a pixel by when nothing else is asked for, in linear units: one step of an 8-bit image.
MAX_CHANGE = 1.0 / 255.0

# A bin is this much wider than it is: float32 and float64 may disagree about the bin of a slot.
_BIN_SLACK = 1e-3

_FLOAT = np.dtype(np.float32)
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
    def highlight(self) -> Array:
        """Largest channel of a tile's first peel over its mean luminance, (ty, tx): what would show as a bokeh."""
        peak = self.high[0, ..., :3].max(axis=-1)
        return np.asarray(peak / np.maximum(self.luminance[0], 1e-6), np.float32)

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
        All decisions together change no pixel by more than this, linear units.
    """

    decisions: tuple[Decision, ...] = ()
    error_bound: float = 0.0

    def explain(self) -> str:
        """The plan in words, for people."""
        return "\n".join(f"{'kept' if one.kept else 'left out'}: {one.effect}: {one.reason}" for one in self.decisions)


def bin_scale(frame: LayeredFrame) -> tuple[float, float]:
    """First inverse depth of the bins, and bins per 1/m."""
    first, last = frame.inverse_depth_range
    return first, BINS / (last - first) if last > first else 0.0


def stats_passes(shape: FrameShape, is_cpu: bool) -> tuple[list[Buffer], list[Pass]]:
    """Passes that read ``color`` and ``inv_depth`` and write the outputs ``tiles`` and ``histogram``.

    Their parameters are ``first_bin`` and ``bin_scale``, as of :func:`bin_scale`.
    """
    tiles_x, tiles_y = -(-shape.width // TILE), -(-shape.height // TILE)
    size = struct_scalar(_SIZE, shape.width, shape.height, shape.pitch, shape.layers, tiles_x, tiles_y)
    args = (read("inv_depth"), read("color"), size, Param("first_bin", _FLOAT), Param("bin_scale", _FLOAT))
    slots = shape.layers * shape.height * shape.width
    tile_bytes = shape.layers * tiles_y * tiles_x * _TILE_STATS.itemsize
    bin_bytes = shape.layers * tiles_y * BINS * 4
    buffers = [Buffer("tiles", tile_bytes, Role.OUTPUT), Buffer("histogram", bin_bytes, Role.OUTPUT)]
    passes = [
        Pass(
            "stats",
            "stats_tiles",
            (write("tiles"), *args),
            (tiles_x, tiles_y, shape.layers),
            (1, 1, 1) if is_cpu else None,
            traffic_bytes=slots * 20 + tile_bytes,
        ),
        Pass(
            "stats",
            "stats_histogram",
            (write("histogram"), *args),
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
    tiles_x, tiles_y = -(-shape.width // TILE), -(-shape.height // TILE)
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
    tiles_x, tiles_y = -(-shape.width // TILE), -(-shape.height // TILE)
    return {
        "tiles": (shape.layers * tiles_y * tiles_x * _TILE_STATS.itemsize, np.uint8),
        "histogram": (shape.layers * tiles_y * BINS, np.int32),
    }
