"""The accumulation reference against an independent ray tracer: Mitsuba 3's thin lens on two scenes that only glow.

Mitsuba shares nothing with this library but the definition of a thin lens: rays in place of rasters, its own lens and
pixel sampling, its own geometry. Both filter pixels with a box, so accumulation moves its views inside the pixel.

``pip install mitsuba`` runs this file; without it the tests are skipped. ``python -m
tests.capture.test_against_mitsuba`` prints the figures of docs/reference.md.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from cldof import Camera, Lens
from cldof.capture.accumulate import accumulate
from cldof.capture.peel import DepthPeeler
from cldof.capture.scene import Material, Node, Scene
from cldof.images import linear_from_srgb
from cldof.metrics import psnr

SAMPLES = 1024
SIZE = (120, 90)


def camera() -> Camera:
    """Off the axes, so that a wrong sign or axis shows."""
    eye, target = np.array((0.4, 0.5, 0.3)), np.array((0.0, 0.0, -3.0))
    back = (eye - target) / np.linalg.norm(eye - target)
    right = np.cross((0.0, 1.0, 0.0), back)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(back, right), back], axis=1)
    pose[:3, 3] = eye
    return Camera(*SIZE, 35.0, near=0.05, pose=pose)


def glowing(mesh: trimesh.Trimesh, colors: np.ndarray) -> Node:
    """A closed mesh with a colour for each vertex, 8-bit sRGB."""
    mesh = mesh.copy()
    rgba = np.concatenate([colors, np.full((len(colors), 1), 255)], axis=1).astype(np.uint8)
    mesh.visual = trimesh.visual.ColorVisuals(mesh, vertex_colors=rgba)
    return Node(mesh, material=Material((1.0, 1.0, 1.0, 1.0), unlit=True))


def box(extents: tuple[float, float, float], at: tuple[float, float, float], color: tuple[int, int, int]) -> Node:
    mesh = trimesh.creation.box(extents)
    mesh.apply_translation(at)
    return glowing(mesh, np.tile(color, (len(mesh.vertices), 1)))


def slats() -> tuple[Scene, Lens]:
    """Slats close to the lens, a card in focus, posts and a wall behind: plain colours, every kind of occlusion."""
    nodes = [box((0.05, 3.0, 0.02), (0.25 * n - 0.7, 0.3, -0.7), (200, 40 * n, 30)) for n in range(7)]
    nodes.append(box((0.9, 0.6, 0.05), (0.1, 0.1, -2.2), (240, 230, 60)))
    nodes += [box((0.12, 2.0, 0.12), (0.5 * n - 1.4, -0.3, -4.0), (30, 90 + 25 * n, 220)) for n in range(6)]
    nodes.append(box((30.0, 30.0, 0.1), (0.0, 0.0, -8.0), (70, 75, 90)))
    return Scene("slats", tuple(nodes)), Lens(0.04, 2.4)


def balls() -> tuple[Scene, Lens]:
    """Balls from 0.9 to 9 m with colours that vary over them, on a floor and before a wall."""
    random = np.random.default_rng(3)
    nodes = []
    for n in range(7):
        mesh = trimesh.creation.icosphere(3, 0.14 + 0.05 * n)
        mesh.apply_translation((0.33 * n - 0.25 * n % 1.1 - 0.35, 0.12 * (n % 3) - 0.05 * n, -0.6 - 0.25 * n * n))
        waves = np.sin(mesh.vertices @ random.normal(size=(3, 3)) * 9.0 / (1.0 + 0.3 * n) + random.random(3) * 6.0)
        nodes.append(glowing(mesh, 128.0 + 120.0 * waves))
    floor = trimesh.creation.box((24.0, 0.1, 24.0))
    floor.apply_translation((0.0, -1.0, -12.0))
    nodes.append(glowing(floor, random.integers(20, 250, (8, 3))))
    nodes.append(box((60.0, 60.0, 0.1), (0.0, 0.0, -14.0), (150, 170, 220)))
    return Scene("balls", tuple(nodes)), Lens(0.1, 2.0)


SCENES: dict[str, Callable[[], tuple[Scene, Lens]]] = {"slats": slats, "balls": balls}


def write_ply(path: Path, mesh: trimesh.Trimesh) -> None:
    """Positions in the world, linear colours as r, g, b, which Mitsuba reads as ``vertex_color``."""
    colors = linear_from_srgb(mesh.visual.vertex_colors[:, :3] / 255.0)
    lines = ["ply", "format ascii 1.0", f"element vertex {len(mesh.vertices)}"]
    lines += [f"property float {name}" for name in "xyzrgb"]
    lines += [f"element face {len(mesh.faces)}", "property list uchar int vertex_indices", "end_header"]
    lines += [" ".join(f"{v:.9g}" for v in (*p, *c)) for p, c in zip(mesh.vertices, colors, strict=True)]
    lines += [f"3 {a} {b} {c}" for a, b, c in mesh.faces]
    path.write_text("\n".join(lines) + "\n", encoding="ascii")


def ray_traced(mitsuba: Any, scene: Scene, view: Camera, lens: Lens, folder: Path) -> np.ndarray:
    """(H, W, 3), float64."""
    eye, forward, up = view.pose[:3, 3], -view.pose[:3, 2], view.pose[:3, 1]
    described: dict[str, Any] = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 1},
        "sensor": {
            "type": "thinlens",
            "fov": view.yfov_deg,
            "fov_axis": "y",
            "aperture_radius": lens.aperture_radius_m,
            "focus_distance": lens.focus_distance_m,
            "near_clip": view.near,
            "to_world": mitsuba.ScalarTransform4f().look_at(
                origin=eye.tolist(), target=(eye + forward).tolist(), up=up.tolist()
            ),
            "film": {
                "type": "hdrfilm",
                "width": view.width,
                "height": view.height,
                "rfilter": {"type": "box"},
                "pixel_format": "rgb",
                "component_format": "float32",
            },
            "sampler": {"type": "multijitter", "sample_count": SAMPLES},
        },
    }
    for number, node in enumerate(scene.nodes):
        file = folder / f"{number}.ply"
        write_ply(file, node.mesh)
        described[f"shape{number}"] = {
            "type": "ply",
            "filename": str(file),
            "face_normals": True,
            "emitter": {"type": "area", "radiance": {"type": "mesh_attribute", "name": "vertex_color"}},
        }
    return np.array(mitsuba.render(mitsuba.load_dict(described), seed=1), dtype=np.float64)[..., :3]


def both(mitsuba: Any, peeler: DepthPeeler, name: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Accumulated, ray traced, and the accumulated image of a pinhole."""
    scene, lens = SCENES[name]()
    mine = accumulate(peeler, scene, camera(), lens, SAMPLES, jitter=True).image
    pinhole = accumulate(peeler, scene, camera(), Lens(0.0, lens.focus_distance_m), 64, jitter=True).image
    with tempfile.TemporaryDirectory() as folder:
        theirs = ray_traced(mitsuba, scene, camera(), lens, Path(folder))
    return mine[..., :3].astype(np.float64), theirs, pinhole[..., :3].astype(np.float64)


