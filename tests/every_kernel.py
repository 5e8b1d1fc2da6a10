"""Small frames that between them run every kernel in every form, for checks that look at memory and not at pictures.

:mod:`tests.test_every_kernel` runs them between canaries, :mod:`tests.tools.checked` under a simulator that watches
every access to memory.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

import cldof.kernels
from cldof import Camera, LayeredFrame, Lens, Renderer
from cldof.host import opencl as cl
from cldof.host.device import Device, Traits
from cldof.host.passes import Pass
from cldof.host.program import BUILD_OPTIONS, Defines, SourceDirectory, expand
from cldof.methods import FrameShape, gaussian, make_method
from cldof.planner import BINS, MAX_CHANGE, SceneStats, bin_scale, everything, plan_frame, planned_program
from cldof.renderer import _image_size, _preparation_program, _Resolve, _resolved, _supersampled
from tests.frames import noise_frame
from tests.kernels import test_blur as blur
from tests.oracles.stats import tile_stats
from tests.shaded import shaded_frame

__all__ = ["CASES", "Case", "FilledSources", "Program", "kernels_in_sources", "record_kernels", "unset_variables"]

Program = tuple[str, Defines]  # stem of the file, and defines

WIDTH, HEIGHT = 48, 32


@dataclass(frozen=True)
class Case:
    """One frame and how to render it."""

    method: str
    options: dict[str, Any] = field(default_factory=dict)
    frame: str = "opaque"  # a name of FRAMES
    coc_px: float = 5.0
    renderer: dict[str, Any] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """For people and files."""
        parts = {**self.options, **self.renderer}
        words = [self.method, self.frame, f"{self.coc_px:g}px", *(f"{key}={value}" for key, value in parts.items())]
        return " ".join(words).replace("/", "")

    def lacks(self, traits: Traits) -> str:
        """What it needs and the device does not have; nothing as a rule."""
        warp = self.options.get("warp")
        if warp == "packed" and not traits.has_int64_atomics:
            return f"{traits.name} has no 64-bit atomics"
        if warp == "views" and not traits.has_long_loops:
            return f"{traits.name} breaks long loops off"
        return ""

    def run(self, device: Device) -> np.ndarray:
        """Render it on a device of the caller's, which is left open."""
        if self.method == "blur":
            return _blurred(device)
        renderer = Renderer(self.method, queue=device.queue, **self.renderer, **self.options)
        renderer.device = device
        frame = FRAMES[self.frame]()
        return renderer.render(frame, Lens(self.coc_px / frame.camera.focal_px, 2.0)).image

    def passes(self, traits: Traits) -> list[Pass]:
        """Those that a device with such traits gets for it; without a device. ``blur`` has none: no method calls it."""
        if self.method == "blur":
            return []
        frame = _frame(self.frame)
        shape = FrameShape.of(frame)
        lens = Lens(self.coc_px / frame.camera.focal_px, 2.0)
        factor, antialias = self.renderer.get("supersample", 1), self.renderer.get("antialias", True)
        is_planned = self.renderer.get("planned", True)
        method = _supersampled(make_method(self.method, **self.options), factor, antialias)
        if is_planned:
            plan = plan_frame(method, frame, lens, _stats_of(self.frame), traits, MAX_CHANGE)
        else:
            plan = everything(method, frame, lens)
        program = planned_program(method, shape, plan, traits)
        left = factor // getattr(method, "supersample", 1)
        if left > 1:
            program = _resolved(program, _Resolve(left, _image_size(shape, factor), antialias))
        return [*_preparation_program(shape, traits.is_cpu, is_planned).passes, *program.passes]

    def programs(self, traits: Traits) -> set[Program]:
        """Those that a device with such traits builds for it; without a device."""
        if self.method == "blur":
            return {("blur", ())}
        return {(one.source, tuple(one.defines)) for one in self.passes(traits)}


def _blurred(device: Device) -> np.ndarray:
    """blur.cl by itself: no method calls it."""
    image = np.random.default_rng(0).random((HEIGHT, WIDTH, 4), np.float32)
    return np.stack([blur.fir(device, image, gaussian.fir_taps(2.0)), blur.iir(device, image, 7.0)])


