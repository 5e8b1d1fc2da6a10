"""Drivers that pip installs: found where the system does not look, told what they do not find out."""

from __future__ import annotations

import os
from pathlib import Path
from types import SimpleNamespace

import pytest

from cldof.host import drivers
from cldof.host.drivers import driver_advice, prepare_drivers

VARIABLES = ("OCL_ICD_FILENAMES", "CL_CONFIG_CPU_TARGET_ARCH")


@pytest.fixture(autouse=True)
def _plain(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    for name in VARIABLES:
        monkeypatch.setenv(name, "")  # set first, so that monkeypatch puts it back
        monkeypatch.delenv(name)
    monkeypatch.setattr(drivers, "_CPUINFO", tmp_path / "no processor")


def settings() -> dict[str, str]:
    prepare_drivers()
    return {name: os.environ[name] for name in VARIABLES if name in os.environ}


@pytest.mark.parametrize(
    ("system", "machine", "driver"),
    [
        ("linux", "x86_64", "pyopencl[pocl]"),
        ("linux", "aarch64", "pocl-opencl-icd"),
        ("win32", "AMD64", "intel-opencl-rt"),
        ("win32", "ARM64", "conda-forge"),
        ("darwin", "arm64", "driver of macOS"),
        ("freebsd14", "amd64", "conda-forge"),
    ],
)
def test_advice_is_for_the_system(system: str, machine: str, driver: str) -> None:
    advice = driver_advice(system, machine)
    assert driver in advice and "pip install" in advice
    assert ("pyopencl[pocl]" in advice) == (driver == "pyopencl[pocl]")  # pip fails on it everywhere else


def install_intel(site: Path) -> None:
    """What pip writes of Intel's wheel for Windows."""
    info = site / "intel_opencl_rt-2026.2.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: intel-opencl-rt\nVersion: 2026.2.0\n")
    (info / "RECORD").write_text("../../Library/bin/OpenCL.dll,,\n../../Library/bin/intelocl64.dll,,\n")


@pytest.fixture
def windows(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(drivers, "sys", SimpleNamespace(platform="win32"))
    monkeypatch.setattr(drivers, "_is_amd_with_avx2", lambda: False)


def test_elsewhere_the_user_chooses(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    install_intel(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(drivers, "sys", SimpleNamespace(platform="linux"))
    assert settings() == {}


@pytest.mark.usefixtures("windows")
def test_windows_is_told_where_pip_put_intels_driver(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    site = tmp_path / "Lib" / "site-packages"
    install_intel(site)
    monkeypatch.syspath_prepend(site)
    assert settings() == {"OCL_ICD_FILENAMES": str(tmp_path / "Library" / "bin" / "intelocl64.dll")}


@pytest.mark.usefixtures("windows")
def test_windows_without_intels_driver(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(name: str) -> None:
        raise drivers.metadata.PackageNotFoundError(name)

    monkeypatch.setattr(drivers.metadata, "files", missing)
    assert settings() == {}


@pytest.mark.usefixtures("windows")
def test_what_the_user_set_stays(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    install_intel(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(drivers, "_is_amd_with_avx2", lambda: True)
    chosen = dict.fromkeys(VARIABLES, "mine")
    for name, value in chosen.items():
        monkeypatch.setenv(name, value)
    assert settings() == chosen


@pytest.mark.parametrize(
    ("cpuinfo", "expected"),
    [
        ("vendor_id\t: AuthenticAMD\nflags\t: fpu avx avx2 bmi2\n", {"CL_CONFIG_CPU_TARGET_ARCH": "core-avx2"}),
        ("vendor_id\t: AuthenticAMD\nflags\t: fpu avx bmi1\n", {}),
        ("vendor_id\t: GenuineIntel\nflags\t: fpu avx avx2 avx512f\n", {}),
        ("CPU implementer\t: 0x41\nFeatures\t: fp asimd\n", {}),
        (None, {}),
    ],
    ids=["amd", "old-amd", "intel", "arm", "no-linux"],
)
def test_intels_runtime_is_told_what_amd_processors_have(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, cpuinfo: str | None, expected: dict[str, str]
) -> None:
    if cpuinfo is not None:
        (tmp_path / "cpuinfo").write_text(cpuinfo)
    monkeypatch.setattr(drivers, "sys", SimpleNamespace(platform="linux"))
    monkeypatch.setattr(drivers, "_CPUINFO", tmp_path / "cpuinfo")
    assert settings() == expected
