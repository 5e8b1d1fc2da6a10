"""Small procedural meshes for the built-in scenes: y up, metres, smooth normals where smooth, sharp where sharp.

Every function returns a :class:`trimesh.Trimesh` with outward faces, vertex normals and texture coordinates; round
shapes stand with their centre at the origin, turned ones (:func:`lathe`) with their foot on y = 0.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray

__all__ = [
    "ball",
    "band",
    "block",
    "knot",
    "lathe",
    "leaf",
    "merge",
    "moved",
    "pipe",
    "quad",
    "ribbon",
    "ring",
    "star",
]

_Array = NDArray[np.float64]
# Corners of a turned profile sharper than this are kept as edges.
_CREASE_DEG = 35.0


def ball(radius: float, segments: int = 48) -> Any:
    """A sphere."""
    angle = np.linspace(-math.pi / 2, math.pi / 2, segments // 2 + 1)
    profile = np.stack([np.cos(angle), np.sin(angle)], axis=1) * radius
    return _revolve(profile, profile / radius, segments)


def band(first: ArrayLike, second: ArrayLike) -> Any:
    """The flat strip between two paths (N, 3) of one plane, facing ``along x across``: paper cut along both edges.

    Parts of no width vanish. Texture coordinates run along the paths and from the first to the second.
    """
    a, b = np.asarray(first, dtype=float), np.asarray(second, dtype=float)
    surface = np.stack([a, b], axis=1)
    facing = np.cross(np.gradient(a, axis=0) + np.gradient(b, axis=0), b - a).sum(axis=0)
    normal = np.broadcast_to(facing / np.linalg.norm(facing), surface.shape)
    uv = np.stack(np.meshgrid(np.linspace(0, 1, len(a)), np.array([0.0, 1.0]), indexing="ij"), axis=-1)
    return _grid(surface, normal, uv)


def block(size: Sequence[float], bevel: float, steps: int = 4) -> Any:
    """A box with rounded edges; ``size`` is the full extent in x, y, z, centred. Texture coordinates per face."""
    half = np.asarray(size, dtype=float) / 2
    ramp = np.tan(np.linspace(-math.pi / 4, 0, steps + 1))  # equal angles around the rounded edge
    line = np.concatenate([ramp, -ramp[::-1]])  # -1 .. 0, 0 .. 1: the two zeros hold the flat part
    inner_sign = np.concatenate([-np.ones(steps + 1), np.ones(steps + 1)])
    inner = half - bevel
    parts = []
    u, v = np.meshgrid(np.arange(line.size), np.arange(line.size), indexing="ij")
    for axis in range(3):
        for side in (-1.0, 1.0):
            a, b = (axis + 1) % 3, (axis + 2) % 3
            core = np.zeros((*u.shape, 3))
            direction = np.zeros_like(core)
            core[..., axis] = side * inner[axis]
            direction[..., axis] = side
            core[..., a], core[..., b] = inner_sign[u] * inner[a], inner_sign[v] * inner[b]
            direction[..., a], direction[..., b] = line[u], line[v]
            direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
            points = core + bevel * direction
            across, up = (0, 1) if axis == 2 else ((2, 1) if axis == 0 else (0, 2))
            uv = np.stack([points[..., across] / half[across], points[..., up] / half[up]], axis=-1) / 2 + 0.5
            parts.append(_grid(points, direction, uv))
    return merge(parts)


def lathe(profile: ArrayLike, segments: int = 48) -> Any:
    """Turn a profile of (radius, height) points, from the foot up, around the y axis."""
    points = np.asarray(profile, dtype=float)
    step = np.diff(points, axis=0)
    keep = np.linalg.norm(step, axis=1) > 1e-9
    points, step = np.vstack([points[:1], points[1:][keep]]), step[keep]
    heading = np.unwrap(np.arctan2(step[:, 1], step[:, 0]))
    corners = np.flatnonzero(np.abs(np.diff(heading)) > math.radians(_CREASE_DEG)) + 1
    parts = []
    for first, last in zip([0, *corners], [*corners, len(points) - 1], strict=True):
        piece = points[first : last + 1]
        tangent = np.gradient(piece, axis=0)
        normal = np.stack([tangent[:, 1], -tangent[:, 0]], axis=1)
        parts.append(_revolve(piece, normal / np.linalg.norm(normal, axis=1, keepdims=True), segments))
    return merge(parts)


def ring(radius: float, tube: float, segments: int = 64, sides: int = 24) -> Any:
    """A torus lying in the x-z plane."""
    angle = np.linspace(0, 2 * math.pi, segments + 1)
    return pipe(np.stack([radius * np.cos(angle), np.zeros_like(angle), radius * np.sin(angle)], axis=1), tube, sides)


def knot(radius: float, tube: float, p: int = 2, q: int = 3, segments: int = 220, sides: int = 20) -> Any:
    """A (p, q) torus knot."""
    t = np.linspace(0, 2 * math.pi, segments + 1)
    reach = radius * (2 + np.cos(q * t)) / 3
    path = np.stack([reach * np.cos(p * t), reach * np.sin(p * t), radius * np.sin(q * t) / 2.2], axis=1)
    return pipe(path, tube, sides)


def pipe(path: ArrayLike, radius: float | Sequence[float], sides: int = 16) -> Any:
    """Sweep a circle along a path (N, 3); the ends are closed when the path is not a loop."""
    points = np.asarray(path, dtype=float)
    loop = bool(np.allclose(points[0], points[-1]))
    radii = np.broadcast_to(np.asarray(radius, dtype=float), (len(points),))
    tangent = np.gradient(points, axis=0)
    if loop:
        tangent[0] = tangent[-1] = points[1] - points[-2]
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    # Carry a frame along without twist, then spread what is missing at the seam of a loop over its length.
    normal = np.empty_like(points)
    start = np.eye(3)[np.argmin(np.abs(tangent[0]))]
    normal[0] = np.cross(tangent[0], start)
    normal[0] /= np.linalg.norm(normal[0])
    for i in range(1, len(points)):
        side = normal[i - 1] - tangent[i] * (normal[i - 1] @ tangent[i])
        normal[i] = side / np.linalg.norm(side)
    binormal = np.cross(tangent, normal)
    twist = np.zeros(len(points))
    if loop:
        twist = np.linspace(0, math.atan2(normal[0] @ binormal[-1], normal[0] @ normal[-1]), len(points))
    angle = np.linspace(0, 2 * math.pi, sides + 1)[None, :] + twist[:, None]
    direction = np.cos(angle)[..., None] * normal[:, None] + np.sin(angle)[..., None] * binormal[:, None]
    surface = points[:, None] + radii[:, None, None] * direction
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    uv = np.stack(np.meshgrid(length / length[-1], np.linspace(0, 1, sides + 1), indexing="ij"), axis=-1)
    parts = [_grid(surface, direction, uv)]
    if not loop:
        for index, sign in ((0, -1.0), (-1, 1.0)):
            rim = surface[index]
            cap = np.stack([rim, np.broadcast_to(points[index], rim.shape)])
            parts.append(_grid(cap, np.broadcast_to(sign * tangent[index], cap.shape), np.zeros((*cap.shape[:2], 2))))
    return merge(parts)


def star(points: int, outer: float, inner: float, thickness: float, twist: float = 0.0, layers: int = 12) -> Any:
    """An upright star prism, foot on y = 0, ``thickness`` tall, turning by ``twist`` radians on its way up."""
    angle = np.linspace(0, 2 * math.pi, 2 * points + 1)
    reach = np.where(np.arange(2 * points + 1) % 2 == 0, outer, inner)
    height = np.linspace(0, thickness, layers + 1)
    parts = []
    for i in range(2 * points):  # one flat-sided strip per edge keeps the edges sharp
        turn = height / thickness * twist
        rim = [
            np.stack([reach[j] * np.cos(angle[j] + turn), height, reach[j] * np.sin(angle[j] + turn)], axis=1)
            for j in (i, i + 1)
        ]
        surface = np.stack(rim, axis=1)
        along = np.gradient(surface, axis=0)
        normal = np.cross(along, (surface[:, 1] - surface[:, 0])[:, None])
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
        uv = np.stack(np.meshgrid(height / thickness, np.array([i, i + 1]) / (2 * points), indexing="ij"), axis=-1)
        parts.append(_grid(surface, normal, uv))
    for level, sign in ((0.0, -1.0), (1.0, 1.0)):
        around = angle + level * twist
        y = np.full_like(angle, level * thickness)
        edge = np.stack([reach * np.cos(around), y, reach * np.sin(around)], axis=1)
        cap = np.stack([edge, np.broadcast_to(np.array([0.0, level * thickness, 0.0]), edge.shape)])
        facing = np.broadcast_to(np.array([0.0, sign, 0.0]), cap.shape)
        parts.append(_grid(cap, facing, cap[..., (0, 2)] / (2 * outer) + 0.5))
    return merge(parts)


def quad(corner: ArrayLike, across: ArrayLike, up: ArrayLike, steps: int = 1, repeat: float = 1.0) -> Any:
    """A flat rectangle from ``corner`` along two edges, facing ``across x up``; ``up`` leads to the texture's top."""
    corner, across, up = (np.asarray(v, dtype=float) for v in (corner, across, up))
    s, t = np.meshgrid(np.linspace(0, 1, steps + 1), np.linspace(0, 1, steps + 1), indexing="ij")
    points = corner + s[..., None] * across + t[..., None] * up
    normal = np.cross(across, up)
    normal /= np.linalg.norm(normal)
    return _grid(points, np.broadcast_to(normal, points.shape), np.stack([s, t], axis=-1) * repeat)


