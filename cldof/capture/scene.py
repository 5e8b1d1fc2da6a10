"""What a scene is: meshes with materials, lights, a sky and a camera. Plain data; no OpenGL is needed to build one.

World axes are y up, metres, right-handed; colours are linear light. Objects are shared by identity: nodes that hold the
same mesh, material and texture objects are uploaded once, and a scene rebuilt around the same objects (an animation)
uploads nothing new. So treat them as immutable and make new ones for new content.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from ..camera import Camera
from ..errors import SceneError
from ..lighting import Ambient, DirectionalLight, Environment, Lighting, PointLight, checked_color

__all__ = ["Ambient", "DirectionalLight", "Environment", "Gradient", "Material", "Node", "PointLight", "Scene"]

# A scene without a camera is seen through this angle and fills this share of the image.
_FRAMING_FOV_DEG, _FRAMING_FILL = 30.0, 0.84

RGB = tuple[float, float, float]
RGBA = tuple[float, float, float, float]


@dataclass(frozen=True, eq=False)
class Material:
    """How a surface looks: glTF's metallic-roughness model, factors in linear light, textures in 8-bit sRGB.

    Vertex or face colours of the mesh, when it has any, multiply ``base_color``: 8-bit ones (trimesh's ``visual``) are
    sRGB, a ``"color"`` attribute of textured meshes is linear.

    Parameters
    ----------
    base_color : RGBA, linear
    base_color_texture, emissive_texture : PIL.Image.Image, optional
        Multiply their factors; row 0 of the image is at v = 1, as trimesh has it.
    metallic, roughness : float, 0 to 1
    metallic_roughness_texture : PIL.Image.Image, optional
        Multiplies them: green is roughness, blue is metallic, linear.
    emissive : RGB, linear
        Light given off; above 1 is legal and kept (HDR).
    alpha_mode : {"opaque", "mask", "blend"}
        Ignore alpha, cut at ``alpha_cutoff``, or use it as coverage.
    double_sided : bool
        Back faces are drawn too, with the normal turned to the viewer.
    unlit : bool
        Show base colour (plus emission) as it is.
    """

    base_color: RGBA = (0.6, 0.6, 0.6, 1.0)
    base_color_texture: Any = None
    metallic: float = 0.0
    roughness: float = 0.6
    metallic_roughness_texture: Any = None
    emissive: RGB = (0.0, 0.0, 0.0)
    emissive_texture: Any = None
    alpha_mode: str = "opaque"
    alpha_cutoff: float = 0.5
    double_sided: bool = False
    unlit: bool = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "base_color", checked_color(self.base_color, "Material base_color", 4))
        object.__setattr__(self, "emissive", checked_color(self.emissive, "Material emissive", 3))
        if self.alpha_mode not in ("opaque", "mask", "blend"):
            raise SceneError(f"Material alpha_mode is {self.alpha_mode!r}; use 'opaque', 'mask' or 'blend'.")


@dataclass(frozen=True, eq=False)
class Node:
    """One mesh placed in the world.

    Parameters
    ----------
    mesh : trimesh.Trimesh
        Geometry, ``vertex_normals``, texture coordinates (``visual.uv``) and colours are taken from it. trimesh smooths
        normals over every edge: :func:`cldof.capture.normals.with_crease_normals` keeps the edges of a box hard.
    transform : array_like, (4, 4)
        Mesh to world; any affine map that can be inverted.
    material : Material
    name : str, optional
        To find the node again, for instance to focus on it.
    """

    mesh: trimesh.Trimesh
    transform: NDArray[np.float64] = field(default_factory=lambda: np.eye(4))
    material: Material = field(default_factory=Material)
    name: str | None = None

    def __post_init__(self) -> None:
        transform = np.array(self.transform, dtype=np.float64)
        if transform.shape != (4, 4) or not np.isfinite(transform).all():
            raise SceneError(f"Node transform must be a finite 4x4 matrix; got shape {transform.shape}.")
        transform.setflags(write=False)
        object.__setattr__(self, "transform", transform)


@dataclass(frozen=True)
class Gradient:
    """A sky at infinity: ``top`` straight up (+y), ``bottom`` straight down, linear in the sine of elevation."""

    top: RGB
    bottom: RGB

    def __post_init__(self) -> None:
        object.__setattr__(self, "top", checked_color(self.top, "Gradient top", 3))
        object.__setattr__(self, "bottom", checked_color(self.bottom, "Gradient bottom", 3))


@dataclass(frozen=True, eq=False)
class Scene:
    """Everything that a capture needs except the image size and the lens.

    Parameters
    ----------
    name : str
    nodes : sequence of Node
    camera : Camera, optional
        A good view; None frames the whole scene. :meth:`camera_for` gives it at any image size.
    lights : sequence of DirectionalLight and PointLight
        At most 8 of each kind.
    ambient : Ambient
    background : None, RGB, Gradient or Environment
        None is a transparent void; else a sky at infinity, in linear light.
    environment : Environment, optional
        Lights the scene in place of ``ambient``, and is what glossy surfaces mirror.
    focus_distance_m, aperture_radius_m : float, optional
        Suggestions of whoever made the scene.
    unlit : bool
        Show all materials unlit.
    view_from_deg : (azimuth, elevation)
        Where a scene without a camera is seen from: turned from +z towards +x, raised towards +y.
    """

    name: str
    nodes: tuple[Node, ...]
    camera: Camera | None = None
    lights: tuple[DirectionalLight | PointLight, ...] = ()
    ambient: Ambient = field(default_factory=Ambient)
    background: RGB | Gradient | Environment | None = None
    focus_distance_m: float | None = None
    aperture_radius_m: float | None = None
    unlit: bool = False
    view_from_deg: tuple[float, float] = (30.0, 14.0)
    environment: Environment | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "nodes", tuple(self.nodes))
        object.__setattr__(self, "lights", tuple(self.lights))
        if self.background is not None and not isinstance(self.background, Gradient | Environment):
            object.__setattr__(self, "background", checked_color(self.background, "Scene background", 3))
        try:
            Lighting(self.lights, self.ambient, self.environment)
        except SceneError as error:
            raise SceneError(f"Scene {self.name!r}: {error}") from None

    @cached_property
    def lighting(self) -> Lighting:
        """All that lights the scene."""
        return Lighting(self.lights, self.ambient, self.environment)

    @cached_property
    def bounds(self) -> NDArray[np.float64]:
        """(2, 3) corners of the world-space box around all vertices, in metres.

        Raises
        ------
        SceneError
            If the scene has no vertices.
        """
        corners = []
        for node in self.nodes:
            if len(node.mesh.vertices):
                world = trimesh.transform_points(node.mesh.vertices, node.transform)
                corners += [world.min(axis=0), world.max(axis=0)]
        if not corners:
            raise SceneError(f"Scene {self.name!r} is empty: it has no vertices.")
        return np.array([np.min(corners, axis=0), np.max(corners, axis=0)])

    @property
    def has_blending(self) -> bool:
        """True when a material uses alpha as coverage, so that one layer does not make an image."""
        return any(node.material.alpha_mode == "blend" for node in self.nodes)

    def camera_for(self, width: int, height: int) -> Camera:
        """The scene's camera at another image size, or one that frames the scene if it has none.

        The vertical field of view stays; in an image narrower than the camera's own, the horizontal one stays instead,
        so that what was framed is still seen.

        Raises
        ------
        SceneError
            If the scene has neither a camera nor vertices.
        """
        if self.camera is None:
            return self._framing_camera(width, height)
        camera = replace(self.camera, width=width, height=height)
        narrowing = (self.camera.width / self.camera.height) / (camera.width / camera.height)
        if narrowing <= 1.0:
            return camera
        half = math.tan(math.radians(self.camera.yfov_deg) / 2.0)
        return replace(camera, yfov_deg=math.degrees(2.0 * math.atan(half * narrowing)))

    def _framing_camera(self, width: int, height: int) -> Camera:
        """The nearest camera in direction ``view_from_deg`` that sees all vertices, centred, with a margin."""
        size = float(np.linalg.norm(self.bounds[1] - self.bounds[0]))
        azimuth, elevation = (math.radians(angle) for angle in self.view_from_deg)
        level = math.cos(elevation)
        back = np.array([math.sin(azimuth) * level, math.sin(elevation), math.cos(azimuth) * level])
        right = np.array([math.cos(azimuth), 0.0, -math.sin(azimuth)])
        rotation = np.stack([right, np.cross(back, right), back], axis=1)
        # A narrow image gets the angle across its width, not its height.
        half = math.tan(math.radians(_FRAMING_FOV_DEG) / 2.0) * max(1.0, height / width)
        camera = Camera(width, height, math.degrees(2.0 * math.atan(half)))
        slope = _FRAMING_FILL * half * np.array([width / height, 1.0])
        # The four planes of the frustum touch the vertices: two opposite planes give a centre and a distance.
        local = np.concatenate([trimesh.transform_points(n.mesh.vertices, n.transform) for n in self.nodes]) @ rotation
        high = (local[:, :2] / slope + local[:, 2:]).max(axis=0)
        low = (-local[:, :2] / slope + local[:, 2:]).max(axis=0)
        centre = (high - low) * slope / 2.0
        distance = max(float((high + low).max()) / 2.0, float(local[:, 2].max()) + 1e-3 * size)
        pose = np.eye(4)
        pose[:3, :3] = rotation
        pose[:3, 3] = rotation @ (centre[0], centre[1], distance)
        return replace(camera, near=1e-3 * max(size, distance - float(local[:, 2].min()), 1e-9), pose=pose)
