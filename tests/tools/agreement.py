"""Do drivers make the same picture? ``python -m tests.tools.agreement NAME=PART ...``

Renders the same frames on each device (in a process of its own, since drivers may not get along), compares all with the
first, and prints a table of the least PSNR in dB per method. Exits with 1 below 70 dB.
"""

from __future__ import annotations

import argparse
import math
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

from tests.every_kernel import CASES, Case

__all__ = ["LEAST_DB", "main", "psnr_db"]

ROOT = Path(__file__).parents[2]
LEAST_DB = 70.0


def chosen(pattern: str = "") -> list[Case]:
    """Every form that renders a whole frame and has the pattern in its name; the smallest frames add nothing."""
    frames = ("opaque", "void", "shaded")
    return [case for case in CASES if case.frame in frames and case.method != "blur" and re.search(pattern, case.name)]


def psnr_db(a: np.ndarray, b: np.ndarray) -> float:
    """Peak signal to noise, the peak being the larger of 1 and what the first image has; inf for the same bits."""
    if not (np.isfinite(a).all() and np.isfinite(b).all()):
        return -math.inf
    error = float(np.mean((a.astype(np.float64) - b) ** 2))
    return math.inf if error == 0.0 else 20.0 * math.log10(max(1.0, float(a.max()))) - 10.0 * math.log10(error)


def main(arguments: Sequence[str] | None = None) -> int:
    """The command; returns its exit code."""
    parser = argparse.ArgumentParser(prog="tests.tools.agreement", description=__doc__.split("\n\n")[0])
    parser.add_argument("devices", nargs="*", metavar="NAME=PART", help="a heading, and part of a device's name")
    parser.add_argument("--only", default="", metavar="REGEX", help="forms whose name it is found in, instead of all")
    parser.add_argument("--store", nargs=2, help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    cases = chosen(options.only)
    if not cases:
        parser.error(f"no form has {options.only!r} in its name")
    if options.store:
        return _store(cases, *options.store)
    with tempfile.TemporaryDirectory(prefix="cldof-agreement-") as folder, ThreadPoolExecutor() as pool:
        names, parts = zip(*(given.split("=", 1) for given in options.devices), strict=True)
        try:
            stored = list(pool.map(lambda part: _rendered(part, options.only, Path(folder)), parts))
        except subprocess.CalledProcessError as error:
            print(f"{error.cmd[-2]}: {error.stderr[-1500:]}", file=sys.stderr)
            return 1
    images = dict(zip(names, stored, strict=True))
    first, *others = images
    print(f"| method, least PSNR to {first} over its forms | " + " | ".join(others) + " |")
    print("|---|" + "---|" * len(others))
    least = math.inf
    for method in sorted({case.method for case in cases}):
        cells = []
        for other in others:
            common = [case.name for case in cases if case.method == method and case.name in images[other]]
            if not common:
                cells.append("none that it can run")
                continue
            values = {name: psnr_db(images[first][name], images[other][name]) for name in common}
            worst = min(values, key=lambda name: values[name])
            least = min(least, values[worst])
            same = sum(value == math.inf for value in values.values())
            cells.append(
                f"{values[worst]:.1f} ({worst.removeprefix(method + ' ')}); {same} of {len(values)} to the bit"
            )
        print(f"| {method} | " + " | ".join(cells) + " |", flush=True)
    return int(least < LEAST_DB)


def _rendered(part: str, pattern: str, folder: Path) -> dict[str, np.ndarray]:
    """Images by name of form, from a process of its own."""
    path = Path(tempfile.mkdtemp(dir=folder)) / "images.npz"
    command = [sys.executable, "-m", "tests.tools.agreement", "--only", pattern, "--store", part, str(path)]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    subprocess.run(command, cwd=ROOT, env=environment, text=True, capture_output=True, check=True)
    with np.load(path, allow_pickle=False) as data:
        return {key: data[key] for key in data.files}


def _store(cases: Sequence[Case], part: str, path: str) -> int:
    from cldof.host.device import Device

    images = {}
    with Device.open(part) as device:
        for case in cases:
            if not case.lacks(device.traits):
                images[case.name] = case.run(device)
    np.savez(path, **images)
    return 0


if __name__ == "__main__":
    sys.exit(main())