def leaf(length: float, width: float, bend: float = 0.35, fold: float = 0.25, steps: int = 10) -> Any:
    """A pointed leaf from the origin along +x, folded along its midrib and drooping by ``bend``; one-sided mesh."""
    s, t = np.meshgrid(np.linspace(0, 1, steps + 1), np.linspace(-1, 1, 9), indexing="ij")
    outline = np.sin(math.pi * s**0.75) * (1 - 0.35 * s)
    x, z = length * s, width / 2 * outline * t
    y = -bend * length * s**2 + fold * np.abs(z) + 0.02 * length * np.sin(9 * s) * t**2
    points = np.stack([x, y, z], axis=-1)
    normal = np.cross(np.gradient(points, axis=1), np.gradient(points, axis=0))
    size = np.linalg.norm(normal, axis=-1, keepdims=True)
    normal = np.where(size > 1e-12, normal / np.maximum(size, 1e-12), (0.0, 1.0, 0.0))
    return _grid(points, normal, np.stack([s, t / 2 + 0.5], axis=-1))


def ribbon(path: ArrayLike, up: ArrayLike) -> Any:
    """A vertical band along a path (N, 3), ``up`` tall: bunting, curtains, backdrops with a soft corner."""
    points = np.asarray(path, dtype=float)
    surface = np.stack([points, points + np.asarray(up, dtype=float)], axis=1)
    normal = np.cross(np.gradient(points, axis=0), np.asarray(up, dtype=float))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    uv = np.stack(np.meshgrid(length / length[-1], np.array([0.0, 1.0]), indexing="ij"), axis=-1)
    return _grid(surface, np.broadcast_to(normal[:, None], surface.shape), uv)


