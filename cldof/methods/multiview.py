"""Multiview synthesis (Lee, Eisemann & Seidel 2009): lens rays traced through a layered image-based scene.

The peels are split into layers of equal growth of the signed circle of confusion (eq. 4). Each pixel sends one ray per
lens sample, which meets the layers front to back and is thickened to a cone as wide as the samples are apart
(section 4.4). Rays that meet what lies outside of the frame, or what no peel holds, are dropped and the rest
renormalised; a pixel that has lost them all shows what a pinhole sees. The aperture may have any shape.

Where this differs from the paper, docs/methods/multiview.md has the measurements:

- Layers are thin (half a pixel of CoC where 32 of them allow it), so that a ray meets each at one place and needs no
  search by false position. All pixels of a run then move alike, and look-ups are contiguous.
- Layers overlap as far as the surface slopes from pixel to pixel, not by a fixed 10 %.
- Cones see means over windows of exactly their width, not mip levels.
- The number of rays follows the blur of what a cell of 16 x 16 pixels can see.
- Glossy surfaces are shaded from points all over the lens before cones take their means, not at the hit after means of
  normals and exponents were taken.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..frame import LayeredFrame
from ..host.device import Traits
from ..host.passes import Buffer, FrameProgram, Param, Pass, Role, read, read_write, write
from ..lens import Aperture, Lens
from .base import FrameShape, Locality, Plan, struct_scalar
from .shading import shading_inputs, split_pass, view_pass

__all__ = ["CELL", "MAX_LAYERS", "MAX_RAYS", "Cone", "LensLayers", "Multiview", "RaySets", "cones", "ray_sets"]

# Constants of kernels/multiview.cl.
MAX_LAYERS = 32
CELL = 16
_HALO = 16
_RUN = 64

MAX_RAYS = 1024

# CoC growth from layer to layer (px) when none is given. Thinner layers gain less than 0.3 dB.
_USUAL_DELTA_PX = 0.5
# Growth rises on this grid, so that a lens in motion keeps to few pass lists.
_STEPS_PER_OCTAVE = 8
# Layers may not take more than this on the device; there are then fewer of them.
_LAYER_BYTES = 1 << 30
_FEWEST_LAYERS = 5

# Width of a cone over the mean distance of lens samples.
_CONE_WIDTH = 1.1
# Rays per px^2 of the largest circle of confusion that a cell can see: more are not traced. Costs up to 0.2 dB.
_RAYS_PER_PX2 = 1.0
# Pixels of the jitter pattern along x and y.
_JITTER = 4

_SIZE = np.dtype([(n, np.int32) for n in ("width", "height", "pitch", "peels", "layers", "cells_x", "cells_y")])
_FLOAT = np.dtype(np.float32)
# Farther than any CoC in px, nearer than slots with nothing in them: the first and last layers have no end.
_ENDLESS = 1e20
# Beyond any frame; shifts are cut there so that sums with them fit an int.
_FARTHEST_PX = 1 << 20


class LensLayers(NamedTuple):
    """Which layers there are, through what aperture they are seen, and from how many of its points they are shaded.

    ``eyes`` is 0 where all that the lens sees looks the same from all of it.
    """

    front: int
    back: int
    delta_px: float
    aperture: Aperture
    eyes: int = 0

    @property
    def total(self) -> int:
        """K."""
        return self.front + 1 + self.back

    @property
    def coc(self) -> NDArray[np.float64]:
        """Signed CoC radius in px at which rays meet each layer, (K,), rising; 0 for the layer in focus."""
        return np.arange(-self.front, self.back + 1, dtype=np.float64) * self.delta_px

    @property
    def bounds(self) -> NDArray[np.float32]:
        """CoC in px where layers begin, (K + 1,); layer k reaches from ``bounds[k]`` to ``bounds[k + 1]``."""
        bounds = (np.arange(-self.front, self.back + 2) - 0.5) * self.delta_px
        bounds[0], bounds[-1] = -_ENDLESS, _ENDLESS
        return bounds.astype(np.float32)


class Cone(NamedTuple):
    """Window of a mean: ``2 * radius + 1`` whole pixels and ``edge`` of one more at either side."""

    radius: int
    edge: float


class RaySets(NamedTuple):
    """Rays of all sets as the kernels take them.

    Attributes
    ----------
    ranges : ndarray of int32, (groups, sets * patterns, 2)
        First ray and number of rays. There is one group for each eye, of the rays closest to it; one if there are none.
    shifts : ndarray of int32, (rays, K, 2)
        How many pixels right and down each ray has moved at each layer.
    needs : ndarray of int32, (K,)
        Which set the blur of a layer asks for.
    eyes : ndarray, (groups, 2)
        Middle of each group on the lens: right and up, in units of its radius.
    """

    ranges: NDArray[np.int32]
    shifts: NDArray[np.int32]
    needs: NDArray[np.int32]
    eyes: NDArray[np.float64]


@dataclass(frozen=True)
class Multiview:
    """Options of the multiview method.

    Parameters
    ----------
    rays : int
        Rays per pixel, 1 to 1024: points on the lens.
    layers : int
        The most layers K, 5 to 32. Growth rises when the CoC range asks for more.
    delta_px : float, optional
        CoC growth from one layer to the next in px (delta of eq. 4), at least 0.1. None: 0.5.
    cone : bool, optional
        Thicken rays to cones. False leaves the grain of single rays. None: wherever there are layers.
    traversal : {"layers", "peels"}
        "peels" walks the peels themselves, layer by layer, instead of images of the layers: without cones, slower, and
        without their memory.
    jitter : bool
        Give the pixels of each block of 4 x 4 different sets of rays: what would be copies of an edge becomes noise.
    adaptive : bool
        Trace fewer rays where all that can be seen is little blurred.
    cull : bool
        Walk the layers that a cell can see, not all. Changes no pixel; False is for measurements.
    seed : int
        Of the lens samples.
    view_dependent : bool
        Shade what is glossy as points of the lens see it, in frames that know how (captured with surface buffers) and
        where it shows. False: as the lens centre sees it.
    eyes : int
        From how many points at most; as many as rays for each ray's own.
    """

    rays: int = 64
    layers: int = MAX_LAYERS
    delta_px: float | None = None
    cone: bool | None = None
    traversal: str = "layers"
    jitter: bool = False
    adaptive: bool = True
    cull: bool = True
    seed: int = 0
    view_dependent: bool = True
    eyes: int = 16

    name = "multiview"
    simulated_aperture = None

    def __post_init__(self) -> None:
        limits = {"rays": (1, MAX_RAYS), "layers": (_FEWEST_LAYERS, MAX_LAYERS), "seed": (0, 2**31 - 1)}
        limits["eyes"] = (1, MAX_RAYS)
        for name, (low, high) in limits.items():
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
                raise InputError(f"multiview: {name} is {value!r}; it must be a whole number from {low} to {high}.")
        if self.traversal not in ("layers", "peels"):
            raise InputError(f"multiview: traversal is {self.traversal!r}; choose one of layers, peels.")
        if self.cone and self.traversal == "peels":
            raise InputError("multiview: cone=True needs traversal='layers'; peels have nothing to average.")
        delta = self.delta_px
        if delta is not None and not (isinstance(delta, int | float) and 0.1 <= delta < math.inf):
            raise InputError(f"multiview: delta_px is {delta!r}; it must be a number of at least 0.1 px.")

    @property
    def has_cones(self) -> bool:
        """Whether rays are thickened."""
        return self.traversal == "layers" if self.cone is None else self.cone

    def plan(self, frame: LayeredFrame, lens: Lens) -> Plan:
        """Choose the layers from the CoC range."""
        c1, c0 = lens.coc_coefficients(frame.camera)
        farthest, nearest = frame.inverse_depth_range
        if not frame.is_opaque:
            farthest = 0.0  # the void is a surface at infinity
        near_px, far_px = max(0.0, -(c1 * nearest + c0)), max(0.0, c1 * farthest + c0)
        shape = FrameShape.of(frame)
        most = self.layers
        if self.traversal == "layers":
            most = min(most, max(_FEWEST_LAYERS, _LAYER_BYTES // (shape.height * shape.pitch * 16) - 2))
        layers = _layers(near_px, far_px, self.delta_px or _USUAL_DELTA_PX, most, lens.aperture)
        if self.view_dependent and frame.is_glossy_through(lens):
            layers = layers._replace(eyes=min(self.eyes, self.rays))
        summary = {
            "method": self.name,
            **{field.name: getattr(self, field.name) for field in fields(self)},
            "layers": layers.total,
            "focus_layer": layers.front,
            "delta_px": layers.delta_px,
            "largest_near_coc_px": near_px,
            "largest_far_coc_px": far_px,
            "eyes": layers.eyes,
        }
        params = {"c1": np.float32(c1), "c0": np.float32(c0)}
        if layers.eyes:
            params["aperture_radius_m"] = np.float32(lens.aperture_radius_m)
        return Plan(layers, params, summary)

    def locality(self, shape: FrameShape, plan: Plan, traits: Traits, tail: float) -> Locality | None:
        """Rays go no farther than their CoC; those of the layer in focus do not leave their pixel.

        Shading from the points of the lens depends on the place in the image, also in focus.
        """
        layers = plan.structure
        assert isinstance(layers, LensLayers)
        if layers.eyes:
            return None
        largest = layers.delta_px * (max(layers.front, layers.back) + 1)
        cone = _HALO if self.has_cones else 0
        return Locality(
            align_px=_RUN,
            # Cells look for layers in whole cells around them.
            margin_px=math.ceil(largest) + cone + 3 * CELL,
            reach_px=lambda coc: coc + layers.delta_px + cone + 2.0,
            leak=lambda coc: np.where(coc < 0.49 * layers.delta_px, 0.0, 1.0),
            counts_slopes=True,
        )

    def program(self, shape: FrameShape, plan: Plan, traits: Traits) -> FrameProgram:
        """Declare the frame's passes."""
        layers = plan.structure
        assert isinstance(layers, LensLayers)
        return _Builder(self, shape, layers, traits).build()


