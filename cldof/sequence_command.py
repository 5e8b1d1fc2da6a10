"""``cldof sequence``: numbered images while focus and aperture move from key to key; the scene is captured once."""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import re
import shlex
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, NamedTuple

from .errors import InputError
from .files import atomic_write
from .focus import LensKey, LensTrack, autofocus, focus_on, render_track
from .frame import LayeredFrame
from .lens import Lens

__all__ = ["add_arguments", "sequence"]

_DEFAULT_FRAMES = 48
_MAX_FRAMES = 100_000
_KEY_WORDS = {
    "focus": "a distance in metres",
    "at": "X,Y in pixels",
    "on": "a node",
    "f": "a number",
    "radius": "metres",
}


class _Key(NamedTuple):
    """A key as it was typed."""

    frame: float
    words: dict[str, str]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The command's own; view, lens and method are those of ``cldof render``."""
    parser.add_argument("scene", metavar="SCENE", help="as for 'cldof render'")
    parser.add_argument(
        "-o", "--output", required=True, metavar="PATTERN", help="such as out/####.png: # are the frame's digits"
    )
    parser.add_argument("--frames", type=int, default=_DEFAULT_FRAMES, metavar="N", help=f"default {_DEFAULT_FRAMES}")
    parser.add_argument(
        "--key",
        action="append",
        default=[],
        metavar="'FRAME WORD=VALUE ...'",
        help="where the lens is at a frame (from 0, or 'last'): focus=M, at=X,Y, on=NODE or auto; f=N or radius=M",
    )
    parser.add_argument("--ease", choices=("linear", "smooth"), default="linear", help="between keys (default linear)")
    parser.add_argument("--report", metavar="FILE", help="also save every frame's lens and time as JSON")
    parser.add_argument("--quiet", action="store_true", help="print errors only")
    # What `cldof render` alone takes.
    parser.set_defaults(views=None, jitter=None, save_frame=None, pinhole=None)


