"""The renderer: one device, one method; a layered frame and a lens in, an image out."""

from __future__ import annotations

import math
import threading
import time
import warnings
from collections import OrderedDict
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from functools import partial
from types import TracebackType
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from .auto import Auto, Budget, Choice, Chooser, Setting, features, load_curves
from .errors import CldofError, DeviceError, DriverError, DriverWarning, InputError
from .frame import FINER, LayeredFrame
from .host.buffers import BufferPool, HostInput
from .host.device import Device
from .host.launch import driver_errors
from .host.passes import Buffer, FrameProgram, Pass, Role, read, write
from .host.profile import PassTiming, copy_baseline, pass_timings
from .host.scheduler import Batch, FrameRing, Submission, compile
from .lens import Lens
from .methods import FrameShape, Method, make_method
from .planner import (
    MAX_CHANGE,
    FramePlan,
    SceneStats,
    bin_scale,
    buffer_sizes,
    everything,
    plan_frame,
    planned_program,
    read_stats,
    stats_params,
    stats_passes,
)

__all__ = ["PendingResult", "Renderer", "Result", "frame_stats"]

_Made = TypeVar("_Made")

# Pass lists kept for the most recent kinds of frame (shape and plan structure); the pool passes their memory on.
_KEPT_PROGRAMS = 4
_MAX_SUPERSAMPLE = 8
# Plans kept with a frame.
_KEPT_PLANS = 16
# Pixels an item of frame_box makes, as kernels/frame.cl has it.
_BOX_RUN = 16


@dataclass(frozen=True)
class Result:
    """A rendered frame.

    Attributes
    ----------
    image : ndarray, (H, W, 4), float32
        Linear light, premultiplied alpha, guard band cropped.
    timings : list of PassTiming
        Per pass, in order; empty unless the renderer was made with ``profile=True``.
    wall_ms : float
        From the call to the image on the host; without the capture of a finer frame, if that was left for now.
    plan : FramePlan
        What was computed and what was left out; ``print(plan.explain())`` says it in words, ``plan.summary`` in plain
        numbers.
    choice : Choice or None
        With ``method="auto"``, what was chosen and expected.
    """

    image: NDArray[np.float32]
    timings: list[PassTiming]
    wall_ms: float
    plan: FramePlan
    choice: Choice | None = None


@dataclass
class _DeviceFrame:
    """A frame's inputs on the device."""

    frame: LayeredFrame  # holds the arrays, which a CPU device reads in place
    shape: FrameShape
    arrays: dict[str, HostInput]  # color, and what else of the frame a method asked for
    preparation: Batch  # made inv_depth, and owns it
    ready: Any  # event
    stats: _ComingStats | None  # None: planning is off
    plans: dict[Any, _Planned] = field(default_factory=dict)  # by method and lens
    last_use: Any = None  # event


class _Planned(NamedTuple):
    """A plan, and what of it the device has to know."""

    plan: FramePlan
    gaps: HostInput | None
    is_kept: bool  # with the frame, for the same lens again


class _ComingStats:
    """Statistics of a frame on their way to the host."""

    def __init__(
        self, frame: LayeredFrame, shape: FrameShape, preparation: Batch, pool: BufferPool, ready: Any
    ) -> None:
        self._shape, self._bins = shape, bin_scale(frame)
        self._arrays: dict[str, NDArray[Any]] = {
            name: np.empty(count, kind) for name, (count, kind) in buffer_sizes(shape).items()
        }
        self._events = [pool.download(preparation.output(name), array, [ready]) for name, array in self._arrays.items()]
        for event in self._events:
            preparation.hold(event)
        self._stats: SceneStats | None = None

    def have_arrived(self) -> bool:
        return self._stats is not None or all(int(event.command_execution_status) <= 0 for event in self._events)

    def wait(self) -> SceneStats:
        if self._stats is None:
            for event in self._events:
                event.wait()
            self._stats = read_stats(self._shape, **self._arrays, first=self._bins[0], scale=self._bins[1])
        return self._stats


class _Chosen:
    """A choice of a frame that is on its way, and who learns from what it takes."""

    def __init__(self, automatic: _Automatic, choice: Choice, feature: NDArray[np.float64], counts: bool) -> None:
        self.choice = choice
        self._automatic, self._feature, self._counts = automatic, feature, counts
        automatic.under_way += 1

    def took(self, ms: float) -> None:
        self._automatic.under_way -= 1
        if self._counts:
            self._automatic.learn(self.choice, self._feature, ms)

    def failed(self) -> None:
        self._automatic.under_way -= 1


