"""What the tests of one process make once: OpenCL contexts, built programs, and built-in scenes.

Tests open devices some hundred times, and each would build the same few programs again: even from the driver's cache
that is 0.04 s a program. Queues, pools and kernels stay each device's own. Scenes are immutable, and take a second each
to make. Children of tests share nothing.
"""

from __future__ import annotations

import sys
from functools import cache
from typing import Any

from cldof.host import device as device_module
from cldof.host import opencl as cl
from cldof.host.device import Device, DeviceInfo
from cldof.host.program import ProgramCache

__all__ = ["share_builds", "share_scenes"]


def share_builds() -> None:
    """From here on every device that is opened shares what others have built."""
    contexts: dict[int, Any] = {}
    programs: dict[tuple[int, str], Any] = {}
    probes: dict[tuple[int, str], Any] = {}
    open_anew: Any = device_module._open
    build: Any = ProgramCache._build
    build_probe: Any = Device._probe

    def open_shared(device: Any, info: DeviceInfo, profiling: bool, out_of_order: bool) -> tuple[Any, Any]:
        context, queue = open_anew(device, info, profiling, out_of_order)
        shared = contexts.setdefault(device.int_ptr, context)
        if shared != context:
            queue = device_module._new_queue(shared, device, profiling, out_of_order)
        return shared, queue

    def program(cache: ProgramCache, source: str) -> Any:
        if cache._disk or cache._context not in contexts.values():  # binaries on disk are what such a test is about
            return build(cache, source)
        key = (cache._context.int_ptr, source)
        if key not in programs:
            programs[key] = build(cache, source)
        return programs[key]

    def probe(device: Device, source: str) -> Any:
        key = (device.context.int_ptr, source)
        if device.context not in contexts.values():
            return build_probe(device, source)
        if key not in probes:
            probes[key] = build_probe(device, source).get_info(cl.kernel_info.PROGRAM)
        return cl.Kernel(probes[key], "probe")

    device_module._open = open_shared
    ProgramCache._build = program  # type: ignore[method-assign]
    Device._probe = probe  # type: ignore[method-assign]


def share_scenes() -> None:
    """From here on each built-in scene is made once, if tests need any; ``make.__wrapped__`` makes another."""
    scenes = sys.modules.get("cldof.capture.scenes")
    if scenes is None:
        return
    listed: Any = scenes.BuiltinScene
    once = cache(cache)  # one cache for each function
    scenes.BuiltinScene = lambda description, make, *group: listed(description, once(make), *group)