def mean_difference(image: np.ndarray, reference: np.ndarray) -> float:
    """Mean absolute difference over the reference's mean."""
    return float(np.abs(image - reference).mean() / reference.mean())


@pytest.fixture(scope="module")
def mitsuba() -> Any:
    module = pytest.importorskip("mitsuba", reason="the optional check against Mitsuba 3: pip install mitsuba")
    module.set_variant("scalar_rgb")
    return module


@pytest.mark.parametrize("name", SCENES)
def test_agrees_with_a_ray_tracer(peeler: DepthPeeler, mitsuba: Any, name: str) -> None:
    mine, theirs, pinhole = both(mitsuba, peeler, name)
    assert mean_difference(mine, theirs) <= 0.005
    assert mine.mean(axis=(0, 1)) == pytest.approx(theirs.mean(axis=(0, 1)), rel=0.001)
    assert mean_difference(pinhole, theirs) > 0.03  # the lens matters in this scene
    # A picture shifted by a tenth of a pixel would be farther off than this.
    assert psnr(mine, theirs) > 45.0


if __name__ == "__main__":
    import mitsuba as module

    module.set_variant("scalar_rgb")
    with DepthPeeler(*SIZE) as drawer:
        for title in SCENES:
            found, traced, sharp = both(module, drawer, title)
            print(
                f"{title}: mean difference {mean_difference(found, traced):.3%}, PSNR {psnr(found, traced):.1f} dB, "
                f"channel means {found.mean(axis=(0, 1))} {traced.mean(axis=(0, 1))}, "
                f"pinhole {mean_difference(sharp, traced):.1%}, {psnr(sharp, traced):.1f} dB"
            )
