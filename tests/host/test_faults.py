"""What goes wrong on the way: the driver refuses, the device is lost, somebody presses Ctrl-C, a disk is full.

Each fault is put in on purpose, at every place where it can happen: one clear error, the next frame is right to the
last bit, and all memory that was in use for the failed frame is back.
"""

from __future__ import annotations

import gc
import linecache
import os
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
import pytest

from cldof import CldofError, LayeredFrame, Lens, Renderer
from cldof.errors import DeviceError
from cldof.files import atomic_write
from cldof.host import opencl as cl
from cldof.host import program as program_module
from cldof.host.caches import prepare_environment
from cldof.host.device import DeviceInfo
from cldof.host.program import ProgramCache
from cldof.images import save_image
from tests.frames import noise_frame

ROOT = Path(__file__).parents[2]
FRAMES = [noise_frame(40, 24, 2, seed=seed) for seed in range(4)]


def lens_for(frame: LayeredFrame, coc_px: float = 6.0) -> Lens:
    return Lens(coc_px / frame.camera.focal_px, 2.0)


@pytest.fixture(scope="module", params=["in order", "any order", "own memory"])
def make(request: pytest.FixtureRequest, device_info: DeviceInfo) -> Callable[[], Renderer]:
    """Renderers on an in-order queue, on one that reorders, and with copies in place of shared memory."""

    def renderer() -> Renderer:
        made = Renderer("layered", device=device_info.index, out_of_order=request.param == "any order")
        if request.param == "own memory":
            made.device.pool.shares_memory = False
        return made

    return renderer


@pytest.fixture(scope="module")
def expected(device_info: DeviceInfo) -> list[np.ndarray]:
    with Renderer("layered", device=device_info.index) as renderer:
        return [renderer.render(frame, lens_for(frame)).image for frame in FRAMES]


