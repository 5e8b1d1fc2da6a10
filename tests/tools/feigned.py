"""Have pip's PoCL compile for another x86-64 processor than this machine's: ``CLDOF_TEST_FEIGN_CPU=haswell``.

What a driver makes of our kernels depends on the processor that it finds. PoCL asks LLVM twice: for the processor's
name, which is the target of its code, and for the features, by which it picks one of its libraries of builtins. The
PyPI build of PoCL holds LLVM with its symbols, so both answers can be replaced in memory, in this process alone.
Nothing in the library knows about it.

Processes are told by the environment alone, see :func:`environment`: a ``sitecustomize`` module in ``feigned_site``
waits for the import of pyopencl. By hand, with a cache of its own::

    CLDOF_TEST_FEIGN_CPU=haswell PYTHONPATH=tests/tools/feigned_site POCL_CACHE_DIR=/tmp/haswell cldof devices
"""

from __future__ import annotations

import ctypes
import importlib.machinery
import importlib.util
import mmap
import os
import platform
import re
import struct
import sys
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

__all__ = [
    "LIBRARIES",
    "PROCESSORS",
    "VARIABLE",
    "Processor",
    "environment",
    "feign",
    "feign_when_imported",
    "why_not_here",
]

VARIABLE = "CLDOF_TEST_FEIGN_CPU"

_SITE = Path(__file__).with_name("feigned_site")

# Features that PoCL picks its library of builtins by; others do not matter to it.
LIBRARIES: dict[str, frozenset[str]] = {}
for _name, _more in (
    ("sse2", "sse2"),
    ("ssse3", "ssse3 cx16"),
    ("sse41", "sse4.1"),
    ("avx", "avx popcnt"),
    ("avx2", "avx2 f16c fma"),
    ("avx512", "avx512f avx512bw avx512cd avx512dq avx512vl"),
):
    LIBRARIES[_name] = frozenset(_more.split()).union(*LIBRARIES.values())

# The library that fits the processor; None leaves the features of the machine.
PROCESSORS: dict[str, str | None] = {
    "x86-64": "sse2",
    "nehalem": "sse41",
    "sandybridge": "avx",
    "haswell": "avx2",
    "znver3": "avx2",
    "skylake-avx512": "avx512",
    "generic": None,
}


@dataclass(frozen=True)
class Processor:
    """A processor to feign.

    Parameters
    ----------
    name : str
        As LLVM calls it; ``"generic"`` is what an LLVM that is older than the processor says.
    library : str, optional
        A name of :data:`LIBRARIES`; None for what the machine's own features call for.
    """

    name: str
    library: str | None

    @classmethod
    def parse(cls, text: str) -> Processor:
        """From ``NAME`` or ``NAME:LIBRARY``: ``znver3:avx512`` is what PoCL 3.0 makes of Zen 4."""
        name, separator, library = text.partition(":")
        if not separator and name not in PROCESSORS:
            raise ValueError(f"{VARIABLE}={text!r} is none of {', '.join(PROCESSORS)}; or say NAME:LIBRARY")
        if separator and library not in LIBRARIES:
            raise ValueError(f"{VARIABLE}={text!r}: the library is none of {', '.join(LIBRARIES)}")
        return cls(name, library if separator else PROCESSORS[name])

    def runs_here(self) -> bool:
        """Whether this machine's processor has what the library of builtins uses; else code can only be compiled."""
        words = re.search(r"^flags\s*:(.*)$", Path("/proc/cpuinfo").read_text(), re.MULTILINE)
        here = set(words[1].split()) if words else set()
        return {feature.replace(".", "_") for feature in LIBRARIES.get(self.library or "", ())} <= here


def why_not_here() -> str:
    """Why no processor can be feigned in this environment; empty where it can."""
    try:
        _pocl_of_pip()
    except ImportError as error:
        return str(error)
    return ""


def _pocl_of_pip() -> Path:
    if sys.platform != "linux" or platform.machine() != "x86_64":
        raise ImportError(f"{VARIABLE} works on x86-64 Linux only; this is {sys.platform} on {platform.machine()}")
    spec = importlib.util.find_spec("pyopencl")
    if spec and spec.origin:
        site = Path(spec.origin).parents[1]
        for folder in ("pyopencl/.libs", "pocl_binary_distribution/.libs"):
            for path in site.glob(f"{folder}/libpocl-*.so"):
                return path
    raise ImportError(f"{VARIABLE} needs the PoCL of PyPI, which is not installed (pip install 'pyopencl[pocl]')")


def environment(processor: str, cache: Path, base: Mapping[str, str] = os.environ) -> dict[str, str]:
    """Variables for a Python process that is to feign a processor, and for its children.

    Parameters
    ----------
    processor : str
        As in :meth:`Processor.parse`.
    cache : Path
        A folder that no process on another processor uses: PoCL's cache does not tell libraries of builtins apart.
    base : mapping
        The variables to begin with.
    """
    Processor.parse(processor)
    path = [str(_SITE), *filter(None, base.get("PYTHONPATH", "").split(os.pathsep))]
    return {
        **base,
        VARIABLE: processor,
        "PYTHONPATH": os.pathsep.join(dict.fromkeys(path)),
        "POCL_CACHE_DIR": str(cache / "pocl"),
        "CLDOF_CACHE_DIR": str(cache / "cldof"),
    }


def feign_when_imported() -> None:
    """With the variable set, have the import of pyopencl be preceded by :func:`feign`."""
    if os.environ.get(VARIABLE) and not any(isinstance(finder, _Finder) for finder in sys.meta_path):
        sys.meta_path.insert(0, _Finder())


