"""The light-field method (Yu, Wang & Yu 2010): the layers warped to many lens views, and the views added up.

Every slot of the layers moves by ``v * C`` pixels in the view from lens point ``v`` (eq. 4; C is its signed CoC
radius), and an atomic minimum over inverse depth decides who is seen (section 3.2). A ray finds its colour in the
layers again (eq. 7), so views hold no colour. Rays that hit a hole are dropped and the rest is renormalised.

With ``peels=1, support="2x2", lookup="winner", dither=False, pattern="halton"`` this is the paper. What the defaults
change was measured (docs/methods/lightfield.md); kernels/lightfield.cl says how.

- All peeled layers are warped and not the first alone, so that most of what were holes is there.
- A slot's support reaches half-way to the neighbours of its own surface and no farther. Fixed supports leave a lattice
  of pin-holes or make silhouettes grow.
- Views take their samples at places that vary within the pixel: a silhouette that moves by part of a pixel covers that
  part on average. What is in focus stays where it is.
- Colour is interpolated between pixels of one surface, and the mip pyramid mixes pixels of one surface only.
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
from .base import FrameShape, Locality, Plan, row_pitch, struct_scalar
from .shading import environment_of, shading_defines, shading_inputs, split_pass

__all__ = ["MAX_VIEWS", "LightField", "Views", "lens_views"]

MAX_VIEWS = 1024

# Constants of kernels/lightfield.cl.
_TILE = 8
_SEGMENT = 32
_MAX_COC_PX = 1 << 20
_SUPPORTS = ("none", "2x2", "3x3", "surface")
_LOOKUPS = ("winner", "bilinear", "jitter")

# Panes of glass one behind the other that keep apart when warped; more fall together, the nearest of them winning.
_MOST_PANES = 8
# A footprint reaches this far beyond half a pixel: steep edges, 4 px, and what rounding adds.
_FOOTPRINT_PX = 6
_MAX_LEVELS = 5
# Below this CoC radius nothing moves by a step of the positions, 1/256 px, and all views are what a pinhole sees.
_NEGLIGIBLE_COC_PX = 1e-3
# Work-items that a CPU core should get, so that none waits for the last one.
_ITEMS_PER_CORE = 2
_WINNER_BYTES = 8
# Share of the work that few tiles leave: finding slots that reach them, mips of all layers.
_TILES_FLOOR = 0.1
# Pixels along a silhouette that say where in its pixel it runs, and one beside it.
_STAIRCASE_PX = 17

_SIZE = np.dtype(
    [
        (name, np.int32)
        for name in (
            "width", "height", "pitch", "peels", "out_width", "out_height", "out_pitch", "guard", "planes",
            "tiles_x", "tiles_y",
        )
    ]
)  # fmt: skip
_LENS = np.dtype(
    [
        ("c1", np.float32), ("c0", np.float32), ("cos4", np.float32), ("cell", np.float32), ("reach", np.int32),
        ("radius", np.float32),
    ]
)  # fmt: skip
_SLOTS = ("slot_at", "slot_key", "slot_coc", "slot_edge", "slot_plane", "slot_count")


class Views(NamedTuple):
    """What shapes the passes of a frame, beside its size."""

    total: int
    aperture: Aperture
    levels: int  # of the mip pyramid, above the layers
    is_shaded: bool = False  # from the views' own points
    panes: int = 0  # of glass, one behind the other


@dataclass(frozen=True)
class LightField:
    """Options of the light-field method.

    Parameters
    ----------
    views : int
        Points on the lens, 1 to 1024. The paper takes 12 to 64.
    peels : int, optional
        The most layers to warp. 1 is the paper's single view; None takes all that the frame has.
    support : {"surface", "none", "2x2", "3x3"}
        Which pixels of a view a slot covers; the last three are the paper's.
    lookup : {"bilinear", "winner", "jitter"}
        Colour of a ray: between the pixels of its surface, that of the slot that it hit, or that of a random pixel in
        its share of the lens.
    mip : bool
        Let rays far from focus see a Gaussian mip pyramid of the layers (eq. 8).
    dither : bool
        Vary from view to view where in a pixel samples are taken.
    pattern : {"spiral", "halton"}
        Points on the lens: those of :func:`cldof.lens_samples`, or the paper's Halton sequence.
    cos4 : bool
        Weaken slanted rays by the fourth power of their cosine. Needs a lens with a focal length; without one the angle
        behind the lens is unknown and all rays count the same.
    memory_mb : float
        Limit for the views' depth and source maps, 8 bytes a pixel, view and plane. Views beyond it are done in
        further batches; the picture is the same.
    warp : {"auto", "views", "atomic", "packed"}
        One work-item a view without atomics, 32-bit atomics in two steps, or 64-bit atomics; all give the same bits.
        "auto" takes the first on CPUs (where loops may be long), else the last where a probe finds 64-bit atomics work,
        else the second.
    seed : int
        Of the lens points.
    cull : bool
        Leave out what no view can see; changes no pixel.
    view_dependent : bool
        Shade what is glossy as each view's point of the lens sees it, in frames that know how (captured with surface
        buffers). False: as the lens centre sees it.
    """

    views: int = 36
    peels: int | None = None
    support: str = "surface"
    lookup: str = "bilinear"
    mip: bool = True
    dither: bool = True
    pattern: str = "spiral"
    cos4: bool = True
    memory_mb: float = 256.0
    warp: str = "auto"
    seed: int = 0
    cull: bool = True
    view_dependent: bool = True

    name = "lightfield"
    simulated_aperture = None

    def __post_init__(self) -> None:
        for name, low, high in (("views", 1, MAX_VIEWS), ("peels", 1, math.inf), ("seed", 0, math.inf)):
            value = getattr(self, name)
            if name == "peels" and value is None:
                continue
            if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
                limit = f"{low} to {high}" if high < math.inf else f"at least {low}"
                raise InputError(f"lightfield: {name} is {value!r}; it must be a whole number, {limit}.")
        for name, choices in (
            ("support", _SUPPORTS),
            ("lookup", _LOOKUPS),
            ("pattern", ("spiral", "halton")),
            ("warp", ("auto", "views", "atomic", "packed")),
        ):
            if getattr(self, name) not in choices:
                raise InputError(f"lightfield: {name} is {getattr(self, name)!r}; choose one of {', '.join(choices)}.")
        if not (isinstance(self.memory_mb, int | float) and self.memory_mb > 0):
            raise InputError(f"lightfield: memory_mb is {self.memory_mb!r}; it must be a positive number.")

    def plan(self, frame: LayeredFrame, lens: Lens) -> Plan:
        """Choose the number of views and mip levels from the CoC range."""
        c1, c0 = lens.coc_coefficients(frame.camera)
        farthest, nearest = frame.shown_inverse_depths
        largest = max(abs(c1 * farthest + c0), abs(c1 * nearest + c0))
        is_shaded = self.view_dependent and frame.is_glossy_through(lens)
        count = self.views if largest >= _NEGLIGIBLE_COC_PX or is_shaded else 1
        # A ray's share of the CoC is pi C^2 / views; a level of the pyramid is as wide as a box of twice its texels.
        cell = math.sqrt(math.pi / count) / 2.0
        levels = 0
        if self.mip and largest > 0.0:
            levels = min(max(0, round(math.log2(largest * cell))), _MAX_LEVELS)
        focal_m = (lens.focal_length_mm or 0.0) * 1e-3
        params = np.zeros((), _LENS)
        params["c1"], params["c0"], params["cell"] = c1, c0, cell
        params["cos4"] = (lens.aperture_radius_m / focal_m) ** 2 if self.cos4 and focal_m else 0.0
        params["radius"] = lens.aperture_radius_m
        params["reach"] = min(math.ceil(largest), _MAX_COC_PX) + _FOOTPRINT_PX
        summary = {
            "method": self.name,
            **{field.name: getattr(self, field.name) for field in fields(self)},
            "views": count,
            "mip_levels": levels,
            "eyes": count if is_shaded else 0,
            "largest_coc_px": largest,
        }
        panes = min(frame.panes, self.peels or frame.panes, _MOST_PANES)
        structure = Views(count, lens.aperture, levels, is_shaded, panes)
        return Plan(structure, {"lens": params[()]}, summary)

    def locality(self, shape: FrameShape, plan: Plan, traits: Traits, tail: float) -> Locality | None:
        """Slots move by their CoC.

        Random pixels and mirrors depend on their place in the image, and panes in focus, or what is in focus before
        the void, are not quite what a pinhole sees.
        """
        views = plan.structure
        assert isinstance(views, Views)
        if self.lookup == "jitter" or views.is_shaded or shape.has_glass or not shape.is_opaque:
            return None
        mips = 4 * 2**views.levels if views.levels else 0
        step = 1.0 / 512.0  # slots that move by less stay where they are
        return Locality(
            align_px=max(64, 2**views.levels),
            margin_px=int(plan.params["lens"]["reach"]) + mips + 2 * _TILE + _STAIRCASE_PX,
            reach_px=lambda coc: coc + _FOOTPRINT_PX + mips,
            rim_px=1,  # rays take their samples all over a pixel, and interpolate
            leak=lambda coc: np.where(coc < step, 2.0 * coc, np.minimum(3.0 * coc + 2.0 / views.total, 1.0)),
            tiles_floor=_TILES_FLOOR,
        )

    def program(self, shape: FrameShape, plan: Plan, traits: Traits) -> FrameProgram:
        """Declare the frame's passes."""
        views = plan.structure
        assert isinstance(views, Views)
        return _Builder(self, shape, views, traits).build()