class Faulty:
    """Calls of a driver's function that fail from the n-th on, until it is healed."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, owner: Any, name: str, error: type[BaseException]) -> None:
        getattr(owner, name)
        self.calls, self.fails_from, self._error = 0, None, error
        self.is_once = error is KeyboardInterrupt
        self.name, self._real = name, getattr(owner, name)

        def call(*args: Any, **options: Any) -> Any:
            self.calls += 1
            if self.fails_from is not None and self.calls > self.fails_from:
                if self.is_once:
                    self.fails_from = None
                raise self._error(f"{name} failed: made to")
            return self._real(*args, **options)

        monkeypatch.setattr(owner, name, call)

    def break_after(self, calls: int) -> None:
        self.calls, self.fails_from = 0, calls

    def heal(self) -> None:
        self.fails_from = None


PLACES = [
    ("opencl", "enqueue_nd_range_kernel", "RuntimeError"),
    ("opencl", "enqueue_copy", "RuntimeError"),
    ("opencl", "Buffer", "MemoryError"),
    ("opencl", "Kernel", "MemoryError"),
    ("opencl", "enqueue_marker", "RuntimeError"),
    ("opencl", "wait_for_events", "RuntimeError"),
    ("CommandQueue", "flush", "RuntimeError"),
    ("Event", "wait", "RuntimeError"),
    ("Kernel", "set_arg", "MemoryError"),
    ("opencl", "enqueue_nd_range_kernel", "KeyboardInterrupt"),
    ("opencl", "enqueue_copy", "KeyboardInterrupt"),
    ("Event", "wait", "KeyboardInterrupt"),
]


def settled_bytes(renderer: Renderer) -> tuple[int, int]:
    """Memory after frames of all kinds; what is kept for reuse does not count."""
    for coc_px in (6.0, 7.0, 8.0, 13.0):
        for frame in FRAMES:
            renderer.render(frame, lens_for(frame, coc_px))
    renderer.device.pool.trim()
    return renderer.device.pool.in_use_bytes, renderer.device.pool.allocated_bytes


@pytest.mark.parametrize("place", PLACES, ids=lambda place: " ".join(place[1:]))
def test_a_driver_that_fails_anywhere_in_a_frame(
    place: tuple[str, str, str],
    make: Callable[[], Renderer],
    expected: list[np.ndarray],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    owner = cl if place[0] == "opencl" else getattr(cl, place[0])
    is_interrupt = place[2] == "KeyboardInterrupt"
    error = KeyboardInterrupt if is_interrupt else getattr(cl, place[2])
    with make() as renderer:
        healthy = settled_bytes(renderer)
        fault = Faulty(monkeypatch, owner, place[1], error)
        failures = 0
        for after in range(40):
            frame = FRAMES[after % len(FRAMES)]
            lens = lens_for(frame, 6.0 + after % 3)  # other numbers of layers, so that programs are made, too
            fault.break_after(after)
            try:
                renderer.render(frame, lens)
            except (CldofError, KeyboardInterrupt) as raised:
                assert isinstance(raised, KeyboardInterrupt) == is_interrupt
                failures += 1
            finally:
                fault.heal()
            image = renderer.render(frame, lens_for(frame)).image
            np.testing.assert_array_equal(image, expected[after % len(FRAMES)], err_msg=f"after {after} calls")
            if fault.calls < after:
                break
        if failures:
            assert settled_bytes(renderer) == healthy, "memory of failed frames is still in use"


def test_a_failed_upload_is_not_kept(make: Callable[[], Renderer], monkeypatch: pytest.MonkeyPatch) -> None:
    """The first frame ever fails at every place that it can, each time on a new renderer."""
    for name in ("enqueue_nd_range_kernel", "Buffer"):
        for after in (0, 1, 4):
            with monkeypatch.context() as patched, make() as renderer:
                fault = Faulty(patched, cl, name, cl.MemoryError)
                renderer.device.traits  # noqa: B018 - the probe comes first
                fault.break_after(after)
                with pytest.raises(CldofError):
                    renderer.render(FRAMES[0], lens_for(FRAMES[0]))
                fault.heal()
                assert np.isfinite(renderer.render(FRAMES[0], lens_for(FRAMES[0])).image).all()


def test_an_interrupt_on_any_line(make: Callable[[], Renderer], expected: list[np.ndarray]) -> None:
    """Ctrl-C lands between any two lines of ours; the renderer is as good as new afterwards."""
    ours = tuple(str(ROOT / "cldof" / name) for name in ("renderer.py", "host"))
    state = {"left": -1, "lines": 0}

    def trace(frame: FrameType, event: str, argument: Any) -> Any:
        if not frame.f_code.co_filename.startswith(ours) or frame.f_code.co_name in ("close", "__exit__", "clear"):
            return None
        # Signals come between calls: never after the last one under a lock and before it is given back.
        if event == "line" and "with self._lock" not in linecache.getline(frame.f_code.co_filename, frame.f_lineno):
            state["lines"] += 1
            if state["left"] == 0:
                state["left"] = -1
                raise KeyboardInterrupt
            state["left"] -= 1
        return trace

    with make() as renderer:
        healthy = settled_bytes(renderer)
        at, step = 0, 0
        interrupted = 0
        while True:
            frame = FRAMES[step % len(FRAMES)]
            state["left"], state["lines"] = at, 0
            before = sys.gettrace()
            sys.settrace(trace)
            try:
                renderer.render(frame, lens_for(frame, 6.0 + 7.0 * (step % 2)))
            except KeyboardInterrupt:
                interrupted += 1
            finally:
                sys.settrace(before)
            found = renderer.render(FRAMES[0], lens_for(FRAMES[0])).image
            np.testing.assert_array_equal(found, expected[0], err_msg=f"interrupted at line event {at}")
            if state["left"] != -1:  # the frame was over before
                break
            step += 1
            at += 7 if at < 400 else 101  # a prime, so that all lines have their turn over the frames
        assert interrupted > 40
        assert settled_bytes(renderer) == healthy


def test_faults_leave_nothing_open(device_info: DeviceInfo, monkeypatch: pytest.MonkeyPatch) -> None:
    def handles() -> tuple[int, int]:
        gc.collect()
        return len(os.listdir("/proc/self/fd")), threading.active_count()

    if not os.path.isdir("/proc/self/fd"):
        pytest.skip("counts files as Linux does")
    with Renderer("layered", device=device_info.index) as renderer:
        renderer.render(FRAMES[0], lens_for(FRAMES[0]))
        before = handles()
        fault = Faulty(monkeypatch, cl, "enqueue_nd_range_kernel", cl.RuntimeError)
        for _ in range(20):
            fault.break_after(3)
            with pytest.raises(DeviceError):
                renderer.render(FRAMES[0], lens_for(FRAMES[0], 20.0))
            fault.heal()
        assert handles() == before


def test_a_lost_device_stays_a_clear_error(device_info: DeviceInfo, monkeypatch: pytest.MonkeyPatch) -> None:
    """Everything fails from now on: every call says so, and closing does not hang or raise anything else."""
    renderer = Renderer("layered", device=device_info.index)
    pending = renderer.render_async(FRAMES[0], lens_for(FRAMES[0]))
    pending.result()
    places = [(cl, "enqueue_nd_range_kernel"), (cl, "enqueue_copy"), (cl.CommandQueue, "finish")]
    faults = [Faulty(monkeypatch, owner, name, cl.RuntimeError) for owner, name in places]
    for fault in faults:
        fault.break_after(0)
    for _ in range(3):
        with pytest.raises(DeviceError, match="made to"):
            renderer.render(FRAMES[1], lens_for(FRAMES[1]))
    with pytest.raises(DeviceError, match="made to"):
        renderer.close()
    assert renderer.device.pool.allocated_bytes == 0
    renderer.close()


def test_a_frame_that_fails_on_the_device_is_not_used_again(
    device_info: DeviceInfo, expected: list[np.ndarray], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The failure shows when the result is waited for; what was made of the frame is then made anew."""
    with Renderer("layered", device=device_info.index) as renderer:
        pending = renderer.render_async(FRAMES[0], lens_for(FRAMES[0]))
        with monkeypatch.context() as patched:
            Faulty(patched, cl.Event, "wait", cl.RuntimeError).break_after(0)
            with pytest.raises(DeviceError, match="made to"):
                pending.result()
        first = renderer._frames
        assert first
        held = next(iter(first.values()))
        np.testing.assert_array_equal(renderer.render(FRAMES[0], lens_for(FRAMES[0])).image, expected[0])
        assert next(iter(renderer._frames.values())) is not held


