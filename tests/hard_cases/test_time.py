"""Time: the same bits again and again; five hundred frames of changing lens, size and method."""

from __future__ import annotations

import gc
import math
import time
from pathlib import Path

import numpy as np
import pytest

from cldof import Lens, Renderer
from cldof.host.device import DeviceInfo
from cldof.methods import METHODS
from tests.frames import noise_frame
from tests.stability import driver_of

from .conftest import Subject, record


@pytest.mark.parametrize("opaque", [True, False], ids=["opaque", "void"])
def test_fifty_times_the_same_bits(subject: Subject, opaque: bool) -> None:
    frame = noise_frame(45, 31, seed=3, opaque=opaque)
    lens = Lens(8.0 / frame.camera.focal_px, 1.7)
    first = subject.render(frame, lens)
    changed = sum(not np.array_equal(subject.render(frame, lens), first) for _ in range(49))
    subject.check("the same frame 50 times", "frames with other bits", changed, 0)


def resident_mb() -> float:
    """Memory of this process that is in use."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("VmRSS"):
            return int(line.split()[1]) / 1024.0
    raise AssertionError("no VmRSS")


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="resident memory is read from /proc")
def test_five_hundred_frames(device_info: DeviceInfo) -> None:
    """All methods in turn, lenses that breathe, sizes that change: memory flat, no drift, no stall."""
    slow = "llvmpipe" in device_info.name
    rounds, warm = (20, 8) if slow else (100, 40)
    names = sorted(METHODS)
    sizes = [(48, 32), (61, 47), (33, 70), (64, 64)]
    frames = [noise_frame(*size, seed=number) for number, size in enumerate(sizes)]
    renderers = {name: Renderer(name, device=device_info.index) for name in names}
    probe_lens = Lens(7.0 / frames[0].camera.focal_px, 1.7)
    driver = driver_of(device_info)
    try:
        first = {name: renderers[name].render(frames[0], probe_lens).image for name in names}
        memory, held, durations = [], [], []
        for turn in range(rounds):
            # The same twenty lenses again and again, so that what is cached does not grow for its own good reasons.
            phase = 2.0 * math.pi * (turn % 20) / 20
            frame = frames[turn % len(frames)]
            lens = Lens((4.0 + 3.5 * math.sin(phase)) / frame.camera.focal_px, 2.0 + math.cos(phase))
            for name in names:
                started = time.perf_counter()
                image = renderers[name].render(frame, lens).image
                durations.append(time.perf_counter() - started)
                assert np.isfinite(image).all()
            gc.collect()
            memory.append(resident_mb())
            held.append(sum(renderer.device.pool.allocated_bytes for renderer in renderers.values()))
        for name in names:
            changed = np.count_nonzero(renderers[name].render(frames[0], probe_lens).image != first[name])
            record("time", "500 frames", "values that drifted", name, driver, changed, 0)
    finally:
        for renderer in renderers.values():
            renderer.close()
    grown = np.mean(memory[-5:]) - memory[warm]
    record("time", "500 frames", "resident memory grown, MB", "all methods", driver, grown, 8.0)
    # The pool keeps the most buffers of each size that it ever needed at once, which takes a while to meet.
    device_grown = max(held[warm:]) / max(held[:warm]) - 1.0
    record("time", "500 frames", "device memory grown, share", "all methods", driver, device_grown, 0.25)
    steady = np.array(durations[warm * len(names) :])
    # Machines with other work to do stop now and then; a stall is a frame that takes seconds.
    record("time", "500 frames", "longest frame, s", "all methods", driver, steady.max(), 20.0 if slow else 2.0)
