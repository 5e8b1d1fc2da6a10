"""The pyramid method (Kraus & Strengert 2007): sub-images of one RGBZ image, blurred by pyramids.

Sub-image i (negative in front of the focus, 0 in focus) is blurred by \\|i\\| reductions and expansions, so the pyramid
dictates its blur radius r(i), and the radius its depth z(i) (eqs. 8-13). Each sub-image is culled of what lies in front
of it, the holes are filled from around them, pixels are weighted by depth, blurred, and blended back to front.

``matting="paper"``, ``radius="paper"``, ``hidden="interpolated"`` and ``normalise=False`` together are the method as
published. The defaults differ, each by measurement (docs/methods/pyramid.md):

- ``matting="seamless"``: ramps are linear in the CoC, so that they reach beyond infinity and no special cases are left.
  A surface enters the sub-image behind its own only where it is broad and slopes into it, as far as the blur opens a
  seam, and takes full weight in its own only where it is broad (as in ``layered``).
- ``radius="fitted"``: r(i) is that of the Gaussian that fits the filters best. It differs from eq. 13 for one step.
- ``hidden="peels"``: behind what is culled stands the next peel, and only where there is none an interpolated pixel.
- ``normalise=True``: the result is divided by its coverage.

A radius here is a standard deviation in px, as in the paper, whose Gaussian lens has one of the lens radius; ours has
``GAUSSIAN_SIGMA`` times the CoC radius.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..frame import LayeredFrame
from ..host.device import Traits
from ..host.passes import Buffer, FrameProgram, Local, Param, Pass, Role, read, read_write, write
from ..lens import GAUSSIAN_SIGMA, Lens
from .base import Array, FrameShape, Locality, Plan, row_pitch

__all__ = ["MAX_STEPS", "SIZE", "Pyramid", "SubImages", "blur_radius", "level_table", "matting_functions"]

# Sigma 440 px.
MAX_STEPS = 9

# Constants of kernels/pyramid.cl.
_LEVELS = 16
_COUNT = 24
_ROWS = 8
_BLOCK = 16
# The least margin, in px: blocks then lie either inside the frame or outside.
_MARGIN = _BLOCK

# Sides whose largest sigma (px) stays below this get no sub-images.
_NEGLIGIBLE_SIGMA_PX = 5e-4

# Eq. 12.
_PAPER_SIGMA = 0.85

# Sigma in px of the Gaussian that fits the filters best (least squares), by steps, the mean over all positions in the
# pyramid; tests/kernels/test_pyramid.py measures it. From position to position it varies between 0.77 and 0.92 times
# 2**n, which is the paper's "0.8 to 0.9" in pixels of the coarsest level.
_FITTED_SIGMA_PX = (0.0, 1.537, 3.367, 6.837, 13.724)
_FITTED_SIGMA = 0.8587  # times 2**n, for more steps

# A surface that slopes into a sub-image enters it this many sigma early, so that no seam opens.
_SEAM_REACH = 2.0

# Of the sum of a product and a number.
_FLOAT32_ROUNDING = 4.0 * 2.0**-24

# A step as a ramp: as steep as float32 tells depths apart.
_STEP = 1e6

# With the published ramps, which are linear in z, a focus at infinity stands at this multiple of z(-1).
_FAR_FOCUS = 1e3

SIZE = np.dtype([(name, np.int32) for name in ("width", "height", "pitch", "peels", "sources", "top", "guard")])
_MATTING = np.dtype(
    [
        ("ramp", np.float32, (_COUNT, 4)),
        ("before", np.float32, (_COUNT, 2)),
        ("seam", np.float32, (_COUNT,)),
        ("around", np.int32, (_COUNT,)),
    ]
)


class SubImages(NamedTuple):
    """Which sub-images there are."""

    first: int
    last: int

    @property
    def indices(self) -> range:
        """Nearest first."""
        return range(self.first, self.last + 1)


class Matting(NamedTuple):
    """Matting functions of sub-images as kernels/pyramid.cl takes them.

    Attributes
    ----------
    ramp : ndarray, (N, 4)
        ``(up scale, up offset, down scale, down offset)`` over inverse depth, or over depth if published.
    before : ndarray, (N, 2)
        Back ramp of the sub-image before; zeros if published and for the first.
    seam : ndarray, (N,)
        Part of the front ramp needed per slope of 1/m per px.
    around : ndarray, (N,)
        Pixels at which to look for the rest of a surface, and once more at twice as many: a sigma of the blur.
    """

    ramp: NDArray[np.float64]
    before: NDArray[np.float64]
    seam: NDArray[np.float64]
    around: NDArray[np.int64]


@dataclass(frozen=True)
class Pyramid:
    """Options of the pyramid method.

    Parameters
    ----------
    sub_images : (int, int), optional
        First and last sub-image, at most 0 and at least 0, for an almost constant time per frame; what is blurred more
        goes to the ends. None: what lens and depths call for.
    matting : {"seamless", "paper"}
        Matting functions; see the module's text.
    radius : {"fitted", "paper"}
        Blur radius of sub-images: measured, or eq. 13.
    perceived_blur : float
        The factor of eq. 13, with ``radius="paper"``.
    hidden : {"peels", "interpolated"}
        What stands behind culled pixels.
    normalise : bool
        Divide by coverage.
    """

    sub_images: tuple[int, int] | None = None
    matting: str = "seamless"
    radius: str = "fitted"
    perceived_blur: float = 2.0
    hidden: str = "peels"
    normalise: bool = True

    name = "pyramid"
    simulated_aperture = "gaussian"

    def __post_init__(self) -> None:
        if self.sub_images is not None:
            try:
                first, last = (int(i) for i in self.sub_images)
                fits = (first, last) == tuple(self.sub_images) and -MAX_STEPS <= first <= 0 <= last <= MAX_STEPS
            except (TypeError, ValueError):
                fits = False
            if not fits:
                raise InputError(
                    f"pyramid: sub_images is {self.sub_images!r}; it must be the first and last index, from "
                    f"-{MAX_STEPS} to 0 and from 0 to {MAX_STEPS}."
                )
            object.__setattr__(self, "sub_images", (first, last))
        if not (isinstance(self.perceived_blur, int | float) and 0.1 <= self.perceived_blur <= 10.0):
            raise InputError(f"pyramid: perceived_blur is {self.perceived_blur!r}; it must be from 0.1 to 10.")
        choices = {"matting": ("seamless", "paper"), "radius": ("fitted", "paper"), "hidden": ("peels", "interpolated")}
        for name, allowed in choices.items():
            if getattr(self, name) not in allowed:
                raise InputError(f"pyramid: {name} is {getattr(self, name)!r}; choose one of {', '.join(allowed)}.")

    def plan(self, frame: LayeredFrame, lens: Lens) -> Plan:
        """Choose the sub-images from the CoC range; derive the matting functions."""
        return self._plan(frame, lens, both_sides=False)

    def plan_both_sides(self, frame: LayeredFrame, lens: Lens) -> Plan:
        """The same with as many sub-images on the side with less blur as on the other, empty ones: for comparison."""
        return self._plan(frame, lens, both_sides=True)

    def _plan(self, frame: LayeredFrame, lens: Lens, both_sides: bool) -> Plan:
        c1, c0 = lens.coc_coefficients(frame.camera)
        farthest, nearest = frame.shown_inverse_depths
        near_px = max(0.0, -GAUSSIAN_SIGMA * (c1 * nearest + c0))
        far_px = max(0.0, GAUSSIAN_SIGMA * (c1 * farthest + c0))
        chosen, last = self._choose(near_px, far_px, GAUSSIAN_SIGMA * c0, max(frame.width, frame.height))
        paper = self.matting == "paper"
        matting = matting_functions(chosen, last, self._radius, c1, c0, paper)
        params = np.zeros((), _MATTING)
        before = 0
        if both_sides:
            most = max(-chosen.first, chosen.last)
            before = most + chosen.first
        there = slice(before, before + len(chosen.indices))
        for name in Matting._fields:
            params[name][there] = getattr(matting, name)
        if both_sides:
            chosen = SubImages(-most, most)
        summary = {
            "method": self.name,
            **{field.name: getattr(self, field.name) for field in fields(self)},
            "first_sub_image": chosen.first,
            "last_sub_image": chosen.last,
            "blur_sigma_px": [abs(self._radius(i)) for i in chosen.indices],
            "largest_near_sigma_px": near_px,
            "largest_far_sigma_px": far_px,
        }
        return Plan(chosen, {"matting": params[()]}, summary)

    def program(self, shape: FrameShape, plan: Plan, traits: Traits) -> FrameProgram:
        """Declare the frame's passes."""
        chosen = plan.structure
        assert isinstance(chosen, SubImages)
        return _Builder(self, shape, chosen, traits).build()

    def locality(self, shape: FrameShape, plan: Plan, traits: Traits, tail: float) -> Locality:
        """A slot is blurred as the sub-image beyond it, and holes are filled from around them."""
        chosen = plan.structure
        assert isinstance(chosen, SubImages)
        steps = max(-chosen.first, chosen.last)
        if steps == 0:
            return Locality(_MARGIN, 0, np.zeros_like, np.zeros_like)
        sigmas = np.array([blur_radius(n) if self.radius == "fitted" else self._radius(n) for n in range(steps + 1)])

        def reach_px(coc_px: Array) -> Array:
            index = np.minimum(np.searchsorted(sigmas, GAUSSIAN_SIGMA * coc_px), steps)
            # Reductions widen a pixel by 1.5 pixels of the coarsest level, expansions by 2.
            return np.where(index > 0, 3.5 * 2.0**index + 2.0, 0.0)

        def leak(coc_px: Array) -> Array:
            share = 2.0 * GAUSSIAN_SIGMA * coc_px / sigmas[1] if self.matting == "seamless" else np.ones_like(coc_px)
            return np.minimum(share, 1.0)

        return Locality(
            max(2 * _MARGIN, 2**steps),
            # Light spreads that far, and by how much goes by what is two sigma around.
            math.ceil(3.5 * 2**steps) + (2 * math.ceil(blur_radius(steps)) if self.matting == "seamless" else 0) + 4,
            reach_px,
            leak,
            # The farthest sub-image culls most.
            guesses_nearer_than_px=(
                self._radius(chosen.last - 1) / GAUSSIAN_SIGMA
                if self.hidden == "peels" and self.normalise
                else math.inf
            ),
            # What lies beyond is a hole, filled from as far as the levels of the pyramid happen to reach.
            guesses_at_edges_px=4.0 * 2**steps + 2.0,
        )

    def _radius(self, i: int) -> float:
        factor = self.perceived_blur if self.radius == "paper" else None
        return math.copysign(blur_radius(abs(i), factor), i)

    def _choose(self, near_px: float, far_px: float, infinity_px: float, side_px: int) -> tuple[SubImages, int]:
        """The sub-images that hold anything, and the index of the last by rule (imax)."""
        if max(near_px, far_px) < _NEGLIGIBLE_SIGMA_PX:
            return SubImages(0, 0), 0
        if self.sub_images is not None:
            return SubImages(*self.sub_images), self.sub_images[1]
        # Wider than the frame there is nothing left to blur.
        most = min(MAX_STEPS, max(1, math.ceil(math.log2(side_px))))
        first = last = 0
        while first > -most and near_px >= _NEGLIGIBLE_SIGMA_PX and -self._radius(first) < near_px:
            first -= 1
        if self.matting == "seamless":
            while last < most and far_px >= _NEGLIGIBLE_SIGMA_PX and self._radius(last) < far_px:
                last += 1
            return SubImages(first, last), last
        # Section 3.1: r(imax - 2) < r(z -> inf) < r(imax - 1).
        while last < most and not self._radius(last - 1) > infinity_px:
            last += 1
        # Nothing is farther than z(i - 2): the sub-image is empty.
        used = [i for i in range(first, last + 1) if i <= 0 or self._radius(i - 2) < far_px]
        return SubImages(first, max(used)), last


