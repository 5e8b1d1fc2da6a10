"""Vendor workarounds: the one place that looks at vendor names. Everything else branches on traits and probes."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

__all__ = ["QUIRKS", "Effect", "Quirk", "effects_of"]


class Effect(Enum):
    """What the library does differently."""

    DRIVER_CACHES_BUILDS = "the driver keeps built programs on disk; ours would only be a second copy"
    NEEDS_LINKER = "needs the system linker for every build, and ends the whole process where there is none"
    VECTORIZES_VECTORS = "builds take ten times as long unless told that kernels use vectors already"
    TRUSTS_CACHE = "takes whatever is in its folder of programs for whole; a process gets a folder of its own"
    LAST_RESORT = "chosen only by name or index, or when there is nothing else"


@dataclass(frozen=True)
class Quirk:
    """One row: which devices, what changes, why, where that is known from, and when it was last seen.

    Parameters
    ----------
    platform, device : str
        Lower-case substrings of the platform's and the device's name; an empty one matches all.
    effect : Effect
    reason : str
    source : str
        Link or measurement.
    date : str
        ISO date of the last check.
    """

    platform: str
    device: str
    effect: Effect
    reason: str
    source: str
    date: str

    def matches(self, platform: str, device: str) -> bool:
        """Whether this row speaks of that device."""
        return self.platform in platform.lower() and self.device in device.lower()


QUIRKS = (
    Quirk(
        platform="portable computing language",
        device="",
        effect=Effect.DRIVER_CACHES_BUILDS,
        reason="POCL_CACHE_DIR holds programs and work-group functions, keyed on source and driver",
        source="seen: a second process builds in a fraction of the time; PoCL 3.0",
        date="2026-11-23",
    ),
    Quirk(
        platform="nvidia cuda",
        device="",
        effect=Effect.DRIVER_CACHES_BUILDS,
        reason="the driver has a compute cache (CUDA_CACHE_PATH)",
        source="pyopencl.characterize.has_src_build_cache, pyopencl 2026.1; not tried here",
        date="2026-11-23",
    ),
    Quirk(
        platform="portable computing language",
        device="",
        effect=Effect.NEEDS_LINKER,
        reason="kernels are linked with `ld` against libgcc and libc; PoCL calls abort() when that fails",
        source="seen with pip's PoCL 3.0 in a bare Debian 12",
        date="2026-11-23",
    ),
    Quirk(
        platform="portable computing language",
        device="",
        effect=Effect.TRUSTS_CACHE,
        reason="a process that dies while it compiles leaves a program without kernels, over which later ones abort()",
        source="seen with pip's PoCL 3.0 on AMD Zen 4, and wherever it is told that it runs on znver3 with AVX-512",
        date="2026-11-30",
    ),
    Quirk(
        platform="intel(r) opencl",
        device="",
        effect=Effect.VECTORIZES_VECTORS,
        reason="layered.cl builds in 11.5 s, with vec_type_hint in 0.9; frames of all methods take the same time",
        source="measured with Intel's CPU runtime 2026.22; what the attribute is for: OpenCL C 1.2, section 6.7.2",
        date="2026-11-23",
    ),
    Quirk(
        platform="",
        device="llvmpipe",
        effect=Effect.LAST_RESORT,
        reason="a conformance device: 17-170 ns per work-item, against 0.3-6 for the other CPU drivers",
        source="measured with Debian's mesa-opencl-icd",
        date="2026-11-23",
    ),
    Quirk(
        platform="oclgrind",
        device="",
        effect=Effect.LAST_RESORT,
        reason="a debugger: 30-130 us per pixel",
        source="measured with Debian's oclgrind",
        date="2026-11-23",
    ),
)


def effects_of(platform: str, device: str) -> frozenset[Effect]:
    """Effects that apply to the device of that name on that platform."""
    return frozenset(quirk.effect for quirk in QUIRKS if quirk.matches(platform, device))
