"""The command line: ``cldof render``, ``cldof devices``, ``cldof scenes``.

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
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from . import __version__
from .camera import Camera
from .errors import CldofError, DeviceError, FrameError, InputError, SceneError
from .files import atomic_write
from .frame import LayeredFrame
from .lens import Lens

if TYPE_CHECKING:
    from .capture.scene import Scene

__all__ = ["main"]

_EXIT_BAD_INPUT = 2
_EXIT_INTERRUPTED = 130

_DEFAULT_SIZE = (1024, 1024)
_DEFAULT_PEELS = 4
# An aperture of our choosing gives this largest CoC radius, as a share of the image height: clearly seen, not garish.
# A sky may blur more, since it rarely shows, but not without bound, since it still costs.
_AUTO_COC_SHARE = 0.02
_AUTO_SKY_COC_SHARE = 0.06
# The guard band holds the largest CoC, up to this share of the longer side: beyond it costs more than it shows.
_GUARD_SHARE = 0.10
# The first, cheap look at a scene finds depths, not pictures.
_PREVIEW_SHRINK = 4
_PREVIEW_LAYERS = 2
_FULL_FRAME_HEIGHT_MM = 24.0
_PATIENCE_S = 2.0


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit code.

    0: done. 2: the input, the machine or the output path did not allow it. 130: interrupted.
    """
    arguments = _parser().parse_args(argv)
    run: Callable[[argparse.Namespace], None] = arguments.run
    try:
        run(arguments)
    except CldofError as error:
        print(f"cldof: {error}", file=sys.stderr)
        return _EXIT_BAD_INPUT
    except MemoryError as error:
        print(f"cldof: out of memory ({error}); try a smaller --size or fewer --peels.", file=sys.stderr)
        return _EXIT_BAD_INPUT
    except KeyboardInterrupt:
        print("cldof: interrupted, nothing half-written.", file=sys.stderr)
        return _EXIT_INTERRUPTED
    return 0


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

    view = render.add_argument_group("view (not for .npz frames, which have their own)")
    view.add_argument("--size", type=_size, metavar="WxH", help="image size in pixels (default 1024x1024)")
    view.add_argument("--yfov", type=_number, metavar="DEG", help="full vertical field of view in degrees")
    view.add_argument(
        "--camera", metavar="FILE", help="JSON with yfov_deg, pose_camera_to_world (4x4, glTF axes), znear, zfar"
    )
    view.add_argument("--unlit", action="store_true", help="show base colours without any light")
    view.add_argument("--transparent", action="store_true", help="leave out the background; alpha tells where it was")
    view.add_argument("--peels", type=int, metavar="N", help=f"layers to capture at most (default {_DEFAULT_PEELS})")

    lens = render.add_argument_group("lens")
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

    how = render.add_argument_group("how")
    how.add_argument("--method", default="layered", help="depth-of-field method (default layered)")
    how.add_argument("--device", metavar="DEVICE", help="OpenCL device: index or part of a name from 'cldof devices'")

    more = render.add_argument_group("further results")
    more.add_argument("--pinhole", metavar="FILE", help="also save the image without any blur")
    more.add_argument("--save-frame", metavar="FILE", help="also save the captured layers (.npz), to render again")
    more.add_argument("--report", metavar="FILE", help="also save lens, camera, device, plan and times as JSON")
    more.add_argument("--quiet", action="store_true", help="print errors only")

    devices = commands.add_parser("devices", help="list OpenCL devices", description="List OpenCL devices.")
    devices.set_defaults(run=_devices)
    scenes = commands.add_parser("scenes", help="list built-in scenes", description="List built-in scenes.")
    scenes.set_defaults(run=_scenes)
    return parser


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


def _devices(arguments: argparse.Namespace) -> None:
    from .host.device import list_devices

    devices = list_devices()
    if not devices:
        raise DeviceError(
            "No OpenCL device found. Any driver will do: a GPU's own, or for the CPU pip install 'pyopencl[pocl]'."
        )
    for device in devices:
        memory = f"{device.compute_units} compute units, {device.global_mem_bytes / 2**30:.1f} GiB"
        print(f"{device.index}  {device.name}\n   {device.kind}, {device.platform}, {device.driver_version}, {memory}")


def _scenes(arguments: argparse.Namespace) -> None:
    from .capture.scenes import builtin_scenes

    scenes = builtin_scenes()
    width = max(map(len, scenes))
    for name, scene in scenes.items():
        print(f"{name:{width}}  {scene.description}")


