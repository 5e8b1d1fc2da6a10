"""One OpenGL context for the whole session; tests that need none do not ask for it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import trimesh

from cldof import Camera
from cldof.capture.peel import DepthPeeler
from cldof.capture.scene import Material, Node
from cldof.errors import CaptureError

MODELS = Path(__file__).resolve().parents[2].parent / "shared" / "scenes"


@pytest.fixture(scope="session")
def peeler() -> Iterator[DepthPeeler]:
    """Shared by all tests, as a context costs more than a test."""
    try:
        peeler = DepthPeeler(64, 64)
    except CaptureError as error:
        pytest.skip(str(error))
    with peeler:
        yield peeler


@pytest.fixture
def models() -> Path:
    """The folder of real models beside the repository."""
    if not MODELS.is_dir():
        pytest.skip(f"no models in {MODELS}")
    return MODELS


def camera_at(
    width: int = 64, height: int = 64, yfov_deg: float = 45.0, eye: tuple[float, float, float] = (0.0, 0.0, 0.0)
) -> Camera:
    """Looking along -z from ``eye``."""
    pose = np.eye(4)
    pose[:3, 3] = eye
    return Camera(width, height, yfov_deg, near=0.01, pose=pose)


def flat(color: tuple[float, ...] = (1.0, 1.0, 1.0), **options: object) -> Material:
    """An unlit, double-sided material, RGB or RGBA."""
    rgba = (*color, 1.0)[:4]
    return Material(base_color=rgba, unlit=True, **{"double_sided": True, **options})  # type: ignore[arg-type]


def quad(depth: float, half: float = 10.0, material: Material | None = None, at: tuple[float, float] = (0, 0)) -> Node:
    """A square across the axis of a camera at the origin, facing it, with texture coordinates (0, 0) to (1, 1)."""
    x, y = at
    corners = [(x - half, y - half), (x + half, y - half), (x + half, y + half), (x - half, y + half)]
    mesh = trimesh.Trimesh([(*c, -depth) for c in corners], [(0, 1, 2), (0, 2, 3)], process=False)
    mesh.visual = trimesh.visual.TextureVisuals(uv=np.array([(0, 0), (1, 0), (1, 1), (0, 1)], dtype=float))
    return Node(mesh, np.eye(4), material or flat())
