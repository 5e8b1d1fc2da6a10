"""What scripts/gpu_check.sh does: parts with a time each, in processes of their own, into one JSON document.

The schema is documented at the top of the script.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import platform
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from cldof import __version__
from cldof.benchmark.harness import commit
from cldof.errors import CldofError, DeviceError
from cldof.files import atomic_write
from cldof.host.device import DeviceInfo, list_devices
from cldof.host.trial import SWITCH
from tests.limits import VARIABLE
from tests.tools.agreement import LEAST_DB

__all__ = ["PARTS", "Part", "Run", "choose", "main", "run_process", "slug", "summary", "test_counts"]

ROOT = Path(__file__).parents[2]
LIMIT_S = 480.0
# What stays for starting, for processes that are asked to end, and for writing the result.
_RESERVE_S = 25.0
# After an interrupt, in which pytest prints what it has; drivers that compile do not notice it.
_GRACE_S = 5.0
_LOG_LINES = 30

# Kernels against their oracles, then every form between canaries.
TESTS = ("tests/kernels", "tests/test_every_kernel.py", "-k", "not full_hd and not dense")
METHODS = ("layered", "pyramid", "multiview", "lightfield", "gather")


@dataclass(frozen=True)
class Run:
    """A process that ended, or was ended."""

    code: int | None
    seconds: float
    text: str

    @property
    def cut(self) -> bool:
        """Whether its time was up."""
        return self.code is None


@dataclass
class Part:
    """One part of the result.

    Attributes
    ----------
    state : str
        ``"passed"``, ``"failed"``, ``"cut"`` (its time was up; what ran passed) or ``"skipped"``.
    why : str
    seconds, budget_s : float
    facts : dict
    """

    state: str
    why: str = ""
    seconds: float = 0.0
    budget_s: float = 0.0
    facts: dict[str, Any] = field(default_factory=dict)

    def to_dict(self) -> dict[str, Any]:
        """For the result: facts beside the rest."""
        data = asdict(self)
        return {**{name: value for name, value in data.items() if name != "facts"}, **data["facts"]}


@dataclass(frozen=True)
class Check:
    """What parts need to know."""

    device: DeviceInfo
    reference: DeviceInfo | None
    folder: Path


def run_process(command: Sequence[str], seconds: float, log: Path, environment: dict[str, str] | None = None) -> Run:
    """Run a command in a session of its own; when its time is up it and all its children end."""
    begin = time.monotonic()
    with log.open("w+", encoding="utf-8", errors="replace") as stream:
        process = subprocess.Popen(
            command,
            cwd=ROOT,
            env={**os.environ, "PYTHONPATH": str(ROOT), **(environment or {})},
            stdout=stream,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )
        code: int | None
        try:
            code = process.wait(timeout=max(seconds, 0.1))
        except subprocess.TimeoutExpired:
            code = None
            os.killpg(process.pid, signal.SIGINT)
            with suppress(subprocess.TimeoutExpired):
                process.wait(timeout=_GRACE_S)
        finally:
            # Also what a process left behind that ended by itself.
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()
        stream.seek(0)
        return Run(code, time.monotonic() - begin, stream.read())


def _tail(text: str) -> str:
    return "\n".join(text.splitlines()[-_LOG_LINES:])


def doctor(check: Check, seconds: float) -> Part:
    """``cldof doctor --json``."""
    cli = [sys.executable, "-c", "import sys; from cldof.cli import main; sys.exit(main())", "doctor"]
    asked = run_process([*cli, "--help"], min(seconds, 20.0), check.folder / "doctor-help.log")
    if asked.code != 0:
        return Part("skipped", "this cldof has no doctor")
    path = check.folder / "doctor.log"
    done = run_process([*cli, "--json"], seconds, path)
    if done.cut:
        return Part("cut", "its time was up", facts={"log": _tail(done.text)})
    start = done.text.find("{")
    try:
        report = json.loads(done.text[start:]) if start >= 0 else None
    except ValueError:
        report = None
    if report is None:
        return Part("failed", f"exit code {done.code} and no JSON", facts={"log": _tail(done.text)})
    return judged_doctor(report, check.device.index)


def judged_doctor(report: dict[str, Any], index: int) -> Part:
    """The part from doctor's report, which is of all devices: this one has to be in order."""
    facts = {
        "findings": [finding for finding in report["findings"] if not finding["what"].startswith("device ")],
        "methods": {
            name: {key: _short(value) for key, value in result.items()}
            for device in report["devices"]
            if device["index"] == index
            for name, result in device["methods"].items()
        },
    }
    mine = next((finding for finding in report["findings"] if finding["what"] == f"device {index}"), None)
    if mine is None:
        return Part("failed", f"it knows no device {index}", facts=facts)
    return Part(
        "passed" if mine["state"] == "ok" else "failed", "" if mine["state"] == "ok" else mine["found"], facts=facts
    )


