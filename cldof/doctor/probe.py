"""What is looked at in a child process, since drivers may end it: ``python -m cldof.doctor.probe WHAT``.

``opencl`` lists devices, ``opengl`` opens an offscreen context, ``device N METHOD ...`` renders the sample on device N
by each method. Every finding is one line of JSON on standard output.
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from ..errors import CldofError

__all__ = ["main"]

_out = sys.stdout


def _opencl() -> None:
    from ..host.device import list_devices

    _say(devices=[asdict(info) for info in list_devices()])


def _opengl() -> None:
    from ..capture.peel import DepthPeeler

    with DepthPeeler(8, 8) as peeler:
        _say(renderer=peeler.device)


def _device(index: int, methods: Sequence[str]) -> None:
    from ..renderer import Renderer
    from .sample import agreement_db, expected, sample_frame, sample_lens

    frame, lens, right = sample_frame(), sample_lens(), expected()
    for name in methods:
        _say(begins=name)
        started = time.perf_counter()
        try:
            with Renderer(name, device=index) as renderer:
                image = renderer.render(frame, lens).image
        except CldofError as error:
            _say(method=name, error=str(error))
            continue
        _say(method=name, db=agreement_db(image, right[name]), seconds=time.perf_counter() - started)


def _say(**finding: Any) -> None:
    print(json.dumps(finding), file=_out, flush=True)


def main(words: Sequence[str]) -> int:
    """Look at one thing."""
    try:
        match words:
            case ["opencl"]:
                _opencl()
            case ["opengl"]:
                _opengl()
            case ["device", index, *methods]:
                _device(int(index), methods)
            case _:
                _say(error=f"nothing is known of {' '.join(words)}")
                return 2
    except CldofError as error:
        _say(error=str(error))
        return 2
    return 0


if __name__ == "__main__":
    # Drivers write to both streams; the parent reads the first.
    _out = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    sys.exit(main(sys.argv[1:]))
