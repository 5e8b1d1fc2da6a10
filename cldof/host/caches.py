"""Folders of built programs: PoCL's has to be chosen before pyopencl is imported, and is not to be believed blindly.

PoCL 3.0 trusts its cache. A program over which the compiler died stays there, and all later processes take it for one
without kernels and end in turn, by abort(). So every process of ours has a folder of its own below the one that PoCL
would use, nothing comes into it but what another process built and ran without dying (:mod:`cldof.host.trial`), what
one that was killed may have left is removed before it is read, and a folder that holds such a program is made anew by
the next process.
"""

from __future__ import annotations

import atexit
import os
import shutil
import struct
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO

if sys.platform != "win32":
    import fcntl

__all__ = [
    "adopt_programs",
    "default_cache_dir",
    "give_up_programs",
    "lent_programs",
    "own_programs",
    "prepare_environment",
    "user_cache_dir",
]

_OWN = "cldof"
_LENT = "trial-"
_DAMAGED = "damaged"
_PROGRAMS = "??/*/program.bc"
_MOST_PROCESSES = 64
_LOCK = "cldof.lock"
# Locks on directories, for as long as the process lives: the environment that they go with is the process's, too.
_claimed: dict[Path, IO[bytes]] = {}

# Room that a cache of programs needs: those of all methods take 5 MB.
_CACHE_BYTES = 32 << 20


def user_cache_dir() -> Path:
    """Where programs keep what they can make again; need not exist."""
    if base := os.environ.get("XDG_CACHE_HOME") or os.environ.get("LOCALAPPDATA"):
        return Path(base)
    try:
        return Path.home() / ".cache"
    except RuntimeError:  # a user without a home directory
        return Path(tempfile.gettempdir())


def default_cache_dir() -> Path:
    """Where the library keeps what it built: ``CLDOF_CACHE_DIR``, or the user's cache directory."""
    if chosen := os.environ.get("CLDOF_CACHE_DIR"):
        return Path(chosen)
    return user_cache_dir() / "cldof"


def prepare_environment() -> None:
    """Give PoCL a cache directory of this process's own; runs before pyopencl is imported.

    Without a directory that it can write to, PoCL 3.0 either reports no device at all (home directory missing or
    read-only, as in many containers) or fails every build; on a full disk, or when it finds a program that was cut
    short, it ends the process. Processes that build the same program at once crash now and then when they share one.
    """
    chosen = os.environ.get("POCL_CACHE_DIR")
    # PoCL's own choice, unless told otherwise.
    directory = user_cache_dir() / "pocl" / "kcache" if chosen is None else Path(chosen)
    if directory in _claimed:
        return
    if not _can_hold_files(directory):
        owner = os.getuid() if hasattr(os, "getuid") else "user"
        directory = Path(tempfile.gettempdir()) / f"cldof-pocl-{owner}"
    os.environ["POCL_CACHE_DIR"] = str(_claim(directory))


def own_programs() -> Path:
    """PoCL's folder of programs in this process."""
    return Path(os.environ["POCL_CACHE_DIR"])


@contextmanager
def lent_programs() -> Iterator[Path]:
    """An empty folder that another process may use as PoCL's, removed after.

    To have it begin with what this process has took longer than to build some of it again.
    """
    scratch = Path(tempfile.mkdtemp(prefix=_LENT, dir=own_programs()))
    try:
        yield scratch
    finally:
        shutil.rmtree(scratch, ignore_errors=True)


def adopt_programs(lent: Path) -> None:
    """Take over what was built in such a folder, where it is not there yet.

    Best effort: what is missing is built again.
    """
    source, target = lent / _OWN, own_programs()
    for program in source.glob(_PROGRAMS):
        for folder, _, names in os.walk(program.parent):
            to = target / Path(folder).relative_to(source)
            with suppress(OSError):
                to.mkdir(parents=True, exist_ok=True)
                for name in names:
                    if not (to / name).exists():
                        _link(os.path.join(folder, name), to / name)


def give_up_programs() -> None:
    """Have the next process begin with an empty folder: this one holds a program that cannot be read."""
    with suppress(OSError):
        (own_programs() / _DAMAGED).touch()


def _link(source: str, target: Path) -> None:
    try:
        os.link(source, target)
    except OSError:  # a file system without links
        shutil.copy2(source, target)


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
    """A folder below, which no other process of ours uses until this one ends."""
    for number in range(_MOST_PROCESSES):
        candidate = directory / (f"{_OWN}-{number}" if number else _OWN)
        if sys.platform == "win32" or candidate in _claimed:
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
        _drop_unfinished(candidate)
        return candidate
    return directory


def _drop_unfinished(directory: Path) -> None:
    """Remove programs of which no kernel was ever ready to run, and kernels that were cut short.

    The former is what a process leaves that dies while it compiles, the latter comes of a power failure or a full disk.
    """
    for lent in directory.glob(f"{_LENT}*"):
        shutil.rmtree(lent, ignore_errors=True)
    if (directory / _DAMAGED).exists():
        for entry in directory.iterdir():
            if entry.is_dir() and not (entry / _LOCK).exists():
                shutil.rmtree(entry, ignore_errors=True)
        (directory / _DAMAGED).unlink()
    for program in directory.glob(_PROGRAMS):
        with suppress(OSError):
            for kernel in program.parent.rglob("*.so"):
                if _is_cut(kernel):
                    kernel.unlink()
            if not any(program.parent.rglob("*.so")):
                shutil.rmtree(program.parent)


def _is_cut(path: Path) -> bool:
    """Whether a program of 64-bit Linux ends before its table of sections does."""
    with open(path, "rb") as file:
        head, size = file.read(64), os.fstat(file.fileno()).st_size
    if len(head) < 64:
        return True
    if head[:5] != b"\x7fELF\x02":
        return False
    (table,) = struct.unpack_from("<Q", head, 40)
    entry_bytes, entries = struct.unpack_from("<HH", head, 58)
    return bool(table + entry_bytes * entries > size)
