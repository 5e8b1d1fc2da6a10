"""What is shipped and required, as far as that shows without a build; the rest is `make test-install`."""

from __future__ import annotations

import os
import subprocess
import sys
from configparser import ConfigParser
from pathlib import Path

import pytest
from packaging.requirements import Requirement

import cldof
from cldof.host.drivers import driver_advice
from tests.tools.install import DRIVERS, PLATFORMS, ROOT, Platform, package_files, supported_pythons

CONFIG = ConfigParser()
CONFIG.read(ROOT / "setup.cfg", encoding="utf-8")
EXTRAS = CONFIG["options.extras_require"]


def requirements(text: str) -> list[Requirement]:
    return [Requirement(line) for line in text.splitlines() if line.strip()]


def wanted(text: str, platform: Platform, python: str = "3.12") -> dict[str, Requirement]:
    """What is installed there; a package that is asked for twice is a mistake."""
    environment = {**platform.markers, "python_version": python, "python_full_version": f"{python}.1"}
    needed = [one for one in requirements(text) if one.marker is None or one.marker.evaluate(environment)]
    names = [one.name.lower() for one in needed]
    assert len(set(names)) == len(names)
    return dict(zip(names, needed, strict=True))


def test_python_m_cldof_is_cldof(tmp_path: Path) -> None:
    def says(*arguments: str) -> tuple[int, str, str]:
        command = [sys.executable, "-W", "error", "-m", "cldof", *arguments]
        done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, env=environment)
        return done.returncode, done.stdout, done.stderr

    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    assert says("--version") == (0, f"cldof {cldof.__version__}\n", "")
    code, out, err = says("render", "no such scene", "-o", "out.png")
    assert (code, out) == (2, "") and err.startswith("cldof: ")  # its exit code is main's
    assert says()[2].startswith("usage: cldof ")


def test_every_file_of_the_package_is_shipped() -> None:
    """setuptools takes modules of folders with ``__init__.py`` and what ``package_data`` matches."""
    packages = {path.parent for path in (ROOT / "cldof").rglob("__init__.py")}
    shipped = {path for package in packages for path in package.glob("*.py")}
    for name, patterns in CONFIG["options.package_data"].items():
        folder = ROOT.joinpath(*name.split("."))
        assert folder in packages
        for pattern in patterns.split(","):
            matches = set(folder.glob(pattern.strip()))
            assert matches, f"{name}: {pattern.strip()} matches nothing"
            shipped |= matches
    assert {path.relative_to(ROOT).as_posix() for path in shipped} == package_files(ROOT)


def test_the_package_says_that_it_is_typed() -> None:
    assert "cldof/py.typed" in package_files(ROOT)


@pytest.mark.parametrize("name", sorted(PLATFORMS))
def test_each_system_gets_the_driver_that_pip_has_for_it(name: str) -> None:
    platform = PLATFORMS[name]
    core = wanted(CONFIG["options"]["install_requires"], platform)
    drivers = {driver for driver in DRIVERS if driver in core}
    if "pocl" in core["pyopencl"].extras:
        drivers.add("pocl-binary-distribution")
    assert drivers == {platform.driver} - {None}
    advice = driver_advice(platform.markers["sys_platform"], platform.markers["platform_machine"])
    assert ("intel-opencl-rt" in advice) == ("intel-opencl-rt" in drivers)
    assert ("pyopencl[pocl]" in advice) == ("pocl-binary-distribution" in drivers)


@pytest.mark.parametrize("name", sorted(PLATFORMS))
def test_extras_have_what_exists_for_a_system(name: str) -> None:
    platform = PLATFORMS[name]
    intel = set(wanted(EXTRAS["intel"], platform))
    assert intel == {
        "Linux x86-64": {"intel-opencl-rt", "intel-cmplr-lib-rt"},  # the second has libimf, which the first links to
        "Windows amd64": {"intel-opencl-rt"},
    }.get(name, set())
    # embreex has no wheel for Linux on Arm, and the test that needs it skips where it is missing.
    assert ("embreex" in wanted(EXTRAS["test"], platform)) == (name != "Linux aarch64")


def test_every_requirement_parses_for_every_python() -> None:
    pythons = supported_pythons()
    assert pythons[0] == CONFIG["options"]["python_requires"].removeprefix(">=")
    for text in (CONFIG["options"]["install_requires"], *EXTRAS.values()):
        for platform in PLATFORMS.values():
            for python in pythons:
                wanted(text, platform, python)
