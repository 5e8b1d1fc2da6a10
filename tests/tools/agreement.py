"""Do drivers make the same picture? ``python -m tests.tools.agreement NAME=PART ...``

Renders the same frames on each device (in a process of its own, since drivers may not get along), compares all with the
first, and prints a table of the least PSNR in dB per method. Exits with 1 below 70 dB, and where a device failed.

Forms are kept one by one, so that of a process that dies or runs out of time those before count. ``CLDOF_TEST_LIMITS``
(:mod:`tests.limits`) holds for all devices but the first.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import re
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from cldof.host.trial import SWITCH
from tests.every_kernel import CASES, Case
from tests.limits import VARIABLE

__all__ = ["LEAST_DB", "Rendered", "chosen", "compared", "main", "psnr_db"]

ROOT = Path(__file__).parents[2]
LEAST_DB = 70.0


@dataclass
class Rendered:
    """What a device made.

    Attributes
    ----------
    images : dict
        By name of form.
    errors : dict
        What forms failed with, by name.
    lacking : dict
        What the device does not have that forms need, by name.
    cut : bool
        Whether its time was up before it had all.
    died : str
        How its process ended, unless as it should.
    """

    images: dict[str, np.ndarray] = field(default_factory=dict)
    errors: dict[str, str] = field(default_factory=dict)
    lacking: dict[str, str] = field(default_factory=dict)
    cut: bool = False
    died: str = ""


def chosen(pattern: str = "", every: bool = False) -> list[Case]:
    """The forms that have the pattern in their name: all, or those that render a whole frame.

    Methods take turns, so that a device whose time is up has shown something of each.
    """
    frames = ("opaque", "void", "shaded")
    turns: Counter[str] = Counter()
    found = []
    for case in CASES:
        if (every or (case.frame in frames and case.method != "blur")) and re.search(pattern, case.name):
            found.append((turns[case.method], case))
            turns[case.method] += 1
    return [case for _, case in sorted(found, key=lambda one: one[0])]


def psnr_db(a: np.ndarray, b: np.ndarray) -> float:
    """Peak signal to noise, the peak being the larger of 1 and what the first image has; inf for the same bits."""
    if not (np.isfinite(a).all() and np.isfinite(b).all()):
        return -math.inf
    error = float(np.mean((a.astype(np.float64) - b) ** 2))
    return math.inf if error == 0.0 else 20.0 * math.log10(max(1.0, float(a.max()))) - 10.0 * math.log10(error)


def main(arguments: Sequence[str] | None = None) -> int:
    """The command; returns its exit code."""
    parser = argparse.ArgumentParser(prog="tests.tools.agreement", description=__doc__.split("\n\n")[0])
    parser.add_argument(
        "devices", nargs="*", metavar="NAME=PART", help="a heading, and index or part of a device's name"
    )
    parser.add_argument("--only", default="", metavar="REGEX", help="forms whose name it is found in, instead of all")
    parser.add_argument("--every", action="store_true", help="all forms of tests/every_kernel.py, the tiny ones too")
    parser.add_argument("--seconds", type=float, metavar="N", help="for each device; what is there by then is compared")
    parser.add_argument("--output", metavar="FILE", help="keep dB by form, and what failed, as JSON")
    parser.add_argument("--store", nargs=2, help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    cases = chosen(options.only, options.every)
    if not cases:
        parser.error(f"no form has {options.only!r} in its name")
    if options.store:
        return _store(cases, *options.store)
    names, parts = zip(*(given.split("=", 1) for given in options.devices), strict=True)
    with tempfile.TemporaryDirectory(prefix="cldof-agreement-") as folder, ThreadPoolExecutor() as pool:
        limits = ["", *[os.environ.get(VARIABLE, "")] * (len(parts) - 1)]
        stored = pool.map(lambda part, limit: _rendered(part, limit, cases, options, Path(folder)), parts, limits)
        made = dict(zip(names, stored, strict=True))
    code = 0
    for name, one in made.items():
        for case, error in one.errors.items():
            print(f"{name}: {case}: {error}", file=sys.stderr)
        if one.died:
            print(f"{name}: {one.died}", file=sys.stderr)
        if one.cut:
            print(
                f"{name}: cut after {options.seconds:g} s with {len(one.images)} of {len(cases)} forms", file=sys.stderr
            )
        code |= bool(one.errors or one.died or not one.images)
    first, *others = names
    print(f"| method, least PSNR to {first} over its forms | " + " | ".join(others) + " |")
    print("|---|" + "---|" * len(others))
    found = {other: compared(made[first], made[other]) for other in others}
    for method in sorted({case.method for case in cases}):
        mine = [case.name for case in cases if case.method == method]
        cells = (_cell(method, {name: db[name] for name in mine if name in db}) for db in found.values())
        print(f"| {method} | " + " | ".join(cells) + " |", flush=True)
    if options.output:
        Path(options.output).write_text(json.dumps(_facts(made, found, len(cases)), indent=1) + "\n", encoding="utf-8")
    return int(code or any(value < LEAST_DB for db in found.values() for value in db.values()))


def compared(first: Rendered, other: Rendered) -> dict[str, float]:
    """PSNR of what both have, by name of form."""
    return {name: psnr_db(image, other.images[name]) for name, image in first.images.items() if name in other.images}


def _cell(method: str, values: dict[str, float]) -> str:
    if not values:
        return "none that it can run"
    worst = min(values, key=lambda name: values[name])
    same = sum(value == math.inf for value in values.values())
    return f"{values[worst]:.1f} ({worst.removeprefix(method + ' ')}); {same} of {len(values)} to the bit"


def _facts(made: dict[str, Rendered], found: dict[str, dict[str, float]], forms: int) -> dict[str, Any]:
    """For ``--output``: JSON knows no infinity, so that equal bits are ``"inf"``."""
    return {
        "forms": forms,
        "devices": {
            name: {"rendered": len(one.images), "cut": one.cut, "died": one.died, "errors": one.errors}
            | {"lacking": one.lacking}
            for name, one in made.items()
        },
        "db": {
            other: {name: value if math.isfinite(value) else str(value) for name, value in db.items()}
            for other, db in found.items()
        },
    }


def _rendered(part: str, limit: str, cases: Sequence[Case], options: argparse.Namespace, folder: Path) -> Rendered:
    """Everything from a process of its own."""
    folder = Path(tempfile.mkdtemp(dir=folder))
    command = [sys.executable, "-m", "tests.limits", "tests.tools.agreement", "--only", options.only]
    command += [*(["--every"] if options.every else []), "--store", part, str(folder)]
    # It may die, so that what it builds needs no child to be tried in.
    environment = {**os.environ, "PYTHONPATH": str(ROOT), VARIABLE: limit, SWITCH: "0"}
    made = Rendered()
    try:
        done = subprocess.run(
            command, cwd=ROOT, env=environment, text=True, capture_output=True, check=False, timeout=options.seconds
        )
        if done.returncode:
            made.died = f"ended with {done.returncode}: {done.stderr[-1500:]}"
    except subprocess.TimeoutExpired:
        made.cut = True
    for index, case in enumerate(cases):
        image, *texts = (folder / f"{index}{ending}" for ending in (".npy", ".error", ".lacks"))
        if image.exists():
            made.images[case.name] = np.load(image, allow_pickle=False)
        for text, where in zip(texts, (made.errors, made.lacking), strict=True):
            if text.exists():
                where[case.name] = text.read_text(encoding="utf-8")
    if made.died and len(made.images) + len(made.errors) + len(made.lacking) < len(cases):
        known = {*made.images, *made.errors, *made.lacking}
        made.died = f"{next(case.name for case in cases if case.name not in known)}: {made.died}"
    return made


def _store(cases: Sequence[Case], part: str, folder: str) -> int:
    from cldof.errors import CldofError
    from cldof.host import opencl as cl
    from cldof.host.device import Device

    with Device.open(part) as device:
        for index, case in enumerate(cases):
            path = Path(folder, str(index))
            if lacks := case.lacks(device.traits):
                path.with_suffix(".lacks").write_text(lacks, encoding="utf-8")
                continue
            try:
                np.save(path.with_suffix(".part.npy"), case.run(device))
            except (CldofError, cl.Error) as error:
                path.with_suffix(".error").write_text(f"{type(error).__name__}: {error}", encoding="utf-8")
                continue
            path.with_suffix(".part.npy").replace(path.with_suffix(".npy"))  # whole, or not there
    return 0


if __name__ == "__main__":
    sys.exit(main())
