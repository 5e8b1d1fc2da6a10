"""Shading from points of the lens, for methods whose frames are glossy: kernels/shading.clh, shading.cl."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..host.device import Traits
from ..host.passes import Buffer, Param, Pass, Role, read, write
from ..lighting import Environment
from .base import FrameShape

__all__ = ["PLANES", "environment_of", "shading_defines", "shading_inputs", "split_pass", "view_pass"]

PLANES = 7
"""Of the ``surface`` buffer: unit normal, specular reflectance, roughness. As kernels/shading.cl has it."""

_LIGHTING_BYTES = 72 * 16
_READ = ("normal", "specular", "shininess", "lighting")


def shading_defines(shape: FrameShape) -> tuple[tuple[str, int], ...]:
    """What kernels that include shading.clh are built with."""
    return (("SHADING_ENVIRONMENT", int("environment" in shape.surface)),)


def environment_of(shape: FrameShape) -> str:
    """The buffer that goes in for ``environment``; of frames without one, a place-holder."""
    return "environment" if "environment" in shape.surface else "lighting"


def shading_inputs(shape: FrameShape) -> list[Buffer]:
    """Buffers of a glossy frame that :func:`split_pass` and shading kernels read."""
    slots = shape.layers * shape.height * shape.width
    sizes = {"normal": slots * 12, "specular": slots * 12, "shininess": slots * 4, "lighting": _LIGHTING_BYTES}
    if "environment" in shape.surface:
        sizes["environment"] = Environment.TEXELS * 16
    return [Buffer(name, nbytes, Role.INPUT) for name, nbytes in sizes.items()]


def split_pass(shape: FrameShape, traits: Traits) -> tuple[Pass, list[Buffer]]:
    """Take what surfaces mirror out of ``color``: the pass, and the buffers ``matte`` and ``surface`` that it makes."""
    slots = shape.layers * shape.height
    buffers = [
        Buffer("matte", slots * shape.width * 16),
        Buffer("surface", slots * shape.pitch * 4 * PLANES),
    ]
    inputs = [read(name) for name in ("color", "inv_depth", *_READ, environment_of(shape))]
    traffic = sum(buffer.nbytes for buffer in buffers) + slots * shape.width * 48
    return _pass("shading_split", (write("matte"), write("surface"), *inputs), shape, traits, (), traffic), buffers


def view_pass(shape: FrameShape, traits: Traits, eye: NDArray[np.float64]) -> Pass:
    """Make the buffer ``view``, the peels' colours as a point of the lens sees them, from what :func:`split_pass` made.

    ``eye`` is (right, up) in units of the lens's radius; the radius is the parameter ``aperture_radius_m``.
    """
    inputs = [read(name) for name in ("matte", "surface", "inv_depth", "lighting", environment_of(shape))]
    place = (np.float32(eye[0]), np.float32(eye[1]), Param("aperture_radius_m", np.dtype(np.float32)))
    traffic = shape.layers * shape.height * shape.width * (32 + 4 * PLANES)
    return _pass("shading_view", (write("view"), *inputs), shape, traits, place, traffic)


def _pass(
    kernel: str, buffers: tuple[Any, ...], shape: FrameShape, traits: Traits, rest: tuple[Any, ...], traffic: int
) -> Pass:
    sizes = (np.int32(n) for n in (shape.layers, shape.height, shape.width, shape.pitch))
    extent = (shape.pitch // traits.lanes, shape.height, shape.layers)
    local_size = (1, 1, 1) if traits.is_cpu else None  # every new local size costs PoCL a compilation
    defines = shading_defines(shape)
    return Pass("shading", kernel, (*buffers, *sizes, *rest), extent, local_size, defines, traffic_bytes=traffic)
