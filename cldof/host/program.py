"""Kernel sources to built programs: include expansion, defines, caching, and build errors that can be read.

Includes are expanded here and no ``-I`` is passed: search paths with a space in them break builds on PoCL and crash
rusticl. For the same reason programs are built through ``pyopencl._cl``: ``pyopencl.Program.build`` always adds an
``-I`` of its own, warns whenever a compiler says anything, and leaves a temporary file behind on every failure.
"""

from __future__ import annotations

import ctypes
import hashlib
import math
import re
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from pathlib import Path
from threading import Lock
from typing import Any, NoReturn, Protocol

import numpy as np

from ..errors import BuildError, DeviceError, DriverError, InputError, OutputError
from ..files import atomic_write
from . import opencl as cl
from .caches import default_cache_dir, give_up_programs
from .quirks import Effect, effects_of

__all__ = ["BUILD_OPTIONS", "Defines", "ProgramCache", "SourceDirectory", "expand", "numbered"]

# One dialect everywhere; argument info lets the scheduler check kernels against passes. No fast-math: it lets compilers
# drop tests for NaN and infinity.
BUILD_OPTIONS = ("-cl-std=CL1.2", "-cl-kernel-arg-info", "-cl-denorms-are-zero")

# For drivers that would vectorize across work-items what works on float16 already.
_HINTED = "#define __kernel __kernel __attribute__((vec_type_hint(float16)))\n"

Defines = tuple[tuple[str, Any], ...]

_INCLUDE = re.compile(r'^\s*#\s*include\s+"(?P<name>[^"]+)"')
_LINE = re.compile(r'^#line (?P<number>\d+) "(?P<name>[^"]+)"$')


class SourceDirectory(Protocol):
    """A place with kernel files: ``importlib.resources.files("cldof.kernels")`` or a :class:`pathlib.Path`."""

    def joinpath(self, name: str, /) -> Any:
        """The file of that name, with ``read_text`` and ``is_file``."""


def expand(stem: str, defines: Defines, directory: SourceDirectory) -> str:
    """The text that is compiled: defines, then the file with every ``#include "..."`` replaced by that file.

    Parameters
    ----------
    stem : str
        ``<stem>.cl`` in `directory`.
    defines : tuple of (str, value) pairs
        Become ``#define name value`` in that order.
    directory : SourceDirectory

    Returns
    -------
    str
        With ``#line`` directives, so that compilers speak of the lines of the files.

    Raises
    ------
    BuildError
        A file is missing, or includes itself.
    """
    return "\n".join((*_define_lines(defines), *_expanded(f"{stem}.cl", directory, ()))) + "\n"


def numbered(source: str) -> str:
    """Expanded source for people: every line with the file and the number that compilers call it by."""
    out = []
    name, number = "<defines>", 1
    for line in source.splitlines():
        if marker := _LINE.match(line):
            name, number = marker["name"], int(marker["number"])
            continue
        out.append(f"{name}:{number:<4d} | {line}")
        number += 1
    return "\n".join(out)


