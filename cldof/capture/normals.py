"""Vertex normals for meshes that bring none: smooth where the surface is smooth, hard where it has an edge."""

from __future__ import annotations

from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

__all__ = ["merged_faces", "with_crease_normals"]


def merged_faces(mesh: trimesh.Trimesh) -> NDArray[np.int64]:
    """Faces over positions: vertices that lie at the same place count as one, whatever splits them."""
    _, place = np.unique(np.asarray(mesh.vertices, dtype=np.float32), axis=0, return_inverse=True)
    merged: NDArray[np.int64] = place.reshape(-1)[np.asarray(mesh.faces)]
    return merged


def with_crease_normals(mesh: trimesh.Trimesh, crease_deg: float = 40.0) -> trimesh.Trimesh:
    """A copy of ``mesh`` whose vertex normals are averaged only over faces within ``crease_deg`` of each other.

    A scan becomes smooth, a box keeps its edges. Vertices on an edge are split; texture coordinates and colours follow.
    Each corner's normal is the mean of the face normals around its place that lie within the angle, weighted by the
    faces' angles there.
    """
    faces = np.asarray(mesh.faces)
    triangles = np.asarray(mesh.triangles, dtype=np.float64)
    face_normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    face_normals /= np.maximum(np.linalg.norm(face_normals, axis=1, keepdims=True), 1e-300)
    place = merged_faces(mesh).ravel()  # per corner
    corner_normals = np.repeat(face_normals, 3, axis=0)
    weighted = corner_normals * _corner_angles(triangles)[:, None]

    summed = np.stack([np.bincount(place, weighted[:, axis]) for axis in range(3)], axis=1)
    normals = _unit(summed, fallback=np.array([0.0, 1.0, 0.0]))[place]
    # Where all faces around a place lie within half the angle of the mean, all lie within the angle of each other.
    bent = np.einsum("ij,ij->i", normals, corner_normals) < np.cos(np.radians(crease_deg / 2.0))
    creased = np.zeros(place.max() + 1, bool)
    creased[place[bent]] = True
    corners = np.flatnonzero(creased[place])
    if corners.size:
        mine, other = _pairs(place[corners])
        mine, other = corners[mine], corners[other]
        near = np.einsum("ij,ij->i", corner_normals[mine], corner_normals[other]) >= np.cos(np.radians(crease_deg))
        mine, other = mine[near], other[near]
        local = np.searchsorted(corners, mine)
        total = np.stack([np.bincount(local, weighted[other, axis], corners.size) for axis in range(3)], axis=1)
        normals[corners] = _unit(total, fallback=corner_normals[corners])

    # One vertex per different (old vertex, normal); rounding joins normals that differ only in their last bits.
    key = np.column_stack([faces.ravel(), np.round(normals * 1e4).astype(np.int64)])
    _, first, new_faces = np.unique(key, axis=0, return_index=True, return_inverse=True)
    source = faces.ravel()[first]
    result = trimesh.Trimesh(
        vertices=np.asarray(mesh.vertices)[source],
        faces=new_faces.reshape(-1, 3),
        vertex_normals=normals[first],
        process=False,
        validate=False,
    )
    visual = mesh.visual
    if visual.defined and visual.kind == "texture" and visual.uv is not None:
        result.visual = trimesh.visual.TextureVisuals(uv=np.asarray(visual.uv)[source], material=visual.material)
        color = visual.vertex_attributes.get("color")
        if color is not None:
            result.visual.vertex_attributes["color"] = np.asarray(color)[source]
    elif visual.defined and visual.kind == "vertex":
        result.visual.vertex_colors = np.asarray(visual.vertex_colors)[source]
    elif visual.defined and visual.kind == "face":
        result.visual.face_colors = np.asarray(visual.face_colors)
    return result


def _unit(vectors: Any, fallback: NDArray[np.float64]) -> NDArray[np.float64]:
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.where(length > 1e-12, vectors / np.maximum(length, 1e-12), fallback)


def _corner_angles(triangles: NDArray[np.float64]) -> NDArray[np.float64]:
    """Inner angle of every corner, face by face."""
    after = np.roll(triangles, -1, axis=1) - triangles
    before = np.roll(triangles, 1, axis=1) - triangles
    cross = np.linalg.norm(np.cross(after, before), axis=2)
    angles: NDArray[np.float64] = np.arctan2(cross, np.einsum("ijk,ijk->ij", after, before)).ravel()
    return angles


def _pairs(group: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Indices of all ordered pairs (each element with itself too) that lie in the same group."""
    order = np.argsort(group, kind="stable")
    _, start, count = np.unique(group[order], return_index=True, return_counts=True)
    member_start, member_count = np.repeat(start, count), np.repeat(count, count)
    first = np.repeat(np.arange(group.size), member_count)
    offset = np.arange(first.size) - np.repeat(np.cumsum(member_count) - member_count, member_count)
    return order[first], order[np.repeat(member_start, member_count) + offset]
