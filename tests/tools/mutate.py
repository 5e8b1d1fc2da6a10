"""Do the tests notice faults in the kernels? ``python -m tests.tools.mutate``

Works on a copy of the tree: each mutant of :mod:`tests.tools.mutants` is put in, the tests that know its file run until
the first failure, then those that know the methods as a whole. A mutant is

- *caught* when a test fails, the process dies or time runs out,
- a *survivor* when all tests pass,
- *broken* when its source does not compile, which proves nothing: the list has to be mended.

Exits with 1 when less than 90 % are caught or one is broken, and with 2 when an anchor is not where it was or tests
fail without any mutant.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from queue import SimpleQueue

from .mutants import MUTANTS, SUITES, WIDE, Mutant

__all__ = ["Outcome", "Workshop", "check_anchors", "main"]

ROOT = Path(__file__).parents[2]
_LEAST_CAUGHT = 0.9
_BUILD_FAILED = "a kernel did not compile"


@dataclass(frozen=True)
class Outcome:
    """What became of a mutant: ``verdict`` is "caught", "survived" or "broken"."""

    mutant: Mutant
    verdict: str
    by: str
    seconds: float


class Workshop:
    """A copy of the tree to break things in.

    Parameters
    ----------
    root : Path
        The tree; left alone.
    scratch : Path
        An empty folder to work in.
    """

    def __init__(self, root: Path, scratch: Path) -> None:
        self.tree = scratch / "tree"
        ignored = shutil.ignore_patterns(".git", ".venv*", "__pycache__", ".*_cache", ".hypothesis", "out", "results")
        shutil.copytree(root, self.tree, ignore=ignored)
        self._environment = {
            **os.environ,
            "POCL_CACHE_DIR": str(scratch / "pocl"),
            "PYTHONPATH": str(self.tree),
            "PYTHONDONTWRITEBYTECODE": "1",
            "CI": "1",  # hypothesis without chance
        }

    def check(self, suite: Sequence[str], limit_s: float) -> tuple[str, str]:
        """Run tests until one fails; a verdict as in :class:`Outcome` and what it is due to."""
        command = [sys.executable, "-m", "pytest", "-x", "-q", "--no-header", "-p", "no:cacheprovider", "--tb=short"]
        try:
            done = subprocess.run(
                [*command, *suite],
                cwd=self.tree,
                env=self._environment,
                capture_output=True,
                text=True,
                timeout=limit_s,
            )
        except subprocess.TimeoutExpired:
            return "caught", f"time limit of {limit_s:.0f} s"
        if done.returncode == 0:
            return "survived", ""
        if done.returncode < 0:
            return "caught", f"the process died of signal {-done.returncode}"
        if _BUILD_FAILED in done.stdout:
            return "broken", "does not compile"
        failed = [line.split(" - ")[0] for line in done.stdout.splitlines() if line.startswith(("FAILED", "ERROR"))]
        if done.returncode != 1 or not failed:
            raise RuntimeError(f"pytest {' '.join(suite)} did not run (code {done.returncode}):\n{done.stdout[-2000:]}")
        return "caught", failed[0].split(" ", 1)[1]

    def try_out(self, mutant: Mutant, suites: Sequence[Sequence[str]], limit_s: float) -> Outcome:
        """Put a mutant in, run test after test until one notices, and take it out again."""
        started = time.perf_counter()
        path = self.tree / "cldof" / "kernels" / mutant.file
        whole = path.read_text(encoding="utf-8")
        path.write_text(whole.replace(mutant.old, mutant.new), encoding="utf-8")
        try:
            verdict, by = "survived", ""
            for suite in suites:
                verdict, by = self.check(suite, limit_s)
                if verdict != "survived":
                    break
        finally:
            path.write_text(whole, encoding="utf-8")
        return Outcome(mutant, verdict, by, time.perf_counter() - started)


def check_anchors(mutants: Sequence[Mutant], root: Path = ROOT) -> list[str]:
    """What is wrong with the list: anchors that are not there once."""
    wrong = []
    for mutant in mutants:
        count = (root / "cldof" / "kernels" / mutant.file).read_text(encoding="utf-8").count(mutant.old)
        if count != 1:
            wrong.append(f"{mutant.name}: the anchor is there {count} times, not once")
        if mutant.new == mutant.old:
            wrong.append(f"{mutant.name}: nothing changes")
    return wrong


def main(arguments: Sequence[str] | None = None) -> int:
    """The command; returns its exit code."""
    parser = argparse.ArgumentParser(prog="tests.tools.mutate", description=__doc__.split("\n\n")[0])
    parser.add_argument("--only", nargs="+", default=[""], help="mutants whose name contains one of these")
    parser.add_argument("--jobs", type=int, default=2, help="copies of the tree to work in at once")
    parser.add_argument("--limit", type=float, default=900.0, metavar="S", help="seconds for one run of tests")
    parser.add_argument("--narrow", action="store_true", help="only the tests of the mutant's own file")
    parser.add_argument("--json", type=Path, help="write the outcomes there")
    options = parser.parse_args(arguments)
    mutants = [mutant for mutant in MUTANTS if any(text in mutant.name for text in options.only)]
    if wrong := check_anchors(mutants):
        print("\n".join(["the list does not fit the kernels any more:", *wrong]), file=sys.stderr)
        return 2
    if not mutants:
        print(f"no mutant has any of {options.only} in its name", file=sys.stderr)
        return 2
    wide = [] if options.narrow else WIDE
    with tempfile.TemporaryDirectory(prefix="cldof-mutants-") as scratch:
        shops: SimpleQueue[Workshop] = SimpleQueue()
        for number in range(options.jobs):
            shops.put(Workshop(ROOT, Path(scratch) / str(number)))
        used = [suite for file in sorted({mutant.file for mutant in mutants}) for suite in SUITES[file]] + wide

        def sound(suite: list[str]) -> str:
            shop = shops.get()
            try:
                verdict, by = shop.check(suite, 4 * options.limit)
            finally:
                shops.put(shop)
            return "" if verdict == "survived" else f"{' '.join(suite)}: {by}"

        def judged(mutant: Mutant) -> Outcome:
            shop = shops.get()
            try:
                outcome = shop.try_out(mutant, [*SUITES[mutant.file], *wide], options.limit)
            finally:
                shops.put(shop)
            print(f"{outcome.verdict:8} {outcome.seconds:5.0f} s  {mutant.name}  [{outcome.by}]", flush=True)
            return outcome

        with ThreadPoolExecutor(options.jobs) as workers:
            unsound = [text for text in workers.map(sound, used) if text]
            if unsound:
                print("\n".join(["tests fail without any mutant:", *unsound]), file=sys.stderr)
                return 2
            outcomes = list(workers.map(judged, mutants))
    print(_table(outcomes))
    if options.json:
        options.json.write_text(json.dumps([{**vars(o), "mutant": vars(o.mutant)} for o in outcomes], indent=1) + "\n")
    caught = sum(outcome.verdict == "caught" for outcome in outcomes)
    has_broken = any(outcome.verdict == "broken" for outcome in outcomes)
    return int(has_broken or caught < _LEAST_CAUGHT * len(outcomes))


def _table(outcomes: Sequence[Outcome]) -> str:
    lines = ["", "| kernels | mutants | caught | survivors |", "|---|---|---|---|"]
    for file in sorted({outcome.mutant.file for outcome in outcomes}):
        of_file = [outcome for outcome in outcomes if outcome.mutant.file == file]
        left = [outcome for outcome in of_file if outcome.verdict != "caught"]
        names = "; ".join(f"{one.mutant.name.split(': ', 1)[1]} ({one.verdict})" for one in left)
        lines.append(f"| {file} | {len(of_file)} | {len(of_file) - len(left)} | {names} |")
    caught = sum(outcome.verdict == "caught" for outcome in outcomes)
    lines.append(f"| all | {len(outcomes)} | {caught} ({100.0 * caught / len(outcomes):.0f} %) | |")
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main())
