"""``cldof bench``: measure, then write tables, plots and the page; or write them again from stored results."""

from __future__ import annotations

import argparse
import shutil
from pathlib import Path
from typing import TYPE_CHECKING

from ..errors import CldofError, InputError

if TYPE_CHECKING:
    from .harness import Settings
    from .record import Record

__all__ = ["add_arguments", "bench", "report"]

RESULTS = "results.json"
QUICK_SCENES: tuple[str, ...] = ("row", "fence")
QUICK_PEER_SCENES: tuple[str, ...] = ("row",)
PEER_SCENES: tuple[str, ...] = ("row", "fence")
_QUICK_SIZE, _SIZE = (256, 256), (512, 512)
_QUICK_VIEWS, _VIEWS = 256, 2048


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of ``cldof bench``."""
    parser.add_argument("-o", "--output", default="out/bench", metavar="FOLDER", help="results (default out/bench)")
    parser.add_argument("--quick", action="store_true", help="two scenes, 256x256, few settings: under 3 minutes")
    parser.add_argument("--fresh", action="store_true", help="start again; otherwise finished rows are kept")
    parser.add_argument(
        "--report-only", action="store_true", help="measure nothing: tables, plots and page from stored results"
    )
    parser.add_argument(
        "--scenes",
        nargs="+",
        metavar="SCENE",
        help="built-in names, files, or bunnies:FILE for nine of a model (default: all built in)",
    )
    parser.add_argument("--sizes", nargs="+", metavar="WxH", help="image sizes (default 512x512)")
    parser.add_argument("--methods", nargs="+", metavar="METHOD", help="methods, accumulate, peers (default: all)")
    parser.add_argument(
        "--devices", nargs="+", metavar="DEVICE", help="as cldof render --device (default: everything OpenCL shows)"
    )
    parser.add_argument("--runs", type=int, metavar="N", help="frames timed per row (default 7, quick 3)")
    parser.add_argument("--reference-views", type=int, metavar="N", help="views of the references (default 2048)")
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="of the lens points (default 0)")


def bench(arguments: argparse.Namespace) -> None:
    """Run what the arguments say.

    Raises
    ------
    CldofError
        After everything is written, when a row gave an image that cannot be right.
    """
    from .harness import print_progress, run
    from .record import Record

    folder = Path(arguments.output)
    if not arguments.report_only:
        settings = settings_from(arguments)
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"Cannot make the folder {folder}: {error.strerror or error}.") from error
        if arguments.fresh:
            (folder / RESULTS).unlink(missing_ok=True)
        run(settings, folder / RESULTS, print_progress)
    record = Record.load(folder / RESULTS)
    report(record, folder)
    wrong = [f"{key}: {why}" for key, why in record.skipped.items() if "not timed" in why or "means nothing" in why]
    if wrong:
        raise CldofError(f"{len(wrong)} rows gave images that cannot be right. {' '.join(wrong)}")


def settings_from(arguments: argparse.Namespace) -> Settings:
    """Defaults filled in."""
    from ..capture.scenes import builtin_scenes
    from ..methods import METHODS
    from .harness import Settings
    from .ladders import ACCUMULATION
    from .peers import PEERS

    quick = arguments.quick
    for name, least in (("runs", 1), ("reference_views", 1), ("seed", 0)):
        value = getattr(arguments, name)
        if value is not None and value < least:
            raise InputError(f"--{name.replace('_', '-')} is {value}; it must be at least {least}.")
    scenes = arguments.scenes or (QUICK_SCENES if quick else tuple(builtin_scenes()))
    peer_scenes = QUICK_PEER_SCENES if quick else PEER_SCENES
    if arguments.scenes:
        peer_scenes = tuple(scene for scene in scenes if scene in PEER_SCENES) or tuple(scenes)
    return Settings(
        scenes=tuple(scenes),
        sizes=tuple(map(_size, arguments.sizes)) if arguments.sizes else (_QUICK_SIZE if quick else _SIZE,),
        methods=tuple(arguments.methods or (ACCUMULATION, *METHODS, *PEERS)),
        devices=tuple(arguments.devices or ()),
        runs=arguments.runs or (3 if quick else 7),
        reference_views=arguments.reference_views or (_QUICK_VIEWS if quick else _VIEWS),
        seed=arguments.seed,
        quick=quick,
        peer_scenes=peer_scenes,
    )


def _size(text: str) -> tuple[int, int]:
    width, cross, height = text.lower().partition("x")
    if not (cross and width.isdecimal() and height.isdecimal() and int(width) and int(height)):
        raise InputError(f"--sizes {text!r} is not WIDTHxHEIGHT in pixels, such as 512x512.")
    return int(width), int(height)


def report(record: Record, folder: Path) -> None:
    """Print the tables; write plots and page into the folder."""
    from .analysis import case_table, summary_table, text_table, unit_text
    from .page import save_page
    from .plots import has_matplotlib, save_plots

    width = shutil.get_terminal_size((160, 24)).columns
    for case in record.cases:
        heads, cells = case_table(record, case)
        print(f"\n== {case}")
        print("\n".join(line[: max(width, 120)] for line in text_table(heads, cells).splitlines()))
    for unlit in (False, True):
        heads, cells = summary_table(record, unlit)
        if cells:
            print(f"\n== medians over the scenes{' with base colours only' if unlit else ''}")
            print(text_table(heads, cells))
    print(f"\n{unit_text(record)}")
    if record.skipped:
        print("\n== skipped")
        for why in dict.fromkeys(record.skipped.values()):
            keys = [key for key, one in record.skipped.items() if one == why]
            print(f"{len(keys)} x {why}" if len(keys) > 1 else f"{keys[0]}: {why}")
    print()
    if has_matplotlib():
        plots = save_plots(record, folder)
        print(f"{len(plots)} plots in {folder}")
    else:
        print("no plots: pip install 'cldof[bench]' brings matplotlib")
    save_page(record, folder / "index.html")
    print(f"{folder / 'index.html'}: open it in any browser")
