"""Scenes around model files, for benchmarks: heavier than what procedures build, and only where the files are."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from trimesh.transformations import rotation_matrix

from .load import load_scene
from .scene import Ambient, DirectionalLight, Gradient, Material, Node, Scene
from .shapes import moved, quad
from .staging import Light, Vector, aimed_camera, floor, mirrored, printed
from .textures import checker, rgb

__all__ = ["bunnies"]

_BUNNY_HEIGHT_M = 0.3


def bunnies(path: str | Path) -> Scene:
    """Nine bunnies in three rows from 0.9 to 3.6 m before a checkered wall; the middle row is in focus.

    With the Stanford bunny's 69 451 triangles these are 625 000, of one mesh that is uploaded once.

    Parameters
    ----------
    path : path
        The model; any that stands up will do.

    Raises
    ------
    SceneError
        If the file cannot be read.
    """
    rng = np.random.default_rng(9)
    model = load_scene(path)
    low, high = model.bounds
    scale = _BUNNY_HEIGHT_M / float(high[1] - low[1])
    stand = np.eye(4)
    stand[:3, :3] *= scale
    stand[:3, 3] = -scale * np.array([(low[0] + high[0]) / 2, low[1], (low[2] + high[2]) / 2])
    light = Light((0.5, -1.0, -0.6), (0.85, 0.8, 0.72), Ambient((0.45, 0.47, 0.52), (0.3, 0.27, 0.24)))
    colors = ["#e0d3c0", "#c8694d", "#5f8fb0", "#d9a94a", "#e9e4da", "#6d9a6a", "#9a7bb0", "#d58a9b", "#8a9aa8"]
    spots: list[Vector] = [
        (-0.2, 0.0, -0.95), (0.03, 0.0, -1.05), (0.24, 0.0, -0.9), (-0.42, 0.0, -1.75), (0.02, 0.0, -1.7),
        (0.44, 0.0, -1.85), (-0.85, 0.0, -3.3), (0.12, 0.0, -3.6), (0.8, 0.0, -3.1),
    ]  # fmt: skip
    nodes: list[Node] = []
    shadows = []
    for spot, color in zip(spots, colors, strict=True):
        angle = float(rng.uniform(-0.7, 0.7))
        place = rotation_matrix(angle, (0.0, 1.0, 0.0))
        place[:3, 3] = spot
        material = Material(base_color=(*rgb(color), 1.0), roughness=0.45)
        nodes += [Node(node.mesh, place @ stand @ node.transform, material) for node in model.nodes]
        # A shadow needs no more than a rough cast.
        hull = model.nodes[0].mesh.convex_hull
        shadows.append(hull.copy().apply_transform(place @ stand @ model.nodes[0].transform))
    tones = ("#d8d2c6", "#8e99a3")
    nodes.append(floor(checker(rng, (1200, 1200), (24, 24), tones), (-4.0, -5.0, 4.0, 0.0), light, shadows))
    wall = checker(rng, (720, 1440), (12, 24), ("#c9b9a0", "#6f7f8f"))
    nodes.append(Node(moved(quad((-4.0, 0, 0), (8, 0, 0), (0, 4, 0)), (0, 0, -5.0)), material=printed(wall, 0.9)))
    top, horizon = rgb("#7f9fc0"), rgb("#dfe4e8")
    return Scene(
        "bunnies",
        tuple(nodes),
        camera=aimed_camera((0.0, 0.42, 0.0), (0.0, 0.2, -1.7), 33.0, 0.1),
        lights=(*light.lights(), DirectionalLight((-0.8, -0.3, -0.4), (0.15, 0.17, 0.2))),
        ambient=light.ambient,
        background=Gradient(top=top, bottom=mirrored(horizon, top)),
        focus_distance_m=1.6,
        aperture_radius_m=0.0275,
    )