class _Finder:
    """Finds nothing by itself; sees that pyopencl is about to be imported, and where it is."""

    def __init__(self) -> None:
        self._is_active = True

    def find_spec(
        self, name: str, path: Any = None, target: ModuleType | None = None
    ) -> importlib.machinery.ModuleSpec | None:
        if name == "pyopencl" and self._is_active:
            self._is_active = False  # while it is looked for, and once it is done
            try:
                # Here and not at the start: what a sitecustomize module raises is printed and passed over.
                feign(Processor.parse(os.environ[VARIABLE]))
            except BaseException:
                self._is_active = True
                raise
        return None


_kept: list[Any] = []  # what the replaced functions point at


def feign(processor: Processor) -> None:
    """Replace what LLVM in pip's PoCL says about the processor; before PoCL looks for devices."""
    functions = _Functions(_pocl_of_pip())
    name = ctypes.create_string_buffer(processor.name.encode())
    _kept.append(name)
    # llvm::StringRef getHostCPUName(): mov rax, address; mov rdx, length; ret
    code = b"\x48\xb8" + struct.pack("<Q", ctypes.addressof(name))
    code += b"\x48\xc7\xc2" + struct.pack("<I", len(processor.name)) + b"\xc3"
    functions.overwrite(functions.address("_ZN4llvm3sys14getHostCPUNameEv"), code)
    if processor.library:
        _feign_features(functions, LIBRARIES[processor.library])


def _feign_features(functions: _Functions, present: frozenset[str]) -> None:
    """Have bool getHostCPUFeatures(StringMap<bool> &) say that of all features it knows these are there."""
    at = functions.address("_ZN4llvm3sys18getHostCPUFeaturesERNS_9StringMapIbNS_15MallocAllocatorEEE")
    signature = ctypes.CFUNCTYPE(ctypes.c_bool, ctypes.c_void_p)
    original = ctypes.string_at(at, 12)

    def features(features_map: int) -> bool:
        functions.overwrite(at, original)
        known: bool = signature(at)(features_map)
        functions.overwrite(at, jump)
        for key, value in _entries(features_map):
            ctypes.memmove(value, bytes([key in present]), 1)
        return known

    replacement = signature(features)
    _kept.append(replacement)
    # mov rax, replacement; jmp rax
    jump = b"\x48\xb8" + struct.pack("<Q", ctypes.cast(replacement, ctypes.c_void_p).value) + b"\xff\xe0"
    functions.overwrite(at, jump)


def _entries(features_map: int) -> list[tuple[str, int]]:
    """Keys, and addresses of the values, of an llvm::StringMap<bool>."""
    table, buckets = struct.unpack("<QI", ctypes.string_at(features_map, 12))
    found = []
    for (entry,) in struct.iter_unpack("<Q", ctypes.string_at(table, 8 * buckets)):
        if 0 < entry < 1 << 47:  # neither empty nor the mark of a removed entry, which is near 2**64
            (length,) = struct.unpack("<Q", ctypes.string_at(entry, 8))
            found.append((ctypes.string_at(entry + 16, length).decode(), entry + 8))
    return found


class _Functions:
    """Functions of a loaded library that it does not export, by the symbol table that it was linked with."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._libc = ctypes.CDLL(None, use_errno=True)
        exported = "clGetExtensionFunctionAddress"  # by every driver for the loader
        loaded = ctypes.cast(ctypes.CDLL(str(path))[exported], ctypes.c_void_p).value or 0
        self._base = 0
        self._base = loaded - self.address(exported)

    def address(self, symbol: str) -> int:
        with open(self._path, "rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
            (sections,) = struct.unpack_from("<Q", content, 0x28)
            entry_bytes, count = struct.unpack_from("<HH", content, 0x3A)
            headers = [struct.unpack_from("<IIQQQQIIQQ", content, sections + entry_bytes * i) for i in range(count)]
            for _, kind, _, _, start, size, linked, *_ in headers:
                if kind != 2:  # SHT_SYMTAB
                    continue
                _, _, _, _, names, names_bytes, *_ = headers[linked]
                # A name may be the end of a longer one, and occur in several.
                for at in _places(content, symbol.encode() + b"\0", names, names_bytes):
                    for entry in _places(content, struct.pack("<I", at - names), start, size):
                        if (entry - start) % 24 == 0:
                            (value,) = struct.unpack_from("<Q", content, entry + 8)
                            return self._base + int(value)
        raise ImportError(f"{VARIABLE}: {self._path} has no symbol {symbol}; only builds that keep them can be told")

    def overwrite(self, at: int, code: bytes) -> None:
        page = mmap.PAGESIZE
        first = at // page * page
        length = -(-(at + len(code) - first) // page) * page
        if self._libc.mprotect(ctypes.c_void_p(first), ctypes.c_size_t(length), 7):  # read, write, execute
            raise ImportError(f"{VARIABLE}: code cannot be made writable: {os.strerror(ctypes.get_errno())}")
        ctypes.memmove(at, code, len(code))


def _places(content: mmap.mmap, wanted: bytes, start: int, size: int) -> Iterator[int]:
    at = content.find(wanted, start, start + size)
    while at >= 0:
        yield at
        at = content.find(wanted, at + 1, start + size)


def run_other_sitecustomize(own: str) -> None:
    """Run the sitecustomize module that ours hides, if there is one."""
    path = [entry for entry in sys.path if os.path.abspath(entry or ".") != os.path.abspath(os.path.dirname(own))]
    spec = importlib.machinery.PathFinder.find_spec("sitecustomize", path)
    if spec and spec.loader:
        module = importlib.util.module_from_spec(spec)
        with suppress(ImportError):
            spec.loader.exec_module(module)
