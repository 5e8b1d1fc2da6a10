"""Gather blur: each pixel averages samples of its own circle of confusion. The plain baseline.

One RGBZ image (all peels composed), no hidden surfaces. With ``kernel="disc"`` samples in front of the pixel that are
too sharp to reach it are left out, so what is in focus does not bleed into what is blurred behind it. A pixel in focus
gathers only from itself, so what is blurred in front of it keeps a hard edge: gathering cannot do better, and the other
methods are there for it. ``kernel="gaussian"`` is the image-space blur that people write first: it looks at no depth
but the pixel's own.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..frame import LayeredFrame
from ..host.device import Traits
from ..host.passes import Buffer, FrameProgram, Param, Pass, Role, read, write
from ..lens import Lens, lens_samples
from .base import FrameShape, Locality, Plan, struct_scalar
from .pyramid import SIZE as FLATTEN_SIZE

__all__ = ["Gather", "gather_samples"]

_SIZE = np.dtype([(name, np.int32) for name in ("width", "height", "pitch", "guard")])
_MAX_SAMPLES = 4096


@dataclass(frozen=True)
class Gather:
    """Options of the gather blur.

    Parameters
    ----------
    samples : int
        Samples of each pixel's CoC, 1 to 4096: a spiral that covers it evenly.
    kernel : {"disc", "gaussian"}
        A disc of the CoC, depth-aware; or a Gaussian of half its radius that looks at no depth.
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
        farthest, nearest = frame.inverse_depth_range
        if not frame.is_opaque:
            farthest = 0.0  # the void is a surface at infinity
        summary = {
            "method": self.name,
            **{field.name: getattr(self, field.name) for field in fields(self)},
            "largest_coc_px": max(abs(c1 * farthest + c0), abs(c1 * nearest + c0)),
        }
        return Plan((), {"c1": np.float32(c1), "c0": np.float32(c0)}, summary)

    def locality(self, shape: FrameShape, plan: Plan, traits: Traits, tail: float) -> Locality:
        """Each pixel looks at its own CoC and nothing reaches it from outside; below half a pixel it is itself."""
        return Locality(
            align_px=16,
            margin_px=math.ceil(plan.summary["largest_coc_px"]) + 2,
            reach_px=lambda coc: coc,
            leak=lambda coc: np.where(coc < 0.5, 0.0, 1.0),
            spreads=False,
            closed_step_px=math.inf,
        )

    def program(self, shape: FrameShape, plan: Plan, traits: Traits) -> FrameProgram:
        """Compose all peels, then gather."""
        pixels, padded = shape.height * shape.width, shape.height * shape.pitch
        samples = gather_samples(self.samples, self.kernel)
        items = 1 if traits.is_cpu else min(64, traits.max_work_group_size)
        local_size = (1, 1) if traits.is_cpu else None
        extent = (shape.width, shape.height, shape.pitch)
        flatten_size = struct_scalar(FLATTEN_SIZE, *extent, shape.layers, 1, 0, shape.guard_px)
        size = struct_scalar(_SIZE, *extent, shape.guard_px)
        buffers = [
            Buffer("color", shape.layers * pixels * 16, Role.INPUT),
            Buffer("inv_depth", shape.layers * padded * 4, Role.INPUT),
            Buffer("image", math.prod(shape.output_size) * 16, Role.OUTPUT),
            Buffer("samples", samples.nbytes, Role.CONSTANT, samples),
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
                read("samples"),
                size,
                np.int32(self.samples),
                Param("c1", np.dtype(np.float32)),
                Param("c0", np.dtype(np.float32)),
            ),
            (items, shape.output_size[0]),
            local_size,
            (("GATHER_DEPTH_AWARE", int(self.kernel == "disc")),),
            traffic_bytes=36 * pixels,
            flops=12 * self.samples * pixels,
        )
        return FrameProgram.of(buffers, [flatten, blur])


def gather_samples(count: int, kernel: str = "disc") -> NDArray[np.float32]:
    """Samples as kernels/gather.cl takes them.

    Returns
    -------
    ndarray, (count, 3), float32
        ``(x, y, distance from the middle)`` in CoC radii.
    """
    points = lens_samples(count, kernel)
    table = np.concatenate([points, np.hypot(*points.T)[:, None]], axis=1)
    return np.ascontiguousarray(table, dtype=np.float32)
