"""What GPUs would make of the kernels: ``python -m tests.tools.registers``, or ``make gpu-registers``

Every program that a GPU gets for the forms of :mod:`tests.every_kernel`, through clang and libclc to PTX and through
NVIDIA's ``ptxas`` to machine code. No GPU is needed. Prints for each kernel the registers of a work-item, its stack and
spills, in its worst form, and the occupancy: the share of the work-items that a multiprocessor could hold at a time.
NVIDIA's OpenCL driver has a front-end of its own before the same ``ptxas``, so a GPU's own figures are near and not the
same.

Exits with 1 where a kernel takes more than 128 registers, a stack or a spill, and, where the tools are those of the
stored table, where one takes more registers than it did (``--store`` when it is meant). A missing tool skips all of it.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path

from cldof.host.passes import Local, Pass
from cldof.host.program import SourceDirectory
from tests.every_kernel import CASES, Program
from tests.tools.compiled import expanded, find_clang, gpu_traits

__all__ = ["ARCHITECTURES", "Architecture", "Kernel", "Usage", "main", "missing_package", "occupancy", "usage_of"]

ROOT = Path(__file__).parents[2]
RECORD = ROOT / "bench" / "results" / "gpu_registers.json"
MOST_REGISTERS = 128

# PTX for the oldest; ptxas takes it for every later one.
_PTX_TARGET = "sm_75"
# Where no pass says: what drivers choose at most for kernels that leave it to them.
_DEFAULT_GROUP = 256


@dataclass(frozen=True)
class Architecture:
    """Limits of one multiprocessor: CUDA C++ Programming Guide, "Technical Specifications per Compute Capability".

    Registers are given to warps in units of 256, and to four warps at a time; the system keeps 1 KiB of shared memory
    per group from 8.x on.
    """

    name: str
    threads: int
    groups: int
    shared_bytes: int
    reserved_bytes: int
    registers: int = 65536


ARCHITECTURES = (
    Architecture("sm_75", threads=1024, groups=16, shared_bytes=64 << 10, reserved_bytes=0),
    Architecture("sm_90", threads=2048, groups=32, shared_bytes=228 << 10, reserved_bytes=1024),
)

_WARP = 32


@dataclass(frozen=True)
class Usage:
    """What ptxas gave to a kernel, or to a function that it did not inline."""

    registers: int
    stack_bytes: int
    spill_store_bytes: int
    spill_load_bytes: int
    shared_bytes: int

    @property
    def is_fit(self) -> bool:
        """Whether it lives in registers alone, and few enough of them."""
        spills = self.spill_store_bytes + self.spill_load_bytes
        return self.registers <= MOST_REGISTERS and self.stack_bytes == 0 and spills == 0


@dataclass(frozen=True)
class Kernel:
    """A kernel's worst form on an architecture."""

    name: str
    architecture: str
    usage: Usage
    group: int
    local_bytes: int
    occupancy: float
    form: str