class ProgramCache:
    """Builds programs for one device and keeps them, in memory and, where the driver does not, on disk.

    Parameters
    ----------
    context : pyopencl.Context
    device : pyopencl.Device
    directory : SourceDirectory
        Where the ``.cl`` and ``.clh`` files are. Also an attribute.
    cache_dir : Path, optional
        Of the disk cache; :func:`default_cache_dir` unless told otherwise.
    defines : callable
        Called before the first build; compile-time constants of all programs, unless a program's own say otherwise.
    from_source : bool
        Never load binaries: on some drivers a program from a binary has no argument info.
    """

    def __init__(
        self,
        context: Any,
        device: Any,
        directory: SourceDirectory,
        cache_dir: Path | None = None,
        *,
        defines: Callable[[], Defines] = tuple,
        from_source: bool = False,
    ) -> None:
        self._context = context
        self._device = device
        self.directory = directory
        self._defines = defines
        self._programs: dict[tuple[str, tuple[str, ...]], Any] = {}
        self._sources: dict[tuple[str, tuple[str, ...]], str] = {}
        self._lock = Lock()
        effects = effects_of(device.platform.name, device.name)
        is_cpu = bool(device.type & cl.device_type.CPU)
        self._prefix = _HINTED if is_cpu and Effect.VECTORIZES_VECTORS in effects else ""
        self._trusts_cache = Effect.TRUSTS_CACHE in effects
        driver_caches = Effect.DRIVER_CACHES_BUILDS in effects
        self._disk = None if driver_caches or from_source else _DiskCache(cache_dir or default_cache_dir())

    def kernel(self, stem: str, name: str, defines: Defines = ()) -> Any:
        """A new kernel object of ``<stem>.cl``; the program behind it is built at most once.

        New each time, because a kernel object holds its arguments: it belongs to one user on one thread.

        Returns
        -------
        pyopencl.Kernel

        Raises
        ------
        BuildError
            The source does not compile, or has no kernel of that name.
        """
        program = self.program(stem, defines)
        try:
            return cl.Kernel(program, name)
        except cl.Error as error:
            found = sorted(program.get_info(cl.program_info.KERNEL_NAMES).split(";"))
            if name in found:
                raise DeviceError(f"{self._device.name.strip()} cannot make a kernel of {name!r}: {error}") from error
            if found == [""] and self._trusts_cache:
                self._give_up(stem, error)
            raise BuildError(f"{stem}.cl has no kernel {name!r}; it has {', '.join(found)}") from error

    def _give_up(self, stem: str, error: Exception) -> NoReturn:
        """A program without any kernel is one over which an earlier process has died."""
        give_up_programs()
        # PoCL ends the process by abort() when a context goes that has held such a program: this one stays.
        ctypes.pythonapi.Py_IncRef(ctypes.py_object(self._context))
        raise DriverError(
            f"{self._device.name.strip()} ({self._device.platform.name}) has {stem}.cl in its cache of programs, but "
            "without kernels: an earlier process died while it was compiled. Run this again: the cache is made anew."
        ) from error

    def program(self, stem: str, defines: Defines = ()) -> Any:
        """The built program of ``<stem>.cl`` with those defines."""
        # By text, since 1, 1.0 and True are the same key but not the same define.
        key = (stem, _define_lines(defines))
        with self._lock:
            program = self._programs.get(key)
            if program is None:
                program = self._programs[key] = self._build(self._expanded(key, defines))
        return program

    def source(self, stem: str, defines: Defines = ()) -> str:
        """What is compiled for ``<stem>.cl`` with those defines."""
        with self._lock:
            return self._expanded((stem, _define_lines(defines)), defines)

    def _expanded(self, key: tuple[str, tuple[str, ...]], defines: Defines) -> str:
        source = self._sources.get(key)
        if source is None:
            own = {name for name, _ in defines}
            everywhere = (one for one in self._defines() if one[0] not in own)
            source = self._prefix + expand(key[0], (*everywhere, *defines), self.directory)
            self._sources[key] = source
        return source

    def clear(self) -> None:
        """Forget the programs in memory; files that changed are read again."""
        with self._lock:
            self._programs.clear()
            self._sources.clear()

    def _key(self, source: str) -> str:
        """Name in the disk cache: a digest of all that the binary depends on."""
        platform = self._device.platform
        parts = (
            source,
            *BUILD_OPTIONS,
            platform.name,
            platform.version,
            self._device.name,
            self._device.driver_version,
        )
        digest = hashlib.sha256()
        for part in parts:
            digest.update(part.encode())
            digest.update(b"\0")  # so that ("ab", "c") and ("a", "bc") differ
        return digest.hexdigest()

    def _build(self, source: str) -> Any:
        key = self._key(source)
        if self._disk and (binary := self._disk.load(key)):
            program = self._from_binary(binary)
            if program is not None:
                return program
        program = cl._cl._Program(self._context, source)
        try:
            program._build(options=_encoded(BUILD_OPTIONS), devices=[self._device])
        except cl.Error as error:
            raise BuildError(self._report(program, source)) from error
        if self._disk:
            self._disk.store(key, program.get_info(cl.program_info.BINARIES)[0])
        return program

    def _from_binary(self, binary: bytes) -> Any:
        # A driver may refuse a binary for reasons of its own; the source is still there.
        try:
            program = cl._cl._Program(self._context, [self._device], [binary])
            program._build(options=_encoded(BUILD_OPTIONS), devices=[self._device])
        except cl.Error:
            return None
        return program

    def _report(self, program: Any, source: str) -> str:
        log = program.get_build_info(self._device, cl.program_build_info.LOG).strip()
        return (
            f"a kernel did not compile on {self._device.name.strip()} ({self._device.platform.name}, driver "
            f"{self._device.driver_version}) with options {' '.join(BUILD_OPTIONS)}\n"
            f"--- source\n{numbered(source)}\n--- compiler log\n{log or '(empty)'}"
        )


class _DiskCache:
    """Program binaries by key. A cache that cannot be read or written is the same as an empty one."""

    def __init__(self, directory: Path) -> None:
        self._directory = directory

    def load(self, key: str) -> bytes | None:
        try:
            content = (self._directory / key).read_bytes()
        except OSError:
            return None
        checksum, binary = content[:32], content[32:]
        return binary if hashlib.sha256(binary).digest() == checksum else None

    def store(self, key: str, binary: bytes) -> None:
        with suppress(OSError, OutputError):
            self._directory.mkdir(parents=True, exist_ok=True)
            with atomic_write(self._directory / key) as file:
                file.write(hashlib.sha256(binary).digest() + binary)


def _expanded(name: str, directory: SourceDirectory, above: tuple[str, ...]) -> Iterable[str]:
    if name in above:
        raise BuildError(f"kernel file {name} includes itself: {' -> '.join((*above, name))}")
    file = directory.joinpath(name)
    if not file.is_file():
        raise BuildError(
            f"kernel file {name} does not exist in {directory}" + (f" (included by {above[-1]})" if above else "")
        )
    yield f'#line 1 "{name}"'
    for number, line in enumerate(file.read_text(encoding="utf-8").splitlines(), start=1):
        if include := _INCLUDE.match(line):
            yield from _expanded(include["name"], directory, (*above, name))
            yield f'#line {number + 1} "{name}"'
        else:
            yield line


def _define_lines(defines: Defines) -> tuple[str, ...]:
    return tuple(f"#define {name} {_literal(name, value)}" for name, value in defines)


def _literal(name: str, value: Any) -> str:
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, bool):
        return str(int(value))
    if isinstance(value, str):
        return value
    if isinstance(value, int):
        text = str(value)
    elif isinstance(value, float) and math.isfinite(value):
        text = value.hex() + "f"  # exact, and legal in OpenCL C
    else:
        raise InputError(f"compile-time constant {name} = {value!r} must be an int, finite float, bool or str")
    return f"({text})" if text.startswith("-") else text


def _encoded(options: Sequence[str]) -> bytes:
    return " ".join(options).encode()