def _layers(near_px: float, far_px: float, delta_px: float, most: int, aperture: Aperture) -> LensLayers:
    for exponent in range(10**6):
        delta = delta_px * math.pow(2.0, exponent / _STEPS_PER_OCTAVE)
        # The layer in focus takes half a step of either side.
        front, back = (max(0, math.ceil(px / delta - 0.5)) for px in (near_px, far_px))
        if front + 1 + back <= most:
            return LensLayers(front, back, delta, aperture)
    raise AssertionError("a step that is large enough needs one layer a side")


def cones(layers: LensLayers, rays: int) -> list[Cone | None]:
    """Window of each layer's cones; None where they are no wider than a pixel."""
    # A uniform disc has a variance of 1/4 along each axis and an area of pi.
    deviations = layers.aperture.samples(256).std(axis=0)
    distance = math.sqrt(4.0 * math.pi * float(deviations.prod()) / rays)
    windows: list[Cone | None] = []
    for coc in np.abs(layers.coc).tolist():
        half = min((_CONE_WIDTH * distance * coc - 1.0) / 2.0, _HALO - 2.0)
        windows.append(Cone(int(half), half - int(half)) if half > 0.0 else None)
    return windows


def ray_sets(method: Multiview, layers: LensLayers) -> RaySets:
    """Shifts of all rays at all layers.

    The first set has one ray, for cells in focus; powers of two below ``rays`` follow when adaptive; ``rays`` come
    last. With jitter there are 16 patterns of each.
    """
    groups = max(1, layers.eyes)  # every one has rays in every set
    counts = [groups]
    if method.adaptive:
        counts += [1 << n for n in range(2, 10) if groups < 1 << n < method.rays]
    counts.append(method.rays)
    patterns = _JITTER**2 if method.jitter else 1
    ranges, shifts = [], []
    first = 0
    for count in counts:
        for pattern in range(patterns):
            points = layers.aperture.samples(count, method.seed * patterns + pattern)
            order, sizes = _grouped(points, groups)
            ends = first + np.cumsum(sizes)
            ranges.append(np.stack([ends - sizes, sizes], axis=1))
            shifts.append(_shifts(layers, points[order]))
            first += count
    points = layers.aperture.samples(method.rays, method.seed * patterns)
    order, sizes = _grouped(points, groups)
    eyes = np.array([part.mean(axis=0) for part in np.split(points[order], np.cumsum(sizes)[:-1])])
    all_shifts = np.concatenate(shifts)
    needs = np.full(layers.total, len(counts) - 1)
    if method.adaptive:
        wanted = _RAYS_PER_PX2 * math.pi * (np.abs(layers.coc) + 0.5) ** 2
        needs = np.minimum(np.maximum(np.searchsorted(counts, wanted), 1), len(counts) - 1)
    if method.adaptive or layers.total == 1:
        needs[np.abs(all_shifts).max(axis=(0, 2)) == 0] = 0
    return RaySets(np.stack(ranges, axis=1).astype(np.int32), all_shifts, needs.astype(np.int32), eyes)