def blur_radius(steps: int, perceived_blur: float | None = None) -> float:
    """Standard deviation in px of a sub-image's blur.

    Parameters
    ----------
    steps : int
        Reductions, and as many expansions.
    perceived_blur : float, optional
        The factor of eq. 13; None gives the fitted radius.
    """
    if steps == 0:
        return 0.0
    if perceived_blur is not None:
        return perceived_blur * _PAPER_SIGMA * 2.0 ** (steps - 1)
    return _FITTED_SIGMA_PX[steps] if steps < len(_FITTED_SIGMA_PX) else _FITTED_SIGMA * 2.0**steps


def matting_functions(
    chosen: SubImages, last: int, radius: Callable[[int], float], c1: float, c0: float, paper: bool
) -> Matting:
    """Matting functions w(i)(z) (section 3.3).

    Parameters
    ----------
    chosen : SubImages
    last : int
        imax; later than ``chosen.last`` where the sub-images between are empty.
    radius : callable
        Signed r(i) in px.
    c1, c0 : float
        The lens: ``C = c1 / z + c0``.
    paper : bool
        As published, over z, or the seamless ones, over 1/z.
    """
    count = len(chosen.indices)
    ramp, seam = np.tile((0.0, 1.0, 0.0, 1.0), (count, 1)), np.zeros(count)
    matting = Matting(ramp, np.zeros((count, 2)), seam, np.ones(count, np.int64))
    if c1 == 0.0:
        return matting
    if paper:
        for row, i in enumerate(chosen.indices):
            ramp[row] = _paper_ramps(i, chosen.first, last, radius, c1, c0)
        return matting
    a, b = GAUSSIAN_SIGMA * c1, GAUSSIAN_SIGMA * c0  # sigma over 1/z
    for row, i in enumerate(chosen.indices):
        if i != chosen.first:
            start, end = radius(i - 2), radius(i - 1)
            ramp[row, :2] = a / (end - start), (b - start) / (end - start)
            widest = max(blur_radius(abs(i)), blur_radius(abs(i - 1)))
            seam[row] = abs(a) / (end - start) * _SEAM_REACH * widest
            matting.around[row] = max(1, math.ceil(widest))
            start, end = radius(i - 1), radius(i)
            matting.before[row] = -a / (end - start), (end - b) / (end - start)
            if i == 0:  # nor the plane in focus for less than whole
                matting.before[row, 1] -= _FLOAT32_ROUNDING * (abs(matting.before[row, 1]) + abs(b / (end - start)))
        if i != last:
            start, end = radius(i), radius(i + 1)
            ramp[row, 2:] = -a / (end - start), (end - b) / (end - start)
            if i == 0:
                # float32 may not take the plane in focus for less than whole: what is behind may be 1e6 times brighter.
                ramp[row, 3] += _FLOAT32_ROUNDING * (abs(ramp[row, 3]) + abs(b / (end - start)))
    return matting


