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
- The number of rays follows the blur of what a cell of 16 x 16 pixels can see, and rises where light is bright.
- Frames may have several samples a pixel, which layers take in; around the focus they are thinner then.
- Glossy surfaces are shaded from points all over the lens before cones take their means, not at the hit after means of
  normals and exponents were taken.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..frame import LayeredFrame
from ..host.device import Traits
from ..host.passes import Buffer, FrameProgram, Param, Pass, Role, read, read_write, write
from ..lens import Aperture, Lens
from .base import FrameShape, Locality, Plan, row_pitch, struct_scalar
from .shading import shading_inputs, split_pass, view_pass

__all__ = [
    "CELL",
    "MAX_LAYERS",
    "MAX_RAYS",
    "Cone",
    "LensLayers",
    "Multiview",
    "RaySets",
    "cones",
    "ray_sets",
    "shift_scales",
]

# Constants of kernels/multiview.cl.
MAX_LAYERS = 32
CELL = 16
_HALO = 16  # times the supersampling
_RUN = 64

MAX_RAYS = 1024

# CoC growth from layer to layer (px) when none is given. Thinner layers gain less than 0.3 dB.
_USUAL_DELTA_PX = 0.5
# Growth rises on this grid, so that a lens in motion keeps to few pass lists.
_STEPS_PER_OCTAVE = 8
# Layers may not take more than this on the device; there are then fewer of them.
_LAYER_BYTES = 1 << 30
_FEWEST_LAYERS = 5

# With several samples a pixel, steps and number of layers to either side of the focus where edges are sharpest.
_FINE_DELTA_PX, _FINE_LAYERS = 0.25, 4
_FEWEST_TO_REFINE = 24

# Width of a cone over the mean distance of lens samples.
_CONE_WIDTH = 1.1
# With several samples a pixel: below this C a window does all of the blur, up to that one it is taken off the rays'.
_WINDOW_PX, _MATCHED_PX = 0.8, 4.0
# Layers nearer to the focus are met in their middle: there whole pixels of shift blur more than they should.
_CENTRED_PX = 0.8
# Rays that move by less all stay in their pixel.
_STILL_PX = 0.499
# Light above this (constant of kernels/multiview.cl) that is blurred by so many px gets so many times the rays.
_BRIGHT, _BRIGHT_PX, _BRIGHT_RAYS = 1.5, 1.5, 4
# Binary search in peels pays where layers grow by more than this: twice. Below, as many rays as take the same time gain
# more.
_COARSE_PX, _USUAL_HALVINGS = 2.0, 2
# Rays per px^2 of the largest circle of confusion that a cell can see: more are not traced. Costs up to 0.2 dB.
_RAYS_PER_PX2 = 1.0
# Pixels of the jitter pattern along x and y, and the order in which Bayer 1973 fills the pattern: row by row.
_JITTER = 4
_BAYER = (0, 8, 2, 10, 12, 4, 14, 6, 3, 11, 1, 9, 15, 7, 13, 5)

_SIZE = np.dtype([(n, np.int32) for n in ("width", "height", "pitch", "peels", "layers", "cells_x", "cells_y")])
_STEPS = np.dtype([(n, np.float32) for n in ("fine", "coarse", "turn", "front")])
_FLOAT = np.dtype(np.float32)
# Farther than any CoC in px, nearer than slots with nothing in them: the first and last layers have no end.
_ENDLESS = 1e20


