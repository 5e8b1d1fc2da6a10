"""Devices, caches and hypothesis settings for every test.

``device`` runs a test once per OpenCL device of the machine, ``out_of_order_device`` the same on queues that reorder.
Their pools surround every buffer with canaries, fill it with NaN, and are checked after every test: a kernel that
writes outside its buffers, or counts on zeros, fails here without any effort in the test. ``CLDOF_TEST_LANES=4`` builds
their kernels for vectors of another width than the device's.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import hypothesis
import numpy as np
import pytest
from hypothesis.database import DirectoryBasedExampleDatabase

from cldof.errors import DeviceError
from cldof.host import caches
from cldof.host import opencl as cl
from cldof.host.buffers import BufferPool
from cldof.host.device import Device, DeviceInfo, list_devices
from cldof.host.trial import SWITCH
from tests.limits import limit_devices
from tests.sharing import share_builds, share_scenes

_REPOSITORY = Path(__file__).parents[1]

# A failing example is kept in `.hypothesis/examples` of the repository, whatever folder tests are started from, and
# tried first the next time. In CI nothing is left to chance and nothing kept. A failure prints the line
# (`@reproduce_failure(...)`) that makes it happen again elsewhere.
hypothesis.settings.register_profile(
    "cldof",
    deadline=None,
    derandomize="CI" in os.environ,
    print_blob=True,
    database=None if "CI" in os.environ else DirectoryBasedExampleDatabase(_REPOSITORY / ".hypothesis" / "examples"),
)
hypothesis.settings.load_profile("cldof")

CANARY = 0xA5
UNWRITTEN = 0xFF  # NaN as float32, -1 as int32


# Before anything imports pyopencl: a cache that later runs find again, where each process at a time has a directory of
# its own. The variables also reach subprocesses.
_CACHE = os.environ.get("POCL_CACHE_DIR") or str(caches.user_cache_dir() / "cldof-tests")
os.environ["POCL_CACHE_DIR"] = _CACHE
caches.prepare_environment()
os.environ["CLDOF_CACHE_DIR"] = str(Path(os.environ["POCL_CACHE_DIR"]) / "cldof")
# Tests build hundreds of kinds of frames, each once: trying them in children would take a second each. Those of trials
# turn them on.
os.environ[SWITCH] = "0"


def _find_devices() -> tuple[list[DeviceInfo], str]:
    """All devices, or with ``CLDOF_TEST_DEVICE`` the one of that index, or those whose name or platform has it."""
    part = os.environ.get("CLDOF_TEST_DEVICE", "").lower()
    try:
        found = [
            info
            for info in list_devices()
            if (info.index == int(part) if part.isdecimal() else part in f"{info.name}\n{info.platform}".lower())
        ]
        return found, f"this machine has no OpenCL device {part}".rstrip()
    except DeviceError as error:
        return [], str(error)


_DEVICES, _WHY_NONE = _find_devices()
_PARAMS = [pytest.param(info, id=f"{info.index}-{info.name.split('-')[0].replace(' ', '_')}") for info in _DEVICES]


limit_devices()
share_builds()


def pytest_configure(config: pytest.Config) -> None:
    """A process that hands out tests to others (``pytest -n 2``) builds nothing: its folder is for one of them."""
    if getattr(config.option, "numprocesses", None) and not hasattr(config, "workerinput"):
        if lock := caches._claimed.pop(caches.own_programs(), None):
            lock.close()
        os.environ["POCL_CACHE_DIR"] = _CACHE


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """What goes to which process."""
    from tests.workers import ByMethod

    return ByMethod(config, log)


def pytest_collection_finish() -> None:
    """Now it is known whether tests need scenes."""
    share_scenes()


class CanaryPool(BufferPool):
    """A pool whose buffers have the size asked for to the byte, canaries on both sides, and NaN inside."""

    def __init__(self, context: Any, queue: Any, *, shares_memory: bool) -> None:
        super().__init__(context, queue, shares_memory=shares_memory)
        self.fill = UNWRITTEN
        self._margin = max(queue.device.mem_base_addr_align // 8, 512)
        self._parents: dict[int, tuple[Any, Any, int]] = {}

    def acquire(self, nbytes: int) -> Any:
        """Never reused, so that every acquired buffer is all NaN."""
        if nbytes <= 0 or nbytes + 2 * self._margin > self._queue.device.max_mem_alloc_size:
            return super().acquire(nbytes)
        contents = np.full(nbytes + 2 * self._margin, CANARY, np.uint8)
        contents[self._margin : -self._margin] = self.fill
        flags = cl.mem_flags.READ_WRITE | cl.mem_flags.COPY_HOST_PTR
        parent = cl.Buffer(self._context, flags, hostbuf=contents)
        buffer = parent.get_sub_region(self._margin, nbytes)
        self._parents[buffer.int_ptr] = (parent, buffer, nbytes)
        self._in_use[buffer.int_ptr] = buffer
        self.in_use_bytes += nbytes
        self.allocated_bytes += nbytes
        self.peak_bytes = max(self.peak_bytes, self.allocated_bytes)
        return buffer

    def trampled(self) -> list[str]:
        """What was written outside its buffer; forgets buffers that are no longer in use."""
        if self._parents:
            self._queue.finish()
        found = []
        margin = np.empty(self._margin, np.uint8)
        for address, (parent, _, nbytes) in list(self._parents.items()):
            for side, start in (("before", 0), ("after", self._margin + nbytes)):
                cl.enqueue_copy(self._queue, margin, parent, src_offset=start)
                wrong = np.flatnonzero(margin != CANARY)
                if wrong.size:
                    found.append(f"{wrong.size} bytes written {side} a buffer of {nbytes}, first at {wrong[0]}")
            if address not in self._in_use:
                del self._parents[address]
        self.trim()
        return found


class DeviceOpener:
    """Opens devices with canaries and closes them at the end of the session."""

    def __init__(self) -> None:
        self.opened: list[Device] = []

    def __call__(self, info: DeviceInfo, **options: Any) -> Device:
        """Like ``Device.open(info.index, ...)``, with pass signatures checked."""
        if width := os.environ.get("CLDOF_TEST_LANES"):
            options.setdefault("lanes", int(width))
        device = Device.open(info.index, check_signatures=True, **options)
        self.opened.append(device)
        device.pool = CanaryPool(device.context, device.queue, shares_memory=device.pool.shares_memory)
        return device


@pytest.fixture(scope="session")
def open_device() -> Iterator[DeviceOpener]:
    """Open further devices: ``open_device(device.info, profiling=True)``; closed when the session ends."""
    opener = DeviceOpener()
    yield opener
    for device in opener.opened:
        device.close()


@pytest.fixture(autouse=True)
def _canaries(open_device: DeviceOpener) -> Iterator[None]:
    yield
    found = [what for device in open_device.opened for what in device.pool.trampled()]  # type: ignore[attr-defined]
    assert not found, f"a kernel wrote outside its buffers: {found}"


@pytest.fixture(scope="session", params=_PARAMS or [pytest.param(None, id="no-device")])
def device_info(request: pytest.FixtureRequest) -> DeviceInfo:
    """Every OpenCL device of this machine in turn."""
    if request.param is None:
        if os.environ.get("CLDOF_REQUIRE_DEVICE") == "1":
            pytest.fail(f"CLDOF_REQUIRE_DEVICE=1, but {_WHY_NONE}")
        pytest.skip(_WHY_NONE)
    return request.param  # type: ignore[no-any-return]


@pytest.fixture(scope="session")
def device(device_info: DeviceInfo, open_device: Callable[..., Device]) -> Device:
    """A device with an in-order queue."""
    return open_device(device_info)


@pytest.fixture(scope="session")
def out_of_order_device(device_info: DeviceInfo, open_device: Callable[..., Device]) -> Device:
    """A device with an out-of-order queue."""
    device = open_device(device_info, out_of_order=True)
    if not device.is_out_of_order:
        pytest.skip(f"{device_info.name} has no out-of-order queues")
    return device
