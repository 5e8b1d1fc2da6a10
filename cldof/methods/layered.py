"""The layered method (Schedl & Wimmer 2012): matting, cascaded Gaussian blur, compositing from both ends.

M peels are split into K depth layers by matting functions over the signed circle of confusion. From the nearest layer
and from the farthest one, layers are composed and blurred step by step towards the layer in focus (their eq. 13): a
layer ``n`` steps from the focus is blurred by all ``n`` steps, in total ``sigma_n^2 = step_1^2 + ... + step_n^2`` with
``step_n = n * sigma_step`` (eqs. 14-15).

``matting="paper"`` uses the published matting functions. The default differs in five things, each measured in
docs/decisions.md; kernels/layered.cl says how.

- Anchors stand at the CoC of their layer, not half-way to the next (eq. 9). Over the interval behind anchor k the
  weight in layer k falls from 1 to 0 in front of a full layer k+1, so what is seen passes from the blur of layer k to
  that of layer k+1; it is right at both ends only if the anchors are the layers' own CoC. In particular the plane in
  focus stays untouched.
- A surface enters the next layer early only where it slopes into it, as far as the blur opens a seam. Entering every
  layer a whole interval early widens silhouettes.
- A surface takes full weight in its own layer where it is broad, a share where it is thin: coverage that blurs to
  little must not be counted twice.
- Hidden slots fall gently where no nearer surface would be covered.
- Glass is shared out between two layers so that it lets through what its alpha says.

Ramps are linear in the CoC, not in z, so that they may reach beyond infinity.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from functools import lru_cache
from itertools import count
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..frame import LayeredFrame
from ..host.device import Traits
from ..host.passes import Buffer, FrameProgram, Local, Param, Pass, Role, read, read_write, write
from ..lens import GAUSSIAN_SIGMA, Lens
from . import gaussian
from .base import Array, FrameShape, Locality, Plan, struct_scalar

__all__ = ["MAX_LAYERS", "LayerStack", "Layered", "matting_functions"]

# Constants of kernels/layered.cl and fir.clh.
MAX_LAYERS = 32
_TILE = 64
_FIR_RUN = 4

# A side whose largest CoC radius (px) stays below this gets no layers: the largest change is then below 1e-5 of a pixel
# value, since a Gaussian of sigma 5e-4 px keeps all but exp(-2e6) of a pixel in place.
_NEGLIGIBLE_COC_PX = 1e-3

# Layers blur by no more than this many times the frame's larger side, as CoC radius; the outermost ones take what is
# blurred more. By then nothing is left of a frame but the mean of its edges.
_WIDEST_SIDES = 4.0

# A surface that slopes into a layer enters it this many sigma early, so that no seam opens between blurred layers.
_SEAM_REACH = 2.0

# Steps of the cascade when none is given: 1 px, or less until the side with more blur has so many layers, but no less
# than 2^(-12/8) = 0.35 px. Fewer layers cost quality, finer steps are below what pixels can show.
_STEPS_PER_OCTAVE = 8
# Above this sigma (px) the variance of taps is an integral.
_LARGE_SIGMA = 16.0
_USUAL_LAYERS_A_SIDE = 8
_FINEST_STEP = 12

_SIZE = np.dtype([(name, np.int32) for name in ("width", "height", "pitch", "peels", "tiles_x", "tiles_y")])
_STEP = np.dtype(
    [
        (name, np.int32)
        for name in ("layer", "in_front", "below", "radius_in", "taps_in", "radius_out", "taps_out", "segment")
    ]
)
_RESOLVE = np.dtype(
    [
        (name, np.int32)
        for name in ("layer", "front", "back", "radius_front", "taps_front", "radius_back", "taps_back", "guard")
    ]
)
_MATTING = np.dtype(
    [
        ("layer", np.float32, (MAX_LAYERS, 4)),
        ("reach", np.float32, (MAX_LAYERS,)),
        ("around", np.int32, (MAX_LAYERS,)),
    ]
)


class LayerStack(NamedTuple):
    """Which depth layers there are: ``front`` in front of the focus, one in focus, ``back`` behind it."""

    front: int
    back: int
    sigma_step: float

    @property
    def total(self) -> int:
        """K."""
        return self.front + 1 + self.back

    def step_sigma(self, layer: int) -> float:
        """Sigma in px of the blur after composing a layer (eq. 14)."""
        return self.sigma_step * abs(layer - self.front)


@dataclass(frozen=True)
class _Blocking:
    """How the FIR kernels cut an image into work-groups."""

    rows: int  # FIR_ROWS
    gap: int  # FIR_GAP
    span: int  # LAYERED_SPAN, a multiple of all lanes; 0: as the device's lanes
    segment: int  # pixels of a row that a work-group owns, where local memory has room for them
    local_size: int
    largest_fir_sigma: float  # above it the recursive engine is faster

    @property
    def defines(self) -> tuple[tuple[str, int], ...]:
        return (("FIR_ROWS", self.rows), ("FIR_GAP", self.gap))

    @property
    def line_bytes(self) -> int:
        """Of a pixel's column in the lines, FIR_LINE floats."""
        return self.rows * 16 + self.gap * 4

    def segment_within(self, local_bytes: int, radius: int) -> int:
        """The longest segment, in whole tiles, whose lines fit with what a filter reads around them; 0 for none."""
        # A byte more a pixel is plenty for the words that layered_step keeps per tile.
        room = (local_bytes - 64) // (self.line_bytes + 1) - 2 * _halo(radius)
        return max(0, min(self.segment, room // _TILE * _TILE))


# On a CPU one work-item owns a block of lines that stays in its L2 cache with the rows that the next block reads again;
# measured on a Zen 3 against 8 rows and segments of 256 and 512. The values for GPUs are reasoned, not measured: enough
# items per group to hide latency, accumulators that fit the registers.
_CPU_BLOCKING = _Blocking(rows=4, gap=0, span=64, segment=1024, local_size=1, largest_fir_sigma=8.0)
_GPU_BLOCKING = _Blocking(rows=4, gap=4, span=0, segment=256, local_size=64, largest_fir_sigma=12.0)


@dataclass(frozen=True)
class Layered:
    """Options of the layered method.

    Parameters
    ----------
    layers : int, optional
        The most depth layers K to use, 3 to 32. Steps grow when the CoC range asks for more. None: up to 32.
    sigma_step : float, optional
        Step of the cascade in px: the blur grows by ``n * sigma_step`` at the n-th layer from the focus. Smaller steps
        give more layers and as a rule a better match; 1 is the paper's. None: 1, or as much less as gives the side with
        more blur eight layers.
    cascade : bool
        False blurs every layer by itself (the paper's slower variant).
    matting : {"seamless", "paper"}
        Matting functions; see the module's text.
    engine : {"auto", "fir", "iir"}
        Gaussian engine; "auto" takes FIR for small sigma and the recursive one above, by device.
    """

    layers: int | None = None
    sigma_step: float | None = None
    cascade: bool = True
    matting: str = "seamless"
    engine: str = "auto"

    name = "layered"
    simulated_aperture = "gaussian"

    def __post_init__(self) -> None:
        if self.layers is not None and not (isinstance(self.layers, int) and 3 <= self.layers <= MAX_LAYERS):
            raise InputError(f"layered: layers is {self.layers!r}; it must be a whole number from 3 to {MAX_LAYERS}.")
        step = self.sigma_step
        if step is not None and not (isinstance(step, int | float) and 0.1 <= step < math.inf):
            raise InputError(f"layered: sigma_step is {step!r}; it must be a number of at least 0.1 px.")
        for name, choices in (("matting", ("seamless", "paper")), ("engine", ("auto", "fir", "iir"))):
            if getattr(self, name) not in choices:
                raise InputError(f"layered: {name} is {getattr(self, name)!r}; choose one of {', '.join(choices)}.")

    def plan(self, frame: LayeredFrame, lens: Lens) -> Plan:
        """Choose K, the focus layer and the step from the CoC range; derive the matting functions."""
        return self._plan(frame, lens, both_sides=False)

    def plan_both_sides(self, frame: LayeredFrame, lens: Lens) -> Plan:
        """The same with as many layers on the side with less blur as on the other, empty ones: for comparison."""
        return self._plan(frame, lens, both_sides=True)

    def _plan(self, frame: LayeredFrame, lens: Lens, both_sides: bool) -> Plan:
        c1, c0 = lens.coc_coefficients(frame.camera)
        farthest, nearest = frame.shown_inverse_depths
        near_px, far_px = max(0.0, -(c1 * nearest + c0)), max(0.0, c1 * farthest + c0)
        widest_px = _WIDEST_SIDES * max(frame.width, frame.height)
        stack = self._stack(min(near_px, widest_px), min(far_px, widest_px))
        coc = layer_coc(stack)
        before = 0
        if both_sides:
            most = max(stack.front, stack.back)
            before = min(most - stack.front, MAX_LAYERS - stack.total)
            after = min(most - stack.back, MAX_LAYERS - stack.total - before)
        params = np.zeros((), _MATTING)
        there = slice(before, before + stack.total)
        params["layer"][there] = matting_functions(coc, c1, c0, self.matting)
        sigma = GAUSSIAN_SIGMA * np.abs(coc)
        # Neighbouring layers blur by different amounts: their seam and a surface's breadth go by the greater.
        sigma[1:] = np.maximum(sigma[1:], sigma[:-1])
        params["reach"][there] = _SEAM_REACH * sigma
        params["around"][there] = np.maximum(1, np.ceil(sigma))
        if both_sides:
            stack = LayerStack(before + stack.front, stack.back + after, stack.sigma_step)
        summary = {
            "method": self.name,
            **{field.name: getattr(self, field.name) for field in fields(self)},
            "layers": stack.total,
            "focus_layer": stack.front,
            "sigma_step": stack.sigma_step,
            "layer_coc_px": coc.tolist(),
            "largest_near_coc_px": near_px,
            "largest_far_coc_px": far_px,
        }
        return Plan(stack, {"matting": params[()]}, summary)

    def program(self, shape: FrameShape, plan: Plan, traits: Traits) -> FrameProgram:
        """Declare the frame's passes."""
        stack = plan.structure
        assert isinstance(stack, LayerStack)
        return _Builder(self, shape, stack, traits).build()

    def locality(self, shape: FrameShape, plan: Plan, traits: Traits, tail: float) -> Locality:
        """A slot is blurred as the layer beyond it; in front of the layer in focus stands what is out of it."""
        stack = plan.structure
        assert isinstance(stack, LayerStack)
        if stack.total == 1:
            return Locality(_TILE, 0, np.zeros_like, np.zeros_like)
        is_recursive = _Engines(self, traits).is_recursive
        coc = np.abs(layer_coc(stack))
        sides = [coc[stack.front :: -1], coc[stack.front :]]
        longest = max(sides, key=len)
        if self.cascade:
            sigmas = [stack.sigma_step * n for n in range(1, len(longest))]
        else:
            sigmas = [GAUSSIAN_SIGMA * float(c) for c in longest[1:]]
        blurs = tuple((sigma, is_recursive(sigma)) for sigma in sigmas)
        reaches = [_reach(blurs[0 if self.cascade else n : n + 1], tail) for n in range(len(blurs))]
        reach = np.array([0.0, *reaches])
        # To what is in front of a pixel, and from there to what shows where it lets light through, once.
        around = math.ceil(GAUSSIAN_SIGMA * float(longest[-1])) + 2

        def reach_px(coc_px: Array) -> Array:
            return np.asarray(reach[np.minimum(np.searchsorted(longest, coc_px), len(longest) - 1)])

        def leak(coc_px: Array) -> Array:
            # Published anchors blur even what is in focus.
            share = 2.0 * coc_px / longest[1] if self.matting == "seamless" else np.ones_like(coc_px)
            return np.minimum(share, 1.0)

        return Locality(_TILE, int(reach[-1]) + around, reach_px, leak, tail=tail, engines=_in_words(blurs))

    def _stack(self, near_px: float, far_px: float) -> LayerStack:
        """The fewest layers that reach both ends of the CoC range, with the step enlarged until they are few enough."""
        most = self.layers or MAX_LAYERS
        first = self.sigma_step or _usual_step(max(near_px, far_px), self.matting)
        for exponent in count():
            # A grid of steps, so that a lens in motion keeps to few pass lists.
            step = first * math.pow(2.0, exponent / _STEPS_PER_OCTAVE)
            front, back = (_layers_needed(px, step, self.matting) for px in (near_px, far_px))
            if front + 1 + back <= most:
                return LayerStack(front, back, step)
        raise AssertionError("a step that is large enough needs one layer a side")


def _usual_step(largest_coc_px: float, matting: str) -> float:
    for exponent in range(_FINEST_STEP + 1):
        step = math.pow(2.0, -exponent / _STEPS_PER_OCTAVE)
        if _layers_needed(largest_coc_px, step, matting) >= _USUAL_LAYERS_A_SIDE:
            break
    return step


def _layers_needed(largest_coc_px: float, step: float, matting: str) -> int:
    if largest_coc_px < _NEGLIGIBLE_COC_PX:
        return 0
    needed = 1
    while needed < MAX_LAYERS and _side_coc(needed, step)[-2 if matting == "paper" else -1] < largest_coc_px:
        needed += 1
    return needed


@lru_cache(maxsize=256)
def _side_coc(last: int, step: float) -> tuple[float, ...]:
    """CoC radii in px of the layers 0 (focus) to ``last`` on one side: what the filters really add up to."""
    variances = [0.0] + [_variance(n * step) for n in range(1, last + 1)]
    return tuple(math.sqrt(total) / GAUSSIAN_SIGMA for total in np.cumsum(variances).tolist())


@lru_cache(maxsize=1024)
def _variance(sigma: float) -> float:
    """Variance that a step adds. Cut off and sampled taps have less than sigma^2, and the layers' CoC follow that."""
    if sigma <= _LARGE_SIGMA:
        return gaussian.fir_variance(gaussian.fir_taps(sigma))
    end = (gaussian.fir_radius(sigma) + 0.5) / sigma  # 1e-6 from the sum over taps
    density = math.exp(-0.5 * end * end) / math.sqrt(2.0 * math.pi)
    return sigma * sigma * (1.0 - 2.0 * end * density / math.erf(end / math.sqrt(2.0)))


def layer_coc(stack: LayerStack) -> NDArray[np.float64]:
    """Signed CoC radius in px of each layer, (K,), rising; 0 for the layer in focus."""
    front = [-c for c in _side_coc(stack.front, stack.sigma_step)[:0:-1]]
    return np.array([*front, *_side_coc(stack.back, stack.sigma_step)])


def matting_functions(coc: NDArray[np.float64], c1: float, c0: float, matting: str = "seamless") -> NDArray[np.float64]:
    """Matting functions as kernels/layered.cl takes them (Schedl & Wimmer 2012, eqs. 3-4).

    Parameters
    ----------
    coc : ndarray, (K,)
        Signed CoC radius of each layer in px, rising.
    c1, c0 : float
        The lens: ``C = c1 / z + c0``.
    matting : {"seamless", "paper"}
        Anchors at the layers' own CoC or half-way to the next (eq. 9).

    Returns
    -------
    ndarray, (K, 4)
        ``(up scale, up offset, down scale, down offset)`` in inverse depth. The first layer has no rise and the last no
        fall: they take all that is nearer and farther.
    """
    total = len(coc)
    if total == 1:
        return np.array([(0.0, 1.0, 0.0, 1.0)])
    # anchor[k + 2] is z_k as a CoC, for k = -2 .. K; beyond the layers they go on at the same distance.
    before, after = coc[0] - (coc[1] - coc[0]), coc[-1] + (coc[-1] - coc[-2])
    line = np.array([2 * before - coc[0], before, *coc, after])
    anchor = line if matting == "seamless" else (line + np.append(line[1:], 2 * after - coc[-1])) / 2.0
    functions = np.empty((total, 4))
    for k in range(total):
        rise_from, rise_to, fall_from, fall_to = anchor[k : k + 4]
        up, down = 1.0 / (rise_to - rise_from), 1.0 / (fall_to - fall_from)
        functions[k] = (c1 * up, (c0 - rise_from) * up, -c1 * down, (fall_to - c0) * down)
    functions[0, :2] = 0.0, 1.0
    functions[-1, 2:] = 0.0, 1.0
    return functions


@lru_cache(maxsize=512)
def _reach(blurs: tuple[tuple[float, bool], ...], tail: float) -> int:
    """Pixels along an axis within which all but ``tail`` of a cascade's light stays; (sigma, is recursive) by blur."""
    kernel = np.ones(1)
    for sigma, is_recursive in blurs:
        if is_recursive:
            pole, gain = gaussian.iir_sections(sigma)[:, :4].astype(np.float64).view(np.complex128).T
            distance = np.abs(np.arange(-math.ceil(12 * sigma), math.ceil(12 * sigma) + 1))
            taps = np.abs((gain * pole ** distance[:, None]).real.sum(axis=1))
        else:
            taps = gaussian.fir_taps(sigma)
        kernel = np.convolve(kernel, taps)
    radius = len(kernel) // 2
    # Outside of +-r along one axis or the other.
    outside = 2.0 * (1.0 - np.cumsum(kernel[radius:] * np.where(np.arange(radius + 1) > 0, 2.0, 1.0)) / kernel.sum())
    return int(np.searchsorted(-outside, -tail))


def _in_words(blurs: tuple[tuple[float, bool], ...]) -> str:
    """Which of the blurs of the longer side are done how; (sigma, is recursive) by blur."""
    parts = []
    for recursive, name in ((False, "by taps (FIR)"), (True, "recursive (IIR)")):
        sigmas = [sigma for sigma, is_recursive in blurs if is_recursive == recursive]
        if sigmas:
            parts.append(f"{len(sigmas)} {name}, sigma {min(sigmas):.2g} to {max(sigmas):.2g} px")
    return "; ".join(parts)


class _Taps:
    """All FIR taps of a frame in one buffer."""

    def __init__(self) -> None:
        self._chunks: list[NDArray[np.float32]] = []
        self._starts: dict[float, tuple[int, int]] = {}
        self.start(0.0)

    def start(self, sigma: float) -> tuple[int, int]:
        """(radius, where the taps start); sigma 0 is the identity."""
        if sigma not in self._starts:
            start = sum(map(len, self._chunks))
            taps = gaussian.fir_taps(sigma) if sigma > 0.0 else np.ones(1)
            radius = len(taps) // 2
            self._chunks.append(gaussian.half_taps(taps))
            self._starts[sigma] = (radius, start)
        return self._starts[sigma]

    def data(self) -> NDArray[np.float32]:
        return np.concatenate(self._chunks)


class _Image(NamedTuple):
    """A partly blurred image: where it is and which column filter it is still owed."""

    name: str
    reached: str
    below: int  # 0 none, 1 sparse, 2 everywhere; as in kernels/layered.cl
    sigma: float


class _Engines:
    """Which blurs are recursive on a device."""

    def __init__(self, method: Layered, traits: Traits) -> None:
        self.method, self.local_limit = method, traits.local_mem_bytes
        self.blocking = _CPU_BLOCKING if traits.is_cpu else _GPU_BLOCKING
        self.span = self.blocking.span or traits.lanes

    def is_recursive(self, sigma: float) -> bool:
        if sigma <= 0.0:
            return False
        fits = self.blocking.segment_within(self.local_limit, gaussian.fir_radius(sigma)) > 0
        if self.method.engine == "fir" and not fits:
            raise InputError(
                f"layered: engine='fir' cannot blur by sigma {sigma:.1f} px on this device: its local memory of "
                f"{self.local_limit} bytes is too small. Use engine='auto'."
            )
        if self.method.engine == "auto":
            return sigma > self.blocking.largest_fir_sigma or not fits
        return self.method.engine == "iir"


class _Builder:
    """Lists the passes of one frame."""

    def __init__(self, method: Layered, shape: FrameShape, stack: LayerStack, traits: Traits) -> None:
        self.method, self.shape, self.stack = method, shape, stack
        self.engines = _Engines(method, traits)
        self.blocking = blocking = self.engines.blocking
        self.local_size = min(blocking.local_size, traits.max_work_group_size)
        self.pixels_a_vector = traits.lanes // 4
        self.tiles_x, self.tiles_y = -(-shape.width // _TILE), -(-shape.height // blocking.rows)
        self.size = struct_scalar(
            _SIZE, shape.width, shape.height, shape.pitch, shape.layers, self.tiles_x, self.tiles_y
        )
        self.image_bytes = shape.height * shape.pitch * 16
        self.pixels = shape.height * shape.width
        self.taps = _Taps()
        self.buffers = [
            Buffer("color", shape.layers * self.pixels * 16, Role.INPUT),
            Buffer("inv_depth", shape.layers * shape.height * shape.pitch * 4, Role.INPUT),
            Buffer("image", math.prod(shape.output_size) * 16, Role.OUTPUT),
            Buffer("matting", _MATTING.itemsize),
            Buffer("tile_peels", stack.total * self.tiles_x * self.tiles_y * 4),
        ]
        self.passes: list[Pass] = []
        # What kernels are handed where there is no image to read yet.
        self.nothing = _Image("taps", "tile_peels", 0, 0.0)
        self.defines: tuple[tuple[str, int], ...] = ()

    def build(self) -> FrameProgram:
        self._set_defines(alpha_run=False)
        self._classify()
        self._compose("rgb")
        if not self.shape.is_opaque:
            self._set_defines(alpha_run=True)
            self._compose("alpha")
        data = self.taps.data()
        self.buffers.append(Buffer("taps", data.nbytes, Role.CONSTANT, data))
        return FrameProgram.of(self.buffers, self.passes)

    def _set_defines(self, alpha_run: bool) -> None:
        self.defines = (
            *self.blocking.defines,
            ("LAYERED_SPAN", self.engines.span),
            ("LAYERED_VOID", int(not self.shape.is_opaque)),
            ("LAYERED_ALPHA_RUN", int(alpha_run)),
            ("LAYERED_GLASS", int(self.shape.has_glass and self.method.matting != "paper")),
            ("LAYERED_PAPER", int(self.method.matting == "paper")),
        )
        # The second run fills in the alpha of the image that the first one wrote.
        self.image = read_write("image") if alpha_run else write("image")

    def _compose(self, run: str) -> None:
        if self.method.cascade:
            focus = self.stack.front
            front = self._cascade(f"{run}_front", range(focus), in_front=True)
            back = self._cascade(f"{run}_back", range(self.stack.total - 1, focus, -1), in_front=False)
            self._resolve(front, back)
        else:
            self._each_by_itself(run)

    def _classify(self) -> None:
        self._add("layered_matting", (write("matting"), Param("matting", _MATTING)), (1,))
        self._add(
            "layered_classify",
            (write("tile_peels"), read("inv_depth"), read("matting"), self.size, np.int32(self.stack.total)),
            (self.tiles_x, self.tiles_y),
            traffic_bytes=self.shape.layers * self.shape.height * self.shape.pitch * 4,
        )

    def _cascade(self, name: str, layers: range, in_front: bool) -> _Image:
        image = self.nothing
        for layer in layers:
            image = self._step(f"{name}_{layer}", layer, image, in_front, self.stack.step_sigma(layer))
        return image

    def _each_by_itself(self, run: str) -> None:
        """Blur every layer alone and put one behind the other, nearest first."""
        composed = f"{run}_composed"
        self._image_buffer(composed)
        sigmas = GAUSSIAN_SIGMA * np.abs(layer_coc(self.stack))
        for layer in range(self.stack.total):
            image = self._step(f"{run}_layer_{layer}", layer, self.nothing, True, float(sigmas[layer]))
            radius, start = self.taps.start(image.sigma)
            self._add(
                "layered_under",
                (
                    write(composed) if layer == 0 else read_write(composed),
                    read(image.name),
                    read("taps"),
                    self.size,
                    np.int32(layer == 0),
                    np.int32(radius),
                    np.int32(start),
                ),
                (-(-self.shape.width // self.pixels_a_vector), -(-self.shape.height // _FIR_RUN)),
                traffic_bytes=self.pixels * 16 * (2 if layer == 0 else 3),
            )
        self._add(
            "layered_finish",
            (self.image, read(composed), self.size, np.int32(self.shape.guard_px)),
            (-(-self.shape.width // self.pixels_a_vector), self.shape.height),
            traffic_bytes=self.pixels * 32,
        )

    def _step(self, name: str, layer: int, image: _Image, in_front: bool, sigma: float) -> _Image:
        """Compose one layer with what there is and blur both."""
        recursive = self.engines.is_recursive(sigma)
        radius_in, taps_in = self.taps.start(image.sigma)
        row_sigma = 0.0 if recursive else sigma
        radius_out, taps_out = self.taps.start(row_sigma)
        reached = f"{name}_reached"
        self._image_buffer(name)
        self.buffers.append(Buffer(reached, self.tiles_x * self.tiles_y * 4))
        blocking = self.blocking
        longest = blocking.segment_within(self.engines.local_limit, radius_out)
        segment = min(max(longest, _TILE), -(-self.shape.width // _TILE) * _TILE)
        step = struct_scalar(
            _STEP, layer, int(in_front), image.below, radius_in, taps_in, radius_out, taps_out, segment
        )
        halo_tiles = -(-_halo(radius_out) // _TILE)
        groups = (-(-self.shape.width // segment), self.tiles_y)
        self._add(
            "layered_step",
            (
                write(name),
                write(reached),
                read(image.name),
                read(image.reached),
                read("color"),
                read("inv_depth"),
                read("tile_peels"),
                read("taps"),
                read("matting"),
                self.size,
                step,
                Local(blocking.line_bytes * (segment + 2 * _halo(radius_out))),
                Local((2 * (segment // _TILE) + 2 * halo_tiles) * 4),
            ),
            (groups[0] * self.local_size, groups[1]),
            (self.local_size, 1),
            traffic_bytes=self.pixels * 16 * (2 if image.below else 1),
            flops=8 * self.pixels * (2 * radius_in + 1 + 2 * radius_out + 1),
        )
        if not recursive:
            return _Image(name, reached, 1, sigma)
        return self._recursive(name, sigma)

    def _recursive(self, name: str, sigma: float) -> _Image:
        sections = gaussian.iir_sections(sigma)
        self.buffers.append(Buffer(f"{name}_sections", sections.nbytes, Role.CONSTANT, sections))
        names = (name, f"{name}_rows", f"{name}_blurred")
        extent = tuple(np.int32(n) for n in (self.shape.width, self.shape.height, self.shape.pitch))
        for kernel, source, target, items in (
            ("blur_iir_rows", names[0], names[1], -(-self.shape.height // self.pixels_a_vector)),
            ("blur_iir_columns", names[1], names[2], -(-self.shape.width // self.pixels_a_vector)),
        ):
            self._image_buffer(target)
            self.passes.append(
                Pass(
                    "blur",
                    kernel,
                    (write(target), read(source), read(f"{name}_sections"), *extent),
                    (items,),
                    (1,) if self.local_size == 1 else None,
                    self.blocking.defines,
                    traffic_bytes=4 * self.pixels * 16,
                    flops=48 * 4 * self.pixels,
                )
            )
        return _Image(names[2], "tile_peels", 2, 0.0)

    def _resolve(self, front: _Image, back: _Image) -> None:
        ends = [(image.below, *self.taps.start(image.sigma)) for image in (front, back)]
        resolve = struct_scalar(
            _RESOLVE,
            self.stack.front,
            ends[0][0],
            ends[1][0],
            *ends[0][1:],
            *ends[1][1:],
            self.shape.guard_px,
        )
        self._add(
            "layered_resolve",
            (
                self.image,
                read(front.name),
                read(front.reached),
                read(back.name),
                read(back.reached),
                read("color"),
                read("inv_depth"),
                read("tile_peels"),
                read("taps"),
                read("matting"),
                self.size,
                resolve,
                Local(self.blocking.line_bytes * _TILE),
            ),
            (self.tiles_x * self.local_size, self.tiles_y),
            (self.local_size, 1),
            traffic_bytes=self.pixels * 16 * (1 + bool(front.below) + bool(back.below)),
        )

    def _image_buffer(self, name: str) -> None:
        self.buffers.append(Buffer(name, self.image_bytes))

    def _add(
        self,
        kernel: str,
        args: tuple[Any, ...],
        global_size: tuple[int, ...],
        local_size: tuple[int, ...] | None = None,
        traffic_bytes: int = 0,
        flops: int = 0,
    ) -> None:
        if local_size is None and self.local_size == 1:
            local_size = (1,) * len(global_size)  # every new local size costs PoCL a compilation
        self.passes.append(
            Pass(
                "layered",
                kernel,
                args,
                global_size,
                local_size,
                self.defines,
                traffic_bytes=traffic_bytes,
                flops=flops,
            )
        )


def _halo(radius: int) -> int:
    """Pixels that a line block reaches beyond its segment; as in kernels/layered.cl."""
    return (radius + 15) & ~15
