"""Do drivers make the same picture? ``python -m tests.tools.agreement NAME=PART ...``

Renders the same frames on each device (in a process of its own, since drivers may not get along), compares all with the
first, and prints a table of the least PSNR in dB per method. Exits with 1 below 70 dB.
"""

from __future__ import annotations

import argparse
import math
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from tests.every_kernel import CASES, Case

__all__ = ["LEAST_DB", "main", "psnr_db"]

ROOT = Path(__file__).parents[2]
LEAST_DB = 70.0


def chosen() -> list[Case]:
    """Every form that renders a whole frame; those that differ from others in memory alone add nothing."""
    return [case for case in CASES if case.frame in ("opaque", "void", "shaded") and case.method != "blur"]


def psnr_db(a: np.ndarray, b: np.ndarray) -> float:
    """Peak signal to noise, the peak being the larger of 1 and what the first image has; inf for the same bits."""
    error = float(np.mean((a.astype(np.float64) - b) ** 2))
    return math.inf if error == 0.0 else 20.0 * math.log10(max(1.0, float(a.max()))) - 10.0 * math.log10(error)


def main(arguments: Sequence[str] | None = None) -> int:
    """The command; returns its exit code."""
    parser = argparse.ArgumentParser(prog="tests.tools.agreement", description=__doc__.split("\n\n")[0])
    parser.add_argument("devices", nargs="*", metavar="NAME=PART", help="a heading, and part of a device's name")
    parser.add_argument("--store", nargs=2, help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    if options.store:
        return _store(*options.store)
    images: dict[str, dict[str, np.ndarray]] = {}
    with tempfile.TemporaryDirectory(prefix="cldof-agreement-") as folder:
        for given in options.devices:
            name, _, part = given.partition("=")
            path = Path(folder) / f"{name}.npz"
            command = [sys.executable, "-m", "tests.tools.agreement", "--store", part, str(path)]
            environment = {**os.environ, "PYTHONPATH": str(ROOT)}
            done = subprocess.run(command, cwd=ROOT, env=environment, text=True, capture_output=True, check=False)
            if done.returncode:
                print(f"{name}: {done.stderr[-1500:]}", file=sys.stderr)
                return 1
            with np.load(path, allow_pickle=False) as data:
                images[name] = {key: data[key] for key in data.files}
    first, *others = images
    print(f"| method, least PSNR to {first} over its forms | " + " | ".join(others) + " |")
    print("|---|" + "---|" * len(others))
    least = math.inf
    for method in sorted({case.method for case in chosen()}):
        cells = []
        for other in others:
            common = [case.name for case in chosen() if case.method == method and case.name in images[other]]
            values = {name: psnr_db(images[first][name], images[other][name]) for name in common}
            worst = min(values, key=lambda name: values[name])
            least = min(least, values[worst])
            same = sum(value == math.inf for value in values.values())
            cells.append(
                f"{values[worst]:.1f} ({worst.removeprefix(method + ' ')}); {same} of {len(values)} to the bit"
            )
        print(f"| {method} | " + " | ".join(cells) + " |", flush=True)
    return int(least < LEAST_DB)


def _store(part: str, path: str) -> int:
    from cldof.host.device import Device

    images = {}
    with Device.open(part) as device:
        for case in chosen():
            if not case.lacks(device.traits):
                images[case.name] = case.run(device)
    np.savez(path, **images)
    return 0


if __name__ == "__main__":
    sys.exit(main())