def _short(value: Any) -> Any:
    """For a record: no whole sources in errors, and no infinity, which JSON does not know."""
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    return " ".join(value.partition("--- source")[0].split())[:400] if isinstance(value, str) else value


def forms(check: Check, seconds: float) -> Part:
    """All forms of tests/every_kernel.py against the CPU's pictures."""
    if check.reference is None:
        return Part(
            "failed", "no CPU device to compare with: pip install 'pyopencl[pocl]', or Debian's pocl-opencl-icd"
        )
    output = check.folder / "forms.json"
    output.unlink(missing_ok=True)
    command = [sys.executable, "-m", "tests.tools.agreement", "--every", "--seconds", f"{seconds - 10.0:.0f}"]
    command += ["--output", str(output), f"CPU={check.reference.index}", f"device={check.device.index}"]
    done = run_process(command, seconds, check.folder / "forms.log")
    if not output.exists():
        return Part("failed", "nothing was compared", facts={"log": _tail(done.text)})
    facts = json.loads(output.read_text(encoding="utf-8"))
    return judged_forms(facts, done.text)


def judged_forms(facts: dict[str, Any], log: str) -> Part:
    """The part from what tests.tools.agreement keeps."""
    db = {name: float(value) for name, value in facts["db"]["device"].items()}
    worst = min(db, key=lambda name: db[name], default=None)
    told = {
        "forms": facts["forms"],
        "compared": len(db),
        "same_bits": sum(value == float("inf") for value in db.values()),
        "least_db": None if worst is None else facts["db"]["device"][worst],
        "worst": worst,
        "below_70_db": sorted(name for name, value in db.items() if value < LEAST_DB),
        "db": facts["db"]["device"],
        "devices": facts["devices"],
    }
    one = facts["devices"]["device"]
    reasons = []
    if told["below_70_db"]:
        reasons.append(f"{len(told['below_70_db'])} forms below {LEAST_DB:g} dB, worst {worst}")
    for name, made in facts["devices"].items():
        reasons += [f"{name}: {len(made['errors'])} forms failed"] if made["errors"] else []
        reasons += [f"{name} died: {made['died'][:300]}"] if made["died"] else []
    if not db:
        reasons.append("nothing was compared")
    if reasons:
        return Part("failed", "; ".join(reasons), facts={**told, "log": _tail(log)})
    if len(db) + len(one["lacking"]) < facts["forms"]:
        return Part("cut", f"its time was up after {len(db)} of {facts['forms']} forms", facts=told)
    return Part("passed", facts=told)


_OUTCOME = re.compile(r"^(tests/\S+?::.*?) (PASSED|FAILED|ERROR|SKIPPED|XFAIL|XPASS)\b", re.MULTILINE)
_COLLECTED = re.compile(r"\bcollected (\d+) items(?: / (\d+) deselected)?")


def test_counts(text: str) -> dict[str, Any]:
    """What pytest's verbose output says, however it ended."""
    found = _OUTCOME.findall(text)
    counts: dict[str, Any] = {
        name: sum(outcome in outcomes for _, outcome in found)
        for name, outcomes in (
            ("passed", ("PASSED", "XPASS")),
            ("failed", ("FAILED", "ERROR")),
            ("skipped", ("SKIPPED",)),
        )
    }
    collected = _COLLECTED.search(text)
    counts["of"] = int(collected[1]) - int(collected[2] or 0) if collected else None
    counts["failures"] = [name for name, outcome in found if outcome in ("FAILED", "ERROR")]
    return counts


# Not a test.
test_counts.__test__ = False  # type: ignore[attr-defined]