def _grouped(points: NDArray[np.float64], groups: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Points in an order that has ``groups`` of neighbours one after the other, and the size of each.

    Halves of halves, across x and y in turn, so that the groups of any two sets of points lie in about the same places.
    """
    order, sizes = [], []

    def split(part: NDArray[np.int64], count: int, axis: int) -> None:
        if count == 1:
            order.append(part)
            sizes.append(len(part))
            return
        part = part[np.argsort(points[part, axis], kind="stable")]
        middle = round(len(part) * (count // 2) / count)
        split(part[:middle], count // 2, 1 - axis)
        split(part[middle:], count - count // 2, 1 - axis)

    split(np.arange(len(points)), groups, 0)
    return np.concatenate(order), np.array(sizes)


def _shifts(layers: LensLayers, points: NDArray[np.float64]) -> NDArray[np.int32]:
    # The ray through lens point v meets C at p + C * (-v.x, v.y), y down.
    places = np.floor((points * (-1.0, 1.0))[:, None] * layers.coc[None, :, None] + 0.5)
    return np.asarray(np.clip(places, -_FARTHEST_PX, _FARTHEST_PX), dtype=np.int32)


class _Builder:
    """Lists the passes of one frame."""

    def __init__(self, method: Multiview, shape: FrameShape, layers: LensLayers, traits: Traits) -> None:
        self.method, self.shape, self.layers = method, shape, layers
        self.is_cpu = traits.is_cpu
        self.cells = (-(-shape.width // CELL), -(-shape.height // CELL))
        values = (shape.width, shape.height, shape.pitch, shape.layers, layers.total, *self.cells)
        self.size = struct_scalar(_SIZE, *values)
        self.lens = (Param("c1", _FLOAT), Param("c0", _FLOAT))
        self.stride = _JITTER if method.jitter else 1
        self.peeled = method.traversal == "peels"
        self.defines = (
            ("MULTIVIEW_VOID", int(not shape.is_opaque)),
            ("MULTIVIEW_STRIDE", self.stride),
            ("MULTIVIEW_PEELED", int(self.peeled)),
            ("MULTIVIEW_PARTS", int(layers.eyes > 0)),
        )
        self.color = "view" if layers.eyes else "color"
        self.peel_bytes = shape.layers * shape.height * shape.pitch * 4
        self.layer_bytes = shape.height * shape.pitch * 16
        self.levels = max(self.cells).bit_length()
        self.passes: list[Pass] = []
        slots = (0 if self.peeled else layers.total) + (not shape.is_opaque)
        cell_bytes = self.cells[0] * self.cells[1] * 4
        self.buffers = [
            Buffer("color", shape.layers * shape.height * shape.width * 16, Role.INPUT),
            Buffer("inv_depth", self.peel_bytes, Role.INPUT),
            Buffer("image", math.prod(shape.output_size) * 16, Role.OUTPUT),
            Buffer("extent", self.peel_bytes),
            Buffer("nbuffer", self.levels * cell_bytes),
            Buffer("lists", cell_bytes),
            Buffer("sets", cell_bytes),
        ]
        if slots:
            self.buffers.append(Buffer("layers", slots * self.layer_bytes))

    def build(self) -> FrameProgram:
        windows: list[Cone | None] = [None] * self.layers.total
        if self.method.has_cones:
            windows = cones(self.layers, self.method.rays)
        rays = ray_sets(self.method, self.layers)
        self._classify(windows, rays)
        if self.layers.eyes:
            split, made = split_pass(self.shape, self.is_cpu)
            self.passes.append(split)
            peels = Buffer("view", self.shape.layers * self.shape.height * self.shape.width * 16)
            self.buffers += [*shading_inputs(self.shape), *made, peels]
        if any(windows):
            self.buffers.append(Buffer("split", self.layer_bytes))
        self._constant("shifts", rays.shifts)
        if self.peeled:
            self._constant("bounds", self.layers.bounds)
        for group, ranges in enumerate(rays.ranges):
            if self.layers.eyes:
                self.passes.append(view_pass(self.shape, self.is_cpu, rays.eyes[group]))
            if not self.peeled:
                self._split(windows)
            if not self.shape.is_opaque:
                self._past()
            self._trace(group, ranges)
        if self.layers.eyes:
            self._finish()
        return FrameProgram.of(self.buffers, self.passes)

    def _classify(self, windows: list[Cone | None], rays: RaySets) -> None:
        """Which layers a cell can see."""
        shape = self.shape
        self._add(
            "multiview_extent",
            (write("extent"), read("inv_depth"), self.size, *self.lens),
            (shape.pitch // 16, shape.height, shape.layers),
            2 * self.peel_bytes,
        )
        low = np.float32((-self.layers.front - 0.5) * self.layers.delta_px)
        delta = np.float32(self.layers.delta_px)
        self._add(
            "multiview_cells",
            (write("nbuffer"), read("inv_depth"), read("extent"), self.size, *self.lens, low, delta),
            self.cells,
            2 * self.peel_bytes,
        )
        for level in range(1, self.levels):
            self._add("multiview_nbuffer", (read_write("nbuffer"), self.size, np.int32(level)), self.cells)
        moves = np.abs(rays.shifts).max(axis=(0, 2))
        halos = np.array([window.radius + 1 if window else 0 for window in windows])
        self._constant("reach", (-(-(moves + halos) // CELL)).astype(np.int32))
        self._constant("needs", rays.needs)
        self._add(
            "multiview_lists",
            (
                write("lists"),
                write("sets"),
                read("nbuffer"),
                read("reach"),
                read("needs"),
                self.size,
                np.int32(self.levels),
                np.int32(self.method.cull),
            ),
            self.cells,
        )

    def _split(self, windows: list[Cone | None]) -> None:
        """Fill the layers, as cones see them."""
        bounds = self.layers.bounds
        for layer, window in enumerate(windows):
            stack = write("layers") if layer == 0 else read_write("layers")
            number = np.int32(layer)
            self._add(
                "multiview_split",
                (
                    stack if window is None else write("split"),
                    read(self.color),
                    read("inv_depth"),
                    read("extent"),
                    read("nbuffer"),
                    self.size,
                    *self.lens,
                    bounds[layer],
                    bounds[layer + 1],
                    number,
                    number if window is None else np.int32(0),
                ),
                self.cells,
                self.layer_bytes,
            )
            if window is None:
                continue
            self._add(
                "multiview_cone",
                (
                    stack,
                    read("split"),
                    read("nbuffer"),
                    self.size,
                    number,
                    number,
                    np.int32(window.radius),
                    np.float32(window.edge),
                ),
                (-(-self.shape.pitch // _RUN), self.cells[1]),
                2 * self.layer_bytes,
            )

    def _past(self) -> None:
        stack, slot = (write("layers"), 0) if self.peeled else (read_write("layers"), self.layers.total)
        self._add(
            "multiview_past",
            (stack, read("color"), self.size, np.int32(slot)),
            (1, self.shape.height),
            self.layer_bytes,
        )

    def _trace(self, group: int, ranges: NDArray[np.int32]) -> None:
        ray_sets = f"ray_sets{group}"
        self._constant(ray_sets, ranges)
        height, width = self.shape.output_size
        peels: tuple[Any, ...] = ()
        if self.peeled:
            peels = (*(read(name) for name in ("inv_depth", "extent", "bounds")), *self.lens)
        out = write("image")
        if self.layers.eyes:
            out = write("parts") if group == 0 else read_write("parts")
        self._add(
            "multiview_trace",
            (
                out,
                # Where there are no layers this is only a place-holder.
                read("layers" if not self.peeled or not self.shape.is_opaque else self.color),
                read("lists"),
                read("sets"),
                read(ray_sets),
                read("shifts"),
                read(self.color),
                *peels,
                self.size,
                np.int32(self.shape.guard_px),
                *((np.int32(group == 0),) if self.layers.eyes else ()),
            ),
            (-(-self.shape.width // (16 * self.stride)), height),
            height * width * 16 * (int(ranges[-1, 1]) + 1),
        )

    def _finish(self) -> None:
        height, width = self.shape.output_size
        self.buffers.append(Buffer("parts", height * width * 4 * (4 if self.shape.is_opaque else 5)))
        self._add(
            "multiview_finish",
            (write("image"), read("parts"), read("color"), self.size, np.int32(self.shape.guard_px)),
            (1, height),
            height * width * 32,
        )

    def _constant(self, name: str, data: NDArray[Any]) -> None:
        data = np.ascontiguousarray(data)
        self.buffers.append(Buffer(name, data.nbytes, Role.CONSTANT, data))

    def _add(self, kernel: str, args: tuple[Any, ...], extent: tuple[int, ...], traffic_bytes: int = 0) -> None:
        local_size = (1,) * len(extent) if self.is_cpu else None  # every new local size costs PoCL a compilation
        self.passes.append(
            Pass("multiview", kernel, args, extent, local_size, self.defines, traffic_bytes=traffic_bytes)
        )
