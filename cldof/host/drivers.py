"""Drivers that pip installs: what to install on which system, and what one has to be told before it is loaded."""

from __future__ import annotations

import os
import platform
import sys
from importlib import metadata
from pathlib import Path

__all__ = ["driver_advice", "prepare_drivers"]

_INTEL_PACKAGE = "intel-opencl-rt"
_INTEL_LIBRARY = "intelocl64.dll"
_CPUINFO = Path("/proc/cpuinfo")
# winnt.h: PF_AVX2_INSTRUCTIONS_AVAILABLE
_WINDOWS_AVX2 = 40


def driver_advice(system: str | None = None, machine: str | None = None) -> str:
    """How to get pyopencl and a driver for the CPU; part of a sentence.

    Parameters
    ----------
    system, machine : str, optional
        As ``sys.platform`` and ``platform.machine()`` say; those of this machine unless given.
    """
    system, machine = system or sys.platform, machine or platform.machine()
    if (system, machine) == ("linux", "x86_64"):
        return "pip install 'pyopencl[pocl]' (or pip install pyopencl and apt-get install pocl-opencl-icd)"
    if system == "linux":
        return "pip install pyopencl and apt-get install pocl-opencl-icd (where there is no apt: pocl from conda-forge)"
    if (system, machine) == ("win32", "AMD64"):
        return f"pip install pyopencl {_INTEL_PACKAGE} (or conda install -c conda-forge pyopencl pocl)"
    if system == "darwin":
        return "pip install pyopencl, which takes the driver of macOS (or conda install -c conda-forge pyopencl pocl)"
    return "pip install pyopencl, and pocl from conda-forge or your system's packages"


def prepare_drivers() -> None:
    """Tell the loader and Intel's CPU runtime what they do not find out; runs before pyopencl is imported.

    On Windows pip does not register a driver, and the Khronos loader in pyopencl's wheel looks at the registry and at
    ``OCL_ICD_FILENAMES`` (which it ignores in processes with administrator rights). Intel's runtime generates code for
    SSE on processors that Intel did not make, unless it is told which extensions there are (docs/decisions.md). What
    the user has set stays.
    """
    if sys.platform == "win32" and (library := _intel_library()):
        os.environ.setdefault("OCL_ICD_FILENAMES", str(library))
    if "CL_CONFIG_CPU_TARGET_ARCH" not in os.environ and _is_amd_with_avx2():
        os.environ["CL_CONFIG_CPU_TARGET_ARCH"] = "core-avx2"


def _intel_library() -> Path | None:
    """Intel's driver, wherever pip put it (an environment, the user's own folder)."""
    try:
        files = metadata.files(_INTEL_PACKAGE) or ()
    except metadata.PackageNotFoundError:
        return None
    return next((Path(str(file.locate())).resolve() for file in files if file.name == _INTEL_LIBRARY), None)


def _is_amd_with_avx2() -> bool:
    if sys.platform == "win32":
        from ctypes import windll

        has_avx2 = windll.kernel32.IsProcessorFeaturePresent(_WINDOWS_AVX2)
        return "AuthenticAMD" in platform.processor() and bool(has_avx2)
    try:
        words = _CPUINFO.read_text(encoding="ascii", errors="replace").split()
    except OSError:  # no Linux; Intel's runtime is for Windows and Linux
        return False
    return "AuthenticAMD" in words and "avx2" in words