class _Automatic:
    """Methods by setting, and the chooser, which is made when the first frame comes."""

    def __init__(self, budget: Budget, device: Device) -> None:
        self._budget, self._device = budget, device
        self._methods: dict[str, Method] = {}
        self._chooser: Chooser | None = None
        self._lock = threading.Lock()  # results may be asked for by other threads than frames
        self.under_way = 0

    def choose(
        self, stats: SceneStats, lens: Lens, frame: LayeredFrame, has_finer: bool
    ) -> tuple[Choice, NDArray[np.float64]]:
        with self._lock:
            if self._chooser is None:
                info = self._device.info
                curves = load_curves(info.name, info.driver_version)
                self._chooser = Chooser(curves, self._budget, copy_baseline(self._device, runs=12).min_ms)
            feature = features(stats, lens, frame)
            return self._chooser.choose(feature, has_finer), feature

    def method(self, setting: Setting) -> Method:
        if str(setting) not in self._methods:
            made = make_method(setting.method, **setting.options)
            self._methods[str(setting)] = _supersampled(made, setting.samples, antialias=False)
        return self._methods[str(setting)]

    def learn(self, choice: Choice, feature: NDArray[np.float64], ms: float) -> None:
        with self._lock:
            if self._chooser is not None:
                self._chooser.observe(choice, feature, ms)


class PendingResult:
    """A frame on its way; made by :meth:`Renderer.render_async`."""

    def __init__(
        self,
        submission: Submission,
        event: Any,
        image: NDArray[np.float32],
        planned: _Planned,
        started: float,
        profile: bool,
        report: Callable[[], None],
    ) -> None:
        self._submission, self._event, self._image, self._planned = submission, event, image, planned
        self._report = report  # tells the renderer that the frame failed
        self._started, self._profile = started, profile
        self._chosen: _Chosen | None = None
        self._faded: PendingResult | None = None
        self._result: Result | None = None

    def chosen(self, chosen: _Chosen, faded: PendingResult | None) -> None:
        """Of ``method="auto"``: the choice, and the same frame by the setting that it fades from."""
        self._chosen, self._faded = chosen, faded

    def done(self) -> bool:
        """Whether :meth:`result` would return at once."""
        if self._result is not None:
            return True
        return int(self._event.command_execution_status) <= 0 and (self._faded is None or self._faded.done())

    def result(self) -> Result:
        """Wait for the image.

        Raises
        ------
        DeviceError
            The device failed on the way.
        """
        if self._result is None:
            try:
                with driver_errors("a frame did not arrive"):
                    self._submission.wait()
                    self._event.wait()
                before = None if self._faded is None else self._faded.result()
            except DeviceError:
                self._report()
                if self._chosen is not None:
                    self._chosen.failed()
                raise
            timings = pass_timings(self._submission) if self._profile else []
            choice = None if self._chosen is None else self._chosen.choice
            if before is not None and choice is not None:
                self._image *= np.float32(choice.share)
                self._image += np.float32(1.0 - choice.share) * before.image
                timings = [*before.timings, *timings]
            wall_ms = (time.perf_counter() - self._started) * 1e3
            if self._chosen is not None:
                self._chosen.took(wall_ms)
            self._result = Result(self._image, timings, wall_ms, self._planned.plan, choice)
        return self._result


