"""Model files to scenes: geometry and images through trimesh, what it drops or rounds from the glTF JSON itself."""

from __future__ import annotations

import io
import json
import logging
import math
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from ..camera import Camera
from ..errors import SceneError
from ..files import parse_json
from ..images import check_picture, srgb_from_linear
from .gltf_check import check_gltf, file_within
from .normals import merged_faces, with_crease_normals
from .scene import Ambient, DirectionalLight, Gradient, Material, Node, PointLight, Scene

__all__ = ["load_scene", "studio_lights"]

_GLB_MAGIC, _GLB_JSON, _GLB_HEADER = b"glTF", 0x4E4F534A, 12
_TAG = "cldof-material-"
_UNREADABLE = {"KHR_draco_mesh_compression", "EXT_meshopt_compression", "KHR_mesh_quantization"}
# glTF says y up; CAD and printing formats have z up by custom; the others say nothing.
_UP_BY_SUFFIX = {".glb": "y", ".gltf": "y", ".stl": "z", ".3mf": "z"}
_UP_AXES = {"x": (1, 0, 0), "y": (0, 1, 0), "z": (0, 0, 1), "-x": (-1, 0, 0), "-y": (0, -1, 0), "-z": (0, 0, -1)}
# A model stands on a flat base when faces within this share of its extent fill this share of its outline there.
_BASE_DEPTH, _BASE_FILL = 0.02, 0.2
# A mesh without a material counts as open, and is drawn from both sides, when more of its edges than this have one face
# only: a scan with a few holes stays closed, a teapot without a bottom does not.
_OPEN_EDGES = 0.01
_STUDIO_SKY = Gradient(top=(1.0, 1.0, 1.0), bottom=(0.1, 0.105, 0.115))
_STUDIO_AMBIENT = Ambient(sky=(0.25, 0.26, 0.28), ground=(0.08, 0.075, 0.07))
# What the lights of a file add up to at the middle of the scene (files give candela and lux, of any exposure).
_FILE_LIGHT_SUM = 1.2


def load_scene(
    path: str | Path,
    *,
    unlit: bool = False,
    up: str | None = None,
    azimuth_deg: float = 30.0,
    elevation_deg: float = 14.0,
    background: Any = "studio",
) -> Scene:
    """Read a model file: glTF (.glb, .gltf), .obj, .ply, .stl, .off or anything else that trimesh reads.

    Cameras, lights, unlit and emissive materials of glTF are kept. What a file lacks is supplied: normals, a
    three-quarter view that fits the model, studio lights and a soft grey background.

    Parameters
    ----------
    path : path
    unlit : bool
        Show base colours as they are.
    up : {"x", "y", "z", "-x", "-y", "-z"}, optional
        The file's up axis, which is turned to y. By default y for glTF and z for .stl and .3mf; for the others it
        points away from the model's one flat base, and is y when there is none.
    azimuth_deg, elevation_deg : float
        From where to look when the file has no camera: turned from +z towards +x, raised towards +y.
    background : "studio", None, RGB or Gradient
        None is a transparent void.

    Returns
    -------
    Scene

    Raises
    ------
    SceneError
        If the file is missing, cannot be read, or holds no triangles with an area.
    """
    path = Path(path)
    if up is not None and up not in _UP_AXES:
        raise SceneError(f"up is {up!r}; it must be one of {', '.join(_UP_AXES)}, or None.")
    if not path.is_file():
        raise SceneError(f"Cannot read scene {path}: {'it is a folder' if path.is_dir() else 'no such file'}.")
    suffix = path.suffix.lower()
    document: dict[str, Any] = {}
    try:
        with _quiet():
            if suffix in (".glb", ".gltf"):
                document, content = _tagged_gltf(path)
                loaded = trimesh.load_scene(
                    io.BytesIO(content), file_type=suffix[1:], resolver=_Folder(path), process=False
                )
            else:
                loaded = trimesh.load_scene(str(path), resolver=_Folder(path), process=False)
            nodes = _nodes(loaded, document, path)
    except SceneError as error:
        if str(path) in str(error):
            raise
        raise SceneError(f"Cannot read scene {path}: {error}") from error
    except MemoryError as error:
        raise SceneError(f"Cannot read scene {path}: not enough memory.") from error
    except Exception as error:
        reason = " ".join(str(error).split())[:200]
        raise SceneError(
            f"Cannot read scene {path}: {type(error).__name__}: {reason}. The file may be damaged or of a format that "
            "is not read; glb, gltf, obj, ply, stl and off are."
        ) from error
    up = up or _UP_BY_SUFFIX.get(suffix) or _guess_up(nodes)
    if up != "y":
        turn = trimesh.geometry.align_vectors(_UP_AXES[up], _UP_AXES["y"])
        nodes = [replace(node, transform=turn @ node.transform) for node in nodes]
    bare = Scene(path.stem, tuple(nodes), view_from_deg=(azimuth_deg, elevation_deg))
    camera = _gltf_camera(document, bare)
    lights = _gltf_lights(document, bare.bounds.mean(axis=0))
    return replace(
        bare,
        camera=camera,
        lights=lights or studio_lights(camera or bare.camera_for(512, 512)),
        ambient=Ambient((0.12,) * 3, (0.06,) * 3) if lights else _STUDIO_AMBIENT,
        background=_STUDIO_SKY if isinstance(background, str) and background == "studio" else background,
        unlit=unlit,
    )