def _render(arguments: argparse.Namespace) -> None:
    from .images import check_writable, save_image
    from .renderer import Renderer

    output = check_writable(arguments.output)
    pinhole = check_writable(arguments.pinhole) if arguments.pinhole else None
    saved_frame = check_writable(arguments.save_frame, (".npz",)) if arguments.save_frame else None
    report = check_writable(arguments.report, ()) if arguments.report else None
    _check_options(arguments)

    watch = _Stopwatch(quiet=arguments.quiet)
    with ExitStack() as stack:
        with watch.step("device"):
            renderer = stack.enter_context(Renderer(method=arguments.method, device=arguments.device, profile=True))
        shot = _load_shot(arguments) if _is_saved_frame(arguments.scene) else _capture_shot(arguments, watch)
        with watch.step("render"):
            result = renderer.render(shot.frame, shot.lens)

        facts = _facts(arguments, shot, result, renderer)
        with watch.step("write"):
            if pinhole is not None:
                save_image(pinhole, shot.frame.pinhole_image(), {**facts, "method": "pinhole", "lens": None})
            if saved_frame is not None:
                shot.frame.save(saved_frame)
            save_image(output, result.image, facts)
        passes = [{"label": timing.label, "ms": timing.ms} for timing in result.timings]
        if report is not None:
            details = {
                **facts,
                "output": str(output),
                "plan": _plain(result.plan.summary),
                "timings": {"steps_s": watch.seconds, "passes_ms": passes},
                "versions": _versions(),
            }
            with atomic_write(report) as stream:
                stream.write(json.dumps(details, indent=2, allow_nan=False).encode() + b"\n")
    if not arguments.quiet:
        _summarise(output, facts, shot, watch, sum(timing.ms for timing in result.timings))


class _Shot(NamedTuple):
    """A frame to render, the lens to render it with, and remarks for the user."""

    frame: LayeredFrame
    lens: Lens
    remarks: list[str]
    capture_device: str | None


def _is_saved_frame(scene: str) -> bool:
    return Path(scene).suffix.lower() == ".npz"


def _check_options(arguments: argparse.Namespace) -> None:
    if arguments.focal_length is not None and arguments.f_number is None and arguments.aperture_radius is None:
        raise InputError("--focal-length alone does not say how wide the lens is open; give --f-number with it.")
    if _is_saved_frame(arguments.scene):
        names = ("size", "yfov", "camera", "unlit", "transparent", "peels", "save_frame")
        given = ["--" + name.replace("_", "-") for name in names if getattr(arguments, name)]
        if given:
            raise InputError(
                f"{arguments.scene} is a captured frame with a view of its own; leave out {', '.join(given)}."
            )


def _load_shot(arguments: argparse.Namespace) -> _Shot:
    frame = LayeredFrame.load(arguments.scene)
    lens, remarks = _choose_lens(arguments, frame, frame.camera, None)
    needed = math.ceil(_largest_coc_px(lens, frame.camera, frame))
    if frame.guard_px < needed:
        remarks.append(
            f"the frame's guard band is {frame.guard_px} px, the largest blur radius {needed} px: light from beyond "
            "the edges is missing there"
        )
    return _Shot(frame, lens, remarks, None)


def _capture_shot(arguments: argparse.Namespace, watch: _Stopwatch) -> _Shot:
    from .capture.peel import DepthPeeler

    with watch.step("scene"):
        scene = _scene(arguments)
    camera = _camera(arguments, scene)
    with DepthPeeler(camera.width, camera.height) as peeler:
        with watch.step("preview"):
            # On a pixel the depth has to be that pixel's own; for anything else a fraction of them is enough.
            shrink = 1 if arguments.focus_at else _PREVIEW_SHRINK
            small = dataclasses.replace(
                camera, width=math.ceil(camera.width / shrink), height=math.ceil(camera.height / shrink)
            )
            preview = peeler.peel(scene, small, layers=_PREVIEW_LAYERS)
        lens, remarks = _choose_lens(arguments, preview, camera, scene)
        needed = math.ceil(_largest_coc_px(lens, camera, preview))
        guard = min(needed, math.ceil(_GUARD_SHARE * max(camera.width, camera.height)))
        if guard < needed:
            remarks.append(
                f"the guard band is capped at {guard} px, the largest blur radius is {needed} px: light from beyond "
                "the edges is missing there"
            )
        peels = _DEFAULT_PEELS if arguments.peels is None else arguments.peels
        with watch.step("capture") as progress:
            frame = peeler.peel(scene, camera, layers=peels, lens=lens, guard_px=guard, progress=progress)
        return _Shot(frame, lens, remarks, peeler.device)


