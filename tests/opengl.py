"""For tests that capture scenes outside tests/capture: skip visibly without OpenGL, fail where it is required."""

import functools
import os

import pytest

from cldof.errors import CaptureError

__all__ = ["require_opengl"]


def require_opengl() -> None:
    """Skip the calling test where no offscreen OpenGL works; fail it with ``CLDOF_REQUIRE_DEVICE=1``."""
    why = _why_not()
    if why is None:
        return
    if os.environ.get("CLDOF_REQUIRE_DEVICE") == "1":
        pytest.fail(f"CLDOF_REQUIRE_DEVICE=1, but {why}")
    pytest.skip(why)


@functools.cache
def _why_not() -> str | None:
    from cldof.capture.peel import DepthPeeler

    try:
        DepthPeeler(8, 8).close()
    except CaptureError as error:
        return str(error)
    return None
