"""For tests that capture scenes outside tests/capture: skip visibly without OpenGL."""

import functools

import pytest

from cldof.errors import CaptureError

__all__ = ["require_opengl"]


def require_opengl() -> None:
    """Skip the calling test where no offscreen OpenGL works."""
    why = _why_not()
    if why is not None:
        pytest.skip(why)


@functools.cache
def _why_not() -> str | None:
    from cldof.capture.peel import DepthPeeler

    try:
        DepthPeeler(8, 8).close()
    except CaptureError as error:
        return str(error)
    return None
