"""The command line: ``cldof render``, ``cldof methods``, ``cldof scenes``, ``cldof devices``.

Everything heavy is imported by the command that needs it, so that ``cldof --help`` answers at once. Mistakes in the
input, a machine that lacks something and results that cannot be written end with one paragraph on stderr and exit
code 2; results are written whole or not at all, and whether they can be is checked before any work is done.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import platform
import sys
import textwrap
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from . import __version__
from .camera import Camera
from .errors import CldofError, DeviceError, FrameError, InputError, SceneError
from .files import atomic_write, read_json
from .focus import autofocus, focus_at, focus_on
from .frame import FINER, LayeredFrame
from .lens import Aperture, DiscAperture, GaussianAperture, ImageAperture, Lens, PolygonAperture
from .lighting import Environment

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from .capture.peel import DepthPeeler
    from .capture.scene import Scene
    from .renderer import Renderer

__all__ = ["main"]

_EXIT_BAD_INPUT = 2
_EXIT_INTERRUPTED = 130

_DEFAULT_SIZE = (1024, 1024)
_DEFAULT_PEELS = 4
# The reference by brute force (capture/accumulate.py) is asked for like a method; it needs no OpenCL.
_ACCUMULATE = "accumulate"
# Neither is the choice of one a method of its own.
_AUTO = "auto"
_DEFAULT_VIEWS = 64
# An aperture of our choosing gives this largest CoC radius, as a share of the image height: clearly seen, not garish.
# A sky may blur more, since it rarely shows, but not without bound, since it still costs.
_AUTO_COC_SHARE = 0.02
_AUTO_SKY_COC_SHARE = 0.06
# The guard band holds the largest CoC, up to this share of the longer side: beyond it costs more than it shows.
_GUARD_SHARE = 0.10
# The first, cheap look at a scene finds depths, not pictures.
_PREVIEW_SHRINK = 4
_PREVIEW_LAYERS = _DEFAULT_PEELS
_FULL_FRAME_HEIGHT_MM = 24.0
_PATIENCE_S = 2.0
# Steps of so many parts or more get a bar.
_BAR_FROM, _BAR_WIDTH = 16, 30


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit code.

    0: done. 1: the doctor found that no picture can be made here. 2: the input, the machine or the output path did
    not allow it. 130: interrupted.
    """
    arguments = _parser().parse_args(argv)
    run: Callable[[argparse.Namespace], int | None] = arguments.run
    try:
        return run(arguments) or 0
    except CldofError as error:
        print(f"cldof: {error}", file=sys.stderr)
        return _EXIT_BAD_INPUT
    except MemoryError as error:
        print(f"cldof: out of memory ({error}); try a smaller --size or fewer --peels.", file=sys.stderr)
        return _EXIT_BAD_INPUT
    except KeyboardInterrupt:
        print("cldof: interrupted, nothing half-written.", file=sys.stderr)
        return _EXIT_INTERRUPTED


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="cldof", description="Depth of field for 3D scenes and RGBD layers.")
    parser.add_argument("--version", action="version", version=f"cldof {__version__}")
    commands = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")

    render = commands.add_parser(
        "render",
        help="render a scene or a saved frame with depth of field",
        description="Render SCENE with depth of field. What is not given is chosen sensibly and printed.",
    )
    render.set_defaults(run=_render)
    render.add_argument(
        "scene",
        metavar="SCENE",
        help="a scene file (glb, gltf, obj, ply, stl ...), a frame saved as .npz, or a name from 'cldof scenes'",
    )
    render.add_argument("-o", "--output", required=True, metavar="FILE", help=".png (sRGB), .exr or .npy (linear)")
    _add_view(render)
    _add_lens(render)
    _add_method(render)

    brute = render.add_argument_group("--method accumulate: many views through the lens, averaged")
    brute.add_argument("--views", type=int, metavar="N", help=f"how many (default {_DEFAULT_VIEWS})")
    brute.add_argument(
        "--jitter",
        action=argparse.BooleanOptionalAction,
        default=None,
        help="also move them inside the pixel, for smooth edges (default); not to compare with a method pixel by pixel",
    )

    more = render.add_argument_group("further results")
    more.add_argument("--pinhole", metavar="FILE", help="also save the image without any blur")
    more.add_argument("--save-frame", metavar="FILE", help="also save the captured layers (.npz), to render again")
    more.add_argument("--report", metavar="FILE", help="also save lens, camera, device, plan and times as JSON")
    more.add_argument(
        "--explain", action="store_true", help="print what was computed, what was left out, why, and what that changes"
    )
    more.add_argument("--quiet", action="store_true", help="print errors only")

    sequence = commands.add_parser(
        "sequence",
        help="render frames in which focus or aperture move, captured once",
        description="Render SCENE while focus and f-number move from key to key. The scene is captured once.",
    )
    sequence.set_defaults(run=_sequence)
    from .sequence_command import add_arguments as add_sequence_arguments

    add_sequence_arguments(sequence)
    _add_view(sequence)
    _add_lens(sequence)
    _add_method(sequence)

    methods = commands.add_parser(
        "methods", help="list methods and their options", description="List methods and their options."
    )
    methods.set_defaults(run=_methods)
    from .benchmark.command import add_arguments

    tune = commands.add_parser(
        "tune",
        help="measure what methods cost on a device, for --method auto",
        description="Measure what settings cost on a device, some six minutes, and keep it for --method auto.",
    )
    tune.set_defaults(run=_tune)
    tune.add_argument("frames", nargs="*", metavar="FRAME", help="frames saved as .npz, in place of built-in scenes")
    tune.add_argument("--device", metavar="DEVICE", help="as for 'cldof render'")
    tune.add_argument("--scenes", nargs="+", metavar="NAME", help="of the built-in ones (default all)")
    tune.add_argument("--errors", action="store_true", help="measure errors too, some ten minutes more")
    tune.add_argument("--rows", metavar="FILE", help="with --errors: also keep every measurement as JSON")
    tune.add_argument(
        "--busy", action="store_true", help="count processor time: for CPUs that have other work to do meanwhile"
    )
    tune.add_argument("--quiet", action="store_true", help="print errors only")

    bench = commands.add_parser(
        "bench",
        help="measure accuracy and time of every method on every device",
        description="Measure scenes x methods x settings x devices; write JSON, tables, plots and one HTML page.",
    )
    bench.set_defaults(run=_bench)
    add_arguments(bench)

    doctor = commands.add_parser(
        "doctor",
        help="what cldof needs, whether it is here, and whether each device makes the right pictures",
        description="Look at packages, drivers and folders, and have each device render a small frame by every method, "
        "in processes of their own. Exit code 0 if a picture can be made here, else 1.",
    )
    doctor.set_defaults(run=_doctor)
    doctor.add_argument("--json", action="store_true", help="as JSON, for a report")
    doctor.add_argument("--device", type=int, metavar="N", help="render on that one alone; see 'cldof devices'")
    doctor.add_argument("--quiet", action="store_true", help="no progress")
    devices = commands.add_parser("devices", help="list OpenCL devices", description="List OpenCL devices.")
    devices.set_defaults(run=_devices)
    scenes = commands.add_parser("scenes", help="list built-in scenes", description="List built-in scenes.")
    scenes.set_defaults(run=_scenes)
    return parser