def lens_views(method: LightField, views: Views) -> NDArray[np.float32]:
    """Lens points and sampling places as kernels/lightfield.cl takes them.

    Returns
    -------
    ndarray, (count, 4), float32
        Point on the lens in radii, x right and y **down**; place within the pixel in whole 1/256 px from its middle.
    """
    table = np.zeros((views.total, 4))
    if views.total > 1:
        index = np.arange(views.total) + 1 + method.seed
        if method.pattern == "halton":
            aperture = views.aperture
            squeeze = (min(1.0, 1.0 / aperture.ratio), min(1.0, aperture.ratio))
            points = aperture._place(_radical_inverse(index, 2), _radical_inverse(index, 3)) * squeeze
        else:
            points = views.aperture.samples(views.total, method.seed)
        table[:, :2] = points * (1.0, -1.0)
        if method.dither:
            places = np.stack([_radical_inverse(index, 5), _radical_inverse(index, 7)], axis=1)
            table[:, 2:] = np.round((places - 0.5) * 254.0)
    return np.ascontiguousarray(table, dtype=np.float32)


def _radical_inverse(index: NDArray[np.integer[Any]], base: int) -> NDArray[np.float64]:
    """Halton's sequence in one base, in (0, 1)."""
    result, digit, rest = np.zeros(len(index)), 1.0, index
    while rest.any():
        digit /= base
        result += digit * (rest % base)
        rest = rest // base
    return result