def test_results_and_errors_after_close(device_info: DeviceInfo, expected: list[np.ndarray]) -> None:
    renderer = Renderer("layered", device=device_info.index)
    pending = [renderer.render_async(frame, lens_for(frame)) for frame in FRAMES]
    renderer.close()
    for one, image in zip(pending, expected, strict=True):
        np.testing.assert_array_equal(one.result().image, image)
    for call in (lambda: renderer.render(FRAMES[0], lens_for(FRAMES[0])), lambda: renderer.stats(FRAMES[0])):
        with pytest.raises(DeviceError, match="closed"):
            call()


def test_closed_by_another_thread_while_rendering(device_info: DeviceInfo) -> None:
    for _ in range(5):
        renderer = Renderer("layered", device=device_info.index)
        renderer.render(FRAMES[0], lens_for(FRAMES[0]))
        errors: list[BaseException] = []
        go = threading.Event()

        def work(renderer: Renderer = renderer, errors: list[BaseException] = errors, go: Any = go) -> None:
            try:
                for index in range(500):
                    renderer.render(FRAMES[index % 4], lens_for(FRAMES[index % 4]))
                    go.set()
            except BaseException as error:
                errors.append(error)

        thread = threading.Thread(target=work)
        thread.start()
        go.wait(30)
        renderer.close()
        thread.join(30)
        assert not thread.is_alive()
        assert len(errors) == 1 and isinstance(errors[0], DeviceError) and "closed" in str(errors[0])


# Caches


@pytest.fixture
def sources(tmp_path: Path) -> Path:
    (tmp_path / "kernels").mkdir()
    (tmp_path / "kernels" / "toy.cl").write_text("__kernel void toy_one(__global int *out) { out[0] = 1; }\n")
    return tmp_path / "kernels"


@pytest.mark.parametrize("kind", ["a file", "below a file", "not writable", "full"])
def test_a_cache_that_cannot_be_written_is_done_without(
    kind: str, device_info: DeviceInfo, sources: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setattr(program_module, "effects_of", lambda platform, device: frozenset())
    folder = {"a file": tmp_path / "file", "below a file": tmp_path / "file" / "x", "not writable": Path("/proc/none")}
    with Renderer("layered", device=device_info.index) as renderer:
        device = renderer.device
        cache = ProgramCache(device.context, device._cl_device, sources, folder.get(kind, tmp_path / "cache"))
        if kind == "full":

            def full(*args: Any) -> None:
                raise OSError(28, "No space left on device")

            monkeypatch.setattr(os, "replace", full)
        assert cache.kernel("toy", "toy_one").num_args == 1
    if kind == "full":
        assert not list((tmp_path / "cache").iterdir()), "half of a file was left"


def _child(code: str, folder: Path, limit: int | None = None) -> subprocess.Popen[str]:
    def limited() -> None:
        import resource

        if limit is not None:
            resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))

    environment = {**os.environ, "POCL_CACHE_DIR": str(folder), "CLDOF_CACHE_DIR": str(folder / "cldof")}
    environment["PYTHONPATH"] = str(ROOT)
    pipe = subprocess.PIPE
    return subprocess.Popen(
        [sys.executable, "-c", code], env=environment, stdout=pipe, stderr=pipe, text=True, preexec_fn=limited
    )


