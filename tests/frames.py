"""Layered frames made of numbers, for tests without OpenGL."""

import numpy as np

from cldof import Camera, LayeredFrame

__all__ = ["noise_frame", "plane_frame"]


def noise_frame(
    width: int, height: int, layers: int = 3, *, seed: int = 0, opaque: bool = True, guard_px: int = 0
) -> LayeredFrame:
    """Blocks and slopes of random colour and depth: silhouettes, hidden surfaces, glass, sky, and (not opaque) void."""
    rng = np.random.default_rng(seed)
    shape = (layers, height + 2 * guard_px, width + 2 * guard_px)
    coarse = (
        rng.random((layers, shape[1] // 9 + 1, shape[2] // 7 + 1)).repeat(9, 1).repeat(7, 2)[:, : shape[1], : shape[2]]
    )
    slope = np.linspace(0.0, 0.4, shape[2])
    inverse = np.sort(coarse + slope + 0.01 * rng.random(shape), axis=0)[::-1] * 0.9 + 0.05
    color = rng.random((*shape, 4))
    color[..., 3] = np.where(rng.random(shape) < 0.1, 0.4, 1.0)
    color[..., :3] *= color[..., 3:]
    depth = 1.0 / inverse
    if layers > 1:
        sky = coarse[-1] < 0.3
        depth[-1][sky] = np.inf
    if opaque:
        color[-1, ..., 3] = 1.0
    else:
        nothing = coarse[0] < 0.4
        depth[:, nothing] = np.inf
        color[:, nothing] = 0.0
    return LayeredFrame(
        color.astype(np.float32), depth.astype(np.float32), Camera(width, height, 40.0), guard_px=guard_px
    )


def plane_frame(image: np.ndarray, depth_m: float, yfov_deg: float = 40.0) -> LayeredFrame:
    """One fronto-parallel plane showing a premultiplied image."""
    height, width = image.shape[:2]
    depth = np.full((height, width), depth_m, np.float32)
    return LayeredFrame(np.asarray(image, np.float32), depth, Camera(width, height, yfov_deg))
