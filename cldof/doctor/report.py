"""The examination: packages, drivers, processor, folders, and each device at work."""

from __future__ import annotations

import json
import math
import os
import platform
import re
import shutil
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from importlib import metadata
from pathlib import Path
from typing import Any

from .. import __version__
from ..host.caches import default_cache_dir, user_cache_dir
from ..host.drivers import driver_advice
from ..host.processor import processor_name
from ..methods import METHODS
from .sample import LEAST_DB

__all__ = ["Finding", "Report", "examine", "first_words"]

_LEAST_PYTHON = (3, 11)
_LEAST_FREE_BYTES = 200 << 20
# A package's name in a requirement.
_NAME = re.compile(r"^[A-Za-z0-9._-]+")
# One device: a driver whose compiler needs minutes is not broken.
_LIMIT_S = 900
# Characters of an error in a line of the table.
_LONGEST = 300

Progress = Callable[[str], None]


@dataclass(frozen=True)
class Finding:
    """One line.

    Attributes
    ----------
    what : str
    state : {"ok", "note", "bad"}
        A note is something that some uses need and this machine lacks.
    found : str
    advice : str
        What to do; empty when all is well.
    """

    what: str
    state: str
    found: str
    advice: str = ""


@dataclass
class Report:
    """All of it.

    Attributes
    ----------
    version : str
    findings : list of Finding
    devices : list of dict
        As :class:`cldof.host.device.DeviceInfo`, and ``methods``: by name ``db`` and ``seconds``, or ``error``.
        ``db`` is infinite where the bits are those expected, and minus infinity where an image is not one to compare.
    """

    version: str = __version__
    findings: list[Finding] = field(default_factory=list)
    devices: list[dict[str, Any]] = field(default_factory=list)

    @property
    def can_render(self) -> bool:
        """Whether a picture can be made: some device renders some method right."""
        return any(_is_right(result) for device in self.devices for result in device["methods"].values())

    def as_json(self) -> str:
        """For reports. Infinite dB, for which JSON has no number, are ``"same"`` and ``"not comparable"``."""
        whole = {"can_render": self.can_render, **asdict(self)}
        for device in whole["devices"]:
            for result in device["methods"].values():
                if math.isinf(result.get("db", 0.0)):
                    result["db"] = "same" if result["db"] > 0 else "not comparable"
        return json.dumps(whole, indent=2, allow_nan=False)


def examine(progress: Progress = lambda what: None, device: int | None = None) -> Report:
    """Look at everything.

    Parameters
    ----------
    progress : callable
        Told what is being looked at.
    device : int, optional
        Render on that one alone.

    Returns
    -------
    Report
    """
    report = Report()
    report.findings += [_python(), *_packages(), Finding("processor", "ok", processor_name())]
    progress("OpenCL")
    listed, died = _ask(["opencl"])
    error = died or _error_in(listed)
    report.devices = next((line["devices"] for line in listed if "devices" in line), [])
    if error:
        report.findings.append(Finding("OpenCL", "bad", error, f"install another driver: {driver_advice()}"))
    elif not report.devices:
        report.findings.append(Finding("OpenCL", "bad", "no device", f"for the CPU: {driver_advice()}"))
    else:
        platforms = dict.fromkeys(f"{one['platform']} ({one['platform_version']})" for one in report.devices)
        report.findings.append(Finding("OpenCL", "ok", "; ".join(platforms)))
    progress("OpenGL")
    report.findings.append(_opengl())
    report.findings += [*_folders()]
    for one in report.devices:
        one["methods"] = {}
        if device is None or one["index"] == device:
            one["methods"] = _at_work(one, progress)
            report.findings.append(_judged(one))
    return report


def _python() -> Finding:
    found = f"{platform.python_implementation()} {platform.python_version()}, {platform.platform()}"
    if sys.version_info < _LEAST_PYTHON:
        return Finding("Python", "bad", found, "cldof needs Python 3.11 or newer")
    return Finding("Python", "ok", found)


def _packages() -> Iterator[Finding]:
    """What the installed package says that it requires here."""
    try:
        required = metadata.requires("cldof") or []
    except metadata.PackageNotFoundError:
        yield Finding("cldof", "note", f"{__version__}, not installed", "pip install -e . in its folder")
        return
    yield Finding("cldof", "ok", __version__)
    for line in required:
        name = _NAME.match(line)
        if name is None or not _applies(line):
            continue
        try:
            yield Finding(name[0], "ok", metadata.version(name[0]))
        except metadata.PackageNotFoundError:
            yield Finding(name[0], "bad", "missing", f"pip install '{line.partition(';')[0].strip()}'")


def _applies(requirement: str) -> bool:
    """Whether a requirement is one of this machine, and not of an extra."""
    marker = requirement.partition(";")[2]
    if "extra" in marker:
        return False
    try:
        from packaging.requirements import Requirement
    except ImportError:  # no requirement of ours, but there as a rule
        return not marker
    parsed = Requirement(requirement).marker
    return parsed is None or parsed.evaluate()


