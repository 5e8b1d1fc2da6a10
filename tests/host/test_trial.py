"""First use of a driver in a child process: children that die, drivers that cannot build, caches that lie."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cldof import Lens, Renderer
from cldof.errors import DriverError, DriverWarning
from cldof.host import device as device_module
from cldof.host import trial, trial_process
from cldof.host.device import Device, DeviceInfo, list_devices
from tests.frames import noise_frame
from tests.tools import feigned

ROOT = Path(__file__).parents[2]
FRAME = noise_frame(40, 24, 2)
LENS = Lens(6.0 / FRAME.camera.focal_px, 2.0)

# Where a child dies, in place of a call or at the end, and what the message then says that it was doing.
PLACES = {
    "Device.open": "opening the device",
    "ProgramCache.program": "building",
    "Batch.submit": "running",
    "": "ending",
}
DYING_CHILD = """
import ctypes, os, sys
from cldof.host import trial, trial_process
from cldof.host.device import Device
from cldof.host.program import ProgramCache
from cldof.host.scheduler import Batch

def die(*args, **options):
    os.abort() if "{signal}" == "SIGABRT" else ctypes.string_at(0)

if "{place}":
    setattr({owner}, "{name}", die)
trial_process.main()
die()
"""


@pytest.fixture
def trials_on(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Children are used, and nothing has been tried yet."""
    monkeypatch.setenv(trial.SWITCH, "1")
    monkeypatch.setattr(trial.Trials, "_folder", tmp_path / "tried")


def children(monkeypatch: pytest.MonkeyPatch, code: str | None = None) -> list[list[str]]:
    """Commands that are started from here on; `code` replaces what children do."""
    started: list[list[str]] = []
    command = trial_process.command()

    def noted() -> list[str]:
        started.append(command if code is None else [sys.executable, "-c", code])
        return started[-1]

    monkeypatch.setattr(trial_process, "command", noted)
    return started


def test_a_frame_is_tried_once(
    trials_on: None, monkeypatch: pytest.MonkeyPatch, device_info: DeviceInfo, tmp_path: Path
) -> None:
    """A child for the device, one for preparation and method; the second renderer knows, as other processes do."""
    started = children(monkeypatch)
    with Renderer("layered", device=device_info.index) as renderer:
        image = renderer.render(FRAME, LENS).image
        assert len(started) == 2
        renderer.render(FRAME, Lens(1.01 * LENS.aperture_radius_m, 2.0))
        traits = renderer.device.traits
    with Renderer("layered", device=device_info.index) as renderer:
        np.testing.assert_array_equal(renderer.render(FRAME, LENS).image, image)
    assert len(started) == 2
    assert (tmp_path / "tried").is_dir()
    with Renderer("gather", device=device_info.index) as renderer:
        renderer.render(FRAME, LENS)
    assert len(started) == 3, "another method, the same device and preparation"
    monkeypatch.setenv(trial.SWITCH, "0")
    with Renderer("layered", device=device_info.index) as renderer:
        np.testing.assert_array_equal(renderer.render(FRAME, LENS).image, image)
        assert renderer.device.traits == traits, "by probes of this process, which before were the child's"


def test_only_what_a_child_has_ended_after_is_noted(trials_on: None, device_info: DeviceInfo, tmp_path: Path) -> None:
    """The child that prepared a frame waits for the frame's own kernels; without any it ends with the device."""
    with Renderer("gather", device=device_info.index) as renderer:
        renderer.stats(FRAME)
        assert len(list((tmp_path / "tried").iterdir())) == 1, "the device"
    assert len(list((tmp_path / "tried").iterdir())) > 1


