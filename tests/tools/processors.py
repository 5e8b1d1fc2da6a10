"""Do other processors and drivers make the same pictures? ``python -m tests.tools.processors``, or ``make test-cpus``

Every form of :mod:`tests.every_kernel` on pip's PoCL as this machine has it, with vectors of each width; then with PoCL
told that it runs on lesser and greater x86-64 processors (:mod:`tests.tools.feigned`); and on Debian's PoCL, which is
unpacked into a temporary folder and leaves the system alone. For a processor whose library of builtins this machine
cannot run, programs are compiled only. Prints a table; exits with 1 where a process ended, a build failed or pictures
differ by more than they may. What cannot be had here is skipped in so many words.
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
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from cldof.errors import BuildError
from cldof.host import opencl as cl
from cldof.host.lanes import LANES
from cldof.host.program import BUILD_OPTIONS
from cldof.host.trial import SWITCH
from tests.every_kernel import CASES
from tests.tools import feigned
from tests.tools.compiled import cpu_traits, sources

__all__ = ["Comparison", "Leg", "Outcome", "compared", "main"]

ROOT = Path(__file__).parents[2]
_HERE = "this one"
_POCL = "Portable Computing Language"
_LIMIT_S = 1200
_MOST_SHOWN = 20

# Without fused multiply-adds, or with sums in another order, pixels differ by rounding; where a sample lands on the
# other side of an edge, or a tie is decided the other way, one differs by more.
CLOSE = 1e-3
MOST_FARTHER = 0.005


@dataclass(frozen=True)
class Leg:
    """One way to make all pictures.

    Parameters
    ----------
    name : str
    lanes : int, optional
        Width of vectors; None leaves it to the library.
    feigned : str
        As in :meth:`tests.tools.feigned.Processor.parse`; empty for this machine's.
    driver : str
        How the driver's version begins; empty for pip's.
    icd : str
        A folder that names drivers to the loader, beside pip's.
    libraries : str
        A folder with libraries that the driver needs.
    compiles_only : bool
        Nothing is run.
    parts : int
        Processes at a time.
    """

    name: str
    lanes: int | None = None
    feigned: str = ""
    driver: str = ""
    icd: str = ""
    libraries: str = ""
    compiles_only: bool = False
    parts: int = 1


@dataclass
class Outcome:
    """What became of a leg.

    Attributes
    ----------
    device : str
        What the driver calls the device.
    lanes : int
        Width of vectors that was used.
    images : dict
        By number of the form.
    compiled : int
        How many programs were compiled, of legs that run nothing.
    problems : list of str
    cpu_s : float
    """

    device: str = ""
    lanes: int = 0
    images: dict[int, np.ndarray] = field(default_factory=dict)
    compiled: int = 0
    problems: list[str] = field(default_factory=list)
    cpu_s: float = 0.0


@dataclass(frozen=True)
class Comparison:
    """Pictures of a leg against those of another.

    Attributes
    ----------
    forms, same : int
        How many were compared, and how many of them have the same bits.
    largest : float
        Largest difference of a value, as a share of the larger of 1 and the brightest.
    where : str
        The form that has it.
    problems : list of str
        Forms that differ by more than they may.
    """

    forms: int
    same: int
    largest: float
    where: str
    problems: list[str]


def compared(images: dict[int, np.ndarray], others: dict[int, np.ndarray], *, exactly: bool) -> Comparison:
    """Compare the forms that both have; `exactly` asks for the same bits."""
    same, largest, where, problems = 0, 0.0, "", []
    common = sorted(images.keys() & others.keys())
    for number in common:
        name, one, other = CASES[number].name, images[number], others[number]
        if np.array_equal(one, other):
            same += 1
            continue
        if one.shape == other.shape:
            off = np.abs(one.astype(np.float64) - other) / max(1.0, float(np.abs(other).max()))
            off[np.isnan(off)] = math.inf
        else:
            off = np.full((1, 1), math.inf)
        most = float(off.max())
        if most > largest:
            largest, where = most, name
        farther = float(np.mean(off.max(axis=-1) > CLOSE))
        if exactly:
            problems.append(f"{name}: other bits, {most:.1e} at most")
        elif farther > MOST_FARTHER:
            problems.append(f"{name}: {100.0 * farther:.1f} % of the pixels differ by more than {CLOSE:g}")
    return Comparison(len(common), same, largest, where, problems)


def main(arguments: Sequence[str] | None = None) -> int:
    """The command; returns its exit code."""
    parser = argparse.ArgumentParser(prog="tests.tools.processors", description=__doc__.split("\n\n")[0])
    parser.add_argument("--only", default="", metavar="REGEX", help="forms whose name it is found in, instead of all")
    parser.add_argument("--jobs", type=int, default=os.cpu_count(), help="processes at a time")
    parser.add_argument("--json", type=Path, help="write the table there, too")
    parser.add_argument("--inside", nargs=2, metavar=("LEG", "ITEMS"), help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    if options.inside:
        return _inside(Leg(**json.loads(options.inside[0])), json.loads(options.inside[1]))
    if reason := feigned.why_not_here():
        print(f"SKIPPED: {reason}", file=sys.stderr)
        return 0
    forms = [number for number, case in enumerate(CASES) if re.search(options.only, case.name)]
    if not forms:
        parser.error(f"no form has {options.only!r} in its name")
    started = time.perf_counter()
    with tempfile.TemporaryDirectory(prefix="cldof-processors-") as name:
        folder = Path(name)
        legs = list(_legs(folder))
        with ThreadPoolExecutor(options.jobs) as workers:
            outcomes = dict(zip(legs, workers.map(lambda leg: _outcome(leg, forms, folder), legs), strict=True))
    rows = list(_rows(outcomes))
    print("| processor and driver | lanes | forms | compared with | same bits | largest difference | CPU time |")
    print("|---|---|---|---|---|---|---|")
    for row in rows:
        largest = "" if row["largest"] is None else f"{row['largest']:.1e} {row['where']}".strip()
        cells = (row["leg"], row["lanes"], row["forms"], row["against"], row["same"], largest, f"{row['cpu_s']:.0f} s")
        print("| " + " | ".join(map(str, cells)) + " |")
    problems = Counter(f"{row['leg']}: {problem}" for row in rows for problem in row["problems"])
    for problem, count in list(problems.items())[:_MOST_SHOWN]:
        print(f"{problem} ({count} times)" if count > 1 else problem)
    if len(problems) > _MOST_SHOWN:
        print(f"... and {len(problems) - _MOST_SHOWN} more")
    minutes = (time.perf_counter() - started) / 60.0
    machine = f"{os.cpu_count()} processors: {_processor()}"
    print(f"{len(rows)} legs, {problems.total()} problems, {minutes:.1f} min on {machine}")
    if options.json:
        record = {"processor": _processor(), "minutes": round(minutes, 1), "legs": rows}
        options.json.write_text(json.dumps(record, indent=1) + "\n")
    return int(bool(problems))


def _processor() -> str:
    found = re.search(r"^model name\s*: (.*)$", Path("/proc/cpuinfo").read_text(), re.MULTILINE)
    return found[1] if found else "unknown"


def _legs(folder: Path) -> Iterator[Leg]:
    own = _own_lanes(folder)
    yield Leg(_HERE)
    for lanes in LANES:
        if lanes != own:
            yield Leg(_HERE, lanes)
    for name in ("haswell", "nehalem", "skylake-avx512"):
        if feigned.Processor.parse(name).runs_here():
            yield Leg(name, feigned=name)
        else:
            print(f"SKIPPED: this machine cannot run code for {name}; it is compiled only", file=sys.stderr)
            yield Leg(name, 16 if name.endswith("avx512") else 8, name, compiles_only=True, parts=2)
    # What PoCL 3.0 takes Zen 4 for: no AVX-512 in its code, AVX-512's library beside it.
    yield Leg("znver3 with the library for AVX-512", 8, "znver3:avx512", compiles_only=True, parts=2)
    if debian := _debian_pocl(folder / "debian"):
        yield debian


def _own_lanes(folder: Path) -> int:
    """What the library chooses here, asked in another process, since this one shall know no driver."""
    outcome = _part(Leg(_HERE), [], Path(tempfile.mkdtemp(dir=folder)))
    if not outcome.lanes:
        raise SystemExit(f"PoCL does not work here: {'; '.join(outcome.problems)}")
    return outcome.lanes


def _debian_pocl(folder: Path) -> Leg | None:
    """Debian's PoCL and what of its dependencies the system lacks, unpacked; the package is not installed."""
    folder.mkdir()
    if not (shutil.which("apt-get") and shutil.which("dpkg")):
        print("SKIPPED: Debian's PoCL; there is no apt-get here", file=sys.stderr)
        return None

    def output(*command: str) -> str:
        return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=True).stdout

    try:
        plan = output("apt-get", "install", "--simulate", "--no-install-recommends", "pocl-opencl-icd")
        if packages := re.findall(r"^Inst (\S+)", plan, re.MULTILINE):
            output("apt-get", "download", *packages)
        for package in folder.glob("*.deb"):
            output("dpkg", "-x", package.name, "root")
    except subprocess.CalledProcessError as error:
        print(f"SKIPPED: Debian's PoCL cannot be had: {error.stderr.strip()[-300:]}", file=sys.stderr)
        return None
    roots = (folder / "root" / "usr" / "lib", Path("/usr/lib"))
    found = [path for root in roots for path in root.glob("*-linux-gnu/libpocl.so.*.*")]
    if not found:
        print("SKIPPED: Debian's package has no libpocl.so", file=sys.stderr)
        return None
    (folder / "pocl.icd").write_text(f"{found[0]}\n")
    libraries = [str(found[0].parent), *map(str, roots[0].glob("llvm-*/lib"))]
    return Leg("Debian's PoCL", driver="3.1", icd=str(folder), libraries=os.pathsep.join(libraries))