def _add_view(parser: argparse.ArgumentParser) -> None:
    view = parser.add_argument_group("view (not for .npz frames, which have their own)")
    view.add_argument("--size", type=_size, metavar="WxH", help="image size in pixels (default 1024x1024)")
    view.add_argument("--yfov", type=_number, metavar="DEG", help="full vertical field of view in degrees")
    view.add_argument(
        "--camera", metavar="FILE", help="JSON with yfov_deg, pose_camera_to_world (4x4, glTF axes), znear, zfar"
    )
    view.add_argument("--unlit", action="store_true", help="show base colours without any light")
    view.add_argument(
        "--environment",
        metavar="FILE",
        help="light the scene by this equirectangular picture in place of ambient light, and show it as the sky; "
        ".exr and .npy are linear, anything else is sRGB",
    )
    view.add_argument("--transparent", action="store_true", help="leave out the background; alpha tells where it was")
    view.add_argument(
        "--peels",
        type=int,
        metavar="N",
        help=f"layers to capture at most (default: what a blur may reveal, up to {_DEFAULT_PEELS})",
    )
    view.add_argument(
        "--azimuth", type=_number, metavar="DEG", help="see files without a camera from here, +z to +x (default 30)"
    )
    view.add_argument("--elevation", type=_number, metavar="DEG", help="and from this far up (default 14)")


def _add_lens(parser: argparse.ArgumentParser) -> None:
    lens = parser.add_argument_group("lens")
    opening = lens.add_mutually_exclusive_group()
    opening.add_argument(
        "--aperture-radius", type=_number, metavar="M", help="aperture radius in metres; 0 is a pinhole"
    )
    opening.add_argument("--f-number", type=_number, metavar="N", help="focal length over aperture diameter")
    lens.add_argument(
        "--focal-length",
        type=_number,
        metavar="MM",
        help="with --f-number; by default the one that gives this view on a sensor 24 mm high",
    )
    focus = lens.add_mutually_exclusive_group()
    focus.add_argument("--focus-distance", type=_number, metavar="M", help="planar distance in metres; inf is legal")
    focus.add_argument("--focus-at", type=_pixel, metavar="X,Y", help="focus on what is seen at this pixel")
    focus.add_argument("--focus-on", metavar="NODE", help="focus on this node of the scene, by name or number")
    focus.add_argument("--autofocus", action="store_true", help="focus on the nearest surface in the middle")

    lens.add_argument(
        "--aperture",
        metavar="SHAPE",
        help="disc, gaussian, polygon:BLADES[:ROTATION_DEG[:CURVATURE]] or image:FILE; for --method accumulate",
    )
    lens.add_argument("--anamorphic", type=_number, metavar="RATIO", help="height over width of that shape (default 1)")


def _add_method(parser: argparse.ArgumentParser) -> None:
    how = parser.add_argument_group("how")
    how.add_argument("--method", default="layered", help="a name from 'cldof methods', or auto (default layered)")
    how.add_argument("--max-error", metavar="ERROR", help="--method auto: PSNR to reach (35dB), or linear RMS (0.018)")
    how.add_argument("--max-ms", type=_number, metavar="MS", help="--method auto: time for a frame")
    how.add_argument("--device", metavar="DEVICE", help="OpenCL device: index or part of a name from 'cldof devices'")
    how.add_argument(
        "--supersample", type=int, metavar="N", help="capture N times larger and scale down after the blur (default 1)"
    )
    how.add_argument(
        "--option",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="an option of the method; see 'cldof methods'",
    )
    how.add_argument("--layers", metavar="K", help="the most depth layers; short for --option layers=K")
    how.add_argument("--sigma-step", metavar="PX", help="short for --option sigma_step=PX")
    how.add_argument("--no-cascade", action="store_true", help="short for --option cascade=false")
    how.add_argument("--engine", metavar="NAME", help="short for --option engine=NAME")
    how.add_argument(
        "--no-view-dependent",
        action="store_true",
        help="shade what is glossy as the lens centre sees it; short for --option view_dependent=false",
    )