@pytest.mark.skipif(sys.platform == "win32", reason="there are no such signals")
@pytest.mark.parametrize("signal", ["SIGSEGV", "SIGABRT"])
@pytest.mark.parametrize("place", PLACES)
def test_a_child_that_dies_is_a_message(
    trials_on: None, monkeypatch: pytest.MonkeyPatch, device_info: DeviceInfo, tmp_path: Path, place: str, signal: str
) -> None:
    with Renderer("gather", device=device_info.index) as renderer:
        renderer.device.trials.close()  # one waits for a frame
        owner, _, name = place.rpartition(".")
        children(monkeypatch, DYING_CHILD.format(place=place, owner=owner or "None", name=name, signal=signal))
        # Any frame; what the device itself was tried with is known.
        with pytest.raises(DriverError) as caught:
            renderer.render(FRAME, LENS)
    said = str(caught.value)
    for part in (signal, PLACES[place], device_info.name, device_info.driver_version, "processor", "report"):
        assert part in said, said
    assert len(list((tmp_path / "tried").iterdir())) == 1, "the device, and nothing of the frame"
    monkeypatch.undo()
    monkeypatch.setenv(trial.SWITCH, "1")
    monkeypatch.setattr(trial.Trials, "_folder", tmp_path / "tried")
    with Renderer("gather", device=device_info.index) as renderer:
        assert np.isfinite(renderer.render(FRAME, LENS).image).all(), "the next one works"


def two_devices(monkeypatch: pytest.MonkeyPatch, info: DeviceInfo) -> None:
    """One device, listed twice."""
    monkeypatch.delenv("CLDOF_DEVICE", raising=False)
    found = device_module._devices()[info.index]
    monkeypatch.setattr(device_module, "_devices", lambda: [found, found])


def failing_first(monkeypatch: pytest.MonkeyPatch, fails: str) -> None:
    """Trials that go wrong on device 0 alone, and find nothing out on others."""

    def tried(self: trial.Trials, *args: Any, **options: Any) -> None:
        if self._info.index == 0 and fails == ("program" if args else "device"):
            raise DriverError("the driver died")

    monkeypatch.setattr(trial.Trials, "device", tried)
    monkeypatch.setattr(trial.Trials, "program", tried)


@pytest.mark.parametrize("fails", ["device", "program"])
@pytest.mark.parametrize("method", ["layered", "auto"])
def test_the_next_device_is_taken_where_the_choice_is_ours(
    trials_on: None, monkeypatch: pytest.MonkeyPatch, device_info: DeviceInfo, fails: str, method: str
) -> None:
    options: dict[str, Any] = {"max_error": 0.05} if method == "auto" else {}
    monkeypatch.setenv(trial.SWITCH, "0")
    with Renderer(method, device=device_info.index, **options) as renderer:
        expected = renderer.render(FRAME, LENS).image
    monkeypatch.setenv(trial.SWITCH, "1")
    two_devices(monkeypatch, device_info)
    failing_first(monkeypatch, fails)
    with pytest.warns(DriverWarning, match=r"the driver died.* taken in its place"):
        renderer = Renderer(method, **options)
        first = renderer.render(FRAME, LENS)
    with renderer:
        assert renderer.device.info.index == 1
        np.testing.assert_array_equal(first.image, expected)
        np.testing.assert_array_equal(renderer.render(FRAME, LENS).image, expected)
    with pytest.raises(DriverError, match="the driver died"), Renderer(method, device=0, **options) as renderer:
        renderer.render(FRAME, LENS)


def test_what_says_nothing_of_the_driver_is_passed_over(
    trials_on: None, monkeypatch: pytest.MonkeyPatch, device_info: DeviceInfo
) -> None:
    """Children that cannot be started, that end before they begin, and that are killed for their memory."""
    killed = 'import os\nprint("{\\"stage\\": \\"running\\"}", flush=True)\nos.kill(os.getpid(), 9)'
    for command in (["/does/not/exist"], [sys.executable, "-c", "raise SystemExit(1)"], [sys.executable, "-c", killed]):
        monkeypatch.setattr(trial_process, "command", lambda command=command: command)
        trial.Trials(device_info).device()