def _outcome(leg: Leg, forms: Sequence[int], folder: Path) -> Outcome:
    """Everything that a leg is asked for; a process that ends is followed by one for what is left."""
    programs = list(range(len(sources([cpu_traits(leg.lanes or LANES[-1])])))) if leg.compiles_only else []
    items = programs or list(forms)
    parts = [items[first :: leg.parts] for first in range(leg.parts)]
    with ThreadPoolExecutor(leg.parts) as workers:
        outcomes = list(workers.map(lambda part: _part(leg, part, Path(tempfile.mkdtemp(dir=folder))), parts))
    whole = replace(outcomes[0])
    for other in outcomes[1:]:
        whole.images |= other.images
        whole.problems = whole.problems + other.problems
        whole.compiled += other.compiled
        whole.cpu_s += other.cpu_s
    return whole


def _part(leg: Leg, items: Sequence[int], folder: Path) -> Outcome:
    # This is the process that may end; the library needs no other to try things in.
    environment = {**os.environ, "PYTHONPATH": str(ROOT), SWITCH: "0"}
    if leg.feigned:
        environment = feigned.environment(leg.feigned, folder, environment)
    else:
        environment |= {"POCL_CACHE_DIR": str(folder / "pocl"), "CLDOF_CACHE_DIR": str(folder / "cldof")}
    # In place of the system's: these machines' other drivers are of no interest here.
    environment["OCL_ICD_VENDORS"] = leg.icd or str(folder)
    if leg.libraries:
        environment["LD_LIBRARY_PATH"] = leg.libraries
    outcome, left, has_started = Outcome(), list(items), False
    while left or not has_started:
        command = [sys.executable, "-m", "tests.tools.processors", "--inside", json.dumps(vars(leg)), json.dumps(left)]
        try:
            done = subprocess.run(
                command, cwd=folder, env=environment, capture_output=True, text=True, errors="replace", timeout=_LIMIT_S
            )
        except subprocess.TimeoutExpired:
            outcome.problems.append(f"no end after {_LIMIT_S} s")
            break
        has_started = True
        lines = [json.loads(line) for line in done.stdout.splitlines() if line.startswith("{")]
        begun = [line["begin"] for line in lines if "begin" in line]
        ended = [line["end"] for line in lines if "end" in line]
        for line in lines:
            outcome.device = line.get("device", outcome.device)
            outcome.lanes = line.get("lanes", outcome.lanes)
            outcome.cpu_s += line.get("cpu_s", 0.0)
            outcome.compiled += line.get("compiled", 0)
            if "problem" in line:
                outcome.problems.append(line["problem"])
        if not begun and (left or not outcome.device):
            outcome.problems.append(f"did not start (code {done.returncode}): {done.stderr[-500:]}")
            break
        if len(begun) > len(ended):
            what = CASES[begun[-1]].name if not leg.compiles_only else f"program {begun[-1]}"
            outcome.problems.append(f"{what}: the process ended with code {done.returncode}")
        left = [item for item in left if item not in begun]
    outcome.images = {int(path.stem): np.load(path) for path in folder.glob("*.npy")}
    return outcome


