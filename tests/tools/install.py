"""Does cldof install and run where its repository is not? ``python -m tests.tools.install [runs|platforms]``

``runs`` builds an sdist and from that a wheel, installs each into an environment of its own and runs the command line
there, with nothing on stderr. ``platforms`` resolves what it requires for systems that this machine is not: a wheel has
to exist of every package, but of those named in `_SOURCE_ONLY`. Prints a line per check; exits with 1 if one fails.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tarfile
import tempfile
import time
import zipfile
from collections.abc import Iterator, Sequence
from configparser import ConfigParser
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from PIL import Image

import cldof

__all__ = ["DRIVERS", "PLATFORMS", "ROOT", "Platform", "main", "package_files", "supported_pythons"]

ROOT = Path(__file__).parents[2]
# Packages that are drivers, or belong to one.
DRIVERS = {"pocl-binary-distribution", "intel-opencl-rt"}
# Pure Python that was never published as a wheel: pyrender 0.1.45 wants this PyOpenGL and no other.
_SOURCE_ONLY = {"pyopengl": "3.1.0"}
_EXTRAS = ("", "test,intel")
_NOT_SHIPPED = shutil.ignore_patterns(".*", "__pycache__", "out", "build", "dist", "*.egg-info", "results")
_FRAME = ("--size", "96x64", "--quiet")


@dataclass(frozen=True)
class Platform:
    """A system that cldof can be installed on.

    Parameters
    ----------
    tag : str
        What uv calls it; for Linux with the glibc of Debian 10 and RHEL 8, the oldest that pyopencl's wheels run on.
    markers : dict
        What an interpreter there says of itself.
    driver : str, optional
        The driver that comes with `cldof`; None where there is no wheel of one that works by itself.
    """

    tag: str
    markers: dict[str, str]
    driver: str | None


def _markers(sys_platform: str, platform_system: str, platform_machine: str, os_name: str) -> dict[str, str]:
    return {
        "sys_platform": sys_platform,
        "platform_system": platform_system,
        "platform_machine": platform_machine,
        "os_name": os_name,
    }


PLATFORMS = {
    "Linux x86-64": Platform(
        "x86_64-manylinux_2_28", _markers("linux", "Linux", "x86_64", "posix"), "pocl-binary-distribution"
    ),
    "Linux aarch64": Platform("aarch64-manylinux_2_28", _markers("linux", "Linux", "aarch64", "posix"), None),
    "macOS arm64": Platform("aarch64-apple-darwin", _markers("darwin", "Darwin", "arm64", "posix"), None),
    "Windows amd64": Platform("x86_64-pc-windows-msvc", _markers("win32", "Windows", "AMD64", "nt"), "intel-opencl-rt"),
}


class CheckError(Exception):
    """What a check found wrong, in words."""


class Checks:
    """Prints a line per check and counts those that failed."""

    def __init__(self) -> None:
        self.failed = 0

    @contextmanager
    def check(self, name: str) -> Iterator[None]:
        """One check; a :class:`CheckError` in the block is its failure."""
        start = time.perf_counter()
        try:
            yield
        except CheckError as error:
            self.failed += 1
            print(f"FAILED  {name}: {error}", flush=True)
        else:
            print(f"ok      {name} ({time.perf_counter() - start:.1f} s)", flush=True)


def package_files(root: Path) -> set[str]:
    """Every file of the package in a tree, as ``cldof/...``."""
    paths = (path for path in (root / "cldof").rglob("*") if path.is_file() and "__pycache__" not in path.parts)
    return {path.relative_to(root).as_posix() for path in paths}


def supported_pythons() -> list[str]:
    """The versions that the package says it is for."""
    config = ConfigParser()
    config.read(ROOT / "setup.cfg", encoding="utf-8")
    versions = (line.rpartition(":: ")[2] for line in config["metadata"]["classifiers"].split("\n"))
    return [version for version in versions if version.startswith("3.")]


def _output(command: Sequence[str | Path], cwd: Path, environment: dict[str, str] | None = None) -> tuple[str, str]:
    """stdout and stderr of a command that has to succeed."""
    done = subprocess.run(command, cwd=cwd, env=environment, capture_output=True, text=True)
    if done.returncode:
        said = (done.stderr.strip() or done.stdout.strip())[-2000:]
        raise CheckError(f"{' '.join(map(str, command))} ended with {done.returncode}:\n{said}")
    return done.stdout, done.stderr


def _environment(folder: Path) -> Path:
    """A new environment; returns the folder of its commands."""
    _output([sys.executable, "-m", "venv", folder], folder.parent)
    return folder / ("Scripts" if os.name == "nt" else "bin")


def _build(tools: Path, scratch: Path) -> dict[str, Path]:
    """The sdist, and the wheel made of it, of a copy of the tree: setuptools writes into the one that it builds."""
    tree, built = scratch / "tree", scratch / "dist"
    shutil.copytree(ROOT, tree, ignore=_NOT_SHIPPED)
    _output([tools / "python", "-m", "build", "--outdir", built, tree], scratch)
    return {"wheel": next(built.glob("*.whl")), "sdist": next(built.glob("*.tar.gz"))}


def _check_contents(kind: str, archive: Path) -> None:
    """All of the package and no other package."""
    if kind == "wheel":
        with zipfile.ZipFile(archive) as wheel:
            names = {name for name in wheel.namelist() if ".dist-info/" not in name}
    else:
        with tarfile.open(archive) as sdist:
            names = {member.name.partition("/")[2] for member in sdist.getmembers() if member.isfile()}
        names = {name for name in names if "/" in name and not name.startswith("cldof.egg-info/")}
    expected = package_files(ROOT)
    if names != expected:
        raise CheckError(f"missing {sorted(expected - names)}, not of the package {sorted(names - expected)}")


def _clean_environment(scratch: Path) -> dict[str, str]:
    """Variables without those that lead back to the repository, its environment or what was built before."""
    kept = {name: value for name, value in os.environ.items() if not name.startswith(("PYTHON", "CLDOF_", "POCL_"))}
    for name in ("VIRTUAL_ENV", "PIP_REQUIRE_VIRTUALENV", "DISPLAY"):
        kept.pop(name, None)
    return {**kept, "XDG_CACHE_HOME": str(scratch / "cache"), "LOCALAPPDATA": str(scratch / "cache")}


def _check_runs(checks: Checks, kind: str, archive: Path, scratch: Path) -> None:
    commands, work = None, scratch / f"work-{kind}"
    work.mkdir()
    with checks.check(f"{kind} installs into an empty environment"):
        commands = _environment(scratch / kind)
        _output([commands / "python", "-m", "pip", "install", "-q", "--disable-pip-version-check", archive], work)
    if commands is None:
        return
    python, script, variables = commands / "python", commands / "cldof", _clean_environment(scratch)

    def run(*command: str | Path) -> str:
        out, err = _output(command, work, variables)
        if err:
            raise CheckError(f"{' '.join(map(str, command))} wrote to stderr:\n{err[:2000]}")
        return out

    def same(one: Path, other: Path) -> None:
        with Image.open(one) as first, Image.open(other) as second:
            if first.size != (96, 64):
                raise CheckError(f"{one.name} is {first.size}, not 96x64")
            if first.convert("RGBA").tobytes() != second.convert("RGBA").tobytes():
                raise CheckError(f"{one.name} and {other.name} differ")

    with checks.check(f"{kind} is imported from its environment, with types"):
        found = Path(run(python, "-c", "import cldof; print(cldof.__file__)").strip()).parent
        if (scratch / kind).resolve() not in found.resolve().parents:
            raise CheckError(f"cldof is imported from {found}")
        if not (found / "py.typed").is_file():
            raise CheckError(f"{found} has no py.typed")
    for words in (["--version"], ["methods"], ["scenes"], ["devices"]):
        with checks.check(f"{kind}: cldof {words[0]}, python -m cldof {words[0]}"):
            said = run(script, *words)
            if not said.strip() or run(python, "-m", "cldof", *words) != said:
                raise CheckError(f"cldof says {said!r}, python -m cldof something else")
            if words == ["--version"] and said.split() != ["cldof", cldof.__version__]:
                raise CheckError(f"version is {said!r}, that of the tree {cldof.__version__}")
    with checks.check(f"{kind}: cldof render"):
        run(script, "render", "row", "-o", "script.png", *_FRAME)
    with checks.check(f"{kind}: python -m cldof render, the same picture"):
        run(python, "-m", "cldof", "render", "row", "-o", "module.png", *_FRAME)
        same(work / "script.png", work / "module.png")
    with checks.check(f"{kind}: cldof render --method auto"):
        run(script, "render", "row", "-o", "auto.png", "--method", "auto", "--max-error", "30dB", *_FRAME)
        same(work / "auto.png", work / "auto.png")


def _resolved(uv: Path, wheel: Path, extra: str, platform: Platform, python: str, scratch: Path) -> dict[str, str]:
    """Packages and versions that an installation there takes."""
    wanted = scratch / "wanted.txt"
    wanted.write_text(f"cldof{f'[{extra}]' if extra else ''} @ {wheel.as_uri()}\n", encoding="utf-8")
    command = [uv, "pip", "compile", "-q", "--no-annotate", "--no-header", "--python-platform", platform.tag]
    command += ["--python-version", python, "--only-binary", ":all:"]
    for name in _SOURCE_ONLY:
        command += ["--no-binary", name]
    out, _ = _output([*command, wanted], scratch)
    return dict(line.strip().split("==") for line in out.splitlines() if "==" in line)


def _check_platforms(checks: Checks, uv: Path, wheel: Path, scratch: Path) -> None:
    for name, platform in PLATFORMS.items():
        for extra in _EXTRAS:
            pythons = supported_pythons()
            with checks.check(f"{name}: cldof{f'[{extra}]' if extra else ''} resolves for Python {', '.join(pythons)}"):
                for python in pythons:
                    found = _resolved(uv, wheel, extra, platform, python, scratch)
                    drivers = {driver for driver in DRIVERS if driver in found}
                    if not extra and drivers != ({platform.driver} - {None}):
                        raise CheckError(f"its drivers are {drivers or 'none'}, not {platform.driver}")
                    for source, version in _SOURCE_ONLY.items():
                        if found.get(source) != version:
                            raise CheckError(f"{source} is {found.get(source)}, not {version}, which has no wheel")


def main(argv: Sequence[str] | None = None) -> int:
    """Run the checks; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m tests.tools.install", description=__doc__)
    parser.add_argument("parts", nargs="*", metavar="PART", help="runs, platforms; both unless given")
    parts: list[str] = parser.parse_args(argv).parts or ["runs", "platforms"]
    if unknown := set(parts) - {"runs", "platforms"}:
        parser.error(f"no such part: {', '.join(sorted(unknown))}")
    checks = Checks()
    with tempfile.TemporaryDirectory(prefix="cldof-install-") as name:
        scratch = Path(name)
        archives: dict[str, Path] = {}
        with checks.check("sdist and wheel are built"):
            tools = _environment(scratch / "tools")
            _output([tools / "python", "-m", "pip", "install", "-q", "build", "uv"], scratch)
            archives = _build(tools, scratch)
        if not archives:
            return 1
        for kind, archive in archives.items():
            with checks.check(f"{kind} holds the package, all of it and nothing else"):
                _check_contents(kind, archive)
            if "runs" in parts:
                _check_runs(checks, kind, archive, scratch)
        if "platforms" in parts:
            _check_platforms(checks, tools / "uv", archives["wheel"], scratch)
    print(f"{checks.failed} failed" if checks.failed else "all passed")
    return 1 if checks.failed else 0


if __name__ == "__main__":
    sys.exit(main())