def studio_lights(camera: Camera) -> tuple[DirectionalLight, ...]:
    """A warm key from the upper left of the camera, a cool fill from the right, a rim light from behind."""
    rotation = camera.pose[:3, :3]

    def light(towards: tuple[float, float, float], color: tuple[float, float, float]) -> DirectionalLight:
        x, y, z = -(rotation @ np.array(towards))
        return DirectionalLight((float(x), float(y), float(z)), color)

    return (
        light((-0.6, 0.75, 0.65), (0.80, 0.77, 0.72)),
        light((0.9, 0.15, 0.6), (0.13, 0.15, 0.18)),
        light((0.35, 0.6, -0.9), (0.65, 0.68, 0.74)),
    )


class _Folder(trimesh.resolvers.FilePathResolver):  # type: ignore[misc]
    """What a model may open beside itself: files of its own folder."""

    def __init__(self, path: Path) -> None:
        super().__init__(str(path))
        self._folder = path.absolute().parent

    def get(self, name: str) -> bytes:
        """Contents of a file."""
        return file_within(self._folder, name).read_bytes()

    def namespaced(self, namespace: str) -> _Folder:
        """The same for a folder below."""
        return _Folder(file_within(self._folder, namespace) / "_")


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep trimesh's log and the warnings of what it calls from the caller's terminal."""
    loggers = [logging.getLogger(name) for name in logging.root.manager.loggerDict if name.split(".")[0] == "trimesh"]
    before = [logger.disabled for logger in loggers]
    for logger in loggers:
        logger.disabled = True
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        for logger, disabled in zip(loggers, before, strict=True):
            logger.disabled = disabled


def _tagged_gltf(path: Path) -> tuple[dict[str, Any], bytes]:
    """The glTF JSON, and the file with each material named by its index, so that trimesh's can be matched to them."""
    raw = path.read_bytes()
    is_binary = raw[:4] == _GLB_MAGIC
    rest = b""
    if is_binary:
        length, kind = int.from_bytes(raw[12:16], "little"), int.from_bytes(raw[16:20], "little")
        if kind != _GLB_JSON or len(raw) < _GLB_HEADER + 8 + length:
            raise SceneError(f"Cannot read scene {path}: the file is cut short or is not glTF 2.0.")
        text, rest = raw[20 : 20 + length], raw[20 + length :]
    else:
        text = raw
    document = parse_json(text)
    if not isinstance(document, dict) or not str(document.get("asset", {}).get("version", "")).startswith("2"):
        raise SceneError(f"Cannot read scene {path}: it is not glTF 2.0.")
    missing = sorted(_UNREADABLE & set(document.get("extensionsRequired", ())))
    if missing:
        raise SceneError(f"Cannot read scene {path}: it needs {', '.join(missing)}. Export it without compression.")
    check_gltf(document, memoryview(rest)[8:], path.absolute().parent)
    materials = [{**material, "name": f"{_TAG}{index}"} for index, material in enumerate(document.get("materials", ()))]
    tagged = json.dumps({**document, "materials": materials} if materials else document).encode()
    if is_binary:
        tagged += b" " * (-len(tagged) % 4)
        chunk = len(tagged).to_bytes(4, "little") + _GLB_JSON.to_bytes(4, "little") + tagged + rest
        tagged = raw[:8] + (_GLB_HEADER + len(chunk)).to_bytes(4, "little") + chunk
    return document, tagged