def _say(**words: Any) -> None:
    print(json.dumps(words), flush=True)


def _inside(leg: Leg, items: Sequence[int]) -> int:
    """In a process of its own, in a folder of its own: make pictures, or compile programs."""
    from cldof.host.device import Device, list_devices

    index = next(
        info.index for info in list_devices() if info.platform == _POCL and info.driver_version.startswith(leg.driver)
    )
    with Device.open(index, lanes=leg.lanes) as device:
        version = device.queue.device.version
        if leg.feigned and not version.endswith(f"-{feigned.Processor.parse(leg.feigned).name}"):
            _say(problem=f"PoCL was not told: {version}")
            return 1
        _say(device=version, lanes=leg.lanes or device.lanes)
        programs = list(sources([cpu_traits(leg.lanes or LANES[-1])]).items()) if leg.compiles_only else []
        before = time.process_time()
        for item in items:
            _say(begin=item)
            name = programs[item][0] if programs else CASES[item].name
            try:
                if programs:
                    _compile(device, programs[item][1])
                    _say(compiled=1)
                elif not CASES[item].lacks(device.traits):
                    np.save(f"{item}.npy", CASES[item].run(device))
            except Exception as error:  # whatever it is, the other forms are still of interest
                _say(problem=f"{name}: {type(error).__name__}: {str(error)[-600:]}")
            now = time.process_time()
            _say(end=item, cpu_s=now - before)
            before = now
    return 0