class Renderer:
    """Renders depth of field by one method on one device.

    A context manager; or call :meth:`close`. Programs, buffers and pass lists are made for the first frame of a kind
    and used again by all later ones. Calls from several threads are taken in turn.

    Parameters
    ----------
    method : str
        Name of the method; see :data:`cldof.methods.METHODS`. ``"auto"`` takes the options ``max_error`` or ``max_ms``
        and chooses a method for every frame (:mod:`cldof.auto`, docs/auto.md); where the image's own pixels are too
        coarse it takes finer frames (:meth:`cldof.LayeredFrame.with_finer`).
    device : int or str, optional
        As :meth:`cldof.host.device.Device.open`: an index, ``"cpu"``, ``"gpu"`` or part of a name. None takes the
        environment's ``CLDOF_DEVICE``, else a GPU, else a CPU.
    context, queue : pyopencl.Context, pyopencl.CommandQueue, optional
        The caller's own, in place of ``device``. They stay the caller's.
    profile : bool
        Time every pass. Not with ``queue``, which is profiled if it was made so.
    out_of_order : bool
        Use an out-of-order queue where the device has one.
    frames_in_flight : int
        How many frames may overlap with :meth:`render_async`; each has buffers of its own.
    supersample : int
        Frames come in captured this many times larger than the image, and the image is box-filtered down after the
        blur: edges in focus become smooth, at about the square of the cost.
    antialias : bool
        False keeps of every pixel the sample in its middle in place of the mean, as references without sub-pixel jitter
        have it; for odd ``supersample``.
    planned : bool
        Leave out what the frame in front of the lens does not call for (:mod:`cldof.planner`). False computes
        everything, for comparison.
    max_change : float
        What leaving out may change a pixel by at most, in linear units; 0 leaves out only what changes nothing.
    statistics : {"frame", "last"}
        Plan a new frame by its own statistics, for which :meth:`render_async` waits, once per frame that was not seen
        before and until the device has come to it; or by those of the frame before, without waiting, with a tile to
        spare for what has moved. The plan's bound then holds where the frame looks like the one before.
    **options
        The method's, for instance ``layers=12`` (:class:`cldof.methods.layered.Layered`).

    Raises
    ------
    InputError
        Unknown method or option.
    DeviceError
        No such device.
    DriverError
        The driver of that device, and of all others that the choice allows, died when it was tried in a child process.
    """

    def __init__(
        self,
        method: str = "layered",
        *,
        device: int | str | None = None,
        context: Any = None,
        queue: Any = None,
        profile: bool = False,
        out_of_order: bool = False,
        frames_in_flight: int = 2,
        supersample: int = 1,
        antialias: bool = True,
        planned: bool = True,
        max_change: float = MAX_CHANGE,
        statistics: str = "frame",
        **options: Any,
    ) -> None:
        if not (isinstance(max_change, int | float) and 0.0 <= max_change < math.inf):
            raise InputError(f"max_change is {max_change!r}; it must be a number of at least 0, in linear units.")
        if statistics not in ("frame", "last"):
            raise InputError(f"statistics is {statistics!r}; choose one of frame, last.")
        self.method = _auto(options) if method == "auto" else make_method(method, **options)
        if isinstance(self.method, Auto) and not planned:
            raise InputError("method='auto' chooses by the planner's statistics; leave planned=True.")
        if frames_in_flight < 1:
            raise InputError(f"frames_in_flight is {frames_in_flight}; it must be at least 1.")
        if not (isinstance(supersample, int) and 1 <= supersample <= _MAX_SUPERSAMPLE):
            raise InputError(f"supersample is {supersample!r}; it must be a whole number, 1 to {_MAX_SUPERSAMPLE}.")
        if not antialias and supersample % 2 == 0:
            raise InputError(
                f"supersample is {supersample} with antialias=False; use an odd number, which has a sample in the "
                "middle of each pixel."
            )
        if context is not None or queue is not None:
            if device is not None:
                raise InputError("Give a device, or a context or queue of your own, not both.")
            self._open = None
            self.device = Device.adopt(context=context, queue=queue)
        else:
            self._open = partial(Device.open, device, profiling=profile, out_of_order=out_of_order)
            self.device = self._open()
        self._given_up: set[int] = set()  # devices
        self._slots = frames_in_flight
        self._supersample, self._antialias = supersample, antialias
        self._planned, self._max_change, self._statistics = planned, float(max_change), statistics
        self._latest: SceneStats | None = None
        if not isinstance(self.method, Auto):
            self.method = _supersampled(self.method, supersample, antialias)
        self._lock = threading.Lock()
        self._rings: OrderedDict[Any, FrameRing] = OrderedDict()
        # Recent frames by identity; holding the frame keeps the identity from being used again.
        self._frames: OrderedDict[int, _DeviceFrame] = OrderedDict()
        self._finer: OrderedDict[int, _DeviceFrame] = OrderedDict()
        self._automatic = _Automatic(self.method.budget, self.device) if isinstance(self.method, Auto) else None
        self._closed = False
        self._has_failed = False

    def render(self, frame: LayeredFrame, lens: Lens, out: NDArray[np.float32] | None = None) -> Result:
        """Render one frame and wait for it.

        Parameters
        ----------
        frame : LayeredFrame
            Kept on the device while it is among the most recent ones; rendering it again with another lens does not
            upload it again.
        lens : Lens
        out : ndarray, (H, W, 4), float32, C-contiguous, optional
            Receives the image; saves an allocation per frame.

        Returns
        -------
        Result

        Raises
        ------
        InputError
            ``out`` does not fit.
        DeviceError
            The device failed or has not enough memory.
        """
        return self.render_async(frame, lens, out).result()

    def render_async(self, frame: LayeredFrame, lens: Lens, out: NDArray[np.float32] | None = None) -> PendingResult:
        """Start one frame and return at once; parameters as :meth:`render`.

        ``out`` must not be touched before :meth:`PendingResult.result` has returned.
        """
        started = time.perf_counter()
        if not isinstance(frame, LayeredFrame) or not isinstance(lens, Lens):
            raise InputError(
                f"render takes a LayeredFrame and a Lens; got {type(frame).__name__}, {type(lens).__name__}."
            )
        shape = FrameShape.of(frame)
        image = _output_array(out, (*_image_size(shape, self._supersample), 4))
        return self._on_a_device_that_works(lambda: self._begin(frame, shape, lens, image, started))

    def _begin(
        self, frame: LayeredFrame, shape: FrameShape, lens: Lens, image: NDArray[np.float32], started: float
    ) -> PendingResult:
        """Upload a frame and enqueue it by the method of this renderer or of its choice."""
        held = self._upload(frame, shape)
        if self._automatic is None:
            assert not isinstance(self.method, Auto)
            return self._start(held, lens, self.method, image, started, self._supersample, self._antialias)[0]
        assert held.stats is not None
        is_alone = self._automatic.under_way == 0
        fits = FINER**2 * frame.color.nbytes <= self.device.traits.max_alloc_bytes
        has_finer = frame.has_finer and fits and self._supersample == 1
        choice, feature = self._automatic.choose(self._known(held)[0], lens, frame, has_finer)
        faded = None
        if choice.fades_from is not None:
            faded, _ = self._start_setting(held, lens, choice.fades_from, np.empty_like(image), started)
        pending, is_new = self._start_setting(held, lens, choice.setting, image, started)
        # The first frame of a kind builds what it needs; those that overlap with others wait for them.
        counts = is_alone and not is_new and faded is None
        pending.chosen(_Chosen(self._automatic, choice, feature, counts), faded)
        return pending

    def _start_setting(
        self, held: _DeviceFrame, lens: Lens, setting: Setting, image: NDArray[np.float32], started: float
    ) -> tuple[PendingResult, bool]:
        """Enqueue a frame by a setting of ``method="auto"``, or the finer one of its view."""
        assert self._automatic is not None
        method = self._automatic.method(setting)
        if setting.samples == 1:
            return self._start(held, lens, method, image, started, self._supersample, self._antialias)
        before = time.perf_counter()
        frame = held.frame.finer
        started += time.perf_counter() - before
        held = self._upload(frame, FrameShape.of(frame), self._finer)
        return self._start(held, lens, method, image, started, setting.samples, antialias=False)

    def _start(
        self,
        held: _DeviceFrame,
        lens: Lens,
        method: Method,
        image: NDArray[np.float32],
        started: float,
        factor: int,
        antialias: bool,
    ) -> tuple[PendingResult, bool]:
        """Enqueue a frame of ``factor`` pixels for one, and tell whether what it needs was made just now."""
        planned = self._plan(held, lens, method)
        plan = planned.plan
        # A method may take in all samples of a pixel at once; otherwise they are rendered like pixels.
        left = factor // int(getattr(method, "supersample", 1))
        resolve = None if left == 1 else _Resolve(left, _image_size(held.shape, factor), antialias)
        ring, is_new = self._ring(held.shape, plan, method, resolve)
        inputs, waits = self._inputs(held, ring.program, method, planned.gaps)
        submission = ring.submit(inputs, plan.params, waits)
        held.last_use = submission.event
        if not planned.is_kept:
            self._free(planned, submission.event)
        output = submission.batch.output("image" if resolve is None else "resolved")
        download = self.device.pool.download(output, image, [submission.event])
        submission.batch.hold(download)
        is_profiling = self.device.is_profiling
        return PendingResult(submission, download, image, planned, started, is_profiling, self._note_failure), is_new

    def stats(self, frame: LayeredFrame) -> SceneStats:
        """What the planner knows of a frame; uploads it, if need be, and waits for the answer.

        Raises
        ------
        DeviceError
            The device failed or has not enough memory.
        """
        return self._on_a_device_that_works(lambda: self._gather(frame))

    def _gather(self, frame: LayeredFrame) -> SceneStats:
        held = self._upload(frame, FrameShape.of(frame))
        if held.stats is None:
            raise InputError("This renderer was made with planned=False and gathers no statistics.")
        return held.stats.wait()

    @property
    def peak_device_bytes(self) -> int:
        """The most device memory held at a time; arrays that a CPU device reads in place are not counted."""
        return self.device.pool.peak_bytes

    def close(self) -> None:
        """Wait for frames on their way and release everything. A second call does nothing."""
        with self._lock:
            if self._closed:
                return
            self._closed = True
            try:
                self.device.finish()
            finally:
                self._rings.clear()
                self._frames.clear()
                self._finer.clear()
                self.device.close()  # with all of its memory

    def __enter__(self) -> Renderer:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        try:
            self.close()
        except CldofError:
            if error is None:
                raise

    def _known(self, held: _DeviceFrame) -> tuple[SceneStats, bool]:
        """Statistics to plan by, and whether they are those of a frame before."""
        assert held.stats is not None
        if self._statistics == "last" and not held.stats.have_arrived():
            for other in reversed([*self._finer.values(), *self._frames.values()]):
                if other.shape == held.shape and other.stats is not None and other.stats.have_arrived():
                    self._latest = other.stats.wait()
                    break
            if self._latest is not None and self._latest.shape == held.shape:
                return self._latest, True
        self._latest = held.stats.wait()
        return self._latest, False

    def _plan(self, held: _DeviceFrame, lens: Lens, method: Method) -> _Planned:
        """What to compute; kept with the frame for the lenses last seen, unless it is by another frame's statistics."""
        key = (method, lens)
        planned = held.plans.get(key)
        if planned is not None:
            return planned
        is_last = False
        if held.stats is None:
            plan = everything(method, held.frame, lens)
        else:
            stats, is_last = self._known(held)
            plan = plan_frame(method, held.frame, lens, stats, self.device.traits, self._max_change, is_last)
        gaps = None if plan.gaps is None else self.device.pool.to_device(plan.gaps, "upload gaps")
        planned = _Planned(plan, gaps, not is_last)
        if planned.is_kept:
            while len(held.plans) >= _KEPT_PLANS:
                self._free(held.plans.pop(next(iter(held.plans))), held.last_use)
            held.plans[key] = planned
        return planned

    def _free(self, planned: _Planned, last_use: Any) -> None:
        if planned.gaps is not None:
            self.device.pool.free_input(planned.gaps, last_use)

    def _on_a_device_that_works(self, call: Callable[[], _Made]) -> _Made:
        """What `call` makes in its turn; on another device, if the driver of this one dies over what is to be built."""
        while True:
            try:
                with self._turn():
                    return call()
            except DriverError as error:
                self._replace_device(error)

    def _replace_device(self, error: DriverError) -> None:
        """Take the next device that the caller's choice allows; raises the error if there is none."""
        if self._open is None:
            raise error
        with self._lock:
            self._given_up.add(self.device.info.index)
            try:
                device = self._open(besides=self._given_up)
            except DeviceError:
                raise error from None
            with suppress(CldofError):
                self.device.close()
            self.device = device
            if isinstance(self.method, Auto):
                self._automatic = _Automatic(self.method.budget, device)
        warnings.warn(f"{error} Device {device.info} was taken in its place.", DriverWarning, stacklevel=5)

    @contextmanager
    def _turn(self) -> Iterator[None]:
        """One call at a time. What fails half-way, an interrupt included, leaves a renderer that makes all things anew.

        Refused input leaves everything as it was.
        """
        with self._lock:
            if self._closed:
                raise DeviceError("This renderer is closed; make a new one.")
            if self._has_failed:
                self._start_afresh()
            try:
                with driver_errors(f"a frame failed on {self.device.info.name}"):
                    yield
            except InputError:
                raise
            except BaseException:
                self._start_afresh()
                raise

    def _note_failure(self) -> None:
        self._has_failed = True

    def _start_afresh(self) -> None:
        """Forget what may be half done, once nothing uses it any more; frames on their way still arrive."""
        self._has_failed = True
        with suppress(DeviceError):
            self.device.finish()
        self._rings.clear()
        self._frames.clear()
        self._finer.clear()
        self.device.pool.clear()
        self._has_failed = False

    def _upload(
        self, frame: LayeredFrame, shape: FrameShape, frames: OrderedDict[int, _DeviceFrame] | None = None
    ) -> _DeviceFrame:
        """The frame's inputs, from the last calls or made now: colour, and inverse depth in padded rows."""
        frames = self._frames if frames is None else frames
        key = id(frame)
        held = frames.get(key)
        if held is not None:
            frames.move_to_end(key)
            return held
        preparation = self._free_preparation(shape, frames)
        if preparation is None:
            program = _preparation_program(shape, self.device.traits.is_cpu, self._planned)
            preparation = compile(program, self.device, stats_params(frame) if self._planned else {}, more=True)
        pool = self.device.pool
        color, depth = pool.to_device(frame.color, "upload color"), pool.to_device(frame.depth, "upload depth")
        submission = preparation.submit(
            {"color": color.buffer, "depth": depth.buffer},
            stats_params(frame) if self._planned else {},
            [*color.waits, *depth.waits],
        )
        pool.free_input(depth, submission.event)
        stats = _ComingStats(frame, shape, preparation, pool, submission.event) if self._planned else None
        held = _DeviceFrame(frame, shape, {"color": color}, preparation, submission.event, stats)
        frames[key] = held
        return held

    def _inputs(
        self, held: _DeviceFrame, program: FrameProgram, method: Method, gaps: HostInput | None
    ) -> tuple[dict[str, Any], list[Any]]:
        """What the program reads of frame and plan, uploaded when it is first asked for, and what to wait for."""
        buffers, waits = {}, [held.ready]
        for name in (name for name, buffer in program.buffers.items() if buffer.role is Role.INPUT):
            if name == "inv_depth":
                buffers[name] = held.preparation.output(name)
                continue
            if name == "gaps" and gaps is not None:
                buffers[name] = gaps.buffer
                waits += gaps.waits
                continue
            if name not in held.arrays:
                if name not in held.frame.inputs:
                    raise InputError(
                        f"Method {method.name!r} needs the frame's {name} buffer; capture with surface=True."
                    )
                held.arrays[name] = self.device.pool.to_device(held.frame.inputs[name], f"upload {name}")
            buffers[name] = held.arrays[name].buffer
            waits += held.arrays[name].waits
        return buffers, waits

    def _free_preparation(self, shape: FrameShape, frames: OrderedDict[int, _DeviceFrame]) -> Batch | None:
        """Make room for one more frame; hand over what prepared the one that goes, if it fits the next."""
        preparation = None
        while len(frames) > self._slots:
            _, old = frames.popitem(last=False)
            for array in old.arrays.values():
                self.device.pool.free_input(array, old.last_use)
            for planned in old.plans.values():
                self._free(planned, old.last_use)
            if old.last_use is not None:
                old.preparation.hold(old.last_use)
            if preparation is None and old.shape == shape:
                preparation = old.preparation
            else:
                old.preparation.close()
        return preparation

    def _ring(
        self, shape: FrameShape, plan: FramePlan, method: Method, resolve: _Resolve | None
    ) -> tuple[FrameRing, bool]:
        """Programs and buffers for frames of a kind, and whether they were made just now."""
        key = (method, shape, plan.structure, resolve)
        ring = self._rings.get(key)
        is_new = ring is None
        if ring is None:
            while len(self._rings) >= _KEPT_PROGRAMS:
                self._rings.popitem(last=False)[1].close()
            program = planned_program(method, shape, plan, self.device.traits)
            if resolve is not None:
                program = _resolved(program, resolve)
            ring = FrameRing(program, self.device, self._slots, plan.params)
            self._rings[key] = ring
            # What frames of other kinds left behind is of use again only if their sizes come back.
            pool = self.device.pool
            if pool.allocated_bytes > 2 * pool.in_use_bytes:
                pool.trim()
        self._rings.move_to_end(key)
        return ring, is_new


