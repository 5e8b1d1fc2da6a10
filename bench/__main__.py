"""`python -m bench`: what `cldof bench` does, from a checkout.

`python -m bench speed` times passes and blurs, `python -m bench auto` judges ``method="auto"``, `python -m bench
planned` tells what planning is worth, `python -m bench racks` whether focus may move.
"""

from __future__ import annotations

import argparse
import math
import sys

from cldof.benchmark.command import add_arguments, bench
from cldof.capture.scenes import builtin_scenes
from cldof.errors import CldofError
from cldof.methods import METHODS

from . import auto, planned, racks, speed


def main() -> int:
    """Run; exit code 2 with one paragraph when something is missing, 130 when interrupted."""
    try:
        if sys.argv[1:2] == ["speed"]:
            parser = argparse.ArgumentParser(
                prog="bench speed",
                description="Speed of frames and of blurs, as ratios to OpenCV's Gaussian blur of sigma 16.",
            )
            parser.add_argument("--device", help="index, cpu, gpu or part of a name (as cldof render --device)")
            parser.add_argument("--runs", type=int, default=30, help="frames to time (default 30)")
            parser.add_argument("--sizes", nargs="+", default=["1024x1024"], help="WxH, 1080p, 4K (default 1024x1024)")
            parser.add_argument("--methods", nargs="+", default=["layered"], help="default: layered")
            parser.add_argument(
                "--seconds",
                type=float,
                default=math.inf,
                help="for the frames of a method at a size (default: no limit)",
            )
            parser.add_argument("--no-blurs", action="store_true", help="frames alone, no table of blurs")
            parser.add_argument("--output", metavar="FILE", help="keep the numbers as JSON")
            arguments = parser.parse_args(sys.argv[2:])
            speed.report(
                arguments.device,
                max(arguments.runs, 3),
                [speed.parse_size(size) for size in arguments.sizes],
                arguments.methods,
                arguments.seconds,
                not arguments.no_blurs,
                arguments.output,
            )
            return 0
        if sys.argv[1:2] == ["auto"]:
            parser = argparse.ArgumentParser(prog="bench auto", description="How method='auto' keeps its budgets.")
            parser.add_argument("--device", help="index, cpu, gpu or part of a name (as cldof render --device)")
            parser.add_argument("--busy", action="store_true", help="processor time in place of the clock")
            parser.add_argument("--scenes", nargs="+", default=auto.SCENES, help="of the built-in ones")
            parser.add_argument("--size", type=int, default=auto.SIZE, help=f"pixels a side (default {auto.SIZE})")
            parser.add_argument("--output", metavar="FILE", help="keep every case as JSON")
            arguments = parser.parse_args(sys.argv[2:])
            auto.report(arguments.device, arguments.busy, tuple(arguments.scenes), arguments.output, arguments.size)
            return 0
        if sys.argv[1:2] == ["planned"]:
            parser = argparse.ArgumentParser(prog="bench planned", description="What planning is worth, by method.")
            parser.add_argument("--device", help="index, cpu, gpu or part of a name (as cldof render --device)")
            parser.add_argument("--size", type=int, default=1024, help="pixels a side (default 1024)")
            parser.add_argument("--runs", type=int, default=5, help="frames to time (default 5)")
            parser.add_argument("--output", metavar="FILE", help="keep the numbers as JSON")
            arguments = parser.parse_args(sys.argv[2:])
            planned.report(arguments.device, arguments.size, arguments.runs, arguments.output)
            return 0
        if sys.argv[1:2] == ["racks"]:
            parser = argparse.ArgumentParser(prog="bench racks", description="Does a rack of focus jump?")
            parser.add_argument("--device", help="index, cpu, gpu or part of a name (as cldof render --device)")
            parser.add_argument("--scenes", nargs="+", default=list(builtin_scenes()), help="of the built-in ones")
            parser.add_argument("--methods", nargs="+", default=sorted(METHODS), help="all by default")
            parser.add_argument("--frames", type=int, default=120, help="of a rack (default 120)")
            parser.add_argument("--size", type=int, default=96, help="pixels a side (default 96)")
            parser.add_argument("--views", type=int, default=48, help="of a reference (default 48)")
            parser.add_argument("--output", metavar="FILE", help="keep the numbers as JSON")
            arguments = parser.parse_args(sys.argv[2:])
            racks.report(**vars(arguments))
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
