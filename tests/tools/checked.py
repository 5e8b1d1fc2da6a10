"""Every kernel under oclgrind, which watches each access to memory: ``python -m tests.tools.checked``

Looks for accesses outside of buffers and for races between work-items, global and local. Cases run in processes of
their own, since the simulator's limit of messages is one for all, and is not thread-safe.

``--uninitialized`` also looks for use of what was never written. Debian's oclgrind 21.10 cannot follow every
instruction of today's compilers then (``freeze``); kernels at which it gives up are named. What was never written in
*buffers* is looked for without it, in tests/test_every_kernel.py.

``--private`` needs no simulator: on the default device, private variables that are declared without a value begin as
NaN and then as other garbage, and all pictures have to have the bits that they always have.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

from tests.every_kernel import CASES, Case, FilledSources, kernels_in_sources, record_kernels

__all__ = ["main", "messages_of"]

ROOT = Path(__file__).parents[2]
_PER_PROCESS = 4
_LIMIT_S = 900
# What the simulator says to what optimising compilers make of `x < 0 ? -x : x` and others; it knows plain code.
_CANNOT_FOLLOW = ("Undefined external function", "Unsupported instruction")
# Between "what" and "Kernel:" in the simulator's log; the first line tells the kind.
_MESSAGE = re.compile(r"^(\S[^\n]*)\n(?:\t[^\n]*\n)*?\tKernel: +(\S+)", re.MULTILINE)


def messages_of(log: str) -> Counter[tuple[str, str]]:
    """How often the log has which message about which kernel, addresses aside."""
    return Counter((re.sub(r"0x[0-9a-f]+", "0x..", what), kernel) for what, kernel in _MESSAGE.findall(log))


def main(arguments: Sequence[str] | None = None) -> int:
    """The command; returns its exit code: 1 when something was found, a case failed or a kernel was not run."""
    parser = argparse.ArgumentParser(prog="tests.tools.checked", description=__doc__.split("\n\n")[0])
    parser.add_argument("--only", nargs="+", default=[""], help="cases whose name contains one of these")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--uninitialized", action="store_true")
    parser.add_argument("--private", action="store_true")
    parser.add_argument("--inside", help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    if options.inside:
        return _inside([int(number) for number in options.inside.split(",")])
    if options.private:
        return _filled([case for case in CASES if any(text in case.name for text in options.only)])
    if shutil.which("oclgrind") is None:
        print("oclgrind is not installed (Debian and Ubuntu: apt-get install oclgrind)", file=sys.stderr)
        return 1
    chosen = [number for number, case in enumerate(CASES) if any(text in case.name for text in options.only)]
    # Far apart, so that each process has cases of several methods and none is much longer than the others.
    count = -(-len(chosen) // _PER_PROCESS)
    groups = [chosen[first::count] for first in range(count)]
    started = time.perf_counter()
    with ThreadPoolExecutor(options.jobs) as workers:
        results = list(workers.map(lambda group: _watched(group, options.uninitialized), groups))
    found = sum((messages for messages, _, _ in results), Counter[tuple[str, str]]())
    seen = {name for _, names, _ in results for name in names}
    failures = [text for _, _, text in results if text]
    for (what, kernel), number in sorted(found.items()):
        print(f"{kernel}: {what} ({number} times)")
    print("\n".join(failures))
    missing = (
        set() if any(options.only) else kernels_in_sources() - seen - {"lightfield_packed"}
    )  # no 64-bit atomics there
    if missing:
        print(f"not run: {', '.join(sorted(missing))}; tests/every_kernel.py needs a case")
    seconds = time.perf_counter() - started
    print(f"{len(chosen)} frames, {len(seen)} kernels, {sum(found.values())} findings, {seconds:.0f} s")
    return int(bool(found or failures or missing))


def _filled(cases: Sequence[Case]) -> int:
    from cldof.host.device import Device

    started, wrong = time.perf_counter(), []
    with (
        Device.open() as plain,
        Device.open(sources=FilledSources(0xFF)) as nans,
        Device.open(sources=FilledSources(0x3E)) as others,
    ):
        for case in cases:
            if case.options.get("warp") == "packed" and not plain.traits.has_int64_atomics:
                continue
            image = case.run(plain)
            if not all(np.array_equal(case.run(device), image) for device in (nans, others)):
                wrong.append(case.name)
                print(f"{case.name}: reads private memory that was never written", flush=True)
    print(f"{len(cases)} frames, {len(wrong)} findings, {time.perf_counter() - started:.0f} s")
    return int(bool(wrong))


def _watched(
    group: list[int], uninitialized: bool, build_options: str = ""
) -> tuple[Counter[tuple[str, str]], list[str], str]:
    """Run cases under the simulator: messages, kernels that ran, and what else went wrong."""
    with tempfile.TemporaryDirectory(prefix="cldof-checked-") as folder:
        log = Path(folder) / "log"
        command = ["oclgrind", "--data-races", "--max-errors", "200", "--log", str(log)]
        if uninitialized:
            command.append("--uninitialized")
        if build_options:
            command += ["--build-options", build_options]
        command += [sys.executable, "-m", "tests.tools.checked", "--inside", ",".join(map(str, group))]
        environment = {**os.environ, "CLDOF_CACHE_DIR": folder, "PYTHONPATH": str(ROOT)}
        names = ", ".join(CASES[number].name for number in group)
        try:
            done = subprocess.run(
                command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=_LIMIT_S, check=False
            )
        except subprocess.TimeoutExpired:
            return Counter(), [], f"no end after {_LIMIT_S} s: {names}"
        said = log.read_text(errors="replace") if log.exists() else ""
    if done.returncode and not build_options and any(what in said + done.stderr for what in _CANNOT_FOLLOW):
        parts = [_watched([number], uninitialized, "-cl-opt-disable") for number in group]
        messages = sum((part[0] for part in parts), Counter[tuple[str, str]]())
        return messages, [name for part in parts for name in part[1]], "\n".join(part[2] for part in parts if part[2])
    kernels = [name for line in done.stdout.splitlines() if line.startswith("[") for name in json.loads(line)]
    text = f"failed (code {done.returncode}): {names}\n{done.stderr[-800:]}" if done.returncode else ""
    return messages_of(said), kernels, text


def _inside(numbers: list[int]) -> int:
    from cldof.host.device import Device

    for number in numbers:
        with Device.open("oclgrind") as device, record_kernels(device) as names:
            # The simulator takes memory of the host for memory that was never written.
            device.pool.shares_memory = False
            if not CASES[number].lacks(device.traits):
                CASES[number].run(device)
        print(json.dumps(sorted(names)), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