def _paper_ramps(
    i: int, first: int, last: int, radius: Callable[[int], float], c1: float, c0: float
) -> tuple[float, float, float, float]:
    def z(j: int) -> float:
        """Eqs. 9-11; inf where ill-defined."""
        if j == 0 and c0 == 0.0:
            return _FAR_FOCUS * z(-1)
        inverse = (radius(j) / GAUSSIAN_SIGMA - c0) / c1
        return 1.0 / inverse if inverse > 0.0 else math.inf

    def ramp(start: float, end: float) -> tuple[float, float]:
        return 1.0 / (end - start), -start / (end - start)

    if i == first:
        up = (0.0, 1.0)
    elif math.isinf(z(i - 2)):
        up = (0.0, -1.0)  # empty
    elif i == last or math.isinf(z(i - 1)):
        up = (_STEP / z(i - 2), 1.0 - _STEP)
    else:
        up = ramp(z(i - 2), z(i - 1))
    down = (0.0, 0.0)
    if not (i == last or math.isinf(z(i)) or math.isinf(z(i + 1))):
        down = ramp(z(i), z(i + 1))
    return up[0], up[1], -down[0], 1.0 - down[1]


def level_table(shape: FrameShape, chosen: SubImages) -> tuple[NDArray[np.int32], int]:
    """Where the levels of all sub-images lie.

    Returns
    -------
    table : ndarray, (sub-images, 16, 4), int32
        See kernels/pyramid.cl.
    pixels : int
        Of the whole buffer.
    """
    table = np.zeros((len(chosen.indices), _LEVELS, 4), np.int32)
    offset = 0
    for row, i in enumerate(chosen.indices):
        steps = abs(i)
        unit = 2**steps
        margin = max(_MARGIN, unit) if steps else 0
        width, height = (-(-side // unit) * unit + 2 * margin for side in (shape.width, shape.height))
        table[row, 0] = margin, steps, width, height
        level = 0
        while level == 0 or max(width, height) > 1:
            level += 1
            width, height = -(-width // 2), -(-height // 2)
            pitch = row_pitch(width)
            table[row, level] = offset, width, height, pitch
            offset += pitch * height
    return table, offset


class _Builder:
    """Lists the passes of one frame."""

    def __init__(self, method: Pyramid, shape: FrameShape, chosen: SubImages, traits: Traits) -> None:
        self.method, self.shape, self.chosen = method, shape, chosen
        self.is_cpu, self.local_limit = traits.is_cpu, traits.local_mem_bytes
        # GPU values are reasoned, not measured.
        self.items = 1 if traits.is_cpu else min(64, traits.max_work_group_size)
        # What is known of a block is looked up once for all of it; on GPUs there are more items instead.
        self.run = _BLOCK if traits.is_cpu else traits.lanes
        self.sources = shape.layers if method.hidden == "peels" else 1
        self.table, pixels = level_table(shape, chosen)
        self.level_pixels = pixels
        self.count = len(chosen.indices)
        self.size: Any = np.array(
            (
                shape.width,
                shape.height,
                shape.pitch,
                shape.layers,
                self.sources,
                self.table[:, 0, 0].max(),
                shape.guard_px,
            ),
            SIZE,
        )[()]
        self.frame_pixels = shape.height * shape.pitch
        self.pixels = shape.height * shape.width
        self.buffers = [
            Buffer("color", shape.layers * self.pixels * 16, Role.INPUT),
            Buffer("inv_depth", shape.layers * self.frame_pixels * 4, Role.INPUT),
            Buffer("image", math.prod(shape.output_size) * 16, Role.OUTPUT),
            Buffer("table", self.table.nbytes, Role.CONSTANT, self.table),
            Buffer("matting", _MATTING.itemsize),
        ]
        self.passes: list[Pass] = []
        self.defines: tuple[tuple[str, int], ...] = ()

    def build(self) -> FrameProgram:
        self._set_defines(0)
        self._add("pyramid_matting", (write("matting"), Param("matting", _MATTING)), (1,))
        self._run("rgb", 0)
        if not self.shape.is_opaque:
            self._run("alpha", 1)
        return FrameProgram.of(self.buffers, self.passes)

    def _set_defines(self, alpha: int) -> None:
        self.defines = (
            ("PYRAMID_PAPER", int(self.method.matting == "paper")),
            ("PYRAMID_VOID", int(not self.shape.is_opaque)),
            ("PYRAMID_ALPHA", alpha),
            ("PYRAMID_DIVIDE", int(self.method.normalise)),
            ("PYRAMID_RUN", self.run),
        )

    def _run(self, run: str, alpha: int) -> None:
        self._set_defines(alpha)
        flat, inv, slope, broad, span, fill, fill_inv, blur = (
            f"{run}_{name}" for name in ("flat", "flat_inv", "slope", "broad", "span", "fill", "fill_inv", "blur")
        )
        if self.method.matting == "paper":
            slope = broad = span = inv
        stack = self.sources * self.frame_pixels
        steps = int(self.table[:, 0, 1].max())
        for name, nbytes in (
            (flat, stack * 16),
            (inv, stack * 4),
            *(((slope, stack * 4), (broad, self.frame_pixels * 4), (span, stack)) if slope != inv else ()),
            (fill, self.level_pixels * 16),
            (fill_inv, self.level_pixels * 4),
            (blur, self.level_pixels * 16 if steps else 16),
        ):
            self.buffers.append(Buffer(name, nbytes))

        tables = (read("table"), read("matting"))
        rgbz = (read(flat), read(inv), read(slope), read(broad), read(span))
        filled = (read(fill), read(fill_inv))
        rows = self.sources * self.shape.height
        self._add(
            "pyramid_flatten",
            (write(flat), write(inv), read("color"), read("inv_depth"), self.size),
            (self.items, rows),
            traffic=40 * self.sources * self.pixels,
        )
        if self.method.matting != "paper":  # else handed over, not read
            self._add(
                "pyramid_slope",
                (write(slope), write(broad), write(span), read(inv), read("matting"), self.size, np.int32(self.count)),
                (self.items, rows),
                traffic=(8 * self.sources + 4) * self.pixels,
            )
        updated = (read_write(fill), read_write(fill_inv), read("table"))
        self._add(
            "pyramid_cull",
            (write(fill), write(fill_inv), *rgbz, *tables, self.size),
            self._over_levels(1),
            traffic=20 * (self.count * self.pixels + self._area(1)),
        )
        deepest = int((self.table[:, 1:, 1] > 0).sum(axis=1).max())
        for k in range(1, deepest):
            traffic = 20 * (self._area(k) + self._area(k + 1))
            self._add("pyramid_pull", (*updated, np.int32(k)), self._over_levels(k + 1), traffic=traffic)
        for k in range(deepest - 1, 0, -1):
            traffic = 4 * self._area(k)
            self._add("pyramid_push", (*updated, np.int32(k)), self._over_levels(k), traffic=traffic)
        if steps:
            self._matte(write(blur), (*rgbz, *filled, *tables, self.size))
        blurred = (read_write(blur), read("table"))
        for k in range(1, steps):
            traffic = 16 * (self._area(k, k) + self._area(k + 1, k))
            self._add("pyramid_reduce", (*blurred, np.int32(k)), self._over_levels(k + 1), traffic=traffic)
        for k in range(steps - 1, 0, -1):
            traffic = 16 * (self._area(k, k) + self._area(k + 1, k))
            self._add("pyramid_expand", (*blurred, np.int32(k)), self._over_levels(k), traffic=traffic)
        if not steps:
            blur = fill  # handed over, not read
        self._add(
            "pyramid_blend",
            (
                read_write("image") if alpha else write("image"),
                read(blur),
                *rgbz,
                *filled,
                *tables,
                self.size,
                np.int32(self.count),
            ),
            (self.items, self.shape.output_size[0]),
            traffic=16 * (self._area(1) + self.pixels),
        )

    def _matte(self, blur: Any, args: tuple[Any, ...]) -> None:
        widest, highest = (int(self.table[:, 1, column].max()) for column in (1, 2))
        fits = (self.local_limit - 256) // 64 - 16  # two lines of 2 * segment + 32 pixels
        one_each = self.items * self.run // 2 - 16  # every item has a run of such a line
        segment = max(min(-(-widest // 16) * 16, fits if self.is_cpu else one_each) // 16 * 16, 16)
        # Rows of sub-images with smaller margins start later.
        blocks = -(-(highest + int(self.size["top"]) // 2) // _ROWS)
        self._add(
            "pyramid_matte",
            (blur, *args, np.int32(segment), Local(2 * (2 * segment + 32) * 16)),
            (-(-widest // segment) * self.items, self.count, blocks),
            (self.items, 1, 1),
            traffic=20 * self.count * self.pixels + 16 * self._area(1),
        )

    def _area(self, level: int, least_steps: int = -1) -> int:
        """Pixels of a level, all sub-images with more steps than ``least_steps`` together."""
        chosen = self.table[self.table[:, 0, 1] > least_steps]
        return int((chosen[:, level, 1].astype(np.int64) * chosen[:, level, 2]).sum())

    def _over_levels(self, level: int) -> tuple[int, int, int]:
        rows = int(self.table[:, level, 2].max())
        if level == 1:  # rows are numbered alike in all sub-images there
            rows = int((self.table[:, 1, 2] + (self.size["top"] - self.table[:, 0, 0]) // 2).max())
        return self.items, self.count, rows

    def _add(
        self,
        kernel: str,
        args: tuple[Any, ...],
        global_size: tuple[int, ...],
        local_size: tuple[int, ...] | None = None,
        traffic: int = 0,
    ) -> None:
        if local_size is None and self.items == 1:
            local_size = (1,) * len(global_size)  # every new local size costs PoCL a compilation
        self.passes.append(Pass("pyramid", kernel, args, global_size, local_size, self.defines, traffic_bytes=traffic))