def tests(check: Check, seconds: float) -> Part:
    """Kernels against their oracles and between canaries, on this device alone."""
    command = [sys.executable, "-m", "pytest", "-v", "--tb=short", "-p", "no:cacheprovider", *TESTS]
    environment = {"CLDOF_TEST_DEVICE": str(check.device.index), "CLDOF_REQUIRE_DEVICE": "1", "COLUMNS": "300"}
    done = run_process(command, seconds, check.folder / "tests.log", environment)
    return judged_tests(done)


def judged_tests(done: Run) -> Part:
    """The part from pytest's output."""
    counts = test_counts(done.text)
    if counts["failed"]:
        why = f"{counts['failed']} tests failed, first {counts['failures'][0]}"
        return Part("failed", why, facts={**counts, "log": _tail(done.text)})
    if not done.cut and done.code != 0:
        return Part("failed", f"pytest ended with {done.code}", facts={**counts, "log": _tail(done.text)})
    if not counts["passed"]:
        return Part("failed", "no test ran", facts={**counts, "log": _tail(done.text)})
    if done.cut:
        ran = counts["passed"] + counts["skipped"]
        return Part("cut", f"its time was up after {ran} of {counts['of']} tests", facts=counts)
    return Part("passed", facts=counts)


def speed(check: Check, seconds: float) -> Part:
    """``bench speed`` of every method at 1080p and 4K."""
    output = check.folder / "speed.json"
    output.unlink(missing_ok=True)
    command = [sys.executable, "-m", "tests.limits", "bench", "speed", "--device", str(check.device.index)]
    command += ["--sizes", "1080p", "4K", "--methods", *METHODS, "--seconds", "4", "--no-blurs"]
    # In this process at once: a child that tries what it builds would know of no limits, and take their time.
    done = run_process([*command, "--output", str(output)], seconds, check.folder / "speed.log", {SWITCH: "0"})
    facts = json.loads(output.read_text(encoding="utf-8")) if output.exists() else {"rows": []}
    timed = [f"{row['title']} {row['width']}x{row['height']}" for row in facts["rows"]]
    if not done.cut and done.code != 0:
        return Part("failed", f"exit code {done.code}", facts={**facts, "log": _tail(done.text)})
    if not timed:
        return Part("failed", "nothing was timed within its time", facts={"log": _tail(done.text)})
    if done.cut:
        return Part("cut", f"its time was up after {timed[-1]}", facts=facts)
    return Part("passed", facts=facts)


# In this order; what one leaves of its seconds goes to those after it.
PARTS: dict[str, tuple[Callable[[Check, float], Part], float]] = {
    "doctor": (doctor, 60.0),
    "forms": (forms, 115.0),
    "speed": (speed, 110.0),
    "tests": (tests, 170.0),
}


def choose(infos: Sequence[DeviceInfo], wanted: str, told: bool) -> tuple[DeviceInfo, DeviceInfo | None]:
    """The device to check, and the CPU device whose pictures are right.

    Raises
    ------
    DeviceError
        There is no such device, or no GPU and none was asked for.
    """
    cpus = [info for info in infos if info.kind == "cpu"]
    if wanted.isdecimal():
        found = [info for info in infos if info.index == int(wanted)]
    elif wanted:
        found = [info for info in infos if wanted.lower() in f"{info.name}\n{info.platform}".lower()]
    else:
        found = cpus if told else [info for info in infos if info.kind == "gpu"]
    if not found:
        there = "; ".join(map(str, infos)) or "none at all"
        raise DeviceError(
            f"no OpenCL {f'device {wanted!r}' if wanted else 'GPU'} among {there}. "
            f"Install its driver; to try the script on a CPU: {VARIABLE}=64,32768,gpu scripts/gpu_check.sh"
        )
    return found[0], next(iter(cpus), None)


def slug(info: DeviceInfo, told: bool) -> str:
    """A device's name for a file's."""
    name = re.sub(r"[^a-z0-9]+", "-", info.name.lower()).strip("-")
    return f"{name}-told-gpu" if told else name


def _load() -> list[float] | None:
    return [round(value, 2) for value in os.getloadavg()] if hasattr(os, "getloadavg") else None