def _opengl() -> Finding:
    advice = (
        "scenes cannot be captured, frames of your own can be rendered; Debian and Ubuntu: apt-get install libegl1 "
        "libgl1 libgl1-mesa-dri"
    )
    said, died = _ask(["opengl"])
    for line in said:
        if "renderer" in line:
            return Finding("OpenGL", "ok", line["renderer"])
    return Finding("OpenGL", "note", first_words(died or _error_in(said) or "none"), advice)


def _folders() -> Iterator[Finding]:
    pocl = Path(os.environ.get("POCL_CACHE_DIR") or user_cache_dir() / "pocl" / "kcache")
    folders = {
        "programs": default_cache_dir(),
        "programs of PoCL": pocl,
        "temporary files": Path(tempfile.gettempdir()),
    }
    for what, folder in folders.items():
        near = next(path for path in (folder, *folder.parents) if path.exists())
        free = shutil.disk_usage(near).free
        size = "" if what == "temporary files" else f"{_mib(_size(folder))} in "
        found = f"{size}{folder}, {_mib(free)} free"
        if not os.access(near, os.W_OK):
            yield Finding(what, "note", f"{found}, cannot be written", "set CLDOF_CACHE_DIR and POCL_CACHE_DIR")
        elif free < _LEAST_FREE_BYTES:
            yield Finding(what, "bad", found, "make room")
        else:
            yield Finding(what, "ok", found)


def _size(folder: Path) -> int:
    return sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())


def _mib(nbytes: int) -> str:
    return f"{nbytes / 2**20:.0f} MiB" if nbytes < 10 << 30 else f"{nbytes / 2**30:.0f} GiB"


def _at_work(device: dict[str, Any], progress: Progress) -> dict[str, Any]:
    """Every method on a device; what ends the child is the error of the method that it was at."""
    results: dict[str, Any] = {}
    left = list(METHODS)
    while left:
        at = left[0]

        def look(line: dict[str, Any]) -> None:
            nonlocal at
            if "begins" in line:
                at = line["begins"]
                progress(f"{device['name']}: {at}")
            elif "method" in line:
                results[line.pop("method")] = line

        _, died = _ask(["device", str(device["index"]), *left], look)
        if died or at not in results:
            results.setdefault(at, {"error": died or "no answer"})
        for result in results.values():
            if "error" in result:
                result["error"] = _without_source(result["error"])
        left = [name for name in left if name not in results] if died else []
    return results


def _judged(device: dict[str, Any]) -> Finding:
    what = f"device {device['index']}"
    found = f"{device['name']} ({device['kind']}, {device['platform']}, driver {device['driver_version']})"
    wrong = {name: result for name, result in device["methods"].items() if not _is_right(result)}
    if not wrong:
        least = min(result["db"] for result in device["methods"].values())
        agreement = "the same bits as expected" if math.isinf(least) else f"at least {least:.0f} dB"
        return Finding(what, "ok", f"{found}: {agreement} in {len(device['methods'])} methods")
    reasons = "; ".join(
        f"{name}: {first_words(result['error'])}" if "error" in result else f"{name}: wrong, {result['db']:.0f} dB"
        for name, result in wrong.items()
    )
    advice = "choose another device (CLDOF_DEVICE or --device), install another driver, and report this"
    return Finding(what, "note" if len(wrong) < len(device["methods"]) else "bad", f"{found}: {reasons}", advice)


def _without_source(error: str) -> str:
    """A build's error without the program's text, which whoever reads a report has."""
    before, _, rest = error.partition("--- source\n")
    _, mark, log = rest.partition("--- compiler log\n")
    return f"{before}{mark}{log}".rstrip()


def first_words(error: str) -> str:
    """An error in a line; reports have all of it."""
    line = " ".join(error.split())
    return line if len(line) <= _LONGEST else f"{line[:_LONGEST]} ..."


def _is_right(result: dict[str, Any]) -> bool:
    return "db" in result and result["db"] >= LEAST_DB


def _ask(words: Sequence[str], look: Callable[[dict[str, Any]], None] = lambda line: None) -> tuple[list[Any], str]:
    """What a child finds, line by line, and how it died, if it did."""
    lines: list[Any] = []
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}
    with tempfile.TemporaryFile() as errors:
        command = [sys.executable, "-m", "cldof.doctor.probe", *words]
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=errors, env=environment) as child:
            assert child.stdout is not None
            limit = threading.Timer(_LIMIT_S, child.kill)
            limit.daemon = True
            limit.start()
            try:
                for text in child.stdout:
                    lines.append(json.loads(text))
                    look(lines[-1])
                code = child.wait()
            except BaseException:
                child.kill()
                raise
            finally:
                is_late = not limit.is_alive()
                limit.cancel()
        errors.seek(0)
        said = errors.read().decode(errors="replace").strip().splitlines()
    if code in (0, 2):
        return lines, ""
    if is_late:
        return lines, f"no answer within {_LIMIT_S} s"
    return lines, f"the process died with {_how(code)}{f': {said[-1]}' if said else ''}"


def _error_in(lines: list[Any]) -> str:
    return next((str(line["error"]) for line in lines if "error" in line), "")


def _how(code: int) -> str:
    return f"signal {-code}" if code < 0 else f"exit code {code}"