def _nodes(loaded: Any, document: dict[str, Any], path: Path) -> list[Node]:
    materials: dict[Any, Material] = {}
    meshes: dict[str, tuple[trimesh.Trimesh, Material] | None] = {}
    nodes, area = [], 0.0
    for name in loaded.graph.nodes_geometry:
        transform, geometry_name = loaded.graph[name]
        if geometry_name not in meshes:
            meshes[geometry_name] = _mesh(loaded.geometry[geometry_name], materials, document, path)
        entry = meshes[geometry_name]
        if entry is None:
            continue
        if abs(float(np.linalg.det(np.asarray(transform)[:3, :3]))) > 0.0:  # a node scaled to 0 is hidden
            nodes.append(Node(entry[0], transform, entry[1], str(name)))
            area += float(entry[0].area)
    if not nodes:
        raise SceneError(f"Scene {path} is empty: it holds no triangles.")
    if not area > 0.0:
        raise SceneError(f"Scene {path} has nothing to show: all of its triangles have zero area.")
    return nodes


def _mesh(
    mesh: Any, materials: dict[Any, Material], document: dict[str, Any], path: Path
) -> tuple[trimesh.Trimesh, Material] | None:
    if not isinstance(mesh, trimesh.Trimesh) or not len(mesh.faces):
        return None
    bad = ~np.isfinite(mesh.vertices).all(axis=1)
    if bad.any():
        raise SceneError(
            f"Scene {path} has {int(bad.sum())} vertices with NaN or infinite coordinates, the first is number "
            f"{int(np.argmax(bad))}; repair the file."
        )
    source = getattr(mesh.visual, "material", None) if mesh.visual.kind == "texture" else None
    name = str(getattr(source, "name", "") or "")
    if document:
        key: Any = int(name[len(_TAG) :]) if name.startswith(_TAG) else None
        if key not in materials:
            materials[key] = _gltf_material(None if key is None else document["materials"][key], source)
        if mesh.visual.kind == "vertex":  # trimesh keeps glTF's linear colours in bytes, where a Scene has sRGB
            colors = np.asarray(mesh.visual.vertex_colors).copy()
            colors[:, :3] = np.round(srgb_from_linear(colors[:, :3] / 255.0) * 255.0)
            mesh.visual.vertex_colors = colors
    else:
        is_open = _is_open(mesh)
        key = (id(source), is_open, mesh.visual.defined)
        if key not in materials:
            materials[key] = _plain_material(source, is_open, has_colors=mesh.visual.kind in ("vertex", "face"))
    if "vertex_normals" not in mesh._cache.cache or not np.asarray(mesh.vertex_normals).any(axis=1).all():
        mesh = with_crease_normals(mesh)
    return mesh, materials[key]