def summary(result: dict[str, Any]) -> str:
    """For people: a line for each part, and the speeds."""
    lines = []
    for name, part in result["parts"].items():
        detail = part["why"]
        if name == "forms" and part.get("compared"):
            compared = (
                f"{part['compared']} of {part['forms']} forms, least {float(part['least_db']):.1f} dB ({part['worst']})"
            )
            detail = "; ".join(filter(None, [compared, detail]))
        if name == "tests" and "passed" in part:
            detail = "; ".join(filter(None, [f"{part['passed']} passed, {part['skipped']} skipped", detail]))
        lines.append(f"{name:8s} {part['state']:8s} {part['seconds']:5.0f} of {part['budget_s']:3.0f} s  {detail}")
    for row in result["parts"].get("speed", {}).get("rows", []):
        blurs = "-" if row["blurs"] is None else f"{row['blurs']:.3g}{' (cpu)' if row['by_processor_time'] else ''}"
        size = f"{row['width']}x{row['height']}"
        lines.append(f"  {row['title']:32s} {size:>10s} {row['frame']['median']:9.2f} ms, {blurs} blurs")
    told = f", told to be a GPU ({result['limits']}): NO GPU WAS MEASURED" if result["told_to_be_gpu"] else ""
    verdict = "PASS" if result["passed"] else "FAIL"
    whole = "" if result["complete"] else ", not all of it ran"
    lines.append(f"{verdict}{whole}: {result['device']['name']}{told}; {result['seconds']:.0f} s")
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> int:
    """The command; returns its exit code."""
    parser = argparse.ArgumentParser(prog="gpu_check.sh", description="Does cldof work on this GPU, and how fast?")
    parser.add_argument("device", nargs="?", default="", help="index, or part of a name (default: the first GPU)")
    parser.add_argument("--output", metavar="FILE", help="default bench/results/gpu-check-<device>.json")
    parser.add_argument("--started", type=float, metavar="S", help="seconds since 1970, from when time counts")
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=list(PARTS), help="some instead of all")
    options = parser.parse_args(arguments)
    # Packages alone may take half a minute to import on a busy machine.
    begin = time.monotonic() - (max(time.time() - options.started, 0.0) if options.started else 0.0)
    limits = os.environ.get(VARIABLE, "")
    told = limits.endswith(",gpu")
    try:
        device, reference = choose(list_devices(), options.device, told)
    except CldofError as error:
        print(f"gpu_check: {error}", file=sys.stderr)
        return 2
    folder = ROOT / "out" / "gpu-check"
    folder.mkdir(parents=True, exist_ok=True)
    path = Path(options.output or ROOT / "bench" / "results" / f"gpu-check-{slug(device, told)}.json")
    check = Check(device, reference, folder)
    print(f"gpu_check: {device}", file=sys.stderr, flush=True)
    result: dict[str, Any] = {
        "schema": 1,
        "cldof": __version__,
        "commit": commit(),
        "date": time.strftime("%Y-%m-%d", time.gmtime()),
        "system": f"{platform.system()} {platform.machine()}, {os.cpu_count()} CPU cores",
        "python": platform.python_version(),
        "device": asdict(device),
        "told_to_be_gpu": told,
        "limits": limits or None,
        "reference": reference and asdict(reference),
        "load_before": _load(),
        "parts": {},
    }
    left = LIMIT_S - _RESERVE_S - (time.monotonic() - begin)
    chosen = [name for name in PARTS if name in options.parts]
    for number, name in enumerate(chosen):
        run, _ = PARTS[name]
        # Later parts keep their own.
        budget = left - sum(PARTS[later][1] for later in chosen[number + 1 :])
        print(f"gpu_check: {name}, at most {budget:.0f} s", file=sys.stderr, flush=True)
        start = time.monotonic()
        part = run(check, budget)
        part.seconds, part.budget_s = round(time.monotonic() - start, 1), round(budget, 1)
        left -= part.seconds
        result["parts"][name] = part.to_dict()
        states = [one["state"] for one in result["parts"].values()]
        result["passed"] = "failed" not in states
        result["complete"] = len(states) == len(PARTS) and all(state == "passed" for state in states)
        result["seconds"] = round(time.monotonic() - begin, 1)
        result["load_after"] = _load()
        with atomic_write(path) as stream:  # after each part, so that a machine that goes away has told something
            stream.write(json.dumps(result, indent=1, allow_nan=False).encode() + b"\n")
    print(summary(result))
    print(f"{path}")
    return 0 if result["passed"] else 1


if __name__ == "__main__":
    sys.exit(main())
