"""Multiview synthesis (Lee, Eisemann & Seidel 2009): lens rays traced through a layered image-based scene.

The peels are split into layers of equal growth of the signed circle of confusion (eq. 4). Each pixel sends one ray per
lens sample, which meets the layers front to back and is thickened to a cone as wide as the samples are apart
(section 4.4). Rays that meet what lies outside of the frame, or what no peel holds, are dropped and the rest
renormalised; a pixel that has lost them all shows what a pinhole sees. The aperture may have any shape.

Where this differs from the paper, docs/methods/multiview.md has the measurements:

- Layers are thin (half a pixel of CoC where 32 of them allow it), so that a ray meets each at one place and needs no
  search by false position. All pixels of a run then move alike, and look-ups are contiguous.
- Layers stand still in the scene while the focus moves (with one sample a pixel), not at fixed circles of confusion.
- Layers overlap as far as the surface slopes from pixel to pixel, not by a fixed 10 %.
- Cones see means over windows of exactly their width, not mip levels.
- Rays take in two pixels for a short while on their way from one to the next, so that a moving focus does not jump.
- The number of rays follows the blur of what a cell of 16 x 16 pixels can see, and rises where light is bright.
- Frames may have several samples a pixel, which layers take in; around the focus they are thinner then.
- Glossy surfaces are shaded from points all over the lens before cones take their means, not at the hit after means of
  normals and exponents were taken.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from functools import cache, lru_cache
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
    "Layering",
    "LensLayers",
    "Multiview",
    "RaySets",
    "cones",
    "ray_sets",
    "shift_scales",
    "turn_px",
]

# Constants of kernels/multiview.cl.
MAX_LAYERS = 32
CELL = 16
_HALO = 16  # times the supersampling
_RUN = 64

MAX_RAYS = 1024

# CoC growth from layer to layer (px) when none is given. Thinner layers gain less than 0.3 dB.
_USUAL_DELTA_PX = 0.5
# Growth around the focus rises on this grid, so that a lens in motion keeps to few pass lists.
_STEPS_PER_OCTAVE = 8
# Layers without windows begin and end at multiples of this, for the same reason.
_PLAIN_GRID = 4
# Share of the work that few tiles leave: that of all but the rays.
_TILES_FLOOR = 0.3
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
# Way of a ray, px, on which it passes from one pixel to the next: takes both in. Wider is smoother and dearer. At C px
# it is the third over C, but at most the first, where theory changes least and rays show most, and at least the second.
_TURN_PX, _LEAST_TURN_PX, _TURN_COC = 0.4, 0.05, 0.4
# As far as this C it is tabulated what rays blur by, in steps of so much, px.
_TABLED_PX, _TABLE_STEP_PX = 6.0, 0.01
# Layers nearer to the focus are met in their middle: there whole pixels of shift blur more than they should. Those that
# stand still in the scene go over to the mean as far as the second figure.
_CENTRED_PX, _ALL_CENTRED_PX = 0.8, 1.2
# Layers that stand still in the scene are in focus where their middle is within half of their growth and this.
_FOCUS_PX = 0.125
# From there to where their blur is right, px of C.
_RAMP_PX = 0.25
# Rays that move by less all stay in their pixel.
_STILL_PX = 0.499
# Light above this (constant of kernels/multiview.cl) that is blurred by so many px gets so many times the rays.
_BRIGHT, _BRIGHT_PX, _BRIGHT_RAYS = 1.5, 1.5, 4
# Binary search in peels pays where layers grow by more than this: twice. Below, as many rays as take the same time gain
# more.
_COARSE_PX, _USUAL_HALVINGS = 2.0, 2
# Rays per px^2 of the largest circle of confusion that a cell can see: more are not traced. Costs up to 0.2 dB. Where
# rays move at all there are at least 64: where cells go from set to set while the focus moves, the image jumps.
_RAYS_PER_PX2, _FEWEST_RAYS_LOG2 = 4.0, 6
# Pixels of the jitter pattern along x and y, and the order in which Bayer 1973 fills the pattern: row by row.
_JITTER = 4
_BAYER = (0, 8, 2, 10, 12, 4, 14, 6, 3, 11, 1, 9, 15, 7, 13, 5)

_SIZE = np.dtype([(n, np.int32) for n in ("width", "height", "pitch", "peels", "layers", "cells_x", "cells_y")])
_STEPS = np.dtype([(n, np.float32) for n in ("anchor", "fine", "coarse", "turn", "number")])
_PLACES = np.dtype(
    [
        ("bound", np.float32, MAX_LAYERS + 1),
        *((n, np.float32, MAX_LAYERS) for n in ("coc", "largest", "scale", "window", "haste")),
        *((n, np.int32, MAX_LAYERS) for n in ("reach", "needs")),
    ]
)
_SHIFT = np.dtype([("x", np.int32), ("y", np.int32), ("to_x", np.float32), ("to_y", np.float32)])
_FLOAT = np.dtype(np.float32)


class LensLayers(NamedTuple):
    """How many layers there are, through what aperture they are seen, and from how many of its points they are shaded.

    Layers ``plain[0]`` to ``plain[1]``, the end not among them, have no windows. ``eyes`` is 0 where all that the lens
    sees looks the same from all of it. ``halvings`` is how often the way of rays through a layer is halved. Layers that
    are ``refined`` are thinner around the focus and move with it.
    """

    total: int
    aperture: Aperture
    plain: tuple[int, int]
    eyes: int = 0
    halvings: int = 0
    refined: bool = False


class Layering(NamedTuple):
    """Where layers are.

    Attributes
    ----------
    inverse : ndarray of float32, (K + 1,)
        Inverse depths in 1/m where layers begin, falling.
    c1, c0 : float
        Signed CoC radius in px of the image is ``c1 * inverse + c0``.
    anchor, fine, coarse, turn, number : float
        The same for kernels, in 1/m: ``number`` layers are nearer than ``anchor``, those up to ``turn`` to either side
        of it are ``fine`` thick and the others ``coarse``.
    refined : bool
        The layer in the middle is in focus, and those around it are thinner.
    """

    inverse: NDArray[np.float32]
    c1: float
    c0: float
    anchor: float
    fine: float
    coarse: float
    turn: float
    number: float
    refined: bool = False

    @classmethod
    def anchored(cls, nearest: float, farthest: float, c1: float, c0: float, delta_px: float, most: int) -> Layering:
        """Even layers that stand still in the scene: their number depends on the aperture, not on the focus.

        The ends of the range lie in the middle of layers: what is nearest or farthest is a facing surface more often
        than what lies between. A single layer is all of the range.
        """
        wanted = math.ceil(min((nearest - farthest) * abs(c1) / delta_px - 1e-6, float(most)))
        wanted = min(wanted + (wanted > 1), most)
        # 1, 2, 3, 4, 6, 8, 12, ...: an aperture in motion keeps to few of them.
        octave = 1 << max(0, wanted - 1).bit_length()
        count = max(1, min(octave * 3 // 4 if octave >= 4 and wanted <= octave * 3 // 4 else octave, most))
        step = max((nearest - farthest) / max(count - 1, 1), 1e-9)  # kernels divide by it
        anchor = nearest + step / 2.0 if count > 1 else nearest
        inverse = (anchor - step * np.arange(count + 1)).astype(np.float32)
        return cls(inverse, c1, c0, anchor, step, step, 0.0, 0.0)

    @classmethod
    def around_focus(
        cls, nearest: float, farthest: float, c1: float, c0: float, delta_px: float, most: int
    ) -> Layering:
        """Layers at fixed C, thinner near the focus; growth rises until there are no more than ``most``."""
        near_px, far_px = max(0.0, -(c1 * nearest + c0)), max(0.0, c1 * farthest + c0)
        fine_px = min(_FINE_DELTA_PX, delta_px)
        turn = (_FINE_LAYERS + 0.5) * fine_px
        for exponent in range(10**6):
            delta = delta_px * math.pow(2.0, exponent / _STEPS_PER_OCTAVE)
            # The layer in focus takes half a step of either side.
            front, back = (
                max(
                    0,
                    math.ceil(px / fine_px - 0.5) if px <= turn else _FINE_LAYERS + math.ceil((px - turn) / delta),
                )
                for px in (near_px, far_px)
            )
            if front + 1 + back <= most:
                break
        number = np.arange(-front, back + 2) - 0.5
        away = np.abs(number)
        coc = np.sign(number) * np.where(
            away <= _FINE_LAYERS + 0.5, away * fine_px, turn + (away - _FINE_LAYERS - 0.5) * delta
        )
        # Through a pinhole, where there is one layer, any will do.
        per_px = 1.0 / abs(c1) if c1 else 1.0
        focus = -c0 / c1 if c1 else nearest
        inverse = (focus - coc * per_px).astype(np.float32)
        return cls(inverse, c1, c0, focus, fine_px * per_px, delta * per_px, turn * per_px, front + 0.5, refined=True)

    @property
    def total(self) -> int:
        """K."""
        return len(self.inverse) - 1

    @property
    def delta_px(self) -> float:
        """Growth of C from layer to layer, px, but for thinner ones."""
        return abs(self.c1) * self.coarse

    @property
    def limits(self) -> NDArray[np.float64]:
        """CoC in px where layers begin, (K + 1,), rising."""
        return self.c1 * self.inverse.astype(np.float64) + self.c0

    @property
    def coc(self) -> NDArray[np.float64]:
        """Signed CoC radius in px in the middle of each layer, (K,), rising."""
        limits = self.limits
        middle = (limits[1:] + limits[:-1]) / 2.0
        if self.refined:
            middle[int(self.number)] = 0.0
        return middle

    @property
    def largest(self) -> NDArray[np.float64]:
        """The largest blur radius in px that a layer may be met at, (K,)."""
        limits = np.abs(self.limits)
        return np.maximum(limits[1:], limits[:-1])

    def met(self, farthest: float, aperture: Aperture, turning: bool) -> NDArray[np.float64]:
        """C in px at which layers are met, (K,): where what rays take in is as wide as the lens says for the middle.

        Rays move by up to ``farthest`` px per px of C. What is in focus stays where it is, and so does all of a layer
        whose middle is no farther from it than half a layer. From there variance grows from nothing, evenly, until it
        is what it should be.

        Parameters
        ----------
        farthest : float
        aperture : Aperture
        turning : bool
            Whether rays pass from pixel to pixel evenly, or as a whole.
        """
        coc = self.coc
        if self.refined:
            return coc
        away, least = np.abs(coc), self.delta_px / 2.0 + _FOCUS_PX
        joint = least + min(least, _RAMP_PX)
        wanted = np.where(away < joint, joint**2 * (away - least) / (joint - least), away**2)
        tabled, blurs = _blurs(aperture, turning)
        start = _still_px(turning) / max(farthest, 1e-6)
        # Far from the focus what pixels add to the blur is as good as constant.
        met = np.maximum(np.interp(wanted, blurs, tabled), start)
        met = np.where(wanted > blurs[-1], np.sqrt(np.maximum(wanted - blurs[-1] + tabled[-1] ** 2, 0.0)), met)
        return np.asarray(np.sign(coc) * np.where(away < least, start * away / least, met))


class Cone(NamedTuple):
    """Window of a mean, in pixels of the peels.

    ``taps`` whole ones from ``first`` on, counted from the pixel's own first one, and ``edge`` of one more at either
    side: ``half`` to either side of the pixel's middle.
    """

    first: int
    taps: int
    edge: float
    half: float

    @classmethod
    def of(cls, half: float, supersample: int) -> Cone:
        """The window that reaches so far, in pixels of the peels: one stands in the pixel's middle, or none does."""
        is_odd = supersample % 2
        whole = max(int(half - 0.5 * is_odd), 1 - is_odd)
        return cls((supersample - is_odd) // 2 - whole, 2 * whole + is_odd, max(0.0, half - 0.5 * is_odd - whole), half)


class RaySets(NamedTuple):
    """Rays of all sets as the kernels take them.

    Attributes
    ----------
    ranges : ndarray of int32, (groups, sets * patterns, 2)
        First ray and number of rays. There is one group for each eye, of the rays closest to it; one if there are none.
    points : ndarray of float32, (rays, 2)
        Where a ray stands per px of C: right and down, at most 1 or so.
    counts : tuple of int
        Rays of each set; the usual one is the last, or the last but one where bright light takes more.
    usual : int
        Its number.
    eyes : ndarray, (groups, 2)
        Middle of each group on the lens: right and up, in units of its radius.
    """

    ranges: NDArray[np.int32]
    points: NDArray[np.float32]
    counts: tuple[int, ...]
    usual: int
    eyes: NDArray[np.float64]

    @property
    def farthest(self) -> float:
        """How far a ray moves per px of C, at most."""
        return float(np.abs(self.points).max())

    def needs(self, blur: NDArray[np.float64], adaptive: bool) -> NDArray[np.int32]:
        """Which set each blur radius in px asks for, and which with bright light, (K, 2)."""
        needs = np.full((len(blur), 2), self.usual)
        if adaptive:
            wanted = _RAYS_PER_PX2 * math.pi * (blur + 0.5) ** 2
            found = np.searchsorted(self.counts[: self.usual + 1], wanted)
            needs[:] = np.minimum(np.maximum(found, 1), self.usual)[:, None]
        needs[blur >= _BRIGHT_PX, 1] = len(self.counts) - 1
        return needs.astype(np.int32)


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

    def halvings(self, delta_px: float) -> int:
        """How often the way of rays through layers of this growth is halved."""
        if self.traversal == "layers":
            return 0
        if self.refine_steps is not None:
            return self.refine_steps
        return _USUAL_HALVINGS if delta_px > _COARSE_PX else 0

    def supersampled(self, factor: int, antialias: bool = True) -> Multiview:
        """This method for frames with ``factor`` times the pixels; itself where it cannot take them in."""
        if self.traversal != "layers":
            return self
        return replace(self, supersample=factor, antialias=self.antialias and antialias)

    def plan(self, frame: LayeredFrame, lens: Lens) -> Plan:
        """Choose the layers from the range of depths, and what of them depends on the lens."""
        where = self.layering(frame, lens)
        eyes = 0
        if self.view_dependent and frame.is_glossy_through(lens):
            eyes = min(self.eyes, self.rays)
        halvings = self.halvings(where.delta_px)
        rays = ray_sets(self, lens.aperture, max(1, eyes))
        met, largest = where.met(rays.farthest, lens.aperture, not halvings), where.largest
        windows = self.windows(where, lens.aperture)
        scales = shift_scales(where.coc, self.supersample, lens.aperture, self.antialias)
        turns = turn_px(scales * met)
        moves = np.floor(rays.farthest * scales * (largest + 1e-3) + 0.5 + turns / 2.0) * self.supersample
        halos = np.array([max(-w.first, w.first + w.taps) + 1 if w else 0 for w in windows])
        needs = rays.needs(largest if halvings else np.abs(met), self.adaptive)
        places = np.zeros((), _PLACES)
        for name, values in (
            ("bound", where.inverse),
            ("coc", met),
            ("largest", largest),
            ("scale", scales),
            ("window", [w.half if w else 0.5 for w in windows]),
            ("haste", 1.0 / turns),
            ("reach", np.minimum(np.ceil((moves + halos) / CELL), 1e6)),
            ("needs", needs[:, 0] + 256 * needs[:, 1]),
        ):
            places[name][: len(values)] = values
        plain = _plain([w is None for w in windows])
        structure = LensLayers(where.total, lens.aperture, plain, eyes, halvings, where.refined)
        farthest, nearest = frame.shown_inverse_depths
        summary = {
            "method": self.name,
            **{field.name: getattr(self, field.name) for field in fields(self)},
            "layers": where.total,
            "focus_layer": int(np.clip(np.searchsorted(where.limits, 0.0) - 1, 0, where.total - 1)),
            "delta_px": where.delta_px,
            "largest_near_coc_px": max(0.0, -(where.c1 * nearest + where.c0)),
            "largest_far_coc_px": max(0.0, where.c1 * farthest + where.c0),
            "eyes": eyes,
            "refine_steps": halvings,
            "highlight_rays": min(_BRIGHT_RAYS * self.rays, MAX_RAYS),
            "highlight_above": _BRIGHT,
            "highlight_coc_px": _BRIGHT_PX,
        }
        steps = (where.anchor, where.fine, where.coarse, where.turn, where.number)
        params = {
            "c1": np.float32(where.c1),
            "c0": np.float32(where.c0),
            "steps": struct_scalar(_STEPS, *steps),
            "given": places[()],
        }
        if eyes:
            params["aperture_radius_m"] = np.float32(lens.aperture_radius_m)
        return Plan(structure, params, summary)

    def layering(self, frame: LayeredFrame, lens: Lens) -> Layering:
        """Where the layers of a frame are through a lens."""
        c1, c0 = (value / self.supersample for value in lens.coc_coefficients(frame.camera))
        farthest, nearest = frame.shown_inverse_depths
        shape = FrameShape.of(frame)
        most = self.layers
        if self.traversal == "layers":
            layer_bytes = shape.height * shape.pitch * 16 // self.supersample**2
            most = min(most, max(_FEWEST_LAYERS, _LAYER_BYTES // layer_bytes - 2))
        kind = Layering.anchored
        if self.supersample > 1 and most >= _FEWEST_TO_REFINE:
            kind = Layering.around_focus
        return kind(nearest, farthest, c1, c0, self.delta_px or _USUAL_DELTA_PX, most)

    def windows(self, where: Layering, aperture: Aperture) -> list[Cone | None]:
        """What each layer is averaged over."""
        if self.supersample == 1 and not self.has_cones:
            return [None] * where.total
        return cones(where.coc, self.rays if self.has_cones else 0, self.supersample, aperture, self.antialias)

    def locality(self, shape: FrameShape, plan: Plan, traits: Traits, tail: float) -> Locality | None:
        """Rays go no farther than their CoC; those of layers close to the focus do not leave their pixel.

        Shading from the points of the lens depends on the place in the image, also in focus; where layers are met
        depends on all of the frame.
        """
        layers = plan.structure
        assert isinstance(layers, LensLayers)
        if layers.eyes or self.is_centred or self.supersample > 1:
            return None
        places: Any = plan.params["given"]
        count = layers.total
        limits = float(plan.params["c1"]) * places["bound"][: count + 1].astype(np.float64) + float(plan.params["c0"])
        # After a search for what is in a layer, those stay that rays do not leave from end to end.
        met = np.abs(places["largest" if layers.halvings else "coc"][:count])
        still_px = _still_px(not layers.halvings) + 9e-4
        moved = met * ray_sets(self, layers.aperture, 1).farthest >= still_px
        # The least blur of anything in a layer that rays move in; a slot so close to a bound may count for both.
        gap = np.maximum(np.maximum(limits[:-1], -limits[1:]), 0.0)[moved] - 2e-3 * plan.summary["delta_px"]
        still = float(gap.min(initial=np.inf))
        largest = float(np.abs(limits).max())
        delta_px = plan.summary["delta_px"]
        cone = _HALO if self.has_cones else 0
        return Locality(
            align_px=_RUN,
            # Cells look for layers in whole cells around them.
            margin_px=math.ceil(largest + delta_px) + cone + 3 * CELL,
            reach_px=lambda coc: coc + delta_px + cone + 2.0,
            leak=lambda coc: np.where(coc < still, 0.0, 1.0),
            counts_slopes=True,
            tiles_floor=_TILES_FLOOR,
        )

    def program(self, shape: FrameShape, plan: Plan, traits: Traits) -> FrameProgram:
        """Declare the frame's passes."""
        layers = plan.structure
        assert isinstance(layers, LensLayers)
        return _Builder(self, shape, layers, traits).build()


def _plain(has_none: list[bool]) -> tuple[int, int]:
    """First and end of the layers that surely have no windows, on a grid: the others may have any."""
    if not any(has_none):
        return 0, 0
    first, end = has_none.index(True), len(has_none) - has_none[::-1].index(True)
    first = -(-first // _PLAIN_GRID) * _PLAIN_GRID
    if end < len(has_none):
        end = end // _PLAIN_GRID * _PLAIN_GRID
    return (first, end) if first < end else (0, 0)


def cones(
    coc: NDArray[np.float64], rays: int, supersample: int, aperture: Aperture, antialias: bool = True
) -> list[Cone | None]:
    """Window of layers at these C; None where it is no wider than the one sample that a pixel has."""
    # A uniform disc has a variance of 1/4 along each axis and an area of pi.
    deviations = _points(aperture).std(axis=0)
    distance = math.sqrt(4.0 * math.pi * float(deviations.prod()) / rays) if rays else 0.0
    windows: list[Cone | None] = []
    for blur in np.abs(coc).tolist():
        width = _CONE_WIDTH * distance * blur
        if supersample > 1:
            width = max(width, _blur_window(blur, aperture, antialias))
        half = min(width * supersample / 2.0, _HALO * supersample - 2.0)
        if supersample == 1 and half <= 0.5:
            windows.append(None)
            continue
        windows.append(Cone.of(half, supersample))
    return windows


def turn_px(coc: NDArray[np.float64]) -> NDArray[np.float64]:
    """Way in px on which rays of layers at these C pass from one pixel to the next."""
    return np.clip(_TURN_COC / np.maximum(np.abs(coc), 1e-6), _LEAST_TURN_PX, _TURN_PX)


def _still_px(turning: bool) -> float:
    """Rays that move by less take in no pixel but their own."""
    return _STILL_PX - _TURN_PX / 2.0 if turning else _STILL_PX


def _variance(points: NDArray[np.float64], coc: NDArray[np.float64], turning: bool) -> NDArray[np.float64]:
    """Of what the rays through these points of the lens take in at each C, px^2, the mean of both axes."""
    to = coc[:, None, None] * points
    pixel = np.floor(to + 0.5)
    past = to - pixel
    turn = turn_px(coc)[:, None, None] if turning else 1e-9
    share = np.maximum(0.5 - (0.5 - np.abs(past)) / turn, 0.0)
    mean = (pixel + share * np.sign(past)).mean(axis=1)
    square = ((1.0 - share) * pixel**2 + share * (pixel + np.sign(past)) ** 2).mean(axis=1)
    return np.asarray((square - mean**2).mean(axis=-1))


@cache
def _blurs(aperture: Aperture, turning: bool) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """C in px at which rays are, rising, and the square of the C that they blur by there."""
    points = _points(aperture)
    coc = np.arange(0.0, _TABLED_PX, _TABLE_STEP_PX)
    blurs = _variance(points, coc, turning) / points.var(axis=0).mean()
    # Rising, be it by nothing to speak of: an inverse needs that.
    return coc, np.maximum.accumulate(blurs) + 1e-9 * coc


@cache
def _points(aperture: Aperture) -> NDArray[np.float64]:
    return aperture.samples(256)


def _blur_window(coc: float, aperture: Aperture, antialias: bool) -> float:
    """Width in px of the box that does what shifts by whole pixels cannot, with several samples a pixel."""
    if coc >= _WINDOW_PX:
        return 1.0
    variance = coc**2 * float(_points(aperture).var(axis=0).mean())
    return math.sqrt(12.0 * variance + antialias)


def shift_scales(
    coc: NDArray[np.float64], supersample: int, aperture: Aperture, antialias: bool = True
) -> NDArray[np.float64]:
    """What shifts of layers at these C are scaled by, (K,).

    Windows and the rounding of shifts blur as well; below 4 px of C that is taken off the shifts, so that the variance
    of all is right.
    """
    scales = np.ones(len(coc))
    if supersample > 1:
        for layer, blur in enumerate(np.abs(coc).tolist()):
            if blur < _MATCHED_PX:
                scales[layer] = 0.0 if blur < _WINDOW_PX else _matched_scale(round(blur, 3), aperture, antialias)
    return scales


@cache
def _matched_scale(coc: float, aperture: Aperture, antialias: bool) -> float:
    points = _points(aperture)
    tries = np.linspace(0.0, 1.2, 241)
    wanted = coc**2 * points.var(axis=0).mean() + (0.0 if antialias else -1.0 / 12.0)
    found = _variance(points, coc * tries, turning=True)
    return float(tries[np.abs(found - wanted).argmin()])


@lru_cache(32)
def ray_sets(method: Multiview, aperture: Aperture, groups: int) -> RaySets:
    """All rays, in so many groups of neighbours.

    The first set has one ray, for cells in focus; powers of two below ``rays`` follow when adaptive; then come ``rays``
    and, for bright light, more. With jitter there are 16 patterns of each.
    """
    counts = [groups]  # every group has rays in every set
    if method.adaptive:
        counts += [1 << n for n in range(_FEWEST_RAYS_LOG2, 10) if groups < 1 << n < method.rays]
    counts.append(method.rays)
    usual = len(counts) - 1
    if method.highlights and method.rays > 1:
        counts.append(min(_BRIGHT_RAYS * method.rays, MAX_RAYS))
    patterns = _JITTER**2 if method.jitter else 1
    ranges, points = [], []
    first = 0
    for count in counts:
        for pattern in range(patterns):
            on_lens = _on_lens(method, aperture, count, pattern)
            order, sizes = _grouped(on_lens, groups)
            ends = first + np.cumsum(sizes)
            ranges.append(np.stack([ends - sizes, sizes], axis=1))
            # The ray through lens point v meets C at p + C * (-v.x, v.y), y down.
            points.append(on_lens[order] * (-1.0, 1.0))
            first += count
    on_lens = _on_lens(method, aperture, method.rays, 0)
    order, sizes = _grouped(on_lens, groups)
    eyes = np.array([part.mean(axis=0) for part in np.split(on_lens[order], np.cumsum(sizes)[:-1])])
    stacked = np.stack(ranges, axis=1).astype(np.int32)
    return RaySets(stacked, np.concatenate(points).astype(np.float32), tuple(counts), usual, eyes)


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
        self.traits, self.is_cpu, self.lanes = traits, traits.is_cpu, traits.lanes
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
        self.halvings = layers.halvings
        self.defines = (
            ("MULTIVIEW_VOID", int(not shape.is_opaque)),
            ("MULTIVIEW_STRIDE", self.stride),
            ("MULTIVIEW_PEELED", int(self.peeled)),
            ("MULTIVIEW_PARTS", int(layers.eyes > 0)),
            ("MULTIVIEW_SCALE", factor),
            ("MULTIVIEW_REFINE", self.halvings),
            ("MULTIVIEW_SPARSE", int(shape.is_sparse)),
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
            *((shape.gaps,) if shape.is_sparse else ()),
            Buffer("extent", self.peel_bytes),
            Buffer("nbuffer", self.levels * fine_bytes),
            Buffer("wanted", cell_bytes),
            Buffer("lists", cell_bytes),
            Buffer("sets", cell_bytes),
        ]
        if slots:
            self.buffers.append(Buffer("layers", slots * self.layer_bytes))

    def build(self) -> FrameProgram:
        sets = ray_sets(self.method, self.layers.aperture, max(1, self.layers.eyes))
        self._classify()
        if self.layers.eyes:
            split, made = split_pass(self.shape, self.traits)
            self.passes.append(split)
            peels = Buffer("view", self.shape.layers * self.shape.height * self.shape.width * 16)
            self.buffers += [*shading_inputs(self.shape), *made, peels]
        plain = range(*self.layers.plain)
        if len(plain) < self.layers.total:
            self.buffers.append(Buffer("split", self.fine_bytes))
        self.buffers.append(Buffer("moments", self.layers.total * math.prod(self.fine_cells) * 16))
        for group, ranges in enumerate(sets.ranges):
            if self.layers.eyes:
                self.passes.append(view_pass(self.shape, self.traits, sets.eyes[group]))
            if group == 0 or not self.peeled:
                self._split(plain)
            if not self.shape.is_opaque:
                self._past()
            if group == 0:
                self._choose(sets)
            self._trace(group, ranges)
        if self.layers.eyes:
            self._finish()
        return FrameProgram.of(self.buffers, self.passes)

    def _classify(self) -> None:
        """Which layers a cell can see."""
        shape = self.shape
        self.buffers.append(Buffer("places", _PLACES.itemsize))
        self._add("multiview_place", (write("places"), Param("given", _PLACES)), (1,))
        self._add(
            "multiview_extent",
            (write("extent"), read("inv_depth"), self.fine, self.lens[0]),
            (shape.pitch // self.lanes, shape.height, shape.layers),
            2 * self.peel_bytes,
        )
        self._add(
            "multiview_cells",
            (write("nbuffer"), read("inv_depth"), read("extent"), self.fine, Param("steps", _STEPS)),
            self.fine_cells,
            2 * self.peel_bytes,
        )
        self._nbuffer("nbuffer")
        self._add(
            "multiview_wanted",
            (
                write("wanted"),
                read("nbuffer"),
                read("places"),
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

    def _choose(self, rays: RaySets) -> None:
        """Where rays meet the layers, and how many rays a cell takes."""
        self.buffers.append(Buffer("coc", self.layers.total * 4))
        args = (*(read(name) for name in ("moments", "nbuffer", "places")), self.fine)
        least, full = math.inf, math.inf
        if self.method.is_centred:
            least, full = _CENTRED_PX, _CENTRED_PX if self.layers.refined else _ALL_CENTRED_PX
        self._add("multiview_centres", (write("coc"), *args, np.float32(least), np.float32(full)), (self.layers.total,))
        self.buffers.append(Buffer("bright", self.levels * math.prod(self.fine_cells) * 4))
        args = (read("moments"), read("nbuffer"), self.fine)
        self._add("multiview_bright", (write("bright"), *args), self.fine_cells)
        self._nbuffer("bright")
        count = len(rays.points)
        self._constant("points", rays.points)
        self.buffers.append(Buffer("shifts", count * self.layers.total * _SHIFT.itemsize))
        self._add(
            "multiview_shifts",
            (
                write("shifts"),
                read("points"),
                read("coc"),
                read("places"),
                np.int32(self.layers.total),
                np.int32(count),
            ),
            (self.layers.total, count),
        )
        self._add(
            "multiview_lists",
            (
                write("lists"),
                write("sets"),
                read("nbuffer"),
                read("bright"),
                read("coc"),
                read("places"),
                self.fine,
                self.size,
                np.int32(self.levels),
                np.int32(self.method.cull),
                np.float32(rays.farthest),
                np.float32(_still_px(not self.halvings) if self.method.adaptive or self.layers.total == 1 else -1.0),
            ),
            self.cells,
        )

    def _split(self, plain: range) -> None:
        """Fill the layers, as cones see them; of peels, find only what C layers have."""
        for layer in range(self.layers.total):
            stack = write("layers") if layer == 0 else read_write("layers")
            number = np.int32(layer)
            target = stack if layer in plain else write("split")
            self._add(
                "multiview_split",
                (
                    *(() if self.peeled else (target,)),
                    write("moments") if layer == 0 else read_write("moments"),
                    read(self.color),
                    *(read(name) for name in ("inv_depth", "extent", "nbuffer", "wanted", "places")),
                    self.fine,
                    np.int32(self.cells[0]),
                    *self.lens,
                    number,
                    number if layer in plain else np.int32(0),
                ),
                self.fine_cells,
                self.fine_bytes,
            )
            if layer in plain:
                continue
            self._add(
                "multiview_cone",
                (
                    stack,
                    *(read(name) for name in ("split", "nbuffer", "wanted", "places")),
                    self.fine,
                    self.size,
                    number,
                    number,
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
            peels = tuple(read(name) for name in ("inv_depth", "extent", "places"))
            if self.halvings:
                peels = (*peels, read("points"), *self.lens)
        out = (read_write if self.shape.is_sparse else write)("image")
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
                *((read("gaps"),) if self.shape.is_sparse else ()),
            ),
            (-(-self.width // (self.lanes * self.stride)), height),
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