def _size(text: str) -> tuple[int, int]:
    width, cross, height = text.lower().partition("x")
    if not (cross and width.isdecimal() and height.isdecimal()):
        raise argparse.ArgumentTypeError(f"{text!r} is not WIDTHxHEIGHT in pixels, such as 1920x1080")
    return int(width), int(height)


def _pixel(text: str) -> tuple[float, float]:
    try:
        x, y = (float(part) for part in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not X,Y in pixels, such as 512,300") from None
    return x, y


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number") from None


def _sequence(arguments: argparse.Namespace) -> None:
    from .sequence_command import sequence

    sequence(arguments)


def _tune(arguments: argparse.Namespace) -> None:
    from .images import check_writable
    from .tune import tune

    if arguments.rows and not arguments.errors:
        raise InputError("--rows keeps the measurements of --errors; give both.")
    rows = check_writable(arguments.rows, ()) if arguments.rows else None
    frames = [LayeredFrame.load(path) for path in arguments.frames]
    watch = _Stopwatch(quiet=arguments.quiet)
    with watch.step("tune") as progress:
        curves, path = tune(
            arguments.device, frames, arguments.errors, arguments.busy, arguments.scenes, rows, progress
        )
    if not arguments.quiet:
        print(f"{path}\n  {curves.source['device']}, copy of 16 MB in {curves.source['copy_ms']:g} ms")


def _bench(arguments: argparse.Namespace) -> None:
    from .benchmark.command import bench

    bench(arguments)


def _doctor(arguments: argparse.Namespace) -> int:
    from .doctor.command import doctor

    return doctor(as_json=arguments.json, device=arguments.device, quiet=arguments.quiet)


def _devices(arguments: argparse.Namespace) -> None:
    from .host.device import list_devices
    from .host.drivers import driver_advice

    devices = list_devices()
    if not devices:
        raise DeviceError(f"No OpenCL device found. Any driver will do: a GPU's own, or for the CPU {driver_advice()}.")
    for device in devices:
        memory = f"{device.compute_units} compute units, {device.global_mem_bytes / 2**30:.1f} GiB"
        print(f"{device.index}  {device.name}\n   {device.kind}, {device.platform}, {device.driver_version}, {memory}")


def _scenes(arguments: argparse.Namespace) -> None:
    from .capture.scenes import builtin_scenes

    scenes = builtin_scenes()
    width = max(map(len, scenes))
    group = None
    for name, scene in scenes.items():
        if scene.group != group:
            print(("" if group is None else "\n") + f"{scene.group}:")
            group = scene.group
        print(f"  {name:{width}}  {scene.description}")


def _methods(arguments: argparse.Namespace) -> None:
    from .method_options import about, options_of, simulated_aperture
    from .methods import METHODS

    def show(name: str, default: str, text: str) -> None:
        print(
            textwrap.fill(f"{name} (default {default}): {text}", 100, initial_indent="  ", subsequent_indent="      ")
        )

    for method in METHODS:
        print(textwrap.fill(f"{method}: {about(method)}", 100, subsequent_indent="  "))
        shape = simulated_aperture(method)
        print(f"  Simulates a {shape} lens." if shape else "  Takes --aperture.")
        for option in options_of(method).values():
            show(f"{option.name}={option.kind}", str(option.default), option.text)
    print(f"{_AUTO}: one of these, chosen for every frame by what it may err or take; see docs/auto.md")
    print("  Takes --aperture.")
    show("--max-error ERROR", "none", "PSNR to reach in dB (35dB), or linear RMS to stay below (0.018)")
    show("--max-ms MS", "none", "time to stay below")
    print(f"{_ACCUMULATE}: the reference: many pinhole views through the lens, averaged; needs no OpenCL")
    print("  Takes --aperture.")
    show("--views N", str(_DEFAULT_VIEWS), "more views, less noise; the noise that is left is printed")
    show("--jitter, --no-jitter", "on", "smooth edges, as box-filtered pixels have them")


def _render(arguments: argparse.Namespace) -> None:
    from .images import check_writable, save_image

    output = check_writable(arguments.output)
    pinhole = check_writable(arguments.pinhole) if arguments.pinhole else None
    saved_frame = check_writable(arguments.save_frame, (".npz",)) if arguments.save_frame else None
    report = check_writable(arguments.report, ()) if arguments.report else None
    _check_options(arguments)
    settings = _Settings(_method_options(arguments), _aperture(arguments))

    watch = _Stopwatch(quiet=arguments.quiet)
    with ExitStack() as stack:
        make = _accumulated if arguments.method == _ACCUMULATE else _rendered
        shot, picture = make(arguments, settings, watch, stack)
        facts = _facts(arguments, shot, picture)
        with watch.step("write"):
            if pinhole is not None:
                save_image(pinhole, picture.pinhole(), {**facts, "method": "pinhole", "settings": {}, "lens": None})
            if saved_frame is not None:
                shot.frame.save(saved_frame)
            save_image(output, picture.image, facts)
        passes = [{"label": timing.label, "ms": timing.ms} for timing in picture.timings]
        if report is not None:
            details = {
                **facts,
                "output": str(output),
                "plan": _plain(picture.plan),
                "timings": {"steps_s": watch.seconds, "passes_ms": passes},
                "versions": _versions(),
            }
            with atomic_write(report) as stream:
                stream.write(json.dumps(details, indent=2, allow_nan=False).encode() + b"\n")
    if arguments.explain:
        print(picture.explained)
    if not arguments.quiet:
        _summarise(output, facts, shot, watch, sum(timing.ms for timing in picture.timings))


class _Settings(NamedTuple):
    """What was asked for beside scene, view and lens."""

    options: dict[str, Any]
    aperture: Aperture


class _Picture(NamedTuple):
    """What a method made of a shot."""

    image: NDArray[np.float32]
    pinhole: Callable[[], NDArray[np.float32]]
    settings: dict[str, Any]
    plan: Any
    timings: list[Any]
    device: str | None
    explained: str = "Brute force: every view is rendered in full; there is nothing to plan."


def _rendered(
    arguments: argparse.Namespace, settings: _Settings, watch: _Stopwatch, stack: ExitStack
) -> tuple[_Shot, _Picture]:
    """Layers, and a method on them."""
    from .renderer import Renderer

    factor = 1 if arguments.supersample is None else arguments.supersample
    with watch.step("device"):
        renderer = stack.enter_context(
            Renderer(arguments.method, device=arguments.device, profile=True, supersample=factor, **settings.options)
        )
    if _is_saved_frame(arguments.scene):
        shot = _load_shot(arguments, settings, factor, watch)
    else:
        shot = _capture_shot(arguments, settings, factor, watch, renderer, stack)
    with watch.step("render"), warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        result = renderer.render(shot.frame, shot.lens)
    shot.remarks.extend(str(warning.message).rstrip(".") for warning in caught)

    def pinhole() -> NDArray[np.float32]:
        sharp = shot.frame.pinhole_image()
        height, width = result.image.shape[:2]
        boxes = sharp.reshape(height, factor, width, factor, 4)
        return np.asarray(boxes.mean(axis=(1, 3), dtype=np.float64), np.float32) if factor > 1 else sharp

    asked = {"supersample": factor, **_plain(renderer.method)}
    if result.choice is not None:
        asked["choice"] = {**_plain(result.choice.to_dict()), "kernels_ms": sum(timing.ms for timing in result.timings)}
    device = str(renderer.device.info)
    plan = result.plan
    return shot, _Picture(result.image, pinhole, asked, plan.to_dict(), result.timings, device, plan.explain())


def _accumulated(
    arguments: argparse.Namespace, settings: _Settings, watch: _Stopwatch, stack: ExitStack
) -> tuple[_Shot, _Picture]:
    """The reference by brute force, which needs no OpenCL."""
    from .capture.accumulate import accumulate
    from .capture.peel import DepthPeeler

    views = _DEFAULT_VIEWS if arguments.views is None else arguments.views
    jitter = True if arguments.jitter is None else arguments.jitter
    with watch.step("scene"):
        scene = _scene(arguments)
    camera = _camera(arguments, scene)
    peeler = stack.enter_context(DepthPeeler(camera.width, camera.height))
    preview, lens, remarks = _aimed(arguments, settings, peeler, scene, camera, watch)
    with watch.step(_ACCUMULATE) as progress:
        reference = accumulate(
            peeler, scene, camera, lens, views, jitter=jitter, progress=progress,
            view_dependent=not arguments.no_view_dependent,
        )  # fmt: skip

    def pinhole() -> NDArray[np.float32]:
        closed = dataclasses.replace(lens, aperture_radius_m=0.0)
        return accumulate(peeler, scene, camera, closed, views, jitter=jitter, noise_floor=False).image

    facts = reference.to_dict()
    floor = facts["noise_floor_db"]
    if floor is not None:
        remarks.append(f"noise floor {floor:.1f} dB: the PSNR of this image against endlessly many views")
    asked = {"views": views, "jitter": jitter, "seed": 0, "view_dependent": not arguments.no_view_dependent}
    shot = _Shot(preview, lens, camera, remarks, peeler.device)
    return shot, _Picture(reference.image, pinhole, asked, {"method": _ACCUMULATE, **facts}, [], None)


class _Shot(NamedTuple):
    """A frame to render, the lens and the image's camera to render it with, and remarks for the user."""

    frame: LayeredFrame
    lens: Lens
    camera: Camera
    remarks: list[str]
    capture_device: str | None


def _is_saved_frame(scene: str) -> bool:
    return Path(scene).suffix.lower() == ".npz"


def _flags(arguments: argparse.Namespace, *names: str) -> list[str]:
    """Those of the options that were given, as they are typed."""
    given = {name: getattr(arguments, name) for name in names}
    if given.get("jitter") is False:
        given = {"no-jitter" if name == "jitter" else name: value is not None for name, value in given.items()}
    # By identity: 0 is a value.
    return [
        "--" + name.replace("_", "-")
        for name, value in given.items()
        if not (value is None or value is False or value == [])
    ]


def _check_options(arguments: argparse.Namespace) -> None:
    if arguments.focal_length is not None and arguments.f_number is None and arguments.aperture_radius is None:
        raise InputError("--focal-length alone does not say how wide the lens is open; give --f-number with it.")
    if arguments.supersample is not None and arguments.supersample < 1:
        raise InputError(f"--supersample is {arguments.supersample}; it must be a whole number, at least 1.")
    if arguments.method == _ACCUMULATE:
        if _is_saved_frame(arguments.scene):
            raise InputError(
                f"{arguments.scene} is a captured frame; --method accumulate draws the scene itself, so give that."
            )
        given = _flags(
            arguments, "device", "supersample", "option", "layers", "sigma_step", "no_cascade", "engine", "peels",
            "save_frame",
        )  # fmt: skip
        if given:
            raise InputError(
                f"--method accumulate captures no layers and takes no options of methods; leave out {', '.join(given)}."
            )
    else:
        given = _flags(arguments, "views", "jitter")
        if given:
            raise InputError(f"{', '.join(given)}: for --method accumulate only, not for {arguments.method!r}.")
    if arguments.camera and (given := _flags(arguments, "azimuth", "elevation")):
        raise InputError(f"--camera says where to look from; leave out {', '.join(given)}.")
    if _is_saved_frame(arguments.scene):
        given = _flags(
            arguments, "size", "yfov", "camera", "unlit", "environment", "transparent", "peels", "save_frame",
            "azimuth", "elevation",
        )  # fmt: skip
        if given:
            raise InputError(
                f"{arguments.scene} is a captured frame with a view of its own; leave out {', '.join(given)}."
            )


def _method_options(arguments: argparse.Namespace) -> dict[str, Any]:
    """The method's options, from --option and the flags that are short for it; checks the method's name too."""
    if arguments.method == _ACCUMULATE:
        return {}
    from .method_options import parse_options
    from .methods import METHODS

    if arguments.method == _AUTO:
        given = _flags(arguments, "option", "layers", "sigma_step", "no_cascade", "engine")
        if given:
            raise InputError(f"--method auto chooses the method's options; leave out {', '.join(given)}.")
        if (arguments.max_error is None) == (arguments.max_ms is None):
            raise InputError("--method auto needs --max-error (such as 35dB) or --max-ms (such as 40), one of both.")
        return {"max_error": arguments.max_error, "max_ms": arguments.max_ms}
    if given := _flags(arguments, "max_error", "max_ms"):
        raise InputError(f"{', '.join(given)}: for --method auto only, not for {arguments.method!r}.")
    if arguments.method not in METHODS:
        known = ", ".join([*METHODS, _AUTO, _ACCUMULATE])
        raise InputError(f"Method {arguments.method!r} is unknown; choose one of {known}.")
    pairs = []
    for text in arguments.option:
        name, equals, value = text.partition("=")
        if not equals:
            raise InputError(f"--option {text!r} is not NAME=VALUE, such as layers=12.")
        pairs.append((name, value))
    pairs += [
        (name, getattr(arguments, name))
        for name in ("layers", "sigma_step", "engine")
        if getattr(arguments, name) is not None
    ]
    if arguments.no_cascade:
        pairs.append(("cascade", "false"))
    if arguments.no_view_dependent:
        pairs.append(("view_dependent", "false"))
    return parse_options(arguments.method, pairs)


def _aperture(arguments: argparse.Namespace) -> Aperture:
    """The shape of the aperture: the one asked for, or the one that the method simulates."""
    if arguments.method not in (_ACCUMULATE, _AUTO):
        from .method_options import simulated_aperture

        simulated = simulated_aperture(arguments.method)
        given = _flags(arguments, "aperture", "anamorphic")
        if simulated is not None:
            if given:
                raise InputError(
                    f"Method {arguments.method!r} simulates a {simulated} lens and no other; leave out "
                    f"{', '.join(given)}, or use --method accumulate."
                )
            return Aperture.of(simulated)
    ratio = 1.0 if arguments.anamorphic is None else arguments.anamorphic
    kind, colon, rest = (arguments.aperture or "disc").partition(":")
    if kind == "disc" and not colon:
        return DiscAperture(ratio=ratio)
    if kind == "gaussian" and not colon:
        return GaussianAperture(ratio=ratio)
    if kind == "image" and rest:
        return ImageAperture(_aperture_image(rest), ratio=ratio)
    if kind == "polygon" and rest.count(":") <= 2:
        blades, *others = rest.split(":")
        try:
            corners, (rotation, curvature) = int(blades), [*(float(value) for value in others), 0.0, 0.0][:2]
        except ValueError:
            pass
        else:
            return PolygonAperture(corners, rotation, curvature, ratio=ratio)
    raise InputError(
        f"--aperture {arguments.aperture!r} is unknown; use disc, gaussian, polygon:BLADES[:ROTATION_DEG[:CURVATURE]] "
        "such as polygon:6:15:0.2, or image:FILE."
    )


def _aperture_image(path: str) -> NDArray[np.float64]:
    """How much light each point of the aperture lets through: the linear luminance of a picture, on black."""
    from .images import check_picture, linear_from_srgb, opened_picture

    what = f"the aperture image {path}"
    check_picture(path, what)
    with opened_picture(path, what) as picture:
        flat = np.asarray(picture.convert("RGBA"), np.float64) / 255.0
    return np.asarray(linear_from_srgb(flat[..., :3]) @ (0.2126, 0.7152, 0.0722) * flat[..., 3])


def _load_shot(arguments: argparse.Namespace, settings: _Settings, factor: int, watch: _Stopwatch) -> _Shot:
    frame = LayeredFrame.load(arguments.scene)
    captured = frame.camera
    camera = dataclasses.replace(
        captured, width=max(1, captured.width // factor), height=max(1, captured.height // factor)
    )
    lens, remarks = _choose_lens(arguments, settings, frame, camera, None)
    needed = math.ceil(_largest_coc_px(lens, captured, frame))
    if frame.guard_px < needed:
        remarks.append(
            f"the frame's guard band is {frame.guard_px} px, the largest blur radius {needed} px: light from beyond "
            "the edges is missing there"
        )
    return _Shot(frame, lens, camera, remarks, None)


def _capture_shot(
    arguments: argparse.Namespace,
    settings: _Settings,
    factor: int,
    watch: _Stopwatch,
    renderer: Renderer,
    stack: ExitStack,
) -> _Shot:
    from .capture.peel import DepthPeeler

    with watch.step("scene"):
        scene = _scene(arguments)
    camera = _camera(arguments, scene)
    peeler = stack.enter_context(DepthPeeler(camera.width, camera.height))
    preview, lens, remarks = _aimed(arguments, settings, peeler, scene, camera, watch)
    if arguments.peels is None:
        arguments.peels = _peels_for(renderer, preview, lens, remarks)
    frame = _capture(arguments, peeler, scene, camera, preview, [lens], remarks, factor, watch)
    return _Shot(frame, lens, camera, remarks, peeler.device)


def _peels_for(renderer: Renderer, preview: LayeredFrame, lens: Lens, remarks: list[str]) -> int:
    """As many peels as a blur may reveal by the preview, and one more for what is too small for it."""
    from .planner import peels_needed

    needed, why = peels_needed(renderer.stats(preview), lens, preview.camera)
    peels = min(needed + (lens.aperture_radius_m > 0.0), _DEFAULT_PEELS)
    if peels < _DEFAULT_PEELS:
        remarks.append(f"{peels} of {_DEFAULT_PEELS} peels captured: {why} (--peels {_DEFAULT_PEELS} captures all)")
    return peels


def _capture(
    arguments: argparse.Namespace,
    peeler: DepthPeeler,
    scene: Scene,
    camera: Camera,
    preview: LayeredFrame,
    lenses: Sequence[Lens],
    remarks: list[str],
    factor: int,
    watch: _Stopwatch,
) -> LayeredFrame:
    """Layers that serve all lenses: a guard band for the largest blur, surfaces where the preview asks for them."""
    needed = math.ceil(max(_largest_coc_px(lens, camera, preview) for lens in lenses))
    guard = min(needed, math.ceil(_GUARD_SHARE * max(camera.width, camera.height)))
    if guard < needed:
        remarks.append(
            f"the guard band is capped at {guard} px, the largest blur radius is {needed} px: light from beyond "
            "the edges is missing there"
        )
    peels = _DEFAULT_PEELS if arguments.peels is None else arguments.peels
    widest = max(lenses, key=lambda lens: lens.aperture_radius_m)
    surface = preview.is_glossy_through(widest)

    def taken(step: str, times: int, lod_bias: float = 0.0) -> LayeredFrame:
        with watch.step(step) as progress:
            return peeler.peel(
                scene, camera.supersampled(times), layers=peels, lens=widest, guard_px=times * guard, surface=surface,
                progress=progress, lod_bias=lod_bias,
            )  # fmt: skip

    frame = taken("capture", factor)
    if arguments.max_error is None or factor > 1:
        return frame

    def finer() -> LayeredFrame:
        remarks.append(f"captured again {FINER} times larger: pixels of the image are too coarse for this error")
        return taken("finer capture", FINER, math.log2(FINER))

    return frame.with_finer(finer)


def _aimed(
    arguments: argparse.Namespace,
    settings: _Settings,
    peeler: DepthPeeler,
    scene: Scene,
    camera: Camera,
    watch: _Stopwatch,
    whole: bool = False,
) -> tuple[LayeredFrame, Lens, list[str]]:
    """A first look at the scene, and the lens that follows from it; ``whole`` looks at every pixel."""
    from .method_options import shades_surfaces

    # What auto knows of times and errors is without surfaces.
    has_choice = arguments.method not in (_ACCUMULATE, _AUTO)
    surface = has_choice and shades_surfaces(arguments.method, settings.options)
    with watch.step("preview"):
        # On a pixel the depth has to be that pixel's own; for anything else a fraction of them is enough.
        shrink = 1 if whole or arguments.focus_at else _PREVIEW_SHRINK
        small = dataclasses.replace(
            camera, width=math.ceil(camera.width / shrink), height=math.ceil(camera.height / shrink)
        )
        preview = peeler.peel(scene, small, layers=_PREVIEW_LAYERS, surface=surface)
    return preview, *_choose_lens(arguments, settings, preview, camera, scene)


def _scene(arguments: argparse.Namespace) -> Scene:
    from .capture.find import find_scene

    turned = _flags(arguments, "azimuth", "elevation")
    view = {f"{name}_deg": getattr(arguments, name) for name in ("azimuth", "elevation")}
    view = {name: angle for name, angle in view.items() if angle is not None}
    if not all(map(math.isfinite, view.values())):
        raise InputError(f"{' and '.join(turned)}: angles must be finite.")
    scene = find_scene(arguments.scene, unlit=arguments.unlit, **view)
    if turned and scene.camera is not None:
        raise InputError(f"{arguments.scene} has a camera of its own; leave out {', '.join(turned)}, or use --camera.")
    if arguments.environment:
        around = _environment(arguments.environment)
        scene = dataclasses.replace(scene, environment=around, background=around)
    return dataclasses.replace(scene, background=None) if arguments.transparent else scene


def _environment(path: str) -> Environment:
    from .images import read_linear

    try:
        return Environment(read_linear(path))
    except SceneError as error:
        raise SceneError(f"--environment {path}: {error}") from None


def _camera(arguments: argparse.Namespace, scene: Scene) -> Camera:
    if arguments.camera:
        width, height = arguments.size or (None, None)
        camera = Camera.load(arguments.camera, *_sized(arguments.camera, width, height))
    else:
        camera = scene.camera_for(*(arguments.size or _DEFAULT_SIZE))
    return camera if arguments.yfov is None else dataclasses.replace(camera, yfov_deg=arguments.yfov)


def _sized(path: str, width: int | None, height: int | None) -> tuple[int | None, int | None]:
    """The size asked for, else the camera file's own, else the default."""
    if width is not None:
        return width, height
    data = read_json(path, f"camera file {path}")
    has_size = isinstance(data, dict) and {"width", "height"} <= set(data)
    return (None, None) if has_size else _DEFAULT_SIZE


def _choose_lens(
    arguments: argparse.Namespace, settings: _Settings, frame: LayeredFrame, camera: Camera, scene: Scene | None
) -> tuple[Lens, list[str]]:
    """The lens asked for, completed from the scene's suggestions or from what the frame shows."""
    remarks: list[str] = []
    if arguments.focus_distance is not None:
        focus = arguments.focus_distance
    elif arguments.focus_at:
        focus = _focus_at(frame, camera, arguments.focus_at)
        remarks.append(f"focus on pixel {arguments.focus_at[0]:g},{arguments.focus_at[1]:g}: {focus:.4g} m")
    elif arguments.focus_on is not None:
        if scene is None:
            raise InputError(f"--focus-on {arguments.focus_on}: a saved frame has no nodes; use --focus-at.")
        focus = focus_on(scene, arguments.focus_on, frame, camera)
        remarks.append(f"focus on node {arguments.focus_on}: {focus:.4g} m")
    elif arguments.autofocus:
        focus = autofocus(frame)
        remarks.append(f"autofocus: {focus:.4g} m")
    elif scene is not None and scene.focus_distance_m is not None:
        focus = scene.focus_distance_m
    else:
        focus, where = _default_focus(frame)
        remarks.append(f"focus on {where}: {focus:.4g} m (--focus-distance or --focus-at sets another)")

    focus = Lens(0.0, focus).focus_distance_m  # refuses an impossible one before anything is derived from it

    if arguments.f_number is not None:
        focal = arguments.focal_length
        if focal is None:
            focal = _FULL_FRAME_HEIGHT_MM / 2.0 / math.tan(math.radians(camera.yfov_deg) / 2.0)
            remarks.append(f"focal length {focal:.4g} mm, which gives this view on a sensor 24 mm high")
        return Lens.photographic(focal, arguments.f_number, focus, settings.aperture), remarks
    if arguments.aperture_radius is not None:
        return Lens(arguments.aperture_radius, focus, arguments.focal_length, settings.aperture), remarks
    if scene is not None and scene.aperture_radius_m is not None:
        return Lens(scene.aperture_radius_m, focus, aperture=settings.aperture), remarks
    radius = _default_aperture_m(frame, camera, focus)
    remarks.append(f"aperture radius {radius:.4g} m, for a visible blur (--aperture-radius or --f-number sets another)")
    return Lens(radius, focus, aperture=settings.aperture), remarks


def _focus_at(frame: LayeredFrame, camera: Camera, pixel: tuple[float, float]) -> float:
    x, y = pixel
    if not (0 <= x < camera.width and 0 <= y < camera.height):
        raise InputError(
            f"--focus-at {x:g},{y:g} is outside the image of {camera.width}x{camera.height} (x right, y down, from 0)."
        )
    # The frame may be larger than the image.
    scale = frame.camera.width / camera.width
    try:
        return focus_at(frame, x * scale, y * scale)
    except FrameError:
        raise InputError(
            f"--focus-at {x:g},{y:g}: nothing is there. Choose another pixel, or use --focus-distance."
        ) from None


def _default_focus(frame: LayeredFrame) -> tuple[float, str]:
    """The surface at the middle of the image; where there is none, the nearest one of all."""
    depth = frame.depth_at(frame.camera.width / 2, frame.camera.height / 2)
    if math.isfinite(depth):
        return depth, "the surface at the middle of the image"
    nearest = float(frame.depth.min())
    if math.isfinite(nearest):
        return nearest, "the nearest surface"
    raise FrameError("Nothing is in sight: the frame holds no surface at all. Check the camera (--camera, --yfov).")


def _default_aperture_m(frame: LayeredFrame, camera: Camera, focus: float) -> float:
    surfaces = frame.depth[np.isfinite(frame.depth)]
    inverse = 1.0 / np.array([surfaces.max(), surfaces.min()], np.float64) if surfaces.size else np.zeros(2)
    spread = float(np.abs(inverse - 1.0 / focus).max())
    sky_spread = abs(frame.inverse_depth_range[0] - 1.0 / focus)
    widest = max(spread / _AUTO_COC_SHARE, sky_spread / _AUTO_SKY_COC_SHARE)
    if widest * (focus if math.isfinite(focus) else 1.0) < 1e-4:  # all in one plane: any aperture leaves it sharp
        return 0.01
    return float(f"{camera.height / (camera.focal_px * widest):.3g}")


def _largest_coc_px(lens: Lens, camera: Camera, frame: LayeredFrame) -> float:
    c1, c0 = lens.coc_coefficients(camera)
    if not (np.isfinite(frame.depth).any() or frame.color[..., 3].any()):
        return 0.0
    return max(abs(c1 * inverse + c0) for inverse in frame.inverse_depth_range)


def _facts(arguments: argparse.Namespace, shot: _Shot, picture: _Picture) -> dict[str, Any]:
    """What made the image: goes into the image file and the report."""
    frame, lens = shot.frame, shot.lens
    has_layers = arguments.method != _ACCUMULATE
    c1, c0 = lens.coc_coefficients(shot.camera)
    low, high = frame.inverse_depth_range
    return {
        "cldof": __version__,
        "scene": Path(arguments.scene).name,
        "method": arguments.method,
        "settings": picture.settings,
        "lens": {**lens.to_dict(), "f_number": _plain(lens.f_number)},
        "camera": shot.camera.to_dict(),
        "layers": frame.layer_count if has_layers else None,
        "guard_px": frame.guard_px if has_layers else None,
        "coc_radius_px": [c1 * high + c0, c1 * low + c0],
        "device": picture.device,
        "capture_device": shot.capture_device,
        "remarks": shot.remarks,
    }


def _summarise(output: Path, facts: dict[str, Any], shot: _Shot, watch: _Stopwatch, kernels_ms: float) -> None:
    camera, lens = shot.camera, shot.lens
    blur = max(map(abs, facts["coc_radius_px"]))
    opening = f"aperture radius {lens.aperture_radius_m * 1e3:.4g} mm"
    if lens.f_number is not None:
        opening += f" (f/{lens.f_number:.3g} at {lens.focal_length_mm:.4g} mm)"
    amount = f"{facts['layers']} layers" if facts["layers"] else f"{facts['settings']['views']} views"
    if facts["settings"].get("supersample", 1) > 1:
        amount += f", supersampled by {facts['settings']['supersample']}"
    print(f"{output}  {camera.width}x{camera.height}, {facts['method']}, {amount}")
    print(f"  lens    {opening}, focus {lens.focus_distance_m:.4g} m, largest blur radius {blur:.1f} px")
    if facts["device"]:
        print(f"  device  {facts['device']}")
    if shot.capture_device:
        print(f"  capture {shot.capture_device}")
    choice = facts["settings"].get("choice")
    if choice is not None:
        from .auto import Setting

        taken = Setting(choice["method"], choice["options"], choice["samples"])
        print(
            f"  auto    {taken}, {choice['reason']}: expected "
            f"{choice['predicted_db']:.1f} dB (give or take {choice['uncertainty_db']:.1f}) and "
            f"{choice['predicted_ms']:.1f} ms a frame; its kernels took {kernels_ms:.1f} ms"
        )
    steps = ", ".join(f"{name} {seconds:.2f} s" for name, seconds in watch.seconds.items())
    print(f"  times   {steps}" + (f" (kernels {kernels_ms:.1f} ms)" if facts["device"] else ""))
    for remark in shot.remarks:
        print(f"  note    {remark}")


def _versions() -> dict[str, str]:
    versions = {"cldof": __version__, "python": platform.python_version()}
    for package in (
        "numpy",
        "pyopencl",
        "pocl-binary-distribution",
        "pyrender",
        "trimesh",
        "PyOpenGL",
        "pillow",
        "OpenEXR",
    ):
        try:
            versions[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            continue
    return versions


def _plain(value: Any) -> Any:
    """Whatever a plan holds, as JSON can hold it; infinity and NaN become None, as in ``Lens.to_dict``."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: _plain(getattr(value, field.name)) for field in dataclasses.fields(value)}
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return _plain(value.tolist())
    if isinstance(value, list | tuple | set | frozenset):
        return [_plain(item) for item in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value if value is None or isinstance(value, bool | int | str) else str(value)


class _Stopwatch:
    """Times the steps of a command, and tells the user about those that take more than two seconds.

    On a terminal a line appears while such a step runs; elsewhere one plain line when it is over.
    """

    def __init__(self, quiet: bool) -> None:
        self.seconds: dict[str, float] = {}
        self._open: list[dict[str, str]] = []
        self._quiet = quiet
        self._live = sys.stderr.isatty()

    @contextmanager
    def step(self, name: str) -> Iterator[Callable[[int, int], None]]:
        """Time the block under ``name``; yields a callable for progress within it (done, of how many).

        The time of steps within it is theirs alone.
        """
        start, others = time.perf_counter(), sum(self.seconds.values())
        state = {"text": f"{name} ..."}
        self._open.append(state)
        over = threading.Event()

        def narrate() -> None:
            wait = _PATIENCE_S
            while not over.wait(wait):
                if self._open[-1] is state:
                    line = f"\r\x1b[K{state['text']} {time.perf_counter() - start:.0f} s"
                    print(line, end="", file=sys.stderr, flush=True)
                wait = 0.5
            if wait != _PATIENCE_S:
                print("\r\x1b[K", end="", file=sys.stderr, flush=True)

        def progress(done: int, total: int) -> None:
            filled = _BAR_WIDTH * done // max(total, 1)
            bar = f" [{'#' * filled}{'.' * (_BAR_WIDTH - filled)}]" if total >= _BAR_FROM else ""
            state["text"] = f"{name} {done}/{total}{bar}"

        narrator = None
        if self._live and not self._quiet:
            narrator = threading.Thread(target=narrate, daemon=True)
            narrator.start()
        try:
            yield progress
        finally:
            over.set()
            if narrator is not None:
                narrator.join()
            self._open.pop()
            self.seconds[name] = elapsed = time.perf_counter() - start - (sum(self.seconds.values()) - others)
            if elapsed > _PATIENCE_S and not self._quiet:
                print(f"{name}: {elapsed:.1f} s", file=sys.stderr)


if __name__ == "__main__":
    sys.exit(main())
