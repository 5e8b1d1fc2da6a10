"""Every program of every form, through the system's clang, for processors that this machine is not.

``python -m tests.tools.compiled`` compiles them with optimisation; tests/test_portable_kernels.py without, in seconds.
Nothing is run and no OpenCL driver is needed: forms say which programs they are made of
(:meth:`tests.every_kernel.Case.programs`).

Drivers crash over calls of *library* functions that pass or return vectors of 64 bytes, in code for a processor without
AVX-512. Clang's intermediate code shows such calls on any machine. Helpers of a program that take a vector wider than
the processor's registers make clang warn (``-Wpsabi``), which drivers print or count.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import subprocess
import sys
import tempfile
import textwrap
import time
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

from cldof.host.device import Traits
from cldof.host.lanes import GPU_LANES, LANES
from cldof.host.program import Defines, SourceDirectory, expand
from tests.every_kernel import CASES, Program

__all__ = [
    "TARGETS",
    "WIDEST_BYTES",
    "X86_64_V4",
    "Target",
    "all_traits",
    "cpu_traits",
    "expanded",
    "failures",
    "find_clang",
    "gpu_traits",
    "main",
    "sources",
    "summary",
    "wide_calls",
]

WIDEST_BYTES = 32
"""What a call out of a program may pass or return at most in one vector."""

_NAMES = ("clang", *(f"clang-{version}" for version in range(21, 13, -1)))
_LANGUAGE = (
    "-x",
    "cl",
    "-cl-std=CL1.2",
    "-Xclang",
    "-cl-ext=+cl_khr_int64_extended_atomics",
    "-Werror",
    "-ferror-limit=3",
)
_TRIVIAL = "__kernel void trivial(__global float *o) { o[get_global_id(0)] = 1.0f; }\n"


@dataclass(frozen=True)
class Target:
    """A processor to compile for, and the width of vectors that its kernels are built with."""

    name: str
    arguments: tuple[str, ...]
    lanes: int


def _x86_64(level: int, lanes: int) -> Target:
    return Target(f"x86-64-v{level}", ("--target=x86_64-unknown-linux-gnu", f"-march=x86-64-v{level}"), lanes)


X86_64_V4 = _x86_64(4, 16)
TARGETS = (
    _x86_64(2, 4),
    _x86_64(3, 8),
    # clang 15 has no calling convention for kernels there.
    Target("aarch64", ("--target=aarch64-unknown-linux-gnu", "-D__kernel="), 4),
)


def find_clang() -> str:
    """A clang of the system that knows OpenCL C; empty if there is none."""
    for name in _NAMES:
        if (path := shutil.which(name)) and not compiler_says(path, _TRIVIAL, ("-fsyntax-only",)):
            return path
    return ""


def compiler_says(clang: str, source: str, arguments: Sequence[str]) -> str:
    """What clang has to say against a source; empty if nothing, and at least a word if it failed."""
    done = subprocess.run([clang, *_LANGUAGE, *arguments, "-"], input=source, capture_output=True, text=True)
    return done.stderr.strip() or (f"ended with code {done.returncode}" if done.returncode else "")


def cpu_traits(lanes: int) -> Traits:
    """Of a CPU device that lacks nothing, so that every form has all of its programs."""
    return Traits(
        is_cpu=True,
        name="a processor",
        platform="none",
        driver_version="0",
        compute_units=4,
        global_mem_bytes=16 << 30,
        max_alloc_bytes=4 << 30,
        local_mem_bytes=256 << 10,
        max_work_group_size=4096,
        preferred_group_limit=256,
        host_unified_memory=True,
        supports_out_of_order=True,
        has_int64_atomics=True,
        has_long_loops=True,
        lanes=lanes,
    )


def gpu_traits() -> Traits:
    """Of a GPU with what all makes have."""
    traits = vars(cpu_traits(GPU_LANES))
    return Traits(
        **{
            **traits,
            "is_cpu": False,
            "name": "a GPU",
            "compute_units": 64,
            "local_mem_bytes": 48 << 10,
            "max_work_group_size": 1024,
            "host_unified_memory": False,
        }
    )


def sources(traits: Iterable[Traits], directory: SourceDirectory | None = None) -> dict[str, str]:
    """The texts that drivers get: all forms on devices with these traits, each text once.

    Parameters
    ----------
    traits : iterable of Traits
    directory : SourceDirectory, optional
        Kernels other than the library's.

    Returns
    -------
    dict
        Text by name; the name is of the file and its compile-time constants.
    """
    found: dict[str, str] = {}
    for device in traits:
        for program in sorted(set().union(*(case.programs(device) for case in CASES)), key=str):
            name, text = expanded(program, device, directory)
            found.setdefault(text, name)
    return {name: text for text, name in found.items()}


def expanded(program: Program, traits: Traits, directory: SourceDirectory | None = None) -> tuple[str, str]:
    """Name and text of one program on a device with such traits, as :func:`sources` has them."""
    stem, defines = program
    # As Device has it: for all programs, unless one has its own.
    widths: Defines = () if any(name == "LANES" for name, _ in defines) else (("LANES", traits.lanes),)
    words = (f"{name}={value}" for name, value in (*widths, *defines))
    return f"{stem}.cl {' '.join(words)}".strip(), expand(
        stem, (*widths, *defines), directory or files("cldof.kernels")
    )


_VECTOR = re.compile(r"<(\d+) x (i\d+|half|bfloat|float|double|ptr)>")
_BITS = {"half": 16, "bfloat": 16, "float": 32, "double": 64, "ptr": 64}
_MANGLED = re.compile(r"@(?:_Z\d+)?(\w+?)(?:Dv\w*)?\(")


def wide_calls(intermediate: str) -> list[str]:
    """Functions that a program calls and does not define, with vectors wider than :data:`WIDEST_BYTES`.

    Parameters
    ----------
    intermediate : str
        LLVM's textual form. ``llvm.*`` are instructions rather than functions.
    """

    def bits(kind: str) -> int:
        return _BITS.get(kind) or int(kind[1:])

    return [
        found[1] if (found := _MANGLED.search(line)) else line
        for line in intermediate.splitlines()
        if line.startswith("declare ")
        and "@llvm." not in line
        and any(int(count) * bits(kind) > 8 * WIDEST_BYTES for count, kind in _VECTOR.findall(line))
    ]


def _calls_out(clang: str, source: str, target: Target) -> str:
    """Calls of ``source`` with wide vectors, or what keeps it from being compiled."""
    with tempfile.TemporaryDirectory(prefix="cldof-compiled-") as folder:
        output = Path(folder) / "program.ll"
        # Unoptimised, so that every call that is written there is still there.
        arguments = (*target.arguments, "-O0", "-S", "-emit-llvm", "-o", str(output))
        if said := compiler_says(clang, source, arguments):
            return said
        calls = wide_calls(output.read_text())
    return f"calls {', '.join(calls)} with vectors wider than {WIDEST_BYTES} bytes" if calls else ""


def failures(
    clang: str, programs: Mapping[str, str], target: Target, *, optimisation: int | None = None
) -> dict[str, str]:
    """What is wrong with programs, by name.

    Parameters
    ----------
    clang : str
    programs : mapping
        As :func:`sources` has them.
    target : Target
    optimisation : int, optional
        Compile to objects at this level. None looks for calls with wide vectors.
    """

    def judged(source: str) -> str:
        if optimisation is None:
            return _calls_out(clang, source, target)
        return compiler_says(clang, source, (*target.arguments, f"-O{optimisation}", "-c", "-o", os.devnull))

    with ThreadPoolExecutor(os.cpu_count()) as workers:
        said = list(workers.map(judged, programs.values()))
    return {name: text for name, text in zip(programs, said, strict=True) if text}


def summary(found: Mapping[str, str]) -> str:
    """For people: what was said, once, and of which programs; from what :func:`failures` gives."""
    names: dict[str, list[str]] = {}
    for name, said in found.items():
        names.setdefault(said, []).append(name)
    return "".join(
        f"{len(those)} programs, first {those[0]}:\n{textwrap.indent(said, '  ')}\n" for said, those in names.items()
    )


def all_traits(lanes: Sequence[int] = LANES) -> list[Traits]:
    """Devices of these widths: CPUs, and GPUs with theirs."""
    return [*map(cpu_traits, lanes), *([gpu_traits()] if GPU_LANES in lanes else [])]


def main(arguments: Sequence[str] | None = None) -> int:
    """The command; returns its exit code: 1 when a program failed."""
    parser = argparse.ArgumentParser(prog="tests.tools.compiled", description=__doc__.split("\n\n")[0])
    parser.add_argument("--optimisation", type=int, default=2, help="level of the objects (2)")
    parser.add_argument("--kernels", type=Path, help="kernel files other than the library's")
    options = parser.parse_args(arguments)
    if not (clang := find_clang()):
        print("SKIPPED: no clang that knows OpenCL C (Debian and Ubuntu: apt-get install clang)", file=sys.stderr)
        return 0
    has_failed = False
    for target, level in ((X86_64_V4, None), *((target, options.optimisation) for target in TARGETS)):
        started = time.perf_counter()
        programs = sources(all_traits(LANES if level is None else (target.lanes,)), options.kernels)
        found = failures(clang, programs, target, optimisation=level)
        what = "calls with wide vectors" if level is None else f"objects at -O{level}"
        seconds = time.perf_counter() - started
        print(f"{target.name}, {what}: {len(programs)} programs, {len(found)} failed, {seconds:.0f} s", flush=True)
        print(summary(found), end="", flush=True)
        has_failed = has_failed or bool(found)
    return int(has_failed)


if __name__ == "__main__":
    sys.exit(main())