def _scene(arguments: argparse.Namespace) -> Scene:
    from .capture.scenes import builtin_scenes

    builtin = builtin_scenes()
    if arguments.scene in builtin:
        scene = builtin[arguments.scene].make()
        if arguments.unlit:
            scene = dataclasses.replace(scene, unlit=True)
    elif not Path(arguments.scene).exists():
        raise SceneError(
            f"{arguments.scene!r} is neither a file nor a built-in scene; built in are {', '.join(builtin)}."
        )
    else:
        from .capture.load import load_scene

        scene = load_scene(arguments.scene, unlit=arguments.unlit)
    return dataclasses.replace(scene, background=None) if arguments.transparent else scene


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
    try:
        data = json.loads(Path(path).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None, None  # Camera.load says what is wrong with the file
    has_size = isinstance(data, dict) and {"width", "height"} <= set(data)
    return (None, None) if has_size else _DEFAULT_SIZE


def _choose_lens(
    arguments: argparse.Namespace, frame: LayeredFrame, camera: Camera, scene: Scene | None
) -> tuple[Lens, list[str]]:
    """The lens asked for, completed from the scene's suggestions or from what the frame shows."""
    remarks: list[str] = []
    if arguments.focus_distance is not None:
        focus = arguments.focus_distance
    elif arguments.focus_at:
        focus = _depth_at(frame, camera, arguments.focus_at)
        remarks.append(f"focus on pixel {arguments.focus_at[0]:g},{arguments.focus_at[1]:g}: {focus:.4g} m")
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
        return Lens.photographic(focal, arguments.f_number, focus), remarks
    if arguments.aperture_radius is not None:
        return Lens(arguments.aperture_radius, focus, arguments.focal_length), remarks
    if scene is not None and scene.aperture_radius_m is not None:
        return Lens(scene.aperture_radius_m, focus), remarks
    radius = _default_aperture_m(frame, camera, focus)
    remarks.append(f"aperture radius {radius:.4g} m, for a visible blur (--aperture-radius or --f-number sets another)")
    return Lens(radius, focus), remarks


def _depth_at(frame: LayeredFrame, camera: Camera, pixel: tuple[float, float]) -> float:
    x, y = pixel
    if not (0 <= x < camera.width and 0 <= y < camera.height):
        raise InputError(
            f"--focus-at {x:g},{y:g} is outside the image of {camera.width}x{camera.height} (x right, y down, from 0)."
        )
    depth = frame.depth_at(x, y)
    if math.isinf(depth) and frame.color[0, int(y) + frame.guard_px, int(x) + frame.guard_px, 3] == 0.0:
        raise InputError(f"--focus-at {x:g},{y:g}: nothing is there. Choose another pixel, or use --focus-distance.")
    return depth


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


def _facts(arguments: argparse.Namespace, shot: _Shot, result: Any, renderer: Any) -> dict[str, Any]:
    """What made the image: goes into the image file and the report."""
    frame, lens = shot.frame, shot.lens
    c1, c0 = lens.coc_coefficients(frame.camera)
    low, high = frame.inverse_depth_range
    return {
        "cldof": __version__,
        "scene": Path(arguments.scene).name,
        "method": arguments.method,
        "lens": {**lens.to_dict(), "f_number": _plain(lens.f_number)},
        "camera": frame.camera.to_dict(),
        "layers": frame.layer_count,
        "guard_px": frame.guard_px,
        "coc_radius_px": [c1 * high + c0, c1 * low + c0],
        "device": str(renderer.device.info),
        "capture_device": shot.capture_device,
        "remarks": shot.remarks,
    }


def _summarise(output: Path, facts: dict[str, Any], shot: _Shot, watch: _Stopwatch, kernels_ms: float) -> None:
    camera, lens = shot.frame.camera, shot.lens
    blur = max(map(abs, facts["coc_radius_px"]))
    opening = f"aperture radius {lens.aperture_radius_m * 1e3:.4g} mm"
    if lens.f_number is not None:
        opening += f" (f/{lens.f_number:.3g} at {lens.focal_length_mm:.4g} mm)"
    print(f"{output}  {camera.width}x{camera.height}, {facts['method']}, {facts['layers']} layers")
    print(f"  lens    {opening}, focus {lens.focus_distance_m:.4g} m, largest blur radius {blur:.1f} px")
    print(f"  device  {facts['device']}")
    if shot.capture_device:
        print(f"  capture {shot.capture_device}")
    steps = ", ".join(f"{name} {seconds:.2f} s" for name, seconds in watch.seconds.items())
    print(f"  times   {steps} (kernels {kernels_ms:.1f} ms)")
    for remark in shot.remarks:
        print(f"  note    {remark}")


def _versions() -> dict[str, str]:
    versions = {"cldof": __version__, "python": platform.python_version()}
    for package in ("numpy", "pyopencl", "pocl-binary-distribution", "pyrender", "trimesh", "PyOpenGL"):
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
        self._quiet = quiet
        self._live = sys.stderr.isatty()

    @contextmanager
    def step(self, name: str) -> Iterator[Callable[[int, int], None]]:
        """Time the block under ``name``; yields a callable for progress within it (done, of how many)."""
        start = time.perf_counter()
        state = {"text": f"{name} ..."}
        over = threading.Event()

        def narrate() -> None:
            wait = _PATIENCE_S
            while not over.wait(wait):
                print(
                    f"\r\x1b[K{state['text']} {time.perf_counter() - start:.0f} s", end="", file=sys.stderr, flush=True
                )
                wait = 0.5
            if wait != _PATIENCE_S:
                print("\r\x1b[K", end="", file=sys.stderr, flush=True)

        def progress(done: int, total: int) -> None:
            state["text"] = f"{name} {done}/{total}"

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
            self.seconds[name] = elapsed = time.perf_counter() - start
            if elapsed > _PATIENCE_S and not self._quiet:
                print(f"{name}: {elapsed:.1f} s", file=sys.stderr)


if __name__ == "__main__":
    sys.exit(main())
