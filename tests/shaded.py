"""Glossy frames made of numbers, for tests without OpenGL."""

from dataclasses import replace

import numpy as np

from cldof import (
    Ambient,
    Camera,
    DirectionalLight,
    Environment,
    LayeredFrame,
    Lighting,
    PointLight,
)
from tests.frames import noise_frame
from tests.oracles import shading as oracle

__all__ = ["LIGHTS", "colored_frame", "environment", "shaded_frame"]

LIGHTS = Lighting(
    (
        DirectionalLight((0.3, -1.0, -0.4), (0.9, 0.8, 0.7)),
        PointLight((0.4, 1.2, -1.0), (0.5, 0.6, 0.9)),
        PointLight((-1.0, 0.8, 0.2), (2.0, 1.0, 1.0), direction=(0.5, -0.3, -1.0), cone_deg=(10.0, 50.0)),
    ),
    Ambient((0.3, 0.4, 0.5), (0.2, 0.1, 0.05)),
)


def environment(seed: int = 0) -> Environment:
    """Patches of random light."""
    return Environment(np.random.default_rng(seed).random((8, 16, 3), np.float32))


def shaded_frame(
    width: int,
    height: int,
    lighting: Lighting = LIGHTS,
    *,
    layers: int = 2,
    seed: int = 0,
    guard_px: int = 0,
    opaque: bool = True,
) -> LayeredFrame:
    """The surfaces of ``noise_frame`` under random normals: half of them face the camera, some mirror nothing."""
    frame = noise_frame(width, height, layers, seed=seed, guard_px=guard_px, opaque=opaque)
    rng = np.random.default_rng([seed, 1])
    shape = frame.depth.shape
    normal = rng.normal((0.0, 0.0, 1.5), size=(*shape, 3))
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    normal[rng.random(shape) < 0.05] = 0.0
    specular = rng.random((*shape, 3)) * (rng.random((*shape, 1)) < 0.8) * (frame.depth < np.inf)[..., None]
    shininess = 2.0 / rng.uniform(0.1, 1.0, shape) ** 4 - 2.0
    pose = np.eye(4)
    pose[:3, :3] = [[0.8, 0.0, 0.6], [0.0, 1.0, 0.0], [-0.6, 0.0, 0.8]]
    pose[:3, 3] = 0.1, 0.4, -0.2
    normal = normal @ pose[:3, :3].T
    buffers = {"normal": normal, "specular": specular, "shininess": shininess}
    arrays = {name: array.astype(np.float32) for name, array in buffers.items()}
    camera: Camera = replace(frame.camera, pose=pose)
    bare = LayeredFrame(frame.color, frame.depth, camera, guard_px=frame.guard_px, lighting=lighting, **arrays)
    return colored_frame(bare)


def colored_frame(frame: LayeredFrame) -> LayeredFrame:
    """The frame with what its surfaces mirror added to its colour."""
    mirrored = mirrored_by(frame, (0.0, 0.0))
    color = frame.color.copy()
    color[..., :3] += (color[..., 3:] * mirrored).astype(np.float32)
    return LayeredFrame(
        color, frame.depth, frame.camera, guard_px=frame.guard_px, lighting=frame.lighting, **frame.surface
    )


def mirrored_by(frame: LayeredFrame, lens_point: tuple[float, float]) -> np.ndarray:
    """What all slots mirror towards a point on the lens, metres right and up, (M, H, W, 3); float64."""
    assert frame.lighting is not None
    packed = frame.inputs["lighting"]
    with np.errstate(divide="ignore"):
        where = oracle.positions(1.0 / frame.depth.astype(np.float64), packed)
    eye = frame.camera.pose[:3, 3] + frame.camera.pose[:3, :2] @ lens_point
    normal, f0 = (frame.surface[name].astype(np.float64) for name in ("normal", "specular"))
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    normal = np.where(length > 1e-6, normal / np.maximum(length, 1e-6), 0.0)
    rough = oracle.roughness(frame.surface["shininess"].astype(np.float64))
    return oracle.specular(where, normal, f0, rough, eye, frame.lighting)
