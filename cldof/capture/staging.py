"""What the built-in scenes are made with: cameras, materials, lights, and floors with their light painted on."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..camera import Camera
from .scene import Ambient, DirectionalLight, Material, Node
from .shapes import leaf, merge, moved, quad
from .textures import picture, rgb, shadow_mask, veins

__all__ = [
    "Light",
    "Vector",
    "aimed_camera",
    "floor",
    "glow",
    "leaf_material",
    "merged",
    "mirrored",
    "paint",
    "plant",
    "printed",
]

Vector = tuple[float, float, float]


def merged(nodes: Sequence[Node]) -> tuple[Node, ...]:
    """One node for each material: drawing takes time by the node as well as by the triangle.

    What has a name stays by itself.
    """
    groups: dict[object, list[Node]] = {}
    for node in nodes:
        groups.setdefault((id(node.material), node.name), []).append(node)
    return tuple(
        group[0]
        if len(group) == 1
        else Node(merge([node.mesh for node in group]), material=group[0].material, name=group[0].name)
        for group in groups.values()
    )


def aimed_camera(eye: Vector, target: Vector, yfov_deg: float, near: float) -> Camera:
    """A camera at ``eye`` that looks at ``target``, upright."""
    forward = np.subtract(target, eye)
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, (0.0, 1.0, 0.0))
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(right, forward), -forward], axis=1)
    pose[:3, 3] = eye
    return Camera(1024, 1024, yfov_deg, near=near, pose=pose)


@cache
def paint(color: str, roughness: float = 0.5, metallic: float = 0.0) -> Material:
    """One colour; the same arguments give the same object, which :func:`merged` counts on."""
    return Material(base_color=(*rgb(color), 1.0), roughness=roughness, metallic=metallic)


def printed(linear: Any, roughness: float = 0.7, unlit: bool = False) -> Material:
    """A texture of :mod:`.textures` on white."""
    return Material(
        base_color=(1.0, 1.0, 1.0, 1.0), base_color_texture=picture(linear), roughness=roughness, unlit=unlit
    )


def glow(color: str, radiance: float) -> Material:
    """A lamp: ``radiance`` times a colour, above white when it is."""
    red, green, blue = rgb(color)
    emissive = (radiance * red, radiance * green, radiance * blue)
    return Material(base_color=(0.0, 0.0, 0.0, 1.0), emissive=emissive, unlit=True)


def mirrored(horizon: Vector, top: Vector) -> Vector:
    """The bottom of a sky that has ``top`` above and ``horizon`` in the middle."""
    red, green, blue = (max(0.0, 2 * h - t) for h, t in zip(horizon, top, strict=True))
    return red, green, blue


class Light(NamedTuple):
    """One sun and one sky, so that painted floors and shaded objects agree."""

    direction: Vector
    sun: Vector
    ambient: Ambient

    def lights(self) -> tuple[DirectionalLight, ...]:
        return (DirectionalLight(self.direction, self.sun),)

    def on_floor(self, sun_mask: Any, sky_mask: Any) -> NDArray[np.float32]:
        """Light on a surface facing up, (H, W, 3), given what is kept from it."""
        slope = -self.direction[1] / math.hypot(*self.direction)
        lit = np.array(self.sun, np.float32) * slope * (1.0 - np.asarray(sun_mask))[..., None]
        return np.asarray(
            lit + np.array(self.ambient.sky, np.float32) * (1.0 - np.asarray(sky_mask))[..., None], np.float32
        )


def floor(
    albedo: NDArray[np.float32],
    area: tuple[float, float, float, float],
    light: Light,
    casters: Sequence[Any],
    *,
    height: float = 0.0,
    softness_m: float = 0.03,
    fade: tuple[Vector, Vector, float, float] | None = None,
) -> Node:
    """A floor with its light painted on. ``area`` is as in shadow_mask; ``fade`` is (colour, eye, start, end in m)."""
    size = (albedo.shape[0], albedo.shape[1])
    sun = shadow_mask(casters, light.direction, area, size, softness_m, height)
    sky = np.minimum(1.0, shadow_mask(casters, (0.0, -1.0, 0.0), area, size, 3.0 * softness_m, height) * 1.1) * 0.75
    color = albedo * light.on_floor(sun, sky)
    left, far, right, near = area
    if fade:
        tint, eye, start, end = fade
        z = np.linspace(far, near, size[0], dtype=np.float32)[:, None]
        x = np.linspace(left, right, size[1], dtype=np.float32)[None, :]
        amount = np.clip((np.hypot(x - eye[0], z - eye[2]) - start) / (end - start), 0, 1)
        amount = (amount * amount * (3 - 2 * amount))[..., None]
        color = color * (1 - amount) + np.array(tint, np.float32) * amount
    mesh = quad((left, height, near), (right - left, 0, 0), (0, 0, far - near))
    return Node(mesh, material=printed(color, unlit=True))


def plant(rng: np.random.Generator, at: Vector, size: float, count: int, material: Material) -> tuple[Node, Any]:
    """A bunch of leaves that spring from one point: the node, and its mesh to cast shadows."""
    leaves = []
    for i in range(count):
        lean = rng.uniform(15, 75)
        length = size * rng.uniform(0.7, 1.1)
        leaves.append(
            moved(
                leaf(length, 0.3 * length, bend=float(rng.uniform(0.3, 0.8)), steps=7),
                at,
                (float(rng.uniform(-20, 20)), i * 137.5, lean if i % 2 else 0.8 * lean),
            )
        )
    mesh = merge(leaves)
    return Node(mesh, material=material), mesh


def leaf_material(rng: np.random.Generator, color: str, light: str) -> Material:
    """Both sides of a leaf with veins."""
    return Material(
        base_color=(1.0, 1.0, 1.0, 1.0),
        base_color_texture=picture(veins(rng, (128, 256), color, light)),
        roughness=0.5,
        double_sided=True,
    )