def _guess_up(nodes: list[Node]) -> str:
    """The axis away from the one flat base that the model has, y if it has none or stands along y already."""
    triangles = np.concatenate([trimesh.transform_points(n.mesh.triangles.reshape(-1, 3), n.transform) for n in nodes])
    triangles = triangles.reshape(-1, 3, 3)
    areas = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]) / 2.0
    extent = np.maximum(np.ptp(triangles.reshape(-1, 3), axis=0), 1e-300)
    bases = []
    for name, axis in _UP_AXES.items():
        up = np.array(axis, dtype=np.float64)
        height = triangles @ up
        low = (height < height.min() + _BASE_DEPTH * (extent @ np.abs(up))).all(axis=1)
        outline = np.prod(extent[up == 0.0])
        if np.maximum(-areas[low] @ up, 0.0).sum() > _BASE_FILL * outline:
            bases.append(name)
    return bases[0] if len(bases) == 1 else "y"


def _is_open(mesh: trimesh.Trimesh) -> bool:
    faces = merged_faces(mesh)
    edges = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    _, count = np.unique(edges, axis=0, return_counts=True)
    return bool((count == 1).mean() > _OPEN_EDGES)


def _gltf_material(data: dict[str, Any] | None, source: Any) -> Material:
    """Factors from the JSON (trimesh rounds them to bytes), images from trimesh."""
    if data is None:
        return Material(base_color=(1.0, 1.0, 1.0, 1.0))
    surface, extensions = data.get("pbrMetallicRoughness", {}), data.get("extensions", {})
    strength = float(extensions.get("KHR_materials_emissive_strength", {}).get("emissiveStrength", 1.0))
    red, green, blue = (strength * float(v) for v in data.get("emissiveFactor", (0.0, 0.0, 0.0)))
    return Material(
        base_color=tuple(surface.get("baseColorFactor", (1.0, 1.0, 1.0, 1.0))),
        base_color_texture=_texture(source, "baseColorTexture"),
        metallic=float(surface.get("metallicFactor", 1.0)),
        roughness=float(surface.get("roughnessFactor", 1.0)),
        metallic_roughness_texture=_texture(source, "metallicRoughnessTexture"),
        emissive=(red, green, blue),
        emissive_texture=_texture(source, "emissiveTexture"),
        alpha_mode=str(data.get("alphaMode", "OPAQUE")).lower(),
        alpha_cutoff=float(data.get("alphaCutoff", 0.5)),
        double_sided=bool(data.get("doubleSided", False)),
        unlit="KHR_materials_unlit" in extensions,
    )


def _texture(source: Any, name: str) -> Any:
    """An image of a material, decoded now, so that a damaged one is found here and not when it is drawn."""
    image = getattr(source, name, None)
    if image is not None:
        check_picture(image, f"its {name}", SceneError)
        image.load()
    return image


def _plain_material(source: Any, is_open: bool, has_colors: bool) -> Material:
    """For formats with simple materials or none: diffuse colour and image, shininess, opacity."""
    if not isinstance(source, trimesh.visual.material.SimpleMaterial):
        base = (1.0, 1.0, 1.0, 1.0) if has_colors else (0.5, 0.5, 0.5, 1.0)
        image = _texture(source, "baseColorTexture")
        return Material(base_color=base, base_color_texture=image, double_sided=is_open)
    red, green, blue, alpha = (float(v) / 255.0 for v in source.diffuse)
    shininess = float(np.ravel(source.kwargs.get("ns", source.glossiness or 10.0))[0])
    return Material(
        base_color=(red, green, blue, alpha),
        base_color_texture=_texture(source, "image"),
        roughness=(2.0 / (max(shininess, 0.0) + 2.0)) ** 0.25,
        alpha_mode="blend" if alpha < 1.0 else "opaque",
        double_sided=is_open or alpha < 1.0,
    )


def _gltf_nodes(document: dict[str, Any]) -> Iterator[tuple[dict[str, Any], NDArray[np.float64]]]:
    """Nodes of the file's scene with their world transforms."""
    nodes, scenes = document.get("nodes", []), document.get("scenes", [])
    roots = scenes[document.get("scene", 0)].get("nodes", []) if scenes else []
    stack = [(index, np.eye(4)) for index in reversed(roots)]
    while stack:
        index, parent = stack.pop()
        node = nodes[index]
        world = parent @ _gltf_transform(node)
        yield node, world
        stack += [(child, world) for child in reversed(node.get("children", []))]