def _mostly_sharp() -> LayeredFrame:
    """In focus but for a corner, so that the planner works in windows; with rows that end before their pitch."""
    depth = np.full((1, 96, 126), 2.0, np.float32)
    depth[:, :20, -20:] = 9.0
    color = np.random.default_rng(1).random((1, 96, 126, 4)).astype(np.float32)
    color[..., 3] = 1.0
    return LayeredFrame(color, depth, Camera(126, 96, 40.0))


def _scattered() -> LayeredFrame:
    """Specks out of focus in opposite corners: single tiles where a method can make them."""
    depth = np.full((1, 96, 126), 2.0, np.float32)
    depth[:, 4:10, 4:10] = depth[:, -10:-4, -10:-4] = 9.0
    color = np.random.default_rng(1).random((1, 96, 126, 4)).astype(np.float32)
    color[..., 3] = 1.0
    return LayeredFrame(color, depth, Camera(126, 96, 40.0))


FRAMES: dict[str, Callable[[], LayeredFrame]] = {
    "opaque": lambda: noise_frame(WIDTH, HEIGHT, 3, guard_px=3),
    "void": lambda: noise_frame(WIDTH - 1, HEIGHT - 1, 3, opaque=False),
    "one": lambda: noise_frame(7, 5, 1),
    "pixel": lambda: noise_frame(1, 1, 1),
    "sharp": _mostly_sharp,
    "scattered": _scattered,
    "shaded": lambda: shaded_frame(WIDTH, HEIGHT),
}


@cache
def _frame(name: str) -> LayeredFrame:
    return FRAMES[name]()


@cache
def _stats_of(name: str) -> SceneStats:
    """What the statistics' kernels find, by their float64 twin."""
    frame = _frame(name)
    first, scale = bin_scale(frame)
    found = tile_stats(frame)
    bins = found.pop("bins")
    return SceneStats(
        shape=FrameShape.of(frame),
        **{key: value.astype(np.float32) for key, value in found.items()},
        bins=(bins.astype(np.uint64) << np.arange(BINS, dtype=np.uint64)).sum(axis=-1, dtype=np.uint64),
        histogram=_histogram(frame, first, scale),
        first=first,
        last=first + BINS / scale if scale else first,
    )


def _histogram(frame: LayeredFrame, first: float, scale: float) -> np.ndarray:
    is_there = frame.color[..., 3] > 0.0
    number = np.clip((1.0 / frame.depth - first) * scale, 0, BINS - 1).astype(int)
    return np.stack([np.bincount(number[m][is_there[m]], minlength=BINS) for m in range(frame.layer_count)]).astype(
        float
    )


def _cases() -> Iterator[Case]:
    yield Case("blur")
    for method in ("gather", "layered", "pyramid", "multiview", "lightfield"):
        for frame in FRAMES:
            yield Case(method, frame=frame)
        yield Case(method, frame="void", renderer={"planned": False})
    yield Case("gather", frame="sharp", coc_px=20.0, renderer={"supersample": 2})
    yield Case("gather", frame="sharp", coc_px=20.0, renderer={"supersample": 3, "antialias": False})
    for options in ({"cascade": False}, {"matting": "paper"}):
        for frame in ("opaque", "void"):
            yield Case("layered", options, frame)
    yield Case("layered", coc_px=40.0)  # the recursive engine
    yield Case("layered", {"cascade": False}, coc_px=40.0)
    for options in (
        {"matting": "paper", "radius": "paper"},
        {"hidden": "interpolated"},
        {"normalise": False},
    ):
        for frame in ("opaque", "void"):
            yield Case("pyramid", options, frame)
    yield Case("pyramid", coc_px=40.0)
    for options in (
        {"cone": False, "rays": 8},
        {"traversal": "peels", "cone": False, "rays": 8},
        {"traversal": "peels", "refine_steps": 2, "layers": 8, "rays": 8},
        {"jitter": True, "rays": 8},
        {"jitter": True, "traversal": "peels", "cone": False, "rays": 8},
        {"adaptive": False, "cull": False, "rays": 8},
    ):
        for frame in ("opaque", "void"):
            yield Case("multiview", options, frame)
    for options in (
        {"warp": "views"},
        {"warp": "atomic"},
        {"warp": "packed"},
        {"support": "none", "warp": "atomic"},
        {"support": "2x2"},
        {"support": "3x3"},
        {"lookup": "winner"},
        {"lookup": "jitter"},
        {"memory_mb": 0.05},
        {"cull": False, "pattern": "halton"},
    ):
        for frame in ("opaque", "void"):
            yield Case("lightfield", {"views": 6, **options}, frame)
    yield Case("lightfield", {"views": 5}, coc_px=40.0)  # mip levels
    yield Case("lightfield", {"views": 5, "lookup": "winner"}, "void", coc_px=40.0)


