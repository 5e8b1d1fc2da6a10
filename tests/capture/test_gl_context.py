"""Contexts come, go, coexist and change threads; a machine without OpenGL gets one clear error."""

from __future__ import annotations

import subprocess
import sys
import threading

import numpy as np
import pytest

from cldof.capture.gl_context import GLContext
from cldof.capture.peel import DepthPeeler
from cldof.capture.scene import Scene
from cldof.errors import CaptureError

from .conftest import camera_at, quad

SCENE = Scene("pair", (quad(2.0, 0.5), quad(3.0)))


def test_contexts_are_made_and_closed_again_and_again(peeler: DepthPeeler) -> None:
    expected = peeler.peel(SCENE, camera_at())
    for _ in range(12):
        with DepthPeeler(32, 32) as other:
            np.testing.assert_array_equal(other.peel(SCENE, camera_at()).depth, expected.depth)
    np.testing.assert_array_equal(peeler.peel(SCENE, camera_at()).depth, expected.depth)  # the display is still there


def test_two_peelers_share_a_scene(peeler: DepthPeeler) -> None:
    with DepthPeeler() as first, DepthPeeler() as second:
        frames = [p.peel(SCENE, camera_at()) for p in (first, second, first)]
        first.close()
        frames.append(second.peel(SCENE, camera_at(33, 65)))
    np.testing.assert_array_equal(frames[0].depth, frames[1].depth)
    np.testing.assert_array_equal(frames[0].depth, frames[2].depth)


def test_any_thread_may_render(peeler: DepthPeeler) -> None:
    expected = peeler.peel(SCENE, camera_at()).depth
    results: list[bool] = []

    def work() -> None:
        for _ in range(3):
            results.append(bool((peeler.peel(SCENE, camera_at()).depth == expected).all()))

    threads = [threading.Thread(target=work) for _ in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert results == [True] * 9


def test_a_context_is_current_only_inside_its_block(peeler: DepthPeeler) -> None:
    from OpenGL import EGL

    first, second = GLContext(), GLContext()
    assert not EGL.eglGetCurrentContext()
    with first.current():
        outer = EGL.eglGetCurrentContext()
        with second.current(), second.current():
            pass
        assert EGL.eglGetCurrentContext().address == outer.address
    assert not EGL.eglGetCurrentContext()
    for context in (first, second, second):
        context.close()


def test_a_closed_peeler_says_so(peeler: DepthPeeler) -> None:
    other = DepthPeeler()
    other.close()
    other.close()
    with pytest.raises(CaptureError, match="closed"):
        other.peel(SCENE, camera_at())


def test_an_unknown_device_number_is_refused(peeler: DepthPeeler, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("EGL_DEVICE_ID", "99")
    with pytest.raises(CaptureError, match="EGL_DEVICE_ID is '99'"):
        GLContext()


def run(code: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, timeout=60)


@pytest.mark.parametrize("missing", ["OpenGL", "pyrender", "OpenGL.EGL"])
def test_without_opengl_one_error_names_the_packages(missing: str) -> None:
    code = (
        f"import sys; sys.modules[{missing!r}] = None\n"
        "from cldof.capture.peel import DepthPeeler\n"
        "from cldof.errors import CaptureError\n"
        "try:\n    DepthPeeler(8, 8)\nexcept CaptureError as error:\n    print(error)\n"
    )
    result = run(code)
    assert result.returncode == 0, result.stderr
    assert "libegl1 libgl1 libgl1-mesa-dri" in result.stdout
    assert result.stderr == ""


def test_scenes_and_loading_import_no_opengl() -> None:
    code = (
        "import sys, cldof, cldof.capture, cldof.capture.scene, cldof.capture.load, cldof.capture.peel\n"
        "import cldof.capture.accumulate\n"
        "found = {'OpenGL', 'pyrender', 'pyglet'} & set(sys.modules)\n"
        "assert not found, found"
    )
    result = run(code)
    assert result.returncode == 0, result.stderr


def test_nothing_leaks_to_the_terminal_even_when_optimised(peeler: DepthPeeler) -> None:
    code = (
        "from cldof.capture.peel import DepthPeeler\n"
        "from cldof.capture.scene import Scene\n"
        "from cldof import Camera\n"
        "with DepthPeeler(8, 8) as p:\n    p.peel(Scene('void', ()), Camera(8, 8))\n"
        "DepthPeeler(8, 8)  # never closed\n"
    )
    command = [sys.executable, "-O", "-W", "error", "-c", code]
    result = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert (result.returncode, result.stdout, result.stderr) == (0, "", "")
