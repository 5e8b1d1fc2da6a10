"""Vendor workarounds: the one place that looks at vendor names. Everything else branches on traits and probes."""

from __future__ import annotations

import atexit
import os
import shutil
import struct
import sys
import tempfile
from contextlib import suppress
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import IO

if sys.platform != "win32":
    import fcntl

__all__ = ["QUIRKS", "Effect", "Quirk", "effects_of", "prepare_environment", "user_cache_dir"]


_MOST_PROCESSES = 64
_LOCK = "cldof.lock"
# Locks on directories, for as long as the process lives: the environment that they go with is the process's, too.
_claimed: dict[Path, IO[bytes]] = {}

# Room that a cache of programs needs: those of all methods take 5 MB.
_CACHE_BYTES = 32 << 20


class Effect(Enum):
    """What the library does differently."""

    DRIVER_CACHES_BUILDS = "the driver keeps built programs on disk; ours would only be a second copy"
    NEEDS_LINKER = "needs the system linker for every build, and ends the whole process where there is none"
    VECTORIZES_VECTORS = "builds take ten times as long unless told that kernels use vectors already"
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


def prepare_environment() -> None:
    """Give PoCL a cache directory that it can write to; runs before pyopencl is imported.

    Without one, PoCL 3.0 either reports no device at all (home directory missing or read-only, as in many containers)
    or fails every build; on a full disk, or when it finds a program that was cut short, it ends the process. Only a
    directory that cannot work is replaced. Processes that build the same program at once crash now and then when they
    share a directory, so a second process at the same time gets one below the first one's.
    """
    chosen = os.environ.get("POCL_CACHE_DIR")
    directory = user_cache_dir() if chosen is None else Path(chosen)
    if not _can_hold_files(directory):
        owner = os.getuid() if hasattr(os, "getuid") else "user"
        directory = Path(tempfile.gettempdir()) / f"cldof-pocl-{owner}"
        os.environ["POCL_CACHE_DIR"] = str(directory)
    elif chosen is None:
        directory = directory / "pocl" / "kcache"  # PoCL's own choice
    own = _claim(directory)
    if own != directory:
        os.environ["POCL_CACHE_DIR"] = str(own)
    _drop_cut_programs(own)


def user_cache_dir() -> Path:
    """Where programs keep what they can make again; need not exist."""
    if base := os.environ.get("XDG_CACHE_HOME") or os.environ.get("LOCALAPPDATA"):
        return Path(base)
    try:
        return Path.home() / ".cache"
    except RuntimeError:  # a user without a home directory
        return Path(tempfile.gettempdir())


def _can_hold_files(directory: Path) -> bool:
    """Whether files can be made in it, or it and its parents can be made, and there is room. Leaves nothing behind."""
    for path in (directory, *directory.parents):
        if path.exists():
            try:
                # Tried, since permissions tell little to root and of file systems that take no files.
                with tempfile.TemporaryFile(dir=path):
                    return shutil.disk_usage(path).free >= _CACHE_BYTES
            except OSError:
                return False
    return False


def _claim(directory: Path) -> Path:
    """A directory that no other process of ours uses: this one, or a numbered one below; until the process ends."""
    if sys.platform == "win32":
        return directory
    for number in range(_MOST_PROCESSES):
        candidate = directory / f"cldof-{number}" if number else directory
        if candidate in _claimed:
            return candidate
        try:
            candidate.mkdir(parents=True, exist_ok=True)
            lock = open(candidate / _LOCK, "wb")  # noqa: SIM115 - held until the process ends
        except OSError:
            break
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            lock.close()
            continue
        _claimed[candidate] = lock
        atexit.register(lock.close)  # an open file at the end of a process is a warning
        return candidate
    return directory


def _drop_cut_programs(directory: Path) -> None:
    """Remove programs that end before their table of sections does, as a power failure or a full disk leaves them."""
    for folder, below, names in os.walk(directory):
        # Those of other processes, which may be writing there.
        below[:] = [name for name in below if not os.path.exists(os.path.join(folder, name, _LOCK))]
        for name in names:
            if name.endswith(".so"):
                with suppress(OSError):
                    _drop_if_cut(os.path.join(folder, name))


def _drop_if_cut(path: str) -> None:
    with open(path, "rb") as file:
        head, size = file.read(64), os.fstat(file.fileno()).st_size
    if len(head) == 64 and head[:5] != b"\x7fELF\x02":
        return  # not one of 64-bit Linux
    if len(head) == 64:
        (table,) = struct.unpack_from("<Q", head, 40)
        entry_bytes, entries = struct.unpack_from("<HH", head, 58)
    if len(head) < 64 or table + entry_bytes * entries > size:
        os.unlink(path)
