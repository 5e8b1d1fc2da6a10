"""What lights a scene, as plain data: all that shading a surface from another point of view needs beside the surface.

The surface model is glTF's metallic-roughness one (capture/shaders/lighting.glsl, kernels/shading.clh): what surfaces
show is the same from everywhere but for what they mirror, ``specular_from`` in docs/methods/multiview.md. World axes
are y up, metres, right-handed; colours are linear light.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .camera import Camera
from .errors import SceneError

__all__ = ["MAX_LIGHTS", "Ambient", "DirectionalLight", "Environment", "Lighting", "PointLight"]

MAX_LIGHTS = 8
"""Of each kind: what shaders and kernels have room for."""

RGB = tuple[float, float, float]


def checked_color(value: Iterable[float], name: str, channels: int) -> tuple[float, ...]:
    """Finite linear light, none below 0.

    Raises
    ------
    SceneError
    """
    color = tuple(float(v) for v in value)
    if len(color) != channels or not all(0.0 <= v < math.inf for v in color):
        raise SceneError(f"{name} is {color}; it must be {channels} finite numbers of linear light, none below 0.")
    return color


def _vector(value: Iterable[float], name: str) -> RGB:
    x, y, z = (float(v) for v in value)
    if not all(math.isfinite(v) for v in (x, y, z)):
        raise SceneError(f"{name} is ({x}, {y}, {z}); it must be finite.")
    return x, y, z


@dataclass(frozen=True)
class DirectionalLight:
    """Parallel light travelling along ``direction``; ``color`` is its irradiance over pi, so 1 on white gives 1."""

    direction: RGB
    color: RGB = (1.0, 1.0, 1.0)

    def __post_init__(self) -> None:
        object.__setattr__(self, "direction", _vector(self.direction, "DirectionalLight direction"))
        object.__setattr__(self, "color", checked_color(self.color, "DirectionalLight color", 3))
        if not any(self.direction):
            raise SceneError("DirectionalLight direction is (0, 0, 0); it must point somewhere.")


@dataclass(frozen=True)
class PointLight:
    """Light from ``position``, falling with the square of distance; ``color`` is what 1 m away gives on white.

    With a ``direction`` it is a spot light: full inside the first of ``cone_deg`` (half angles), none outside the
    second.
    """

    position: RGB
    color: RGB = (1.0, 1.0, 1.0)
    direction: RGB | None = None
    cone_deg: tuple[float, float] = (0.0, 45.0)

    def __post_init__(self) -> None:
        object.__setattr__(self, "position", _vector(self.position, "PointLight position"))
        object.__setattr__(self, "color", checked_color(self.color, "PointLight color", 3))
        if self.direction is not None:
            object.__setattr__(self, "direction", _vector(self.direction, "PointLight direction"))


@dataclass(frozen=True)
class Ambient:
    """Light from everywhere: ``sky`` on surfaces facing up (+y), ``ground`` on those facing down, blended between."""

    sky: RGB = (0.25, 0.25, 0.25)
    ground: RGB = (0.25, 0.25, 0.25)

    def __post_init__(self) -> None:
        object.__setattr__(self, "sky", checked_color(self.sky, "Ambient sky", 3))
        object.__setattr__(self, "ground", checked_color(self.ground, "Ambient ground", 3))


class Environment:
    """Light from all around, as a picture of it; takes the place of :class:`Ambient`.

    What surfaces mirror is prefiltered by roughness. Inside, pictures are octahedral maps: finding the texel of a
    direction takes no trigonometry. Levels have 256, 128, 64, 32, 16 and 16 texels a side for roughness 0, 0.2, ... 1,
    and a border of one texel that the map's own folding fills, so that a look-up between texels needs no cases.

    Parameters
    ----------
    image : array_like, (H, W, 3)
        Equirectangular, linear light, finite, none below 0, at least 2 x 4 pixels. Row 0 is straight up (+y), the
        middle column is seen along -z and columns run towards +x.

    Attributes
    ----------
    levels : list of ndarray, (N + 2, N + 2, 3), float32
        What roughness 0, 0.2, ... 1 mirrors.
    irradiance : ndarray, (18, 18, 3), float32
        Light on a white matte surface that faces the direction.
    """

    SIDES = (256, 128, 64, 32, 16, 16)
    TEXELS = sum((side + 2) ** 2 for side in (*SIDES, 16))
    _SAMPLES = 128

    def __init__(self, image: ArrayLike) -> None:
        array = np.asarray(image)
        if array.dtype.kind != "f" or array.ndim != 3 or array.shape[2] != 3 or min(array.shape[:2]) < 2:
            raise SceneError(
                f"Environment image has shape {array.shape} and dtype {array.dtype}; it must be (H, W, 3) of floats, "
                "linear light, at least 2 x 4 pixels."
            )
        if array.shape[1] < 4:
            raise SceneError(f"Environment image is {array.shape[1]} pixels wide; it must be at least 4.")
        self.image: NDArray[np.float32] = np.array(array, dtype=np.float32)
        bad = ~(np.isfinite(self.image) & (self.image >= 0.0))
        if bad.any():
            y, x = np.argwhere(bad)[0][:2]
            raise SceneError(
                f"Environment image has {np.count_nonzero(bad)} values that are negative, NaN or infinite; the first "
                f"is at pixel x={x}, y={y}."
            )
        self.image.setflags(write=False)

    @cached_property
    def levels(self) -> list[NDArray[np.float32]]:
        return [with_border(level).astype(np.float32) for level in self._filtered()]

    @cached_property
    def irradiance(self) -> NDArray[np.float32]:
        directions = octahedral_directions(self.SIDES[-1])
        first, second = _hammersley(self._SAMPLES)
        cosine = np.sqrt(1.0 - first)
        lobe = _around(cosine, second)
        total = np.zeros_like(directions)
        for local, density in zip(lobe, cosine / math.pi, strict=True):
            total += _lookup(self._source(density), _turned(local, directions))
        return with_border(total / self._SAMPLES).astype(np.float32)

    @cached_property
    def packed(self) -> NDArray[np.float32]:
        """All levels and the irradiance one after the other, (TEXELS, 4), as shaders and kernels take them."""
        flat = np.concatenate([level.reshape(-1, 3) for level in (*self.levels, self.irradiance)])
        packed = np.concatenate([flat, np.zeros((len(flat), 1), np.float32)], axis=1)
        packed.setflags(write=False)
        return packed

    @cached_property
    def _mips(self) -> list[NDArray[np.float64]]:
        """The picture as an octahedral map and its halvings, without borders."""
        side = self.SIDES[0]
        # Two by two points a texel, of a picture that is no finer than they are.
        image = self.image.astype(np.float64)
        while image.shape[1] >= 8 * side and image.shape[0] % 2 == image.shape[1] % 2 == 0:
            image = (image[::2, ::2] + image[1::2, ::2] + image[::2, 1::2] + image[1::2, 1::2]) / 4.0
        mips = [_halved(_equirectangular(image, octahedral_directions(2 * side)))]
        while len(mips[-1]) > 1:
            mips.append(_halved(mips[-1]))
        return mips

    def _source(self, density: float) -> NDArray[np.float64]:
        """The picture at the scale of the solid angle that one of the samples stands for (Krivanek & Colbert 2008)."""
        angle = 1.0 / (self._SAMPLES * max(density, 1e-6))
        texel = 4.0 * math.pi / self.SIDES[0] ** 2
        level = round(0.5 * math.log2(max(angle / texel, 1.0)))
        return with_border(self._mips[min(level, len(self._mips) - 1)])

    def _filtered(self) -> list[NDArray[np.float64]]:
        """GGX lobes seen straight on, weighted by the cosine, as Karis 2013 has them."""
        levels = [self._mips[0]]
        for number, side in enumerate(self.SIDES[1:], 1):
            alpha2 = (number / (len(self.SIDES) - 1)) ** 4
            first, second = _hammersley(self._SAMPLES)
            cosine = np.sqrt((1.0 - first) / (1.0 + (alpha2 - 1.0) * first))
            half = _around(cosine, second)
            lobe = 2.0 * cosine[:, None] * half - (0.0, 0.0, 1.0)
            density = alpha2 / (math.pi * (cosine**2 * (alpha2 - 1.0) + 1.0) ** 2) / 4.0
            directions = octahedral_directions(side)
            total, weights = np.zeros_like(directions), 0.0
            for local, one in zip(lobe, density, strict=True):
                if local[2] > 0.0:
                    total += local[2] * _lookup(self._source(one), _turned(local, directions))
                    weights += local[2]
            levels.append(total / weights)
        return levels


@dataclass(frozen=True, eq=False)
class Lighting:
    """All light on a scene.

    Parameters
    ----------
    lights : sequence of DirectionalLight and PointLight
        At most 8 of each kind.
    ambient : Ambient
    environment : Environment, optional
        Takes the place of ``ambient``.

    Raises
    ------
    SceneError
    """

    lights: tuple[DirectionalLight | PointLight, ...] = ()
    ambient: Ambient = field(default_factory=Ambient)
    environment: Environment | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "lights", tuple(self.lights))
        for light in self.lights:
            if not isinstance(light, DirectionalLight | PointLight):
                raise SceneError(f"Lighting takes DirectionalLight and PointLight; got {type(light).__name__}.")
        if not isinstance(self.ambient, Ambient):
            raise SceneError(f"Lighting ambient must be an Ambient; got {type(self.ambient).__name__}.")
        if not isinstance(self.environment, Environment | None):
            raise SceneError(f"Lighting environment must be an Environment; got {type(self.environment).__name__}.")
        for kind in (DirectionalLight, PointLight):
            count = sum(isinstance(light, kind) for light in self.lights)
            if count > MAX_LIGHTS:
                raise SceneError(f"There are {count} lights of kind {kind.__name__}; at most {MAX_LIGHTS} are drawn.")

    def arrays(self) -> dict[str, NDArray[np.float64]]:
        """Lights by kind, one a row; spot lights have the cosines of both half angles, others an axis of 0."""
        suns = [light for light in self.lights if isinstance(light, DirectionalLight)]
        points = [light for light in self.lights if isinstance(light, PointLight)]
        towards = -np.array([light.direction for light in suns], np.float64).reshape(-1, 3)
        axes = np.array([light.direction or (0.0, 0.0, 0.0) for light in points], np.float64).reshape(-1, 3)
        lengths = np.linalg.norm(axes, axis=1, keepdims=True)
        return {
            "directional_to_light": towards / np.linalg.norm(towards, axis=1, keepdims=True),
            "directional_color": np.array([light.color for light in suns], np.float64).reshape(-1, 3),
            "point_position": np.array([light.position for light in points], np.float64).reshape(-1, 3),
            "point_color": np.array([light.color for light in points], np.float64).reshape(-1, 3),
            "point_axis": axes / np.where(lengths > 0.0, lengths, 1.0),
            "point_cone": np.cos(np.radians([light.cone_deg for light in points])).reshape(-1, 2),
        }

    def packed(self, camera: Camera, guard_px: int) -> NDArray[np.float32]:
        """Lights and camera as kernels/shading.clh takes them, ``SHADING_FLOATS`` of float32."""
        parts = self.arrays()
        rows = np.zeros((2 + 6 + 4 * 2 * MAX_LIGHTS, 4))
        suns, points = len(parts["directional_color"]), len(parts["point_color"])
        rows[0, :2] = suns, points
        rows[1] = camera.focal_px, camera.width / 2.0 + guard_px, camera.height / 2.0 + guard_px, 0.0
        rows[2, :3], rows[3, :3] = self.ambient.sky, self.ambient.ground
        rows[4:8, :3] = camera.pose[:3].T  # right, up, back, eye
        for row, light in enumerate(np.arange(suns) * 4 + 8):
            rows[light, :3], rows[light + 1, :3] = parts["directional_to_light"][row], parts["directional_color"][row]
        for row, light in enumerate(np.arange(points) * 4 + 8 + 4 * MAX_LIGHTS):
            outer, inner = parts["point_cone"][row, ::-1]
            rows[light, :3], rows[light + 1, :3] = parts["point_position"][row], parts["point_color"][row]
            rows[light + 2, :3], rows[light + 3, :2] = parts["point_axis"][row], (outer, max(inner, outer + 1e-4))
            rows[light + 3, 2] = parts["point_axis"][row].any()
        return rows.astype(np.float32)

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers; the environment's picture is left to the caller."""
        lights: list[dict[str, Any]] = []
        for light in self.lights:
            if isinstance(light, DirectionalLight):
                lights.append({"direction": light.direction, "color": light.color})
            else:
                spot = {"position": light.position, "color": light.color}
                lights.append({**spot, "direction": light.direction, "cone_deg": light.cone_deg})
        return {"lights": lights, "ambient": {"sky": self.ambient.sky, "ground": self.ambient.ground}}

    @classmethod
    def from_dict(cls, data: dict[str, Any], environment: Environment | None = None) -> Lighting:
        """Read what :meth:`to_dict` wrote."""
        lights = [PointLight(**light) if "position" in light else DirectionalLight(**light) for light in data["lights"]]
        return cls(tuple(lights), Ambient(**data["ambient"]), environment)