def _gltf_transform(node: dict[str, Any]) -> NDArray[np.float64]:
    if "matrix" in node:
        return np.array(node["matrix"], dtype=np.float64).reshape(4, 4).T
    x, y, z, w = node.get("rotation", (0.0, 0.0, 0.0, 1.0))
    transform: NDArray[np.float64] = trimesh.transformations.quaternion_matrix((w, x, y, z))
    transform[:3, :3] *= np.array(node.get("scale", (1.0, 1.0, 1.0)), dtype=np.float64)
    transform[:3, 3] = node.get("translation", (0.0, 0.0, 0.0))
    return transform


def _rigid(world: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """The rotation and place of a transform, without its scale; None where a mirror or a zero scale leaves none."""
    u, size, v = np.linalg.svd(world[:3, :3])
    if size[2] <= 1e-12 * size[0] or np.linalg.det(u @ v) < 0.0:
        return None
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = u @ v, world[:3, 3]
    return pose


def _gltf_camera(document: dict[str, Any], scene: Scene) -> Camera | None:
    """The file's first perspective camera. Its clipping planes are not used: nothing needs them, and they may cut."""
    for node, world in _gltf_nodes(document):
        if "camera" not in node:
            continue
        data, pose = document["cameras"][node["camera"]].get("perspective"), _rigid(world)
        if data is None or pose is None:
            continue
        yfov, aspect = math.degrees(float(data["yfov"])), float(data.get("aspectRatio", 1.0))
        distance = float(np.linalg.norm(scene.bounds.mean(axis=0) - pose[:3, 3]))
        size = float(np.linalg.norm(scene.bounds[1] - scene.bounds[0]))
        return Camera(max(1, round(1024 * aspect)), 1024, yfov, near=1e-3 * max(distance, size), pose=pose)
    return None


def _gltf_lights(document: dict[str, Any], centre: NDArray[np.float64]) -> tuple[DirectionalLight | PointLight, ...]:
    """KHR_lights_punctual, at most 8 of a kind, scaled together so that they add up to :data:`_FILE_LIGHT_SUM`."""
    data = document.get("extensions", {}).get("KHR_lights_punctual", {}).get("lights", [])
    found: list[tuple[dict[str, Any], NDArray[np.float64]]] = []
    for node, world in _gltf_nodes(document):
        index = node.get("extensions", {}).get("KHR_lights_punctual", {}).get("light")
        pose = _rigid(world)
        if index is not None and pose is not None:
            found.append((data[index], pose))
    total = 0.0
    for light, pose in found:
        reach = 1.0 if light["type"] == "directional" else max(float(np.sum((pose[:3, 3] - centre) ** 2)), 1e-12)
        total += float(light.get("intensity", 1.0)) * float(np.mean(light.get("color", (1.0, 1.0, 1.0)))) / reach
    if not total > 0.0:
        return ()
    lights: list[DirectionalLight | PointLight] = []
    for light, pose in found:
        scale = float(light.get("intensity", 1.0)) * _FILE_LIGHT_SUM / total
        red, green, blue = (scale * float(v) for v in light.get("color", (1.0, 1.0, 1.0)))
        x, y, z = (float(v) for v in -pose[:3, 2])
        position = (float(pose[0, 3]), float(pose[1, 3]), float(pose[2, 3]))
        if light["type"] == "directional":
            lights.append(DirectionalLight((x, y, z), (red, green, blue)))
        elif light["type"] == "spot":
            spot = light.get("spot", {})
            cone = (spot.get("innerConeAngle", 0.0), spot.get("outerConeAngle", math.pi / 4.0))
            angles = (math.degrees(float(cone[0])), math.degrees(float(cone[1])))
            lights.append(PointLight(position, (red, green, blue), (x, y, z), angles))
        else:
            lights.append(PointLight(position, (red, green, blue)))
    directional = [light for light in lights if isinstance(light, DirectionalLight)]
    points = [light for light in lights if isinstance(light, PointLight)]
    return (*directional[:8], *points[:8])