def _compile(device: Any, source: str) -> None:
    cl_device = device.queue.device
    program = cl._cl._Program(device.context, source)
    try:
        program._build(options=" ".join(BUILD_OPTIONS).encode(), devices=[cl_device])
    except cl.Error as error:
        raise BuildError(program.get_build_info(cl_device, cl.program_build_info.LOG).strip()) from error
    program.get_info(cl.program_info.BINARIES)  # PoCL compiles the kernels here


def _rows(outcomes: dict[Leg, Outcome]) -> Iterator[dict[str, Any]]:
    """One per leg: each against this machine's with vectors of the same width, these against its own choice."""
    native = outcomes[Leg(_HERE)]
    by_lanes = {outcome.lanes: outcome for leg, outcome in outcomes.items() if leg.name == _HERE}
    has_fma = feigned.Processor.parse("haswell").runs_here()
    for leg, outcome in outcomes.items():
        row: dict[str, Any] = {
            "leg": leg.name,
            "device": outcome.device,
            "lanes": outcome.lanes,
            "cpu_s": outcome.cpu_s,
        }
        other, against, exactly = by_lanes.get(outcome.lanes), f"{_HERE}, {outcome.lanes} lanes", False
        if leg.name == _HERE:
            other, against = (None, "") if outcome is native else (native, f"{_HERE}, {native.lanes} lanes")
        elif leg.feigned:
            library = feigned.Processor.parse(leg.feigned).library
            exactly = has_fma and "fma" in feigned.LIBRARIES.get(library or "", ())
        row["forms"] = f"{outcome.compiled} programs compiled" if leg.compiles_only else len(outcome.images)
        if leg.compiles_only or other is None:
            yield row | {"against": "", "same": "", "largest": None, "where": "", "problems": outcome.problems}
            continue
        found = compared(outcome.images, other.images, exactly=exactly)
        row |= {"against": against, "same": found.same, "largest": found.largest, "where": found.where}
        yield row | {"problems": [*outcome.problems, *found.problems]}


if __name__ == "__main__":
    sys.exit(main())