def _python(code: str, variables: Mapping[str, str]) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, **variables}
    environment["PYTHONPATH"] = os.pathsep.join(filter(None, (variables.get("PYTHONPATH"), str(ROOT))))
    return subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, env=environment, check=False, timeout=300
    )


def _render(frame: str, out: Path, device: int, variables: Mapping[str, str]) -> subprocess.CompletedProcess[str]:
    words = (
        "render",
        frame,
        "-o",
        str(out),
        "--aperture-radius",
        "0.01",
        "--focus-distance",
        "2",
        "--device",
        str(device),
    )
    code = f"from cldof.cli import main; raise SystemExit(main({list(words)!r}))"
    return _python(code, {**variables, trial.SWITCH: "1"})


def _pocl() -> DeviceInfo:
    if why := feigned.why_not_here():
        pytest.skip(why)
    return next(info for info in list_devices() if "portable computing" in info.platform.lower())


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> str:
    path = tmp_path_factory.mktemp("frame") / "frame.npz"
    FRAME.save(path)
    return str(path)


def test_a_driver_that_does_not_know_the_processor(tmp_path: Path, saved: str) -> None:
    """As PoCL 3.0 on AMD's Zen 5, which its LLVM 14 calls generic."""
    done = _render(saved, tmp_path / "out.png", _pocl().index, feigned.environment("generic", tmp_path))
    assert done.returncode == 2, done.stderr
    assert "unknown target CPU 'generic'" in done.stderr and "delete" not in done.stderr
    assert "processor" in done.stderr and "Traceback" not in done.stderr
    assert not (tmp_path / "out.png").exists()


DYING = """
from cldof.host import opencl as cl
from cldof.host.device import Device
from pathlib import Path
device = Device.open({index}, sources=Path({sources!r}))
program = device.programs.program({stem!r})
print(program.get_info(cl.program_info.KERNEL_NAMES), flush=True)
program.get_info(cl.program_info.BINARIES)
"""
ASKING = """
from cldof.errors import DriverError
from cldof.host.device import Device
from pathlib import Path
try:
    Device.open({index}, sources=Path({sources!r})).programs.kernel({stem!r}, "wide")
except DriverError as error:
    print(error)
"""


def test_a_poisoned_cache_is_made_anew(tmp_path: Path, saved: str) -> None:
    """PoCL dies over a call that passes 64 bytes where its library, but not its LLVM, takes AVX-512 for granted."""
    index = _pocl().index
    variables = {**feigned.environment("znver3:avx512", tmp_path / "cache"), trial.SWITCH: "0"}
    (tmp_path / "wide.cl").write_text(
        "__kernel void small(__global int *o) { *o = 1; }\n"
        "__kernel void wide(__global int16 *o, float16 v) { *o = convert_int16(v); }\n"
    )
    values = {"index": index, "sources": str(tmp_path), "stem": "wide"}
    died = _python(DYING.format(**values), variables)
    assert died.stdout.split() == ["small;wide"], died.stderr
    assert died.returncode < 0
    folder = Path(variables["POCL_CACHE_DIR"])
    assert list(folder.rglob("small.so")), "the crash has left half of its program"

    asked = _python(ASKING.format(**values), variables)
    assert "an earlier process died" in asked.stdout, asked.stderr
    assert asked.returncode == 0, "no abort() at the end"

    done = _render(saved, tmp_path / "out.png", index, variables)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "out.png").exists()
    assert not list(folder.rglob("small.so"))


def test_a_child_finds_what_this_process_finds(trials_on: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """An adopted queue is tried on the device that it is of."""
    started = children(monkeypatch)
    monkeypatch.setattr(os, "cpu_count", lambda: 1)  # no second child meanwhile
    for info in list_devices():
        with Device.open(info.index) as own, Device.adopt(queue=own.queue) as adopted:
            assert adopted.trials is not None
            assert adopted.trials._info == info
    assert len(started) == len(list_devices())