def _auto(options: dict[str, Any]) -> Auto:
    unknown = sorted(set(options) - {"max_error", "max_ms"})
    if unknown:
        raise InputError(f"Method 'auto' has no option {unknown[0]!r}; its options are: max_error, max_ms.")
    made = Auto(**options)
    made.budget  # noqa: B018  refuses what makes no sense before a device is opened
    return made


def frame_stats(device: Device, frame: LayeredFrame) -> SceneStats:
    """Statistics of one frame, on a device of the caller's; a :class:`Renderer` has them for its own frames."""
    shape = FrameShape.of(frame)
    pool = device.pool
    inputs = {"color": pool.to_device(frame.color), "depth": pool.to_device(frame.depth)}
    program, params = _preparation_program(shape, device.traits.is_cpu, with_stats=True), stats_params(frame)
    with compile(program, device, params) as batch:
        submission = batch.submit(
            {name: one.buffer for name, one in inputs.items()},
            params,
            [event for one in inputs.values() for event in one.waits],
        )
        stats = _ComingStats(frame, shape, batch, pool, submission.event).wait()
    for one in inputs.values():
        pool.free_input(one)
    return stats


def _preparation_program(shape: FrameShape, is_cpu: bool, with_stats: bool) -> FrameProgram:
    """What is made of a frame once: inverse depth, and on the way statistics for the planner."""
    slots = shape.layers * shape.height * shape.width
    rows = shape.layers * shape.height
    buffers = [
        Buffer("color", slots * 16, Role.INPUT),
        Buffer("depth", slots * 4, Role.INPUT),
        Buffer("inv_depth", rows * shape.pitch * 4, Role.OUTPUT),
    ]
    if with_stats:
        more, passes = stats_passes(shape, is_cpu)
        return FrameProgram.of([*buffers, *more], passes)
    inverse = Pass(
        "frame",
        "frame_inverse_depth",
        (
            write("inv_depth"),
            read("depth"),
            read("color"),
            np.int32(shape.width),
            np.int32(shape.pitch),
            shape.nothing,
        ),
        (rows,),
        traffic_bytes=slots * 24,
    )
    return FrameProgram.of(buffers, [inverse])