def octahedral_directions(side: int) -> NDArray[np.float64]:
    """Unit vectors at the texels of an octahedral map, (side, side, 3): x right, z down, +y in the middle."""
    at = (np.arange(side) + 0.5) * 2.0 / side - 1.0
    z, x = np.meshgrid(at, at, indexing="ij")
    y = 1.0 - np.abs(x) - np.abs(z)
    fold = np.maximum(-y, 0.0)
    vectors = np.stack([x - np.copysign(fold, x), y, z - np.copysign(fold, z)], axis=-1)
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))


def with_border(level: NDArray[Any]) -> NDArray[Any]:
    """Add the texel that lies beyond each edge, where the map is folded over."""
    side = len(level)
    result = np.empty((side + 2, side + 2, level.shape[2]), level.dtype)
    result[1:-1, 1:-1] = level
    result[0, 1:-1], result[-1, 1:-1] = level[0, ::-1], level[-1, ::-1]
    result[1:-1, 0], result[1:-1, -1] = level[::-1, 0], level[::-1, -1]
    result[0, 0], result[0, -1] = level[-1, -1], level[-1, 0]
    result[-1, 0], result[-1, -1] = level[0, -1], level[0, 0]
    return result


def _halved(level: NDArray[np.float64]) -> NDArray[np.float64]:
    return (level[::2, ::2] + level[1::2, ::2] + level[::2, 1::2] + level[1::2, 1::2]) / 4.0