def merge(parts: Sequence[Any]) -> Any:
    """Several meshes as one, seams kept."""
    offsets = np.cumsum([0, *(len(part.vertices) for part in parts[:-1])])
    return _mesh(
        np.concatenate([part.vertices for part in parts]),
        np.concatenate([part.vertex_normals for part in parts]),
        np.concatenate([part.visual.uv for part in parts]),
        np.concatenate([part.faces + offset for part, offset in zip(parts, offsets, strict=True)]),
    )


def moved(
    mesh: Any,
    to: Sequence[float] = (0.0, 0.0, 0.0),
    turn_deg: Sequence[float] = (0.0, 0.0, 0.0),
    scale: float | Sequence[float] = 1.0,
) -> Any:
    """A copy, scaled, then turned around x, then y, then z, then moved."""
    factor = np.broadcast_to(np.asarray(scale, dtype=float), (3,))
    rotation = trimesh.transformations.euler_matrix(*np.radians(turn_deg), axes="sxyz")[:3, :3]
    normals = (np.asarray(mesh.vertex_normals) / factor) @ rotation.T
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    vertices = (np.asarray(mesh.vertices) * factor) @ rotation.T + np.asarray(to, dtype=float)
    return _mesh(vertices, normals, np.asarray(mesh.visual.uv), np.asarray(mesh.faces))


def _revolve(profile: _Array, normal: _Array, segments: int) -> Any:
    angle = np.linspace(0, 2 * math.pi, segments + 1)
    cos, sin = np.cos(angle), np.sin(angle)

    def spin(pair: _Array) -> _Array:
        return np.stack(
            [pair[:, :1] * cos, np.broadcast_to(pair[:, 1:], (len(pair), cos.size)), -pair[:, :1] * sin], axis=-1
        )

    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(profile, axis=0), axis=1))])
    v, u = np.meshgrid(length / length[-1], angle / (2 * math.pi), indexing="ij")
    return _grid(spin(profile), spin(normal), np.stack([u, v], axis=-1))


def _grid(points: _Array, normals: ArrayLike, uv: _Array) -> Any:
    """A mesh from a (U, V) grid of points; triangles without area are left out and the rest face their normals."""
    rows, columns = points.shape[:2]
    index = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = (part.ravel() for part in (index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]))
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    flat, flat_normals = points.reshape(-1, 3), np.asarray(normals, dtype=float).reshape(-1, 3)
    corner = flat[faces]
    facing = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    extent = float(np.ptp(flat, axis=0).max())
    keep = np.linalg.norm(facing, axis=1) > 1e-12 * extent * extent
    faces, facing = faces[keep], facing[keep]
    away = np.einsum("ij,ij->i", facing, flat_normals[faces].sum(axis=1)) < 0
    faces[away] = faces[away][:, ::-1]
    return _mesh(flat, flat_normals, uv.reshape(-1, 2), faces)


def _mesh(vertices: _Array, normals: _Array, uv: _Array, faces: NDArray[np.int64]) -> Any:
    visual = trimesh.visual.TextureVisuals(uv=uv)
    return trimesh.Trimesh(vertices, faces, vertex_normals=normals, visual=visual, process=False)
