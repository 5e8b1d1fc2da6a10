"""An offscreen OpenGL context through EGL that comes, goes and changes threads without surprises.

pyrender's own EGL platform calls ``eglTerminate`` on a display that all contexts of the process share, never lets go of
a context, and makes its EGL calls inside ``assert``, which ``python -O`` drops. This one does none of that.

Environment: ``EGL_DEVICE_ID`` picks a device by number (default: the first that works).
"""

from __future__ import annotations

import ctypes
import os
import sys
import threading
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from ..errors import CaptureError

__all__ = ["GLContext", "import_pyrender"]

_HELP = (
    "Capturing a scene needs OpenGL 3.3 or later through EGL. On Debian and Ubuntu: "
    "apt-get install libegl1 libgl1 libgl1-mesa-dri (renders on the CPU), or the GPU vendor's driver."
)
_import_lock = threading.Lock()
_GL_LOWER_LEFT, _GL_ZERO_TO_ONE = 0x8CA1, 0x935F
# Newest first: 4.5 brings glClipControl, which the depth test uses when it is there.
_GL_VERSIONS = ((4, 5), (4, 1), (3, 3))


def _unavailable(what: object) -> CaptureError:
    detail = f"{type(what).__name__}: {what}" if isinstance(what, BaseException) else str(what)
    return CaptureError(f"{_HELP} What failed: {' '.join(detail.split())[:300]}")


def import_pyrender() -> Any:
    """Import pyrender on EGL, past what newer Python and a machine without X11 break in it.

    Raises
    ------
    CaptureError
        If pyrender, EGL or OpenGL cannot be loaded.
    """
    with _import_lock, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        loaded = sys.modules.get("pyrender")
        if loaded is not None and "pyrender.platforms.egl" in sys.modules:
            return loaded
        os.environ.setdefault("PYOPENGL_PLATFORM", "egl")
        try:
            from OpenGL.plugins import FormatHandler

            # PyOpenGL before 3.1.8 does not know what byref() returns on Python 3.12 and later.
            handler = FormatHandler.by_name("ctypesparameter")
            if handler is not None and "_ctypes.CArgObject" not in handler.check:
                handler.check.append("_ctypes.CArgObject")
            # pyrender imports its viewer, which opens libX11 through pyglet unless pyglet is headless.
            import pyglet

            pyglet.options["headless"] = True
            import pyrender
            import pyrender.platforms.egl
        except Exception as error:
            raise _unavailable(error) from error
        return pyrender