class LensLayers(NamedTuple):
    """Which layers there are, through what aperture they are seen, and from how many of its points they are shaded.

    Layers around the focus may be thinner: ``fine`` of them to either side are ``fine_px`` thick, the others
    ``delta_px``. ``eyes`` is 0 where all that the lens sees looks the same from all of it.
    """

    front: int
    back: int
    delta_px: float
    aperture: Aperture
    eyes: int = 0
    fine: int = 0
    fine_px: float = 0.0

    @property
    def total(self) -> int:
        """K."""
        return self.front + 1 + self.back

    @property
    def steps(self) -> tuple[float, float, float, float]:
        """Steps near the focus and beyond, the C in px where they change, and the number of the layer in focus."""
        near = self.fine_px or self.delta_px
        return near, self.delta_px, (self.fine + 0.5) * near, float(self.front)

    def _place(self, number: NDArray[np.float64]) -> NDArray[np.float64]:
        near, step, turn, _ = self.steps
        away = np.abs(number)
        return np.sign(number) * np.where(away <= self.fine + 0.5, away * near, turn + (away - self.fine - 0.5) * step)

    @property
    def coc(self) -> NDArray[np.float64]:
        """Signed CoC radius in px at the middle of each layer, (K,), rising; 0 for the layer in focus.

        With ``Multiview.is_centred`` rays meet a layer at the mean of what it holds instead, if there is something.
        """
        return self._place(np.arange(-self.front, self.back + 1, dtype=np.float64))

    @property
    def limits(self) -> NDArray[np.float64]:
        """CoC in px where layers begin, (K + 1,)."""
        return self._place(np.arange(-self.front, self.back + 2, dtype=np.float64) - 0.5)

    @property
    def bounds(self) -> NDArray[np.float32]:
        """As ``limits``, but without end: layer k reaches from ``bounds[k]`` to ``bounds[k + 1]``."""
        bounds = self.limits
        bounds[0], bounds[-1] = -_ENDLESS, _ENDLESS
        return bounds.astype(np.float32)

    @property
    def largest(self) -> NDArray[np.float64]:
        """The largest blur radius in px that a layer may be met at, (K,)."""
        limits = np.abs(self.limits)
        return np.maximum(limits[1:], limits[:-1])


class Cone(NamedTuple):
    """Window of a mean, in pixels of the peels.

    ``taps`` whole ones from ``first`` on, counted from the pixel's own first one, and ``edge`` of one more at either
    side.
    """

    first: int
    taps: int
    edge: float


