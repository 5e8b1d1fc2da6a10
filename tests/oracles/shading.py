"""The shading model in float64: capture/shaders/lighting.glsl whole, and the part of it that kernels/shading.clh has.

Points, normals and colours are (..., 3), roughness is (...).
"""

import numpy as np

from cldof import Lighting
from cldof.lighting import Environment

LEAST_COSINE = 1e-3


def roughness(shininess: np.ndarray) -> np.ndarray:
    """Of a Phong exponent."""
    return np.maximum((2.0 / (np.maximum(shininess, 0.0) + 2.0)) ** 0.25, 0.08)


def positions(inv_depth: np.ndarray, lighting: np.ndarray) -> np.ndarray:
    """World positions of the pixels of a frame, (..., H, W, 3), through the packed camera."""
    focal, middle_x, middle_y = lighting[1, :3].astype(np.float64)
    right, up, back, eye = lighting[4:8, :3].astype(np.float64)
    height, width = inv_depth.shape[-2:]
    y, x = np.mgrid[:height, :width] + 0.5
    ray = ((x - middle_x) / focal)[..., None] * right + ((middle_y - y) / focal)[..., None] * up - back
    return eye + ray / np.maximum(inv_depth, 1e-9)[..., None]


def octahedral(bordered: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """A map with a border seen in directions: texel by texel, bilinear."""
    side = bordered.shape[0] - 2
    d = directions / np.maximum(np.abs(directions).sum(-1, keepdims=True), 1e-30)
    below = d[..., 1] < 0.0
    u = np.where(below, (1.0 - np.abs(d[..., 2])) * np.where(d[..., 0] < 0.0, -1.0, 1.0), d[..., 0])
    v = np.where(below, (1.0 - np.abs(d[..., 0])) * np.where(d[..., 2] < 0.0, -1.0, 1.0), d[..., 2])
    x, y = (u + 1.0) / 2.0 * side + 0.5, (v + 1.0) / 2.0 * side + 0.5
    i, j = np.clip(x.astype(int), 0, side), np.clip(y.astype(int), 0, side)
    result = np.zeros(directions.shape)
    for dy in (0, 1):
        for dx in (0, 1):
            weight = (1.0 - np.abs(x - i - dx)) * (1.0 - np.abs(y - j - dy))
            result += weight[..., None] * bordered[j + dy, i + dx].astype(np.float64)
    return result


def mirrored(lighting: Lighting, directions: np.ndarray, rough: np.ndarray) -> np.ndarray:
    """Light from unit directions as a rough surface mirrors it."""
    if lighting.environment is None:
        sky, ground = (np.array(c) for c in (lighting.ambient.sky, lighting.ambient.ground))
        return ground + (sky - ground) * (0.5 + 0.5 * directions[..., 1:2])
    levels = np.stack([octahedral(level, directions) for level in lighting.environment.levels])
    at = rough * (len(levels) - 1)
    sharper = np.clip(at.astype(int), 0, len(levels) - 2)
    pick = [np.take_along_axis(levels, (sharper + n)[None, ..., None], 0)[0] for n in (0, 1)]
    return pick[0] + (pick[1] - pick[0]) * (at - sharper)[..., None]


def irradiance(lighting: Lighting, normal: np.ndarray) -> np.ndarray:
    """Light from around on a matte surface."""
    environment: Environment | None = lighting.environment
    if environment is None:
        return mirrored(lighting, normal, np.ones(normal.shape[:-1]))
    return octahedral(environment.irradiance, normal)


def _lit(position: np.ndarray, lighting: Lighting) -> list[tuple[np.ndarray, np.ndarray]]:
    """Direction to every light, and its colour there."""
    parts = lighting.arrays()
    found = [
        (np.broadcast_to(to_light, position.shape), np.broadcast_to(color, position.shape))
        for to_light, color in zip(parts["directional_to_light"], parts["directional_color"], strict=True)
    ]
    rows = zip(*(parts[f"point_{name}"] for name in ("position", "color", "axis", "cone")), strict=True)
    for place, color, axis, (inner, outer) in rows:
        to_light = place - position
        square = (to_light**2).sum(-1, keepdims=True)
        direction = to_light / np.sqrt(np.maximum(square, 1e-30))
        strength = 1.0 / np.maximum(square, 1e-6)
        if axis.any():
            t = np.clip((-(direction @ axis)[..., None] - outer) / max(inner - outer, 1e-4), 0.0, 1.0)
            strength = strength * t * t * (3.0 - 2.0 * t)
        found.append((direction, strength * color))
    return found


def _terms(
    position: np.ndarray, normal: np.ndarray, f0: np.ndarray, rough: np.ndarray, eye: np.ndarray, lighting: Lighting
) -> tuple[np.ndarray, list[tuple[np.ndarray, np.ndarray, np.ndarray]]]:
    """What is mirrored from around; for each light its mirrored part, its light on the surface, and Fresnel's share."""
    v = eye - position
    v = v / np.linalg.norm(v, axis=-1, keepdims=True)
    n_v_signed = (normal * v).sum(-1)
    n_v = np.maximum(n_v_signed, LEAST_COSINE)
    grazing = np.clip(50.0 * f0.max(-1, keepdims=True), 0.0, 1.0)
    a = np.minimum((1.0 - rough) ** 2, np.exp2(-9.28 * n_v)) * (1.0 - rough) + (0.0425 - 0.0275 * rough)
    share = f0 * (-1.04 * a + 1.04 - 0.572 * rough)[..., None] + grazing * (1.04 * a - 0.04 + 0.022 * rough)[..., None]
    around = share * mirrored(lighting, 2.0 * n_v_signed[..., None] * normal - v, rough)
    around = np.where((normal**2).sum(-1, keepdims=True) > 0.0, around, 0.0)
    alpha2, k = rough**4, rough**2 / 2.0
    lights = []
    for to_light, color in _lit(position, lighting):
        n_l = np.maximum((normal * to_light).sum(-1), 0.0)
        h = to_light + v
        h = h / np.maximum(np.linalg.norm(h, axis=-1, keepdims=True), 1e-30)
        n_h = np.maximum((normal * h).sum(-1), 0.0)
        v_h = np.clip((v * h).sum(-1), 0.0, 1.0)
        d = n_h**2 * (alpha2 - 1.0) + 1.0
        masking = (n_l * (1.0 - k) + k) * (n_v * (1.0 - k) + k)
        fresnel = f0 + (grazing - f0) * ((1.0 - v_h) ** 5)[..., None]
        incoming = color * n_l[..., None]
        lights.append((fresnel * (alpha2 / (4.0 * d * d * masking))[..., None] * incoming, incoming, fresnel))
    return around, lights


def specular(
    position: np.ndarray, normal: np.ndarray, f0: np.ndarray, rough: np.ndarray, eye: np.ndarray, lighting: Lighting
) -> np.ndarray:
    """What surfaces mirror towards an eye, (..., 3); ``eye`` may be one for all or one for each."""
    around, lights = _terms(position, normal, f0, rough, eye, lighting)
    return around + sum(mirrored for mirrored, _, _ in lights)


def shade(
    position: np.ndarray,
    normal: np.ndarray,
    diffuse: np.ndarray,
    f0: np.ndarray,
    rough: np.ndarray,
    eye: np.ndarray,
    lighting: Lighting,
) -> np.ndarray:
    """All that surfaces show an eye, but for what they give off."""
    around, lights = _terms(position, normal, f0, rough, eye, lighting)
    total = diffuse * irradiance(lighting, normal) + around
    for mirrored_part, incoming, fresnel in lights:
        total = total + mirrored_part + diffuse * (1.0 - fresnel) * incoming
    return total