RENDER = """
import sys
from cldof import Lens, Renderer
from tests.frames import noise_frame
frame = noise_frame(40, 24, 2)
with Renderer("layered", device=0) as renderer:
    print(renderer.render(frame, Lens(6.0 / frame.camera.focal_px, 2.0)).image.tobytes().hex()[:64])
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="PoCL's files are ELF there")
def test_caches_shared_damaged_or_without_room(device_info: DeviceInfo, tmp_path: Path) -> None:
    if "portable computing" not in device_info.platform.lower() or device_info.index != 0:
        pytest.skip("is about PoCL's cache of programs")
    cache = tmp_path / "pocl"
    cache.mkdir()
    both = [_child(RENDER, cache) for _ in range(2)]  # at once, nothing there yet
    said = {child.communicate(timeout=120) for child in both}
    assert [child.returncode for child in both] == [0, 0], said
    assert len(said) == 1
    programs = sorted(cache.rglob("*.so"))
    assert len(programs) > 3
    for program in programs:
        os.truncate(program, program.stat().st_size // 2)
    again = _child(RENDER, cache)
    assert again.communicate(timeout=120) == (expected := said.pop()), "programs cut short are made anew"
    for source in cache.rglob("*.bc"):
        os.truncate(source, 0)
    for program in cache.rglob("*.so"):
        program.unlink()
    broken = _child(RENDER, cache)
    assert broken.communicate(timeout=120) == expected, "and so are programs without kernels"


def test_a_disk_without_room_is_not_used_for_programs(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """PoCL's compiler ends the process when a file cannot be written to its end."""
    monkeypatch.setenv("POCL_CACHE_DIR", str(tmp_path))
    prepare_environment()
    assert Path(os.environ["POCL_CACHE_DIR"]).is_relative_to(tmp_path)
    monkeypatch.setenv("POCL_CACHE_DIR", str(tmp_path))
    monkeypatch.setattr("shutil.disk_usage", lambda path: type("Usage", (), {"free": 1 << 20})())
    prepare_environment()
    assert not Path(os.environ["POCL_CACHE_DIR"]).is_relative_to(tmp_path)


# Files that are written


@contextmanager
def small_disk() -> Iterator[None]:
    """No file grows beyond 2000 bytes. Not a fixture: the tests' own report may go to a file that is larger by then."""
    resource = pytest.importorskip("resource")
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (2000, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.mark.parametrize("suffix", ["png", "exr", "npy"])
def test_a_full_disk_leaves_the_old_picture(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"image.{suffix}"
    save_image(path, np.zeros((4, 4, 4), np.float32), {"number": 1})
    before = {entry.name: entry.read_bytes() for entry in tmp_path.iterdir()}
    large = np.random.default_rng(0).random((64, 64, 4)).astype(np.float32)
    with small_disk(), pytest.raises(CldofError, match=str(path)):
        save_image(path, large, {"number": 2})
    assert {entry.name: entry.read_bytes() for entry in tmp_path.iterdir()} == before


def test_a_full_disk_leaves_the_old_frame(tmp_path: Path) -> None:
    path = tmp_path / "frame.npz"
    noise_frame(3, 3, 1).save(path)
    before = path.read_bytes()
    with small_disk(), pytest.raises(CldofError, match=r"frame\.npz"):
        noise_frame(64, 64).save(path)
    assert [entry.name for entry in tmp_path.iterdir()] == ["frame.npz"]
    assert path.read_bytes() == before


@pytest.mark.parametrize("error", [KeyboardInterrupt, MemoryError, ValueError])
def test_an_interrupted_write_leaves_nothing(tmp_path: Path, error: type[BaseException]) -> None:
    (tmp_path / "out").write_text("old")
    with pytest.raises(error), atomic_write(tmp_path / "out") as stream:
        stream.write(b"half of it")
        raise error
    assert [(entry.name, entry.read_text()) for entry in tmp_path.iterdir()] == [("out", "old")]
