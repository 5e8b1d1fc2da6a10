"""Every script in examples/ runs as a user would run it, at a small size."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from PIL import Image

from cldof.host.device import DeviceInfo
from tests.opengl import require_opengl

ROOT = Path(__file__).parent.parent
ARGUMENTS: dict[str, list[str]] = {
    "explain": [],
    "render_npz": ["image.png", "--size", "96"],
    "render_scene": ["image.png", "--size", "96", "--scene", "floating"],
    "glossy": ["image.png", "--size", "96"],
    "loop": ["--size", "96", "--frames", "4"],
    "rack_focus": [".", "--size", "96", "--frames", "4"],
}
WITHOUT_OPENGL = {"explain", "render_npz"}


def test_all_examples_are_run() -> None:
    assert {path.stem for path in (ROOT / "examples").glob("*.py")} == set(ARGUMENTS)


@pytest.mark.parametrize("name", sorted(ARGUMENTS))
def test_example(name: str, device_info: DeviceInfo, tmp_path: Path) -> None:
    if name not in WITHOUT_OPENGL:
        require_opengl()
    environment = {**os.environ, "CLDOF_DEVICE": str(device_info.index)}
    environment["PYTHONPATH"] = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")]))
    command = [sys.executable, "-W", "error", str(ROOT / "examples" / f"{name}.py"), *ARGUMENTS[name]]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    assert done.stdout and not done.stderr
    if "image.png" in ARGUMENTS[name]:
        with Image.open(tmp_path / "image.png") as picture:
            assert picture.size == (96, 96)
    elif name == "explain":
        assert done.stdout.count("Expected work") == 3
    else:
        assert done.stdout.count("ms") == 4
