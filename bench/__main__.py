"""`python -m bench`: what `cldof bench` does, from a checkout; `python -m bench speed` times passes and blurs."""

from __future__ import annotations

import argparse
import sys

from cldof.benchmark.command import add_arguments, bench
from cldof.errors import CldofError

from . import speed


def main() -> int:
    """Run; exit code 2 with one paragraph when something is missing, 130 when interrupted."""
    try:
        if sys.argv[1:2] == ["speed"]:
            parser = argparse.ArgumentParser(
                prog="bench speed",
                description="Speed of the layered method and of its blurs, as ratios to a device copy.",
            )
            parser.add_argument("--device", help="index, cpu, gpu or part of a name (as cldof render --device)")
            parser.add_argument("--runs", type=int, default=30, help="frames to time (default 30)")
            arguments = parser.parse_args(sys.argv[2:])
            speed.report(arguments.device, max(arguments.runs, 3))
            return 0
        parser = argparse.ArgumentParser(prog="bench", description=__doc__)
        add_arguments(parser)
        bench(parser.parse_args())
        return 0
    except CldofError as error:
        print(f"bench: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("bench: interrupted; finished rows are kept, the same command goes on.", file=sys.stderr)
        return 130


if __name__ == "__main__":
    sys.exit(main())