def _fastest_warp(traits: Traits) -> str:
    """A view fits a CPU core's cache, where atomics take six times as long; others take as few passes as they can."""
    if traits.is_cpu and traits.has_long_loops:
        return "views"
    return "packed" if traits.has_int64_atomics else "atomic"


class _Builder:
    """Lists the passes of one frame."""

    def __init__(self, method: LightField, shape: FrameShape, views: Views, traits: Traits) -> None:
        self.method, self.shape, self.views, self.traits = method, shape, views, traits
        self.peels = min(shape.layers, method.peels or shape.layers)
        self.out_height, self.out_width = shape.output_size
        self.out_pitch = row_pitch(self.out_width)
        self.planes = 1 + views.panes
        self.tiles = (-(-shape.width // _TILE), self.peels * -(-shape.height // _TILE))
        self.size = struct_scalar(
            _SIZE, shape.width, shape.height, shape.pitch, self.peels, self.out_width, self.out_height, self.out_pitch,
            shape.guard_px, self.planes, self.tiles[0], self.tiles[1] // self.peels,
        )  # fmt: skip
        self.slots = self.peels * shape.height * shape.pitch
        if self.slots >= 1 << 31:
            raise InputError(f"lightfield: {self.peels} peels of {shape.width}x{shape.height} are too many to number.")
        view_bytes = self.planes * self.out_height * self.out_pitch * _WINNER_BYTES
        limit = min(int(method.memory_mb * 1e6), traits.max_alloc_bytes)
        self.batch = max(1, min(views.total, limit // view_bytes))
        table = lens_views(method, views)
        pixels = self.out_height * self.out_pitch if self.batch < views.total else 1
        self.buffers = [
            Buffer("color", shape.layers * shape.height * shape.width * 16, Role.INPUT),
            Buffer("inv_depth", shape.layers * shape.height * shape.pitch * 4, Role.INPUT),
            Buffer("image", self.out_height * self.out_width * 16, Role.OUTPUT),
            Buffer("views", table.nbytes, Role.CONSTANT, table),
            *(Buffer(name, self.slots * 4) for name in _SLOTS[:4]),
            Buffer("slot_plane", self.slots),
            Buffer("slot_count", self.peels * shape.height * 4),
            Buffer("cells", self.slots),
            Buffer("winners", self.batch * view_bytes),
            Buffer("sum", pixels * 16),
            Buffer("seen", pixels * 4),
        ]
        self.passes: list[Pass] = []
        self.gaps: tuple[Any, ...] = ()
        if shape.is_sparse:
            self.buffers.append(shape.gaps)
            self.gaps = (read("gaps"),)
        # What rays and the pyramid look up; see kernels/shading.cl.
        self.color = "matte" if views.is_shaded else "color"
        self.lens = Param("lens", _LENS)
        warp = method.warp if method.warp != "auto" else _fastest_warp(traits)
        if warp == "packed" and not traits.has_int64_atomics:
            raise InputError(f"lightfield: warp='packed' needs 64-bit atomics, which {traits.name} does not have.")
        if warp == "views" and not traits.has_long_loops:
            raise InputError(
                f"lightfield: warp='views' needs loops that {traits.name} breaks off; take 'atomic' or 'auto'."
            )
        self.warp = warp
        self.defines = (
            ("LIGHTFIELD_SUPPORT", _SUPPORTS.index(method.support)),
            ("LIGHTFIELD_GLASS", views.panes),
            ("LIGHTFIELD_VOID", int(not shape.is_opaque)),
            ("LIGHTFIELD_LOOKUP", _LOOKUPS.index(method.lookup)),
            ("LIGHTFIELD_LEVELS", views.levels),
            ("LIGHTFIELD_PACKED", int(warp == "packed")),
            ("LIGHTFIELD_SPARSE", int(shape.is_sparse)),
            ("LIGHTFIELD_SHADED", int(views.is_shaded)),
            *(shading_defines(shape) if views.is_shaded else ()),
        )

    def build(self) -> FrameProgram:
        self._cull()
        self._add(
            "lightfield_slots",
            (
                *map(write, (*_SLOTS, "cells")),
                *map(read, ("inv_depth", "color", "tile_open")),
                *self.gaps,
                self.size,
                self.lens,
            ),
            (self.peels * self.shape.height,),
            traffic_bytes=self.slots * 4,
        )
        if self.views.is_shaded:
            split, made = split_pass(self.shape, self.traits)
            self.buffers += [*shading_inputs(self.shape), *made]
            self.passes.append(split)
        mips = self._pyramid()
        for first in range(0, self.views.total, self.batch):
            count = min(self.batch, self.views.total - first)
            if self.warp == "views":
                self._warp_by_view(first, count)
            else:
                self._warp_by_slot(first, count)
            self._synthesize(first, count, mips)
        return FrameProgram.of(self.buffers, self.passes)

    def _cull(self) -> None:
        tiles = self.tiles[0] * self.tiles[1]
        if not self.method.cull:
            everything = np.ones(tiles, np.uint8)
            self.buffers.append(Buffer("tile_open", tiles, Role.CONSTANT, everything))
            return
        self.buffers += [Buffer("tiles", tiles * 8), Buffer("tile_open", tiles)]
        inputs = (read("inv_depth"), read("color"), self.size, self.lens)
        self._add("lightfield_tiles", (write("tiles"), *inputs), self.tiles, traffic_bytes=self.slots * 4)
        self._add("lightfield_cull", (write("tile_open"), read("tiles"), self.size, self.lens), self.tiles)

    def _pyramid(self) -> tuple[Any, ...]:
        """Passes that make the pyramid; what `lightfield_synthesize` takes to read it."""
        if not self.views.levels:
            return ()
        sizes, firsts, total = [(self.shape.width, self.shape.height)], [0], 0
        for _ in range(self.views.levels):
            width, height = ((n + 1) // 2 for n in sizes[-1])
            sizes.append((width, height))
            firsts.append(total)
            total += self.peels * width * height
        self.buffers += [Buffer("mips", total * 16), Buffer("mip_depths", total * 4)]
        for level in range(1, self.views.levels + 1):
            range_ = (sizes[level][0], self.peels * sizes[level][1])
            if level == 1:
                args: tuple[Any, ...] = (
                    write("mips"),
                    write("mip_depths"),
                    read(self.color),
                    read("inv_depth"),
                    self.size,
                )
                self._add("lightfield_shrink", (*args, self.lens), range_)
            else:
                numbers = (self.peels, *sizes[level - 1], firsts[level - 1], firsts[level])
                args = (read_write("mips"), read_write("mip_depths"), self.lens, *map(np.int32, numbers))
                self._add("lightfield_shrink_again", args, range_)
        table = np.array([(*size, first, 0) for size, first in zip(sizes[1:], firsts[1:], strict=True)], np.int32)
        self.buffers.append(Buffer("mip_table", table.nbytes, Role.CONSTANT, table))
        return read("mips"), read("mip_depths"), read("mip_table")

    def _warp_by_view(self, first: int, count: int) -> None:
        wanted = -(-_ITEMS_PER_CORE * self.traits.compute_units // count)
        rows = max(2 * _SEGMENT, -(-self.out_height // wanted))
        self._add(
            "lightfield_views",
            (
                write("winners"),
                *map(read, (*_SLOTS, "views")),
                *self.gaps,
                self.size,
                self.lens,
                np.int32(first),
                np.int32(rows),
            ),
            (count, -(-self.out_height // rows)),
            traffic_bytes=count * (self.slots * 16 + self.out_height * self.out_pitch * _WINNER_BYTES * self.planes),
        )

    def _warp_by_slot(self, first: int, count: int) -> None:
        words = count * self.planes * self.out_height * self.out_pitch * 2
        self._add("lightfield_clear", (write("winners"), np.uint32(words)), (words,), traffic_bytes=words * 4)
        kernels = ("lightfield_packed",) if self.warp == "packed" else ("lightfield_depths", "lightfield_sources")
        for kernel in kernels:
            self._add(
                kernel,
                (read_write("winners"), *map(read, (*_SLOTS, "views")), self.size, np.int32(first)),
                (self.slots, count),
                traffic_bytes=count * (self.slots * 16 + words * 4 // count),
            )

    def _synthesize(self, first: int, count: int, mips: tuple[Any, ...]) -> None:
        access = write if first == 0 else read_write
        is_last = first + count == self.views.total
        pixels = self.out_height * self.out_width
        shading: tuple[Any, ...] = ()
        if self.views.is_shaded:
            shading = tuple(map(read, ("color", "surface", "lighting", environment_of(self.shape))))
        self._add(
            "lightfield_synthesize",
            (
                (read_write if self.gaps else write)("image"),
                access("sum"),
                access("seen"),
                *map(read, ("winners", self.color, "inv_depth", "cells", "views")),
                *self.gaps,
                *mips,
                *shading,
                self.size,
                self.lens,
                np.int32(first),
                np.int32(count),
                np.int32(is_last),
            ),
            (-(-self.out_width // _SEGMENT), self.out_height),
            traffic_bytes=count * pixels * (self.planes * _WINNER_BYTES + 16) + pixels * 16,
        )

    def _add(self, kernel: str, args: tuple[Any, ...], global_size: tuple[int, ...], traffic_bytes: int = 0) -> None:
        # Every new local size costs PoCL a compilation.
        local_size = (1,) * len(global_size) if self.traits.is_cpu and self._has_heavy_items(kernel) else None
        self.passes.append(
            Pass("lightfield", kernel, args, global_size, local_size, self.defines, traffic_bytes=traffic_bytes)
        )

    @staticmethod
    def _has_heavy_items(kernel: str) -> bool:
        return kernel not in ("lightfield_clear", "lightfield_depths", "lightfield_sources", "lightfield_packed")