CASES: list[Case] = list(_cases())


@contextmanager
def record_kernels(device: Device, programs: set[Program] | None = None) -> Iterator[set[str]]:
    """Names of the kernels that are made inside the block; adds the programs that they are of to `programs`."""
    names: set[str] = set()
    make = device.programs.kernel

    def recorded(stem: str, name: str, defines: Defines = ()) -> Any:
        names.add(name)
        if programs is not None:
            programs.add((stem, tuple(defines)))
        return make(stem, name, defines)

    device.programs.kernel = recorded  # type: ignore[method-assign]
    try:
        yield names
    finally:
        del device.programs.kernel  # type: ignore[attr-defined]


def kernels_in_sources() -> set[str]:
    """Every kernel of the library."""
    folder = Path(next(iter(cldof.kernels.__path__)))
    return {name for file in folder.glob("*.cl") for name in re.findall(r"__kernel\s+void\s+(\w+)", file.read_text())}


# Clang's own analysis, asked for inside the source, since PoCL takes no -W. What is no type saves compiling the rest.
_WATCHED = ("uninitialized", "sometimes-uninitialized", "conditional-uninitialized", "array-bounds", "return-type")
_STOP = "what_nobody_declares"


def unset_variables(device: Device, program: Program, directory: SourceDirectory) -> list[str] | None:
    """What the compiler says about variables that are read before they are set on some way, and the like.

    Returns
    -------
    list of str
        One line each; None if the compiler is none of Clang's family and cannot be asked.
    """
    stem, defines = program
    asked = "".join(f'#pragma clang diagnostic error "-W{name}"\n' for name in _WATCHED)
    source = f"{asked}{expand(stem, defines, directory)}\ntypedef {_STOP} stop;\n"
    built = cl._cl._Program(device.context, source)
    with suppress(cl.Error):
        built._build(options=" ".join(BUILD_OPTIONS).encode(), devices=[device.queue.device])
    log = built.get_build_info(device.queue.device, cl.program_build_info.LOG)
    said = [line.strip() for line in log.splitlines() if "error: " in line]
    if not any(_STOP in line for line in said):
        return None
    return [line for line in said if _STOP not in line]


# A declaration without a value: vectors, arrays and scalars, by the line.
_UNSET = re.compile(
    r"^ +(?:u?int|float|shading_t)(?:2|3|4|8|16)? (?P<names>\w+(?:\[[^\]]+\])*(?:, \w+(?:\[[^\]]+\])*)*);"
)
_STRUCT = re.compile(r"(?:typedef )?struct\b[^;]*\{$")


class FilledSources:
    """The kernels, but for private variables that are declared without a value: these begin as `fill`.

    Parameters
    ----------
    fill : int
        Every byte of them.
    real : SourceDirectory, optional
        Other kernels than the library's.
    """

    def __init__(self, fill: int, real: Any = None) -> None:
        self._fill = fill
        self._real = files("cldof.kernels") if real is None else real

    def joinpath(self, name: str) -> FilledSources:
        """The file of that name."""
        return FilledSources(self._fill, self._real.joinpath(name))

    def is_file(self) -> bool:
        """Whether it is there."""
        return self._real.is_file()

    def read_text(self, encoding: str) -> str:
        """Its text, with as many lines as before."""
        lines, in_struct = [], False
        for line in self._real.read_text(encoding=encoding).splitlines():
            in_struct = line[:1] != "}" and (in_struct or bool(_STRUCT.match(line)))
            if (found := _UNSET.match(line)) and not in_struct:
                names = [name.split("[")[0].strip() for name in found["names"].split(",")]
                line = line[: found.end()] + "".join(map(self._filled, names)) + line[found.end() :]
            lines.append(line)
        return "\n".join(lines) + "\n"

    def _filled(self, name: str) -> str:
        loop = f"for (uint i_ = 0; i_ < sizeof({name}); i_++)"
        return f" {loop} ((volatile uchar *)&{name})[i_] = {self._fill};"
