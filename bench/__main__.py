"""`python -m bench`: speed of the layered method and of its blurs on one device, as ratios to a device copy."""

from __future__ import annotations

import argparse
import sys

from cldof.errors import CldofError

from . import speed


def main() -> int:
    """Print the tables; exit code 2 with one paragraph when something is missing."""
    parser = argparse.ArgumentParser(prog="bench", description=__doc__)
    parser.add_argument("--device", help="index, cpu, gpu or part of a name (as cldof render --device)")
    parser.add_argument("--runs", type=int, default=30, help="frames to time (default 30)")
    arguments = parser.parse_args()
    try:
        speed.report(arguments.device, max(arguments.runs, 3))
    except CldofError as error:
        print(f"bench: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