def sequence(arguments: argparse.Namespace) -> None:
    """Run the command.

    Raises
    ------
    CldofError
    """
    from . import cli
    from .capture.peel import DepthPeeler
    from .images import check_writable, save_image
    from .renderer import Renderer

    if arguments.method == "accumulate":
        raise InputError("cldof sequence renders captured layers; for accumulated images call cldof render by frame.")
    cli._check_options(arguments)
    if not 1 <= arguments.frames <= _MAX_FRAMES:
        raise InputError(f"--frames is {arguments.frames}; it must be 1 to {_MAX_FRAMES}.")
    names = _names(arguments.output, arguments.frames)
    paths = [check_writable(name) for name in names]
    report = check_writable(arguments.report, ()) if arguments.report else None
    keys = [_parsed(text, arguments.frames) for text in arguments.key]
    settings = cli._Settings(cli._method_options(arguments), cli._aperture(arguments))
    factor = 1 if arguments.supersample is None else arguments.supersample
    watch = cli._Stopwatch(quiet=arguments.quiet)

    with watch.step("device"):
        renderer = Renderer(arguments.method, device=arguments.device, supersample=factor, **settings.options)
    with ExitStack() as stack:
        stack.enter_context(renderer)
        if cli._is_saved_frame(arguments.scene):
            frame = LayeredFrame.load(arguments.scene)
            captured = frame.camera
            camera = dataclasses.replace(captured, width=captured.width // factor, height=captured.height // factor)
            lens, remarks = cli._choose_lens(arguments, settings, frame, camera, None)
            track = _track(keys, lens, arguments, lambda key: _focus(key, frame, camera, None))
            lenses = track.lenses(arguments.frames)
            capture_device = None
        else:
            with watch.step("scene"):
                scene = cli._scene(arguments)
            camera = cli._camera(arguments, scene)
            peeler = stack.enter_context(DepthPeeler(camera.width, camera.height))
            whole = any("at" in key.words for key in keys)
            preview, lens, remarks = cli._aimed(arguments, settings, peeler, scene, camera, watch, whole)
            track = _track(keys, lens, arguments, lambda key: _focus(key, preview, camera, scene))
            lenses = track.lenses(arguments.frames)
            frame = cli._capture(arguments, peeler, scene, camera, preview, lenses, remarks, factor, watch)
            capture_device = peeler.device
        times = []
        with watch.step("frames") as progress:
            for index, result in enumerate(render_track(renderer, frame, lenses)):
                facts = {
                    "scene": Path(arguments.scene).name,
                    "method": arguments.method,
                    "frame": index,
                    "lens": lenses[index].to_dict(),
                    "camera": camera.to_dict(),
                }
                save_image(paths[index], result.image, facts)
                times.append(result.wall_ms)
                progress(index + 1, arguments.frames)
        if report is not None:
            details = {
                "scene": Path(arguments.scene).name,
                "method": arguments.method,
                "settings": {"supersample": factor, **cli._plain(renderer.method)},
                "camera": camera.to_dict(),
                "device": str(renderer.device.info),
                "capture_device": capture_device,
                "remarks": remarks,
                "frames": [
                    {"output": name, "lens": each.to_dict(), "ms": ms}
                    for name, each, ms in zip(names, lenses, times, strict=True)
                ],
            }
            with atomic_write(report) as stream:
                stream.write(json.dumps(details, indent=2, allow_nan=False).encode() + b"\n")
    if not arguments.quiet:
        first, last = lenses[0], lenses[-1]
        print(
            f"{names[0]} .. {names[-1]}  {arguments.frames} frames, {camera.width}x{camera.height}, {arguments.method}"
        )
        print(
            f"  lens    focus {first.focus_distance_m:.4g} to {last.focus_distance_m:.4g} m, aperture radius "
            f"{first.aperture_radius_m * 1e3:.4g} to {last.aperture_radius_m * 1e3:.4g} mm"
        )
        print("  times   " + ", ".join(f"{name} {seconds:.2f} s" for name, seconds in watch.seconds.items()))
        for remark in remarks:
            print(f"  note    {remark}")


def _names(pattern: str, count: int) -> list[str]:
    """Names of the frames' files."""
    runs = list(re.finditer("#+", Path(pattern).name))
    if len(runs) != 1:
        raise InputError(f"-o {pattern!r}: the file's name needs one run of # for the frame's number, as ####.png.")
    start, end = runs[0].span()
    if count > 10 ** (end - start):
        raise InputError(f"-o {pattern!r} has room for {10 ** (end - start)} frames, not for {count}: add another #.")
    folder, name = Path(pattern).parent, Path(pattern).name
    return [str(folder / f"{name[:start]}{index:0{end - start}d}{name[end:]}") for index in range(count)]


def _parsed(text: str, frames: int) -> _Key:
    try:
        number, *words = shlex.split(text)
        at = float(frames - 1) if number == "last" else float(number)
    except ValueError:
        raise InputError(f"--key {text!r} is not FRAME WORD=VALUE ..., such as '0 focus=1.5 f=2'.") from None
    values: dict[str, str] = {}
    for word in words:
        name, equals, value = word.partition("=")
        is_known = name == "auto" if not equals else name in _KEY_WORDS and value != ""
        if not is_known:
            known = ", ".join(f"{name}= {what}" for name, what in _KEY_WORDS.items())
            raise InputError(f"--key {text!r}: {word!r} is none of {known}, auto.")
        values[name] = value
    if len(values.keys() & {"focus", "at", "on", "auto"}) > 1 or len(values.keys() & {"f", "radius"}) > 1:
        raise InputError(f"--key {text!r} says more than once where to focus, or how wide to open.")
    if not values:
        raise InputError(f"--key {text!r} says nothing about the lens.")
    return _Key(at, values)


def _number(key: _Key, name: str) -> float:
    try:
        return float(key.words[name])
    except ValueError:
        raise InputError(f"--key at frame {key.frame:g}: {name}={key.words[name]} is not a number.") from None


def _track(keys: Sequence[_Key], lens: Lens, arguments: argparse.Namespace, focus: Any) -> LensTrack:
    """The keys, and the lens of the other options where they are silent."""
    made = []
    for key in keys:
        radius = None
        if "radius" in key.words:
            radius = _number(key, "radius")
        elif "f" in key.words:
            focal = lens.focal_length_mm or arguments.focal_length
            if focal is None:
                raise InputError("--key with f=N needs --focal-length MM or --f-number.")
            radius = Lens.photographic(focal, _number(key, "f"), math.inf).aperture_radius_m
        made.append(LensKey(key.frame, focus(key), radius))
    if all(key.focus_distance_m is None for key in made):
        made.append(LensKey(-1.0, focus_distance_m=lens.focus_distance_m))
    if all(key.aperture_radius_m is None for key in made):
        made.append(LensKey(-2.0, aperture_radius_m=lens.aperture_radius_m))
    return LensTrack(made, lens.aperture, lens.focal_length_mm, arguments.ease)


def _focus(key: _Key, frame: LayeredFrame, camera: Any, scene: Any) -> float | None:
    """Where a key focuses; None where it does not say."""
    from . import cli

    if "focus" in key.words:
        return _number(key, "focus")
    if "at" in key.words:
        try:
            return cli._focus_at(frame, camera, cli._pixel(key.words["at"]))
        except argparse.ArgumentTypeError as error:
            raise InputError(f"--key at frame {key.frame:g}: {error}.") from None
    if "on" in key.words:
        if scene is None:
            raise InputError(f"--key on={key.words['on']}: a saved frame has no nodes; use at=X,Y.")
        return focus_on(scene, key.words["on"], frame, camera)
    return autofocus(frame) if "auto" in key.words else None