def _between(image: NDArray[Any], x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
    """Between texels; x and y count from the middle of the first one."""
    left, top = (np.clip(np.floor(v).astype(int), 0, n - 2) for v, n in ((x, image.shape[1]), (y, image.shape[0])))
    right, down = (x - left)[..., None], (y - top)[..., None]
    above = image[top, left] * (1.0 - right) + image[top, left + 1] * right
    below = image[top + 1, left] * (1.0 - right) + image[top + 1, left + 1] * right
    return np.asarray(above * (1.0 - down) + below * down)


def _lookup(bordered: NDArray[Any], directions: NDArray[np.float64]) -> NDArray[np.float64]:
    """An octahedral map with a border, seen in unit directions."""
    side = len(bordered) - 2
    x, y, z = np.moveaxis(directions / np.abs(directions).sum(axis=-1, keepdims=True), -1, 0)
    fold = np.maximum(-y, 0.0)
    x, z = x + np.copysign(fold, x), z + np.copysign(fold, z)
    return _between(bordered, (x + 1.0) * side / 2.0 + 0.5, (z + 1.0) * side / 2.0 + 0.5)


def _equirectangular(image: NDArray[np.float64], directions: NDArray[np.float64]) -> NDArray[np.float64]:
    height, width = image.shape[:2]
    x, y, z = np.moveaxis(directions, -1, 0)
    column = (np.arctan2(x, -z) / (2.0 * math.pi) + 0.5) * width + 0.5
    row = np.arccos(np.clip(y, -1.0, 1.0)) / math.pi * height - 0.5
    around = np.concatenate([image[:, -1:], image, image[:, :1]], axis=1)
    return _between(around, column, np.clip(row, 0.0, height - 1.0))


def _hammersley(count: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Two coordinates in (0, 1), even in each."""
    index = np.arange(count)
    bits = sum(((index >> bit) & 1) / 2.0 ** (bit + 1) for bit in range(count.bit_length()))
    return (index + 0.5) / count, np.asarray(bits)


def _around(cosine: NDArray[np.float64], turn: NDArray[np.float64]) -> NDArray[np.float64]:
    """Unit vectors with a cosine to +z, (N, 3)."""
    sine = np.sqrt(np.maximum(0.0, 1.0 - cosine**2))
    return np.stack([sine * np.cos(2 * np.pi * turn), sine * np.sin(2 * np.pi * turn), cosine], axis=-1)


def _turned(local: NDArray[np.float64], directions: NDArray[np.float64]) -> NDArray[np.float64]:
    """A vector given in frames around directions."""
    axis = np.where(np.abs(directions[..., :1]) < 0.9, (1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
    right = np.cross(axis, directions)
    right /= np.linalg.norm(right, axis=-1, keepdims=True)
    return np.asarray(right * local[0] + np.cross(directions, right) * local[1] + directions * local[2])
