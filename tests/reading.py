"""Read files that may do harm in a process of their own: ``python -m tests.reading`` with jobs as JSON on its input.

A job is ``[reader, path]``; each answer has ``error`` (class or null), ``ours``, ``message``, ``seconds``, ``opened``.
Memory is limited to what the process has at its start and :data:`HEADROOM_BYTES` more, time to :data:`LIMIT_S` each.
"""

from __future__ import annotations

import json
import os
import resource
import signal
import sys
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

HEADROOM_BYTES = 1200 << 20
LIMIT_S = 10


class _Timeout(BaseException):
    pass


def _readers() -> dict[str, Callable[[str], Any]]:
    from cldof import Camera, LayeredFrame
    from cldof.benchmark.record import Record
    from cldof.capture.load import load_scene
    from cldof.cli import _aperture_image
    from cldof.images import read_metadata

    return {
        "scene": load_scene,
        "frame": LayeredFrame.load,
        "metadata": read_metadata,
        "camera": lambda path: Camera.load(path, 64, 64),
        "aperture": _aperture_image,
        "record": Record.load,
    }


def _limit_memory() -> None:
    with open("/proc/self/statm") as stream:
        now = int(stream.read().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (now + HEADROOM_BYTES, now + HEADROOM_BYTES))


def _timeout(number: int, frame: Any) -> None:
    raise _Timeout


def main() -> None:
    """Read jobs, answer each with a line."""
    from cldof import CldofError

    readers = _readers()
    opened: list[str] = []

    def watch(event: str, arguments: tuple[Any, ...]) -> None:
        if event == "open" and isinstance(arguments[0], str | os.PathLike):
            opened.append(str(Path(arguments[0]).resolve()))

    warnings.simplefilter("ignore")
    sys.addaudithook(watch)
    signal.signal(signal.SIGALRM, _timeout)
    jobs = json.load(sys.stdin)
    _limit_memory()
    for name, path in jobs:
        opened.clear()
        error: BaseException | None = None
        started = time.perf_counter()
        signal.alarm(LIMIT_S)
        try:
            readers[name](path)
        except (Exception, _Timeout) as raised:
            error = raised
        signal.alarm(0)
        answer = {
            "error": None if error is None else type(error).__name__,
            "ours": isinstance(error, CldofError),
            "message": str(error),
            "seconds": time.perf_counter() - started,
            "opened": opened[:],
        }
        del error
        print(json.dumps(answer), flush=True)


if __name__ == "__main__":
    main()
