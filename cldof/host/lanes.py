"""How many floats a work-item computes with at a time, ``LANES`` of the kernels: one table.

As wide as the device's vector registers. Twice as wide halves the registers that a kernel has for different things:
they spill, and compilers warn of calls that pass such vectors, or crash over them. On GPUs a vector is registers of
one thread, and what does not fit goes to memory.
"""

from __future__ import annotations

__all__ = ["GPU_LANES", "LANES", "PROBE_SOURCE", "lanes_for"]

LANES = (16, 8, 4)
"""Widths that the kernels can be built for."""

# One pixel, or four values of neighbouring pixels: registers for a hundred such are what lets enough threads run.
GPU_LANES = 4

# By the compiler's own word, where it is one for a processor: it may know less than the processor can, and what a
# driver says of native widths is then too much (PoCL 3.0 says 16 on AMD's Zen 4, for which its LLVM 14 has no AVX-512).
PROBE_SOURCE = """
__kernel void probe(__global uint *out)
{
#if defined(__AVX512F__)
    out[0] = 16u;
#elif defined(__AVX__)
    out[0] = 8u;
#elif defined(__SSE2__) || defined(__ARM_NEON)
    out[0] = 4u;
#else
    out[0] = 0u;
#endif
}
"""


def lanes_for(is_cpu: bool, compiled_width: int, native_width: int) -> int:
    """The width to build kernels for.

    Parameters
    ----------
    is_cpu : bool
    compiled_width : int
        Floats in a register as :data:`PROBE_SOURCE` finds it; 0 if the compiler does not say.
    native_width : int
        ``CL_DEVICE_NATIVE_VECTOR_WIDTH_FLOAT``.

    Returns
    -------
    int
        One of :data:`LANES`.
    """
    if not is_cpu:
        return GPU_LANES
    width = compiled_width or native_width
    return next((lanes for lanes in LANES if lanes <= width), min(LANES))
