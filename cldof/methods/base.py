"""What a method is to the renderer."""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from ..frame import LayeredFrame
from ..host.device import Traits
from ..host.passes import Buffer, FrameProgram, Role
from ..lens import Lens

__all__ = ["EMPTY", "TILE", "FrameShape", "Locality", "Method", "Plan", "row_pitch", "struct_scalar"]

Array = NDArray[np.float64]

TILE = 16
"""Pixels each way of the tiles that the planner looks at and asks for, as kernels/stats.cl has it."""

EMPTY = -1.0
"""Inverse depth of a slot with nothing in it, as kernels/common.clh has it."""


class FrameShape(NamedTuple):
    """What of a frame shapes the passes, beside the plan."""

    layers: int
    height: int  # guard band included, like width
    width: int
    guard_px: int
    is_opaque: bool
    has_glass: bool
    surface: tuple[str, ...] = ()  # what the frame has beside colour and depth: LayeredFrame.inputs
    is_glossy: bool = False
    is_sparse: bool = False  # only the tiles that the input ``gaps`` asks for are made

    @classmethod
    def of(cls, frame: LayeredFrame) -> FrameShape:
        """The shape of a frame."""
        return cls(
            frame.layer_count,
            frame.height,
            frame.width,
            frame.guard_px,
            frame.is_opaque,
            frame.has_glass,
            tuple(sorted(frame.inputs)),
            frame.is_glossy,
        )

    @property
    def pitch(self) -> int:
        """Pixels from one row to the next in images on the device."""
        return row_pitch(self.width)

    @property
    def nothing(self) -> np.float32:
        """Inverse depth of slots with neither light nor coverage: where the image is not opaque, the void's."""
        return np.float32(EMPTY if self.is_opaque else 0.0)

    @property
    def tiles(self) -> tuple[int, int]:
        """Rows and columns of the planner's tiles."""
        return -(-self.height // TILE), -(-self.width // TILE)

    @property
    def gaps(self) -> Buffer:
        """The input of sparse frames, ushort[rows of tiles][columns of tiles].

        Pixels between a tile and the nearest one that is asked for, 0 in those.
        """
        return Buffer("gaps", math.prod(self.tiles) * 2, Role.INPUT)

    @property
    def output_size(self) -> tuple[int, int]:
        """(height, width) without the guard band."""
        return self.height - 2 * self.guard_px, self.width - 2 * self.guard_px


def row_pitch(width: int) -> int:
    """Row pitch in pixels: a multiple of 16, so that vectors never straddle rows, and no multiple of 256.

    With a pitch of a power of two the pixels of a column share few cache sets, which costs CPUs a third in column
    filters.
    """
    pitch = -(-width // 16) * 16
    return pitch + 16 if pitch % 256 == 0 else pitch


def struct_scalar(dtype: np.dtype[Any], *values: float) -> np.generic:
    """A struct argument of a kernel, field by field."""
    record: Any = np.array(values, dtype)
    scalar: np.generic = record[()]
    return scalar


@dataclass(frozen=True)
class Plan:
    """How one frame is going to be rendered.

    Attributes
    ----------
    structure : hashable
        What shapes the passes. Frames with the same structure and shape share programs, buffers and pass lists.
    params : mapping
        Values of the passes' :class:`~cldof.host.passes.Param` arguments.
    summary : mapping
        Plain numbers for reports.
    """

    structure: Hashable
    params: Mapping[str, Any]
    summary: Mapping[str, Any]


@dataclass(frozen=True)
class Locality:
    """How far a method looks, and what it makes of what is nearly in focus: what the planner may leave out.

    Attributes
    ----------
    align_px : int
        A part of a frame that begins at a multiple of this is computed as within the whole frame.
    margin_px : int
        Pixels around a part on which its result depends.
    reach_px : callable
        By how many pixels light of a slot may spread, from its CoC radius in px; arrays in, arrays out.
    leak : callable
        Share of a pixel's light that may come from elsewhere, from the pixel's CoC radius, as long as no nearer surface
        reaches it. 0: it is the pinhole's pixel.
    spreads : bool
        False where a blurred surface never covers what is in focus beside it.
    tail : float
        Light that lies beyond ``reach_px`` and ``margin_px``, as a share.
    closed_step_px : float
        A surface hides what is behind it where its CoC changes by no more than this from one pixel to the next.
    counts_slopes : bool
        Whether a slot reaches as far in depth as its neighbours, as to ``leak``.
    rim_px : int
        So far beside a blur, also one behind, pixels in focus are not exactly the pinhole's.
    guesses_nearer_than_px : float
        Where all that a column of pixels holds has a signed CoC below this, the method guesses what is behind it from
        all around; such places are not taken apart. -inf: it never guesses.
    guesses_at_edges_px : float
        So near to the edges of the frame (not of the image) it guesses, too.
    engines : str
        Which blur engines run on this device, in words, where there is a choice.
    tiles_floor : float, optional
        For methods that can make single tiles of a frame (``FrameShape.is_sparse``): the share of the work that is left
        when there are few. None: it is all or a part of its own.
    """

    align_px: int
    margin_px: int
    reach_px: Callable[[Array], Array]
    leak: Callable[[Array], Array]
    spreads: bool = True
    tail: float = 0.0
    closed_step_px: float = 0.0
    counts_slopes: bool = False
    rim_px: int = 0
    guesses_nearer_than_px: float = -math.inf
    guesses_at_edges_px: float = 0.0
    engines: str = ""
    tiles_floor: float | None = None


class Method(Protocol):
    """A depth-of-field method: turns lens and frame into passes, and owns no OpenCL object.

    Passes may read the inputs ``color`` (float[layers][height][width][4]) and ``inv_depth``
    (float[layers][height][pitch], see kernels/frame.cl), and of frames that have them ``normal``, ``albedo``,
    ``specular`` (float[layers][height][width][3]), ``shininess`` (float[layers][height][width]), ``lighting`` and
    ``environment`` (see kernels/shading.clh), and of sparse shapes ``gaps``. They write the output ``image``
    (float[output height][output width][4]), of sparse shapes into what the pinhole image is.
    """

    name: str
    simulated_aperture: str | None  # the one shape of lens that it simulates, or None: the lens's own

    def plan(self, frame: LayeredFrame, lens: Lens) -> Plan:
        """Decide what to compute, from numbers alone."""
        ...

    def program(self, shape: FrameShape, plan: Plan, traits: Traits) -> FrameProgram:
        """Declare the passes; depends on ``plan.structure`` only."""
        ...

    def locality(self, shape: FrameShape, plan: Plan, traits: Traits, tail: float) -> Locality | None:
        """What the planner may take apart, if a share ``tail`` of a slot's light may be ignored; None for nothing."""
        ...