class _Resolve(NamedTuple):
    """How a supersampled image becomes one of this size, (height, width)."""

    factor: int
    size: tuple[int, int]
    antialias: bool


def _supersampled(method: Method, factor: int, antialias: bool) -> Method:
    """The method for frames of so many pixels for one: told of it, if it can take them in."""
    if factor > 1 and hasattr(method, "supersampled"):
        told: Method = method.supersampled(factor, antialias)
        return told
    return method


def _image_size(shape: FrameShape, factor: int) -> tuple[int, int]:
    height, width = shape.output_size
    if height % factor or width % factor:
        raise InputError(
            f"The frame's camera is {width}x{height}, which supersample={factor} does not divide; capture it "
            f"with a camera of {factor} times the image's size."
        )
    return height // factor, width // factor


def _resolved(program: FrameProgram, resolve: _Resolve) -> FrameProgram:
    """Append to a method's passes the box filter, or what keeps the middle of every pixel."""
    factor, (height, width), antialias = resolve
    buffers = [replace(b, role=Role.TRANSIENT) if b.name == "image" else b for b in program.buffers.values()]
    buffers.append(Buffer("resolved", height * width * 16, Role.OUTPUT))
    last = Pass(
        "frame",
        "frame_box" if antialias else "frame_middle",
        (write("resolved"), read("image"), np.int32(width), np.int32(height), np.int32(factor)),
        (-(-width // _BOX_RUN), height),
        traffic_bytes=height * width * 16 * ((factor**2 if antialias else 1) + 1),
    )
    return FrameProgram.of(buffers, [*program.passes, last])


def _output_array(out: NDArray[np.float32] | None, shape: tuple[int, ...]) -> NDArray[np.float32]:
    if out is None:
        return np.empty(shape, np.float32)
    if not isinstance(out, np.ndarray) or out.shape != shape or out.dtype != np.float32:
        found = f"{out.dtype} {out.shape}" if isinstance(out, np.ndarray) else type(out).__name__
        raise InputError(f"out is {found}; it must be a float32 array of shape {shape}.")
    if not (out.flags.c_contiguous and out.flags.writeable):
        raise InputError("out must be C-contiguous and writeable.")
    return out