def occupancy(architecture: Architecture, registers: int, group: int, local_bytes: int) -> float:
    """Share of a multiprocessor's threads that can be at work at a time, those of half-empty warps not counted.

    Parameters
    ----------
    architecture : Architecture
    registers : int
        Of a work-item.
    group : int
        Work-items of a group.
    local_bytes : int
        Of a group.
    """
    warps = -(-group // _WARP)
    by_threads = architecture.threads // (warps * _WARP)
    per_warp = -(-max(registers, 1) * _WARP // 256) * 256
    by_registers = architecture.registers // per_warp // 4 * 4 // warps
    taken = local_bytes + architecture.reserved_bytes
    by_shared = architecture.shared_bytes // taken if taken else architecture.groups
    return min(architecture.groups, by_threads, by_registers, by_shared) * group / architecture.threads


_ENTRY = re.compile(
    r"Function properties for (?P<name>\w+)\n\s*(?P<stack>\d+) bytes stack frame, (?P<stores>\d+) bytes spill stores, "
    r"(?P<loads>\d+) bytes spill loads(?:\n.*Used (?P<registers>\d+) registers(?P<rest>.*))?"
)


def usage_of(log: str) -> dict[str, Usage]:
    """By kernel or function, from what ``ptxas -v`` says; functions have no registers of their own."""
    found = {}
    for match in _ENTRY.finditer(log):
        rest = match["rest"] or ""
        shared = re.search(r"(\d+) bytes smem", rest)
        cumulative = re.search(r"(\d+) bytes cumulative stack", rest)
        found[match["name"]] = Usage(
            int(match["registers"] or 0),
            max(int(match["stack"]), int(cumulative[1]) if cumulative else 0),
            int(match["stores"]),
            int(match["loads"]),
            int(shared[1]) if shared else 0,
        )
    return found


@dataclass(frozen=True)
class _Tools:
    clang: str
    libclc: str
    ptxas: str

    @property
    def versions(self) -> list[str]:
        def said(command: str) -> str:
            return subprocess.run([command, "--version"], capture_output=True, text=True).stdout

        clang = re.search(r"clang version ([\d.]+)", said(self.clang))
        ptxas = re.search(r"release [\d.]+, V([\d.]+)", said(self.ptxas))
        return [f"clang {clang[1] if clang else '?'}", f"ptxas {ptxas[1] if ptxas else '?'}"]

    def ptx(self, source: str, output: Path) -> str:
        """Compile to PTX; what there is to say against it."""
        command = [self.clang, "-x", "cl", "-cl-std=CL1.2", "--target=nvptx64--nvidiacl", "-w", "-O3"]
        for word in ("-cl-ext=+cl_khr_int64_extended_atomics", "-target-cpu", _PTX_TARGET):
            command += ["-Xclang", word]
        for word in ("-mlink-builtin-bitcode", self.libclc):
            command += ["-Xclang", word]
        # GPU drivers inline every function.
        command += ["-mllvm", "-inline-threshold=1000000", "-S", "-o", str(output), "-"]
        done = subprocess.run(command, input=_ATOM_MIN + source, capture_output=True, text=True)
        return (done.stderr.strip() or f"code {done.returncode}") if done.returncode else ""


# NVIDIA's devices have it, libclc does not.
_ATOM_MIN = """__attribute__((overloadable)) ulong atom_min(volatile __global ulong *at, ulong value)
{
    ulong before;
    __asm__ volatile("atom.global.min.u64 %0, [%1], %2;" : "=l"(before) : "l"(at), "l"(value) : "memory");
    return before;
}
"""
_TRIVIAL = "__kernel void trivial(__global float *o) { o[get_global_id(0)] = exp(o[0]) + rsqrt(o[1]); }\n"


def _find_tools() -> _Tools | str:
    """The tools, or which one is missing."""
    if not (clang := find_clang()):
        return "no clang that knows OpenCL C (Debian and Ubuntu: apt-get install clang)"
    places = ["/usr/local/cuda/bin", *Path(sys.prefix).glob("lib/python*/site-packages/nvidia/cuda_nvcc/bin")]
    path = os.pathsep.join([os.environ.get("PATH", ""), *map(str, places)])
    if not (ptxas := shutil.which("ptxas", path=path)):
        return "no ptxas (pip install nvidia-cuda-nvcc-cu12 brings it)"
    if not (libclc := _find_libclc(clang)):
        return f"no libclc that {clang} can read (Debian and Ubuntu: apt-get install {_libclc_package(clang)})"
    return _Tools(clang, libclc, ptxas)


def _find_libclc(clang: str) -> str:
    """Builtins that this clang can read, which are those of its own version; empty if there are none."""
    for folder in ("/usr/lib/clc", "/usr/share/clc"):
        library = f"{folder}/nvptx64--nvidiacl.bc"
        with tempfile.TemporaryDirectory() as scratch:
            if not _Tools(clang, library, "").ptx(_TRIVIAL, Path(scratch) / "trivial.ptx"):
                return library
    return ""


def _libclc_package(clang: str) -> str:
    said = subprocess.run([clang, "--version"], capture_output=True, text=True).stdout
    found = re.search(r"clang version (\d+)", said)
    return f"libclc-{found[1]}" if found else "libclc"


def missing_package() -> str:
    """Debian's package with the builtins for the clang that is here, if it is needed."""
    clang = find_clang()
    return _libclc_package(clang) if clang and not _find_libclc(clang) else ""


def _launches(directory: SourceDirectory | None) -> dict[tuple[str, str], dict[str, tuple[int, int]]]:
    """Kernels that a GPU runs, by name and text of their program: work-items and local bytes of a group, the most."""
    traits = gpu_traits()
    launches: dict[Program, dict[str, tuple[int, int]]] = {}
    for case in CASES:
        for one in case.passes(traits):
            kernels = launches.setdefault((one.source, tuple(one.defines)), {})
            kernels[one.kernel] = max(kernels.get(one.kernel, (0, 0)), _group(one))
    return {expanded(program, traits, directory): kernels for program, kernels in launches.items()}


def _group(one: Pass) -> tuple[int, int]:
    items = math.prod(one.local_size) if one.local_size else _DEFAULT_GROUP
    return items, sum(argument.nbytes for argument in one.args if isinstance(argument, Local))


def _kernels(
    tools: _Tools, name: str, source: str, kernels: dict[str, tuple[int, int]], folder: Path
) -> list[Kernel] | str:
    """One program on all architectures; what went wrong, if something did."""
    ptx = folder / "program.ptx"
    if said := tools.ptx(source, ptx):
        return f"{name}: {said}"
    found = []
    for architecture in ARCHITECTURES:
        command = [tools.ptxas, "-v", f"-arch={architecture.name}", "-o", str(folder / "program.cubin"), str(ptx)]
        done = subprocess.run(command, capture_output=True, text=True)
        if done.returncode:
            return f"{name}: {(done.stderr + done.stdout).strip()}"
        for kernel, usage in usage_of(done.stderr + done.stdout).items():
            if usage.registers and kernel not in kernels:
                continue  # a CPU's form of it, or one that this program is not for
            group, local_bytes = kernels.get(kernel, (0, 0))
            local_bytes += usage.shared_bytes
            share = occupancy(architecture, usage.registers, group, local_bytes) if group else math.nan
            found.append(Kernel(kernel, architecture.name, usage, group, local_bytes, share, name))
    return found


def _table(worst: dict[tuple[str, str], Kernel]) -> str:
    lines = []
    for architecture in ARCHITECTURES:
        lines += [
            "",
            f"| kernel on {architecture.name} | registers | stack, bytes | spills, bytes stored / loaded | "
            "group | local, bytes | occupancy |",
            "|---|---|---|---|---|---|---|",
        ]
        rows = [kernel for kernel in worst.values() if kernel.architecture == architecture.name]
        for kernel in sorted(rows, key=lambda row: (-row.usage.registers, row.name)):
            usage = kernel.usage
            spills = f"{usage.spill_store_bytes} / {usage.spill_load_bytes}"
            share = "" if math.isnan(kernel.occupancy) else f"{100.0 * kernel.occupancy:.0f} %"
            lines.append(
                f"| {kernel.name} | {usage.registers or 'a function'} | {usage.stack_bytes} | {spills} | "
                f"{kernel.group or ''} | {kernel.local_bytes} | {share} |"
            )
    return "\n".join(lines)


def _grown(worst: dict[tuple[str, str], Kernel], tools: Sequence[str]) -> list[str]:
    """Kernels that take more registers than the stored table has."""
    if not RECORD.exists():
        return []
    record = json.loads(RECORD.read_text())
    if record["tools"] != list(tools):
        print(f"the stored table is of {', '.join(record['tools'])}; not compared", file=sys.stderr)
        return []
    before = {(row["name"], row["architecture"]): row["usage"]["registers"] for row in record["kernels"]}
    return [
        f"{kernel.name} on {kernel.architecture} takes {kernel.usage.registers} registers, {before[key]} before: "
        f"{kernel.form}"
        for key, kernel in worst.items()
        if kernel.usage.registers > before.get(key, MOST_REGISTERS)
    ]


def main(arguments: Sequence[str] | None = None) -> int:
    """The command; returns its exit code."""
    parser = argparse.ArgumentParser(prog="tests.tools.registers", description=__doc__.split("\n\n")[0])
    parser.add_argument("--store", action="store_true", help=f"write the table to {RECORD.relative_to(ROOT)}")
    parser.add_argument("--only", default="", metavar="FILE", help="kernel files whose name begins so")
    parser.add_argument("--kernels", type=Path, help="kernel files other than the library's")
    options = parser.parse_args(arguments)
    tools = _find_tools()
    if isinstance(tools, str):
        print(f"SKIPPED: {tools}; no kernel was measured", file=sys.stderr)
        return 0
    started = time.perf_counter()
    launches = {key: value for key, value in _launches(options.kernels).items() if key[0].startswith(options.only)}
    with (
        tempfile.TemporaryDirectory(prefix="cldof-registers-") as folder,
        ThreadPoolExecutor(os.cpu_count()) as workers,
    ):
        results = list(
            workers.map(
                lambda item: _kernels(tools, *item[0], item[1], Path(tempfile.mkdtemp(dir=folder))), launches.items()
            )
        )
    failed = [result for result in results if isinstance(result, str)]
    worst: dict[tuple[str, str], Kernel] = {}
    for kernel in (kernel for result in results if not isinstance(result, str) for kernel in result):
        key = (kernel.name, kernel.architecture)
        if key not in worst or _weight(kernel) > _weight(worst[key]):
            worst[key] = kernel
    print(_table(worst))
    unfit = [
        f"{kernel.name} on {kernel.architecture} does not fit: {kernel.form}"
        for kernel in worst.values()
        if not kernel.usage.is_fit
    ]
    grown = [] if options.store else _grown(worst, tools.versions)
    print("\n".join(["", *unfit, *grown, *failed]))
    seconds = time.perf_counter() - started
    counts = f"{len(launches)} programs, {len({name for name, _ in worst})} kernels"
    print(f"{counts}, {len(unfit)} unfit, {len(grown)} grown, {len(failed)} failed, {seconds:.0f} s")
    print(", ".join(tools.versions))
    if options.store:
        rows = [asdict(kernel) for _, kernel in sorted(worst.items())]
        RECORD.write_text(json.dumps({"tools": tools.versions, "kernels": rows}, indent=1) + "\n")
    return int(bool(unfit or grown or failed))


def _weight(kernel: Kernel) -> tuple[int, ...]:
    usage = kernel.usage
    return (
        not usage.is_fit,
        usage.stack_bytes + usage.spill_store_bytes,
        usage.registers,
        kernel.local_bytes,
        kernel.group,
    )


if __name__ == "__main__":
    sys.exit(main())
