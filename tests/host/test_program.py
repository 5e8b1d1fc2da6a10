"""Include expansion, build errors, and caches that never get in the way."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from cldof.errors import BuildError, InputError
from cldof.host import opencl as cl
from cldof.host import program as program_module
from cldof.host.caches import default_cache_dir
from cldof.host.device import Device, DeviceInfo
from cldof.host.program import ProgramCache, expand, numbered
from cldof.host.quirks import Effect

KERNEL = "__kernel void toy_one(__global int *out) { out[0] = 1; }\n"


@pytest.fixture
def sources(tmp_path: Path) -> Path:
    directory = tmp_path / "kernel files"
    directory.mkdir()
    return directory


@pytest.fixture
def cached(
    device: Device, sources: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Callable[[], ProgramCache]:
    """Caches with a disk part, also where the driver has one."""
    monkeypatch.setattr(program_module, "effects_of", lambda platform, device: frozenset())
    return lambda: ProgramCache(device.context, device._cl_device, sources, tmp_path / "cache")


def test_includes_expand_with_line_numbers(sources: Path) -> None:
    (sources / "toy.cl").write_text('first\n  #  include "a.clh" // why\nlast\n')
    (sources / "a.clh").write_text('#include "b.clh"\nin a\n')
    (sources / "b.clh").write_text("in b\n")
    assert expand("toy", (("N", 3), ("SCALE", 0.5), ("ON", True)), sources).splitlines() == [
        "#define N 3",
        "#define SCALE 0x1.0000000000000p-1f",
        "#define ON 1",
        '#line 1 "toy.cl"',
        "first",
        '#line 1 "a.clh"',
        '#line 1 "b.clh"',
        "in b",
        '#line 2 "a.clh"',
        "in a",
        '#line 3 "toy.cl"',
        "last",
    ]


def test_numbers_are_those_of_the_files(sources: Path) -> None:
    (sources / "toy.cl").write_text('first\n#include "a.clh"\nlast\n')
    (sources / "a.clh").write_text("in a\n")
    assert numbered(expand("toy", (("N", 3),), sources)).splitlines() == [
        "<defines>:1    | #define N 3",
        "toy.cl:1    | first",
        "a.clh:1    | in a",
        "toy.cl:3    | last",
    ]


def test_missing_and_circular_files_are_named(sources: Path) -> None:
    with pytest.raises(BuildError, match=r"toy\.cl does not exist"):
        expand("toy", (), sources)
    (sources / "toy.cl").write_text('#include "a.clh"\n')
    with pytest.raises(BuildError, match=r"a\.clh does not exist.*included by toy\.cl"):
        expand("toy", (), sources)
    (sources / "a.clh").write_text('#include "a.clh"\n')
    with pytest.raises(BuildError, match=r"toy\.cl -> a\.clh -> a\.clh"):
        expand("toy", (), sources)


def test_odd_defines_are_refused(sources: Path) -> None:
    (sources / "toy.cl").write_text(KERNEL)
    for value in ([1], float("inf"), None):
        with pytest.raises(InputError, match=r"N = .* must be"):
            expand("toy", (("N", value),), sources)


def test_defines_are_exact(sources: Path) -> None:
    (sources / "toy.cl").write_text("")
    defines = (("A", -3), ("B", np.float32(-0.5)), ("C", np.int64(7)), ("D", "x + y"))
    assert expand("toy", defines, sources).splitlines()[:4] == [
        "#define A (-3)",
        "#define B (-0x1.0000000000000p-1f)",
        "#define C 7",
        "#define D x + y",
    ]


def test_build_errors_can_be_read(cached: Callable[[], ProgramCache], sources: Path, device: Device) -> None:
    (sources / "toy.cl").write_text('// one\n#include "a.clh"\n' + KERNEL)
    (sources / "a.clh").write_text("static int f(void) { return undeclared_thing; }\n")
    with pytest.raises(BuildError) as caught:
        cached().program("toy", (("N", 3),))
    message = str(caught.value)
    assert device.info.name in " ".join(message.split())
    assert "-cl-std=CL1.2" in message
    assert "a.clh:1    | static int f(void)" in message
    log = message.split("--- compiler log")[1]
    assert "undeclared_thing" in log
    assert "a.clh:1" in log


def test_an_unknown_kernel_lists_those_there_are(cached: Callable[[], ProgramCache], sources: Path) -> None:
    (sources / "toy.cl").write_text(KERNEL)
    with pytest.raises(BuildError, match=r"no kernel 'toy_two'; it has toy_one"):
        cached().kernel("toy", "toy_two")


def test_kernels_say_that_they_use_vectors_where_a_driver_for_cpus_needs_to_be_told(
    device: Device, sources: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (sources / "toy.cl").write_text(KERNEL)
    texts = []
    for effects in (frozenset(), frozenset({Effect.VECTORIZES_VECTORS})):
        monkeypatch.setattr(program_module, "effects_of", lambda platform, device, effects=effects: effects)
        cache = ProgramCache(device.context, device._cl_device, sources, tmp_path / "cache", from_source=True)
        assert cache.kernel("toy", "toy_one").num_args == 1
        texts.append(cache.program("toy").get_info(cl.program_info.SOURCE))
    assert "vec_type_hint" not in texts[0]
    assert ("vec_type_hint(float16)" in texts[1]) == device.traits.is_cpu


def test_programs_are_built_once_kernels_are_new(
    cached: Callable[[], ProgramCache], sources: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (sources / "toy.cl").write_text(KERNEL)
    cache = cached()
    first = cache.program("toy")
    monkeypatch.setattr(cache, "_build", None)
    assert cache.program("toy") is first
    assert cache.kernel("toy", "toy_one") is not cache.kernel("toy", "toy_one")


def test_sources_defines_and_files_are_part_of_the_key(cached: Callable[[], ProgramCache], sources: Path) -> None:
    (sources / "toy.cl").write_text(KERNEL)
    cache = cached()
    first = cache.program("toy")
    variants = [cache.program("toy", (("N", value),)) for value in (1, 1.0, 2)]
    assert len({program.int_ptr for program in (first, *variants)}) == 4
    (sources / "toy.cl").write_text(KERNEL.replace("toy_one", "toy_two"))
    assert cache.program("toy") is first
    cache.clear()
    assert cache.kernel("toy", "toy_two").num_args == 1  # not the binary on disk


def test_disk_cache_is_used(
    cached: Callable[[], ProgramCache], sources: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (sources / "toy.cl").write_text(KERNEL)
    cached().program("toy")
    assert len(list((tmp_path / "cache").iterdir())) == 1
    loaded = []
    original = ProgramCache._from_binary
    monkeypatch.setattr(
        ProgramCache, "_from_binary", lambda self, binary: loaded.append(binary) or original(self, binary)
    )
    assert cached().kernel("toy", "toy_one").num_args == 1
    assert len(loaded) == 1


@pytest.mark.parametrize("damage", ["cut off", "empty", "changed", "a directory"])
def test_a_damaged_disk_cache_is_ignored(
    cached: Callable[[], ProgramCache], sources: Path, tmp_path: Path, damage: str
) -> None:
    (sources / "toy.cl").write_text(KERNEL)
    cached().program("toy")
    (file,) = (tmp_path / "cache").iterdir()
    content = file.read_bytes()
    if damage == "a directory":
        file.unlink()
        file.mkdir()
    else:
        file.write_bytes({"cut off": content[:-9], "empty": b"", "changed": content[:-1] + b"?"}[damage])
    assert cached().kernel("toy", "toy_one").num_args == 1
    assert [path.name for path in (tmp_path / "cache").iterdir()] == [file.name]  # no temporary file stays


def test_a_binary_that_the_driver_refuses_is_built_anew(
    cached: Callable[[], ProgramCache], sources: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (sources / "toy.cl").write_text(KERNEL)
    monkeypatch.setattr(program_module._DiskCache, "load", lambda self, key: b"not a program")
    assert cached().kernel("toy", "toy_one").num_args == 1


def test_a_cache_directory_that_cannot_be_made_is_no_error(
    cached: Callable[[], ProgramCache], sources: Path, tmp_path: Path
) -> None:
    (sources / "toy.cl").write_text(KERNEL)
    (tmp_path / "cache").write_text("a file is in the way")
    assert cached().kernel("toy", "toy_one").num_args == 1


def test_drivers_with_a_cache_get_no_second_one(device_info: DeviceInfo, device: Device, tmp_path: Path) -> None:
    if "Portable Computing Language" not in device_info.platform:
        pytest.skip("about PoCL")
    assert ProgramCache(device.context, device._cl_device, tmp_path)._disk is None


def test_cache_directory_follows_the_environment(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("CLDOF_CACHE_DIR", str(tmp_path))
    assert default_cache_dir() == tmp_path
    monkeypatch.delenv("CLDOF_CACHE_DIR")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert default_cache_dir() == tmp_path / "cldof"


def test_compiler_chatter_is_no_warning(cached: Callable[[], ProgramCache], sources: Path) -> None:
    """Warnings are errors in tests, so that this builds shows that none leaks."""
    (sources / "toy.cl").write_text("#warning said by the test\n" + KERNEL)
    cached().program("toy")