class GLContext:
    """One EGL context without a surface, current only inside ``with context.current():``.

    Any thread may enter; two threads take turns. Contexts are independent of each other, and closing one leaves the
    others alone. A context is never left current, so it never blocks another thread or library.
    """

    def __init__(self) -> None:
        import_pyrender()
        from OpenGL import EGL as egl
        from OpenGL import GL as gl

        self._egl, self._lock = egl, threading.RLock()
        self._depth, self._display, self._context = 0, None, None
        failures: list[str] = []
        for device in self._devices():
            try:
                self._display, self._context = self._open(device)
                with self.current():
                    self.renderer: str = gl.glGetString(gl.GL_RENDERER).decode(errors="replace")
                    self.version: str = gl.glGetString(gl.GL_VERSION).decode(errors="replace")
                return
            except Exception as error:
                failures.append(f"{type(error).__name__}: {error}" if str(error) else type(error).__name__)
                self.close()
        raise _unavailable("; ".join(failures) or "no EGL device")

    @staticmethod
    def _devices() -> list[Any]:
        from pyrender.platforms import egl as platform

        try:
            devices = platform.query_devices()
        except Exception:  # no device enumeration: the default display is the one choice
            devices = []
        devices = devices or [platform.EGLDevice(None)]
        chosen = os.environ.get("EGL_DEVICE_ID")
        if chosen is None:
            return list(devices)
        if not chosen.isdigit() or int(chosen) >= len(devices):
            raise CaptureError(f"EGL_DEVICE_ID is {chosen!r}; this machine has EGL devices 0 to {len(devices) - 1}.")
        return [devices[int(chosen)]]

    def _open(self, device: Any) -> tuple[Any, Any]:
        egl = self._egl
        display = device.get_display()
        major, minor, count = egl.EGLint(), egl.EGLint(), egl.EGLint()
        if not egl.eglInitialize(display, ctypes.pointer(major), ctypes.pointer(minor)):
            raise CaptureError("eglInitialize failed")
        if not egl.eglBindAPI(egl.EGL_OPENGL_API):
            raise CaptureError("EGL has no desktop OpenGL")
        wanted = (egl.EGLint * 5)(egl.EGL_SURFACE_TYPE, 0, egl.EGL_RENDERABLE_TYPE, egl.EGL_OPENGL_BIT, egl.EGL_NONE)
        configs = (egl.EGLConfig * 1)()
        if not egl.eglChooseConfig(display, wanted, configs, 1, ctypes.pointer(count)) or count.value < 1:
            raise CaptureError("EGL offers no configuration for desktop OpenGL")
        failure: Exception = CaptureError("no OpenGL 3.3 core context")
        for gl_major, gl_minor in _GL_VERSIONS:
            attributes = (egl.EGLint * 7)(
                egl.EGL_CONTEXT_MAJOR_VERSION,
                gl_major,
                egl.EGL_CONTEXT_MINOR_VERSION,
                gl_minor,
                egl.EGL_CONTEXT_OPENGL_PROFILE_MASK,
                egl.EGL_CONTEXT_OPENGL_CORE_PROFILE_BIT,
                egl.EGL_NONE,
            )
            try:
                context = egl.eglCreateContext(display, configs[0], egl.EGL_NO_CONTEXT, attributes)
            except Exception as error:
                failure = error
                continue
            if context:
                return display, context
        raise failure

    @property
    def is_open(self) -> bool:
        """False once closed."""
        return self._context is not None

    @contextmanager
    def current(self) -> Iterator[None]:
        """Hold the context; reentrant. Whatever was current in this thread before is current again afterwards.

        Raises
        ------
        CaptureError
            If the context is closed or cannot be made current.
        """
        egl = self._egl
        with self._lock:
            if self._context is None:
                raise CaptureError("This OpenGL context is closed; make a new one.")
            if self._depth == 0:
                outer = (
                    egl.eglGetCurrentDisplay(),
                    egl.eglGetCurrentSurface(egl.EGL_DRAW),
                    egl.eglGetCurrentSurface(egl.EGL_READ),
                    egl.eglGetCurrentContext(),
                )
                self._make_current(self._display, egl.EGL_NO_SURFACE, egl.EGL_NO_SURFACE, self._context)
            self._depth += 1
            try:
                yield
            finally:
                self._depth -= 1
                if self._depth == 0:
                    if outer[3]:
                        self._make_current(*outer)
                    else:
                        nothing = (egl.EGL_NO_SURFACE, egl.EGL_NO_SURFACE, egl.EGL_NO_CONTEXT)
                        self._make_current(self._display, *nothing)

    def clip_depth_zero_to_one(self) -> bool:
        """Let depth clip to [0, 1], not [-1, 1], which loses precision near 0. Needs OpenGL 4.5; False without.

        By address, since PyOpenGL 3.1.0 (the one that pyrender pins) ends at OpenGL 4.4.
        """
        words = self.version.split(None, 1)[0].split(".")
        address = self._egl.eglGetProcAddress(b"glClipControl")
        if not address or (int(words[0]), int(words[1])) < (4, 5):
            return False
        with self.current():
            ctypes.CFUNCTYPE(None, ctypes.c_uint, ctypes.c_uint)(address)(_GL_LOWER_LEFT, _GL_ZERO_TO_ONE)
        return True

    def _make_current(self, *what: Any) -> None:
        try:
            done = self._egl.eglMakeCurrent(*what)
        except Exception as error:
            raise CaptureError(f"The OpenGL context cannot be made current: {error}.") from error
        if not done:
            raise CaptureError("The OpenGL context cannot be made current.")

    def close(self) -> None:
        """Destroy the context; again is harmless. The display stays: other contexts of the process share it."""
        with self._lock:
            if self._context is None:
                return
            from OpenGL import contextdata

            with self.current():
                key = contextdata.getContext()
            self._egl.eglDestroyContext(self._display, self._context)
            contextdata.cleanupContext(key)  # else a later context at the same address inherits stale pointers
            self._context = None