class RaySets(NamedTuple):
    """Rays of all sets as the kernels take them.

    Attributes
    ----------
    ranges : ndarray of int32, (groups, sets * patterns, 2)
        First ray and number of rays. There is one group for each eye, of the rays closest to it; one if there are none.
    points : ndarray of float32, (rays, 2)
        Where a ray stands per px of C: right and down, at most 1 or so.
    needs : ndarray of int32, (K, 2)
        Which set the blur of a layer asks for, and which bright light in it.
    eyes : ndarray, (groups, 2)
        Middle of each group on the lens: right and up, in units of its radius.
    """

    ranges: NDArray[np.int32]
    points: NDArray[np.float32]
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
    refine_steps : int, optional
        With "peels": how often the way of a ray through a layer is halved in search of what it meets, 0 to 4: binary
        search after a linear one. ``centred`` says nothing then. None: twice where layers grow by more than 2 px
        of CoC, else not at all.
    jitter : bool
        Give the pixels of each block of 4 x 4 different sets of rays: what would be copies of an edge becomes noise.
    adaptive : bool
        Trace fewer rays where all that can be seen is little blurred.
    cull : bool
        Walk the layers that a cell can see, not all. Changes no pixel; False is for measurements.
    centred : bool, optional
        Meet each layer at the mean CoC of what it holds in the frame, not in its middle: 0.7 dB better in the median of
        our scenes, but the planner cannot leave parts of the frame out. None: with several samples a pixel.
    highlights : bool
        Trace four times the rays where light above 1 is blurred: its discs show every ray.
    supersample : int
        Frames have this many times the pixels of the image along x and y; ``Renderer(supersample=...)`` sets it. Layers
        take all of them in, so that rays, memory for layers and most of the time stay those of the image.
    antialias : bool
        With several samples a pixel: smooth edges in focus. False: a pixel in focus is what stands at its middle, as
        in references without sub-pixel jitter; for odd ``supersample``.
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
    refine_steps: int | None = None
    jitter: bool = False
    adaptive: bool = True
    cull: bool = True
    centred: bool | None = None
    highlights: bool = True
    supersample: int = 1
    antialias: bool = True
    seed: int = 0
    view_dependent: bool = True
    eyes: int = 16

    name = "multiview"
    simulated_aperture = None

    def __post_init__(self) -> None:
        limits = {"rays": (1, MAX_RAYS), "layers": (_FEWEST_LAYERS, MAX_LAYERS), "seed": (0, 2**31 - 1)}
        limits |= {"eyes": (1, MAX_RAYS), "supersample": (1, 8)}
        if self.refine_steps is not None:
            limits["refine_steps"] = (0, 4)
        for name, (low, high) in limits.items():
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
                raise InputError(f"multiview: {name} is {value!r}; it must be a whole number from {low} to {high}.")
        if self.traversal not in ("layers", "peels"):
            raise InputError(f"multiview: traversal is {self.traversal!r}; choose one of layers, peels.")
        if self.cone and self.traversal == "peels":
            raise InputError("multiview: cone=True needs traversal='layers'; peels have nothing to average.")
        if self.refine_steps and self.traversal == "layers":
            raise InputError(
                f"multiview: refine_steps is {self.refine_steps}; it needs traversal='peels': images of layers hold no "
                "depth to search."
            )
        if self.traversal == "peels" and self.supersample > 1:
            raise InputError("multiview: supersample needs traversal='layers'; scale the image down instead.")
        if not self.antialias and self.supersample > 1 and self.supersample % 2 == 0:
            raise InputError(
                f"multiview: supersample is {self.supersample} with antialias=False; use an odd number, which has a "
                "sample at the middle of each pixel."
            )
        delta = self.delta_px
        if delta is not None and not (isinstance(delta, int | float) and 0.1 <= delta < math.inf):
            raise InputError(f"multiview: delta_px is {delta!r}; it must be a number of at least 0.1 px.")

    @property
    def is_centred(self) -> bool:
        """Whether layers are met at the mean of what they hold."""
        return self.supersample > 1 if self.centred is None else self.centred

    @property
    def has_cones(self) -> bool:
        """Whether rays are thickened."""
        return self.traversal == "layers" if self.cone is None else self.cone

    def halvings(self, layers: LensLayers) -> int:
        """How often the way of rays through these layers is halved."""
        if self.traversal == "layers":
            return 0
        if self.refine_steps is not None:
            return self.refine_steps
        return _USUAL_HALVINGS if layers.delta_px > _COARSE_PX else 0

    def supersampled(self, factor: int) -> Multiview:
        """This method for frames with ``factor`` times the pixels; itself where it cannot take them in."""
        return replace(self, supersample=factor) if self.traversal == "layers" else self

    def plan(self, frame: LayeredFrame, lens: Lens) -> Plan:
        """Choose the layers from the CoC range."""
        c1, c0 = (value / self.supersample for value in lens.coc_coefficients(frame.camera))
        farthest, nearest = frame.inverse_depth_range
        if not frame.is_opaque:
            farthest = 0.0  # the void is a surface at infinity
        near_px, far_px = max(0.0, -(c1 * nearest + c0)), max(0.0, c1 * farthest + c0)
        shape = FrameShape.of(frame)
        most = self.layers
        if self.traversal == "layers":
            layer_bytes = shape.height * shape.pitch * 16 // self.supersample**2
            most = min(most, max(_FEWEST_LAYERS, _LAYER_BYTES // layer_bytes - 2))
        refined = self.supersample > 1 and most >= _FEWEST_TO_REFINE
        layers = _layers(near_px, far_px, self.delta_px or _USUAL_DELTA_PX, most, lens.aperture, refined)
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
            "refine_steps": self.halvings(layers),
            "highlight_rays": min(_BRIGHT_RAYS * self.rays, MAX_RAYS),
            "highlight_above": _BRIGHT,
            "highlight_coc_px": _BRIGHT_PX,
        }
        params = {"c1": np.float32(c1), "c0": np.float32(c0)}
        if layers.eyes:
            params["aperture_radius_m"] = np.float32(lens.aperture_radius_m)
        return Plan(layers, params, summary)

    def locality(self, shape: FrameShape, plan: Plan, traits: Traits, tail: float) -> Locality | None:
        """Rays go no farther than their CoC; those of the layer in focus do not leave their pixel.

        Shading from the points of the lens depends on the place in the image, also in focus; where layers are met
        depends on all of the frame.
        """
        layers = plan.structure
        assert isinstance(layers, LensLayers)
        if layers.eyes or self.is_centred or self.supersample > 1:
            return None
        halvings = self.halvings(layers)
        # Slots in the layer in focus stay in their pixel; after a search for them, those that rays do not leave.
        still = 0.49 * layers.delta_px if not halvings or layers.delta_px < 1.0 else 0.0
        largest = layers.delta_px * (max(layers.front, layers.back) + 1)
        cone = _HALO if self.has_cones else 0
        return Locality(
            align_px=_RUN,
            # Cells look for layers in whole cells around them.
            margin_px=math.ceil(largest) + cone + 3 * CELL,
            reach_px=lambda coc: coc + layers.delta_px + cone + 2.0,
            leak=lambda coc: np.where(coc < still, 0.0, 1.0),
            counts_slopes=True,
        )

    def program(self, shape: FrameShape, plan: Plan, traits: Traits) -> FrameProgram:
        """Declare the frame's passes."""
        layers = plan.structure
        assert isinstance(layers, LensLayers)
        return _Builder(self, shape, layers, traits).build()


def _layers(
    near_px: float, far_px: float, delta_px: float, most: int, aperture: Aperture, refined: bool = False
) -> LensLayers:
    fine, fine_px = (_FINE_LAYERS, min(_FINE_DELTA_PX, delta_px)) if refined else (0, 0.0)
    for exponent in range(10**6):
        delta = delta_px * math.pow(2.0, exponent / _STEPS_PER_OCTAVE)
        # The layer in focus takes half a step of either side.
        if refined:
            turn = (fine + 0.5) * fine_px
            front, back = (
                math.ceil(px / fine_px - 0.5) if px <= turn else fine + math.ceil((px - turn) / delta)
                for px in (near_px, far_px)
            )
        else:
            front, back = (math.ceil(px / delta - 0.5) for px in (near_px, far_px))
        front, back = max(0, front), max(0, back)
        if front + 1 + back <= most:
            return LensLayers(front, back, delta, aperture, 0, fine, fine_px)
    raise AssertionError("a step that is large enough needs one layer a side")


def cones(layers: LensLayers, rays: int, supersample: int = 1, antialias: bool = True) -> list[Cone | None]:
    """Window of each layer; None where it is no wider than the one sample that a pixel has."""
    # A uniform disc has a variance of 1/4 along each axis and an area of pi.
    deviations = layers.aperture.samples(256).std(axis=0)
    distance = math.sqrt(4.0 * math.pi * float(deviations.prod()) / rays) if rays else 0.0
    windows: list[Cone | None] = []
    for coc in np.abs(layers.coc).tolist():
        width = _CONE_WIDTH * distance * coc
        if supersample > 1:
            width = max(width, _blur_window(coc, layers.aperture, antialias))
        half = min(width * supersample / 2.0, _HALO * supersample - 2.0)
        if supersample == 1 and half <= 0.5:
            windows.append(None)
            continue
        # Pixels of the peels stand around the middle of the image's: one at 0, or two half a pixel away.
        offset = 0.5 if supersample % 2 else 0.0
        whole = max(int(half - offset), 0 if supersample % 2 else 1)
        first = (supersample - 1) // 2 - whole if supersample % 2 else supersample // 2 - whole
        windows.append(Cone(first, 2 * whole + supersample % 2, max(0.0, half - offset - whole)))
    return windows


def _blur_window(coc: float, aperture: Aperture, antialias: bool) -> float:
    """Width in px of the box that does what shifts by whole pixels cannot, with several samples a pixel."""
    if coc >= _WINDOW_PX:
        return 1.0
    variance = coc**2 * float(aperture.samples(256).var(axis=0).mean())
    return math.sqrt(12.0 * variance + antialias)


def shift_scales(layers: LensLayers, supersample: int, antialias: bool) -> NDArray[np.float64]:
    """What shifts of each layer are scaled by, (K,).

    Windows and the rounding of shifts blur as well; below 4 px of C that is taken off the shifts, so that the variance
    of all is right.
    """
    scales = np.ones(layers.total)
    if supersample == 1:
        return scales
    points = layers.aperture.samples(256)
    tries = np.linspace(0.0, 1.2, 241)
    for layer, coc in enumerate(np.abs(layers.coc).tolist()):
        if coc < _WINDOW_PX:
            scales[layer] = 0.0
        elif coc < _MATCHED_PX:
            wanted = coc**2 * points.var(axis=0).mean() + (0.0 if antialias else -1.0 / 12.0)
            found = np.floor(coc * tries[:, None, None] * points + 0.5).var(axis=1).mean(axis=1)
            scales[layer] = tries[np.abs(found - wanted).argmin()]
    return scales


def ray_sets(method: Multiview, layers: LensLayers) -> RaySets:
    """All rays, and how many of them each layer asks for.

    The first set has one ray, for cells in focus; powers of two below ``rays`` follow when adaptive; then come ``rays``
    and, for bright light, more. With jitter there are 16 patterns of each.
    """
    groups = max(1, layers.eyes)  # every one has rays in every set
    counts = [groups]
    if method.adaptive:
        counts += [1 << n for n in range(2, 10) if groups < 1 << n < method.rays]
    counts.append(method.rays)
    usual = len(counts) - 1
    if method.highlights and method.rays > 1:
        counts.append(min(_BRIGHT_RAYS * method.rays, MAX_RAYS))
    patterns = _JITTER**2 if method.jitter else 1
    ranges, points = [], []
    first = 0
    for count in counts:
        for pattern in range(patterns):
            on_lens = _on_lens(method, layers.aperture, count, pattern)
            order, sizes = _grouped(on_lens, groups)
            ends = first + np.cumsum(sizes)
            ranges.append(np.stack([ends - sizes, sizes], axis=1))
            # The ray through lens point v meets C at p + C * (-v.x, v.y), y down.
            points.append(on_lens[order] * (-1.0, 1.0))
            first += count
    on_lens = _on_lens(method, layers.aperture, method.rays, 0)
    order, sizes = _grouped(on_lens, groups)
    eyes = np.array([part.mean(axis=0) for part in np.split(on_lens[order], np.cumsum(sizes)[:-1])])
    blur = layers.largest if method.halvings(layers) else np.abs(layers.coc)
    needs = np.full((layers.total, 2), usual)
    if method.adaptive:
        wanted = _RAYS_PER_PX2 * math.pi * (blur + 0.5) ** 2
        needs[:] = np.minimum(np.maximum(np.searchsorted(counts[: usual + 1], wanted), 1), usual)[:, None]
    needs[blur >= _BRIGHT_PX, 1] = len(counts) - 1
    stacked = np.stack(ranges, axis=1).astype(np.int32)
    return RaySets(stacked, np.concatenate(points).astype(np.float32), needs.astype(np.int32), eyes)


def _on_lens(method: Multiview, aperture: Aperture, count: int, pattern: int) -> NDArray[np.float64]:
    """Lens samples of one set; with jitter those of one of 16 pixels.

    All sets of a block are shifted lattices whose shifts are a lattice themselves: together they fill the lens evenly,
    as sixteen times as many samples would, and pixels that are close to each other differ most.
    """
    if not method.jitter:
        return aperture.samples(count, method.seed)
    index, golden = np.arange(count), (math.sqrt(5.0) - 1.0) / 2.0
    number, start = _BAYER[pattern], np.random.default_rng(method.seed).random(2)
    across, around = (start[0] + number / 16.0) % 1.0, (start[1] + 7.0 * number / 16.0) % 1.0
    return aperture.place((index + across) / count, (index * golden + around) % 1.0)


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


class _Builder:
    """Lists the passes of one frame."""

    def __init__(self, method: Multiview, shape: FrameShape, layers: LensLayers, traits: Traits) -> None:
        self.method, self.shape, self.layers = method, shape, layers
        self.is_cpu = traits.is_cpu
        factor = self.factor = method.supersample
        if shape.width % factor or shape.height % factor or shape.guard_px % factor:
            raise InputError(
                f"The frame is {shape.width}x{shape.height} with a guard band of {shape.guard_px} px, which "
                f"supersample={factor} does not divide; capture {factor} times the image and {factor} times its band."
            )
        self.width, self.height, self.guard = shape.width // factor, shape.height // factor, shape.guard_px // factor
        self.pitch = row_pitch(self.width)
        self.cells = (-(-self.width // CELL), -(-self.height // CELL))
        self.fine_cells = (-(-shape.width // CELL), -(-shape.height // CELL))
        counts = (shape.layers, layers.total)
        self.fine = struct_scalar(_SIZE, shape.width, shape.height, shape.pitch, *counts, *self.fine_cells)
        self.size = struct_scalar(_SIZE, self.width, self.height, self.pitch, *counts, *self.cells)
        self.lens = (Param("c1", _FLOAT), Param("c0", _FLOAT))
        self.stride = _JITTER if method.jitter else 1
        self.peeled = method.traversal == "peels"
        self.halvings = method.halvings(layers)
        self.defines = (
            ("MULTIVIEW_VOID", int(not shape.is_opaque)),
            ("MULTIVIEW_STRIDE", self.stride),
            ("MULTIVIEW_PEELED", int(self.peeled)),
            ("MULTIVIEW_PARTS", int(layers.eyes > 0)),
            ("MULTIVIEW_SCALE", factor),
            ("MULTIVIEW_REFINE", self.halvings),
        )
        self.color = "view" if layers.eyes else "color"
        self.peel_bytes = shape.layers * shape.height * shape.pitch * 4
        self.layer_bytes = self.height * self.pitch * 16
        self.fine_bytes = shape.height * shape.pitch * 16
        self.levels = max(self.fine_cells).bit_length()
        self.passes: list[Pass] = []
        slots = (0 if self.peeled else layers.total) + (not shape.is_opaque)
        cell_bytes, fine_bytes = (x * y * 4 for x, y in (self.cells, self.fine_cells))
        self.buffers = [
            Buffer("color", shape.layers * shape.height * shape.width * 16, Role.INPUT),
            Buffer("inv_depth", self.peel_bytes, Role.INPUT),
            Buffer("image", (self.width - 2 * self.guard) * (self.height - 2 * self.guard) * 16, Role.OUTPUT),
            Buffer("extent", self.peel_bytes),
            Buffer("nbuffer", self.levels * fine_bytes),
            Buffer("wanted", cell_bytes),
            Buffer("lists", cell_bytes),
            Buffer("sets", cell_bytes),
        ]
        if slots:
            self.buffers.append(Buffer("layers", slots * self.layer_bytes))

    def build(self) -> FrameProgram:
        windows: list[Cone | None] = [None] * self.layers.total
        if self.factor > 1 or self.method.has_cones:
            rays = self.method.rays if self.method.has_cones else 0
            windows = cones(self.layers, rays, self.factor, self.method.antialias)
        sets = ray_sets(self.method, self.layers)
        scales = shift_scales(self.layers, self.factor, self.method.antialias)
        self._classify(windows, sets, scales)
        if self.layers.eyes:
            split, made = split_pass(self.shape, self.is_cpu)
            self.passes.append(split)
            peels = Buffer("view", self.shape.layers * self.shape.height * self.shape.width * 16)
            self.buffers += [*shading_inputs(self.shape), *made, peels]
        if any(windows):
            self.buffers.append(Buffer("split", self.fine_bytes))
        self.buffers.append(Buffer("moments", self.layers.total * math.prod(self.fine_cells) * 16))
        if self.peeled:
            self._constant("bounds", self.layers.bounds)
            if self.halvings:
                self._constant("limits", self.layers.limits.astype(np.float32))
        for group, ranges in enumerate(sets.ranges):
            if self.layers.eyes:
                self.passes.append(view_pass(self.shape, self.is_cpu, sets.eyes[group]))
            if group == 0 or not self.peeled:
                self._split(windows)
            if not self.shape.is_opaque:
                self._past()
            if group == 0:
                self._choose(sets, scales)
            self._trace(group, ranges)
        if self.layers.eyes:
            self._finish()
        return FrameProgram.of(self.buffers, self.passes)

    def _classify(self, windows: list[Cone | None], rays: RaySets, scales: NDArray[np.float64]) -> None:
        """Which layers a cell can see."""
        shape = self.shape
        self._add(
            "multiview_extent",
            (write("extent"), read("inv_depth"), self.fine, *self.lens),
            (shape.pitch // 16, shape.height, shape.layers),
            2 * self.peel_bytes,
        )
        steps = struct_scalar(_STEPS, *self.layers.steps)
        self._add(
            "multiview_cells",
            (write("nbuffer"), read("inv_depth"), read("extent"), self.fine, steps, *self.lens),
            self.fine_cells,
            2 * self.peel_bytes,
        )
        self._nbuffer("nbuffer")
        self.farthest = np.abs(rays.points).max() * scales
        moves = np.floor(self.farthest * self.layers.largest + 0.5) * self.factor
        halos = np.array([max(-w.first, w.first + w.taps) + 1 if w else 0 for w in windows])
        self._constant("reach", np.ceil((moves + halos) / CELL).astype(np.int32))
        self._add(
            "multiview_wanted",
            (
                write("wanted"),
                read("nbuffer"),
                read("reach"),
                self.fine,
                self.size,
                np.int32(self.levels),
                np.int32(self.method.cull),
            ),
            self.cells,
        )

    def _nbuffer(self, name: str) -> None:
        for level in range(1, self.levels):
            self._add("multiview_nbuffer", (read_write(name), self.fine, np.int32(level)), self.fine_cells)

    def _choose(self, rays: RaySets, scales: NDArray[np.float64]) -> None:
        """Where rays meet the layers, and how many rays a cell takes."""
        nominal = self.layers.coc.astype(np.float32)
        self._constant("nominal", nominal)
        self.buffers.append(Buffer("coc", nominal.nbytes))
        least = _CENTRED_PX if self.method.is_centred else _ENDLESS
        args = (*(read(name) for name in ("moments", "nbuffer", "nominal")), self.fine, np.float32(least))
        self._add("multiview_centres", (write("coc"), *args), (self.layers.total,))
        self.buffers.append(Buffer("bright", self.levels * math.prod(self.fine_cells) * 4))
        args = (read("moments"), read("nbuffer"), self.fine)
        self._add("multiview_bright", (write("bright"), *args), self.fine_cells)
        self._nbuffer("bright")
        count = len(rays.points)
        self._constant("points", rays.points)
        self._constant("scale", scales.astype(np.float32))
        self.buffers.append(Buffer("shifts", count * self.layers.total * 8))
        self._add(
            "multiview_shifts",
            (
                write("shifts"),
                read("points"),
                read("coc"),
                read("scale"),
                np.int32(self.layers.total),
                np.int32(count),
            ),
            (self.layers.total, count),
        )
        if self.halvings:
            self._constant("farthest", self.layers.largest.astype(np.float32))
        self._constant("moves", self.farthest.astype(np.float32))
        self._constant("needs", rays.needs)
        self._add(
            "multiview_lists",
            (
                write("lists"),
                write("sets"),
                read("nbuffer"),
                read("bright"),
                read("farthest" if self.halvings else "coc"),
                read("reach"),
                read("moves"),
                read("needs"),
                self.fine,
                self.size,
                np.int32(self.levels),
                np.int32(self.method.cull),
                np.float32(_STILL_PX if self.method.adaptive or self.layers.total == 1 else -1.0),
            ),
            self.cells,
        )

    def _split(self, windows: list[Cone | None]) -> None:
        """Fill the layers, as cones see them; of peels, find only what C layers have."""
        bounds = self.layers.bounds
        for layer, window in enumerate(windows):
            stack = write("layers") if layer == 0 else read_write("layers")
            number = np.int32(layer)
            target = stack if window is None else write("split")
            self._add(
                "multiview_split",
                (
                    *(() if self.peeled else (target,)),
                    write("moments") if layer == 0 else read_write("moments"),
                    read(self.color),
                    *(read(name) for name in ("inv_depth", "extent", "nbuffer", "wanted")),
                    self.fine,
                    np.int32(self.cells[0]),
                    *self.lens,
                    bounds[layer],
                    bounds[layer + 1],
                    number,
                    number if window is None else np.int32(0),
                ),
                self.fine_cells,
                self.fine_bytes,
            )
            if window is None:
                continue
            self._add(
                "multiview_cone",
                (
                    stack,
                    *(read(name) for name in ("split", "nbuffer", "wanted")),
                    self.fine,
                    self.size,
                    number,
                    number,
                    np.int32(window.first),
                    np.int32(window.taps),
                    np.float32(window.edge),
                ),
                (-(-self.pitch // _RUN), self.cells[1]),
                self.fine_bytes + self.layer_bytes,
            )

    def _past(self) -> None:
        stack, slot = (write("layers"), 0) if self.peeled else (read_write("layers"), self.layers.total)
        self._add(
            "multiview_past",
            (stack, read("color"), self.size, np.int32(slot)),
            (1, self.height),
            self.layer_bytes,
        )

    def _trace(self, group: int, ranges: NDArray[np.int32]) -> None:
        ray_sets = f"ray_sets{group}"
        self._constant(ray_sets, ranges)
        height, width = self.height - 2 * self.guard, self.width - 2 * self.guard
        peels: tuple[Any, ...] = ()
        if self.peeled:
            peels = (*(read(name) for name in ("inv_depth", "extent", "bounds")), *self.lens)
            if self.halvings:
                peels = (*peels, read("limits"), read("points"))
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
                np.int32(self.guard),
                *((np.int32(group == 0),) if self.layers.eyes else ()),
            ),
            (-(-self.width // (16 * self.stride)), height),
            height * width * 16 * (int(ranges[-1, 1]) + 1),
        )

    def _finish(self) -> None:
        height, width = self.height - 2 * self.guard, self.width - 2 * self.guard
        self.buffers.append(Buffer("parts", height * width * 4 * (4 if self.shape.is_opaque else 5)))
        self._add(
            "multiview_finish",
            (write("image"), read("parts"), read("color"), self.size, np.int32(self.guard)),
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
