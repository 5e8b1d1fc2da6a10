"""Imports point one way, and importing the library needs neither OpenCL nor OpenGL.

The rooms and who may enter which are those of the design: ``cli -> renderer -> planner, methods -> host``; data
modules import only each other; ``capture`` and ``host`` know nothing of one another; ``host`` knows nothing of lenses.
"""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parent.parent / "cldof"
DATA = {"errors", "lens", "camera", "frame", "files", "images", "lighting"}

# What each room may import of the project. A room is a module or a package right below cldof.
ALLOWED = {
    **dict.fromkeys(DATA, DATA),
    "metrics": DATA,
    "capture": DATA | {"capture"},
    "kernels": {"kernels"},
    "host": {"host", "errors", "files", "kernels"},
    "methods": DATA | {"methods", "host", "kernels"},
    "planner": DATA | {"planner", "methods", "host"},
    "auto": DATA | {"auto", "planner"},
    "renderer": DATA | {"renderer", "auto", "planner", "methods", "host"},
}
# Packages that only some rooms may import, however deep inside a function.
FOREIGN = {
    "pyopencl": {"host"},
    "pyrender": {"capture"},
    "OpenGL": {"capture"},
    "pyglet": {"capture"},
    "trimesh": {"capture"},
}
MODULES = sorted(PACKAGE.rglob("*.py"))


def imported(path: Path) -> set[tuple[str, ...]]:
    """Absolute dotted names that a module imports, also inside functions and as ``import_module(".x", ...)``."""
    package = ("cldof", *path.relative_to(PACKAGE).parent.parts)
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {tuple(alias.name.split(".")) for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else ()
            module = (*base, *(node.module.split(".") if node.module else ()))
            found |= {(*module, alias.name) for alias in node.names}
        elif isinstance(node, ast.Call) and getattr(node.func, "id", "") == "import_module":
            target = node.args[0]
            if isinstance(target, ast.Constant):
                found.add(tuple(target.value.split(".")))
    return found


def room(path: Path) -> str:
    """Name of the module or package right below cldof."""
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def has_room(name: str) -> bool:
    """Whether there is such a module or package; other names are those of classes and functions."""
    return (PACKAGE / f"{name}.py").exists() or (PACKAGE / name).is_dir()


@pytest.mark.parametrize("path", MODULES, ids=lambda path: path.relative_to(PACKAGE).as_posix())
def test_imports_point_one_way(path: Path) -> None:
    allowed = ALLOWED.get(room(path))  # None: __init__, __main__ and cli may use everything
    for name in imported(path):
        assert room(path) in FOREIGN.get(name[0], {room(path)}), f"{path.name} imports {name[0]}"
        if allowed is not None and name[0] == "cldof" and len(name) > 1 and has_room(name[1]):
            assert name[1] in allowed, f"{room(path)} must not import cldof.{name[1]}"


def test_the_rule_is_about_something() -> None:
    """The parser finds relative imports of both kinds; a rule over nothing would always hold."""
    assert ("cldof", "errors", "DeviceError") in imported(PACKAGE / "host" / "device.py")
    assert ("cldof", "host", "hazards") in imported(PACKAGE / "host" / "scheduler.py")


BLOCKED = """
import sys

class Blocker:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in ("pyopencl", "pyrender", "trimesh", "OpenGL", "pyglet"):
            raise ImportError(f"{name} is blocked")

sys.meta_path.insert(0, Blocker())
"""


def run(code: str) -> None:
    command = [sys.executable, "-W", "error", "-c", BLOCKED + code]
    done = subprocess.run(command, cwd=PACKAGE.parent, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_library_imports_without_opencl_and_opengl() -> None:
    run("import cldof; cldof.Lens; cldof.Camera; cldof.LayeredFrame")


def test_missing_pyopencl_is_one_clear_error() -> None:
    run(
        "from cldof.host import buffers, device, hazards, launch, profile, program, quirks, scheduler\n"
        "from cldof import DeviceError\n"
        "for attempt in (device.Device.open, device.list_devices):\n"
        "    try:\n"
        "        attempt()\n"
        "    except DeviceError as error:\n"
        "        assert 'pip install' in str(error)\n"
        "    else:\n"
        "        raise SystemExit('no error')\n"
    )
