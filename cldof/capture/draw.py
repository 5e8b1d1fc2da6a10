"""One pass over a scene: pyrender keeps context, meshes and textures, the shaders beside this file do the drawing.

pyrender's own forward pass is not used: its shaders clamp, encode and quantise, its programs are text substitution with
errors swallowed, and it blends where a peel must not. Importing this module imports OpenGL (or raises
:class:`~cldof.CaptureError`), so the rest of the package imports it late.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import resources
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from ..camera import Camera
from ..errors import CaptureError, SceneError
from ..images import linear_from_srgb
from ..lens import Lens
from .gl_context import import_pyrender
from .scene import Environment, Gradient, Node, Scene

pyrender: Any = import_pyrender()

from OpenGL import GL as gl  # noqa: E402
from OpenGL.error import Error as GLError  # noqa: E402

__all__ = ["PassOptions", "SceneRenderer", "Target", "View", "opengl_errors"]

_SHADER_HEADER = "#version 330 core\n"
_PREVIOUS_UNIT, _BASE_UNIT, _EMISSIVE_UNIT, _ROUGHNESS_UNIT, _ENVIRONMENT_UNIT = 0, 1, 2, 3, 4
# Texels in a row, as shaders/environment.glsl has it.
_ENVIRONMENT_ROW = 512


@contextmanager
def opengl_errors(doing: str) -> Iterator[None]:
    """Turn what PyOpenGL raises into one :class:`~cldof.CaptureError` that says what was being done."""
    try:
        yield
    except GLError as error:
        reason = getattr(error, "description", None) or str(error)
        reason = reason.decode(errors="replace") if isinstance(reason, bytes) else str(reason)
        raise CaptureError(f"OpenGL failed while {doing}: {' '.join(reason.split())[:300]}") from error


@dataclass(frozen=True, eq=False)
class View:
    """A pinhole at one point of the lens; what lies in focus does not move (see shaders/projection.glsl).

    Parameters
    ----------
    camera : Camera
        Its size is that of the target, guard band included.
    lens_point : (x, y)
        Metres from the lens centre, camera axes.
    focus_distance_m : float
    jitter_px : (x, y)
        Shift of the sample inside the pixel, x right and y down.
    shade_from_lens_point : bool
        What surfaces mirror is what the lens point sees; False: what the lens centre sees, from everywhere.
    """

    camera: Camera
    lens_point: tuple[float, float] = (0.0, 0.0)
    focus_distance_m: float = math.inf
    jitter_px: tuple[float, float] = (0.0, 0.0)
    shade_from_lens_point: bool = False

    def uniforms(self) -> dict[str, Any]:
        """What projection.glsl and the shaders that include it need, worked out in float64."""
        camera = self.camera
        half = np.array([camera.width, camera.height]) / 2.0
        focal = camera.focal_px / half * (1.0, -1.0)  # y down in the window: row 0 of a read-back is the top row
        in_focus = math.isfinite(self.focus_distance_m)
        shift = focal * self.lens_point / (self.focus_distance_m if in_focus else 1.0)
        eye = camera.pose[:3, 3]
        if self.shade_from_lens_point:
            eye = eye + camera.pose[:3, :2] @ self.lens_point
        near, far = camera.near, camera.far
        depth_range = (near, 0.0) if math.isinf(far) else (near * far / (far - near), near / (far - near))
        return {
            "focal": focal,
            "depth_range": np.array(depth_range),
            "lens_shift": shift,
            "lens_point": np.array(self.lens_point),
            "focus": np.array([self.focus_distance_m, 1.0] if in_focus else [1.0, 0.0]),
            "jitter": -np.array(self.jitter_px) / half,
            "eye": eye,
            "to_world": camera.pose[:3, :3],
            "up": camera.pose[1, :3],
        }


@dataclass(frozen=True)
class PassOptions:
    """What a pass does beyond drawing.

    ``lens_reach_m``: back faces of single-sided materials are dropped unless a lens point within this radius sees their
    front; 0 drops all that this view sees from behind, None keeps them all. ``stop_at_opaque``: nothing is peeled
    behind an opaque fragment. ``surface``: write the surface buffers too. ``lod_bias``: mip levels that textures are
    coarser by.
    """

    lens_reach_m: float | None = None
    stop_at_opaque: bool = False
    surface: bool = False
    lod_bias: float = 0.0

    @classmethod
    def for_layers(cls, lens: Lens | None, surface: bool, lod_bias: float = 0.0) -> PassOptions:
        """A Gaussian lens has no rim: beyond twice its radius lie 3e-4 of its light."""
        return cls(None if lens is None else 2.0 * lens.aperture_radius_m, surface=surface, lod_bias=lod_bias)


class Target:
    """A framebuffer: colour (RGBA32F), inverse depth (R32F), optional surface buffers, 32-bit float depth test."""

    def __init__(self, width: int, height: int, surface: bool) -> None:
        self.width, self.height = width, height
        formats = [(gl.GL_RGBA32F, gl.GL_RGBA), (gl.GL_R32F, gl.GL_RED)]
        formats += [(gl.GL_RGBA32F, gl.GL_RGBA)] * 3 if surface else []
        self.textures: list[int] = []
        self.framebuffer = gl.glGenFramebuffers(1)
        gl.glBindFramebuffer(gl.GL_FRAMEBUFFER, self.framebuffer)
        for index, (internal, layout) in enumerate(formats):
            self._attach(gl.GL_COLOR_ATTACHMENT0 + index, internal, layout)
        self._attach(gl.GL_DEPTH_ATTACHMENT, gl.GL_DEPTH_COMPONENT32F, gl.GL_DEPTH_COMPONENT)
        self._layouts = [layout for _, layout in formats]
        buffers = [gl.GL_COLOR_ATTACHMENT0 + index for index in range(len(formats))]
        gl.glDrawBuffers(len(buffers), buffers)
        status = gl.glCheckFramebufferStatus(gl.GL_FRAMEBUFFER)
        if status != gl.GL_FRAMEBUFFER_COMPLETE:
            raise CaptureError(f"OpenGL cannot draw to a {width}x{height} float framebuffer (status {int(status):#x}).")

    def _attach(self, attachment: int, internal: int, layout: int) -> None:
        texture = gl.glGenTextures(1)
        self.textures.append(texture)
        gl.glActiveTexture(gl.GL_TEXTURE0)
        gl.glBindTexture(gl.GL_TEXTURE_2D, texture)
        gl.glTexImage2D(gl.GL_TEXTURE_2D, 0, internal, self.width, self.height, 0, layout, gl.GL_FLOAT, None)
        for name in (gl.GL_TEXTURE_MIN_FILTER, gl.GL_TEXTURE_MAG_FILTER):
            gl.glTexParameteri(gl.GL_TEXTURE_2D, name, gl.GL_NEAREST)
        gl.glFramebufferTexture2D(gl.GL_FRAMEBUFFER, attachment, gl.GL_TEXTURE_2D, texture, 0)

    @property
    def inverse_depth(self) -> int:
        """The texture that the next peel tests against."""
        return self.textures[1]

    def clear(self) -> None:
        """Bind for drawing; everything 0: no colour, nothing there."""
        gl.glBindFramebuffer(gl.GL_FRAMEBUFFER, self.framebuffer)
        gl.glViewport(0, 0, self.width, self.height)
        gl.glDepthMask(gl.GL_TRUE)
        gl.glClearColor(0.0, 0.0, 0.0, 0.0)
        gl.glClearDepth(0.0)
        gl.glClear(gl.GL_COLOR_BUFFER_BIT | gl.GL_DEPTH_BUFFER_BIT)

    def read(self, index: int, out: NDArray[np.float32]) -> NDArray[np.float32]:
        """Copy an attachment (its location in shaders/peel.glsl) into a C-contiguous array."""
        gl.glBindFramebuffer(gl.GL_READ_FRAMEBUFFER, self.framebuffer)
        gl.glReadBuffer(gl.GL_COLOR_ATTACHMENT0 + index)
        gl.glPixelStorei(gl.GL_PACK_ALIGNMENT, 1)
        gl.glReadPixels(0, 0, self.width, self.height, self._layouts[index], gl.GL_FLOAT, out)
        return out

    def delete(self) -> None:
        """Free it; the context must be current."""
        gl.glDeleteFramebuffers(1, [self.framebuffer])
        gl.glDeleteTextures(self.textures)


class _Program:
    """A compiled program whose uniforms are set by name; a name that it does not use is skipped."""

    def __init__(self, stem: str, defines: dict[str, int]) -> None:
        stages = []
        self.id = gl.glCreateProgram()
        header = _SHADER_HEADER + "".join(f"#define {name} {value}\n" for name, value in sorted(defines.items()))
        for suffix, kind in (("vert", gl.GL_VERTEX_SHADER), ("frag", gl.GL_FRAGMENT_SHADER)):
            source = header + _shader_source(f"{stem}.{suffix}")
            stage = gl.glCreateShader(kind)
            gl.glShaderSource(stage, source)
            gl.glCompileShader(stage)
            if not gl.glGetShaderiv(stage, gl.GL_COMPILE_STATUS):
                raise _build_failure(f"{stem}.{suffix}", defines, gl.glGetShaderInfoLog(stage), source)
            gl.glAttachShader(self.id, stage)
            stages.append(stage)
        gl.glLinkProgram(self.id)
        if not gl.glGetProgramiv(self.id, gl.GL_LINK_STATUS):
            raise _build_failure(stem, defines, gl.glGetProgramInfoLog(self.id), "")
        for stage in stages:
            gl.glDeleteShader(stage)
        self._locations: dict[str, int] = {}

    def set(self, values: dict[str, Any]) -> None:
        """Set uniforms of the bound program: bool, int, float, or float arrays whose last axis is the component."""
        for name, value in values.items():
            location = self._locations.get(name)
            if location is None:
                location = self._locations[name] = int(gl.glGetUniformLocation(self.id, name))
            if location < 0:
                continue
            if isinstance(value, (bool, int)):
                gl.glUniform1i(location, int(value))
            elif isinstance(value, float):
                gl.glUniform1f(location, value)
            else:
                array = np.ascontiguousarray(value, dtype=np.float32)
                if name in _MATRICES:
                    upload = gl.glUniformMatrix4fv if array.shape == (4, 4) else gl.glUniformMatrix3fv
                    upload(location, 1, gl.GL_TRUE, array)
                elif name in _SCALAR_ARRAYS:
                    gl.glUniform1fv(location, array.size, array)
                else:
                    upload = {2: gl.glUniform2fv, 3: gl.glUniform3fv, 4: gl.glUniform4fv}[array.shape[-1]]
                    upload(location, array.size // array.shape[-1], array)


_MATRICES = {"model", "model_view", "normal_matrix", "to_world"}
_SCALAR_ARRAYS = {"point_cone_inner"}


def _shader_source(name: str) -> str:
    """A shader's text with its ``#include "file"`` lines filled in, compiler messages numbered per included line."""
    text = (resources.files(__package__) / "shaders" / name).read_text(encoding="utf-8")
    lines = []
    for line in text.splitlines():
        start, _, rest = line.partition('"')
        lines.append(_shader_source(rest.rstrip('"')) if start == "#include " else line)
    return "\n".join(lines) + "\n"


def _build_failure(name: str, defines: dict[str, int], log: bytes | str, source: str) -> CaptureError:
    log = log.decode(errors="replace") if isinstance(log, bytes) else log
    numbered = "\n".join(f"{number:4d}  {line}" for number, line in enumerate(source.splitlines(), 1))
    return CaptureError(f"Shader {name} with {defines} did not compile:\n{log.strip()}\n{numbered}")


class _Texture(pyrender.Texture):  # type: ignore[misc]
    """An 8-bit image as a texture, trilinear and repeating.

    Colours are sRGB and decoded here into half floats: OpenGL's own sRGB textures may be decoded by an approximation
    (0.4 % off in Mesa 22).
    """

    def __init__(self, image: Any, is_color: bool) -> None:
        super().__init__(source=np.asarray(image.convert("RGBA")), source_channels="RGBA")
        self._is_color = is_color

    def _add_to_context(self) -> None:
        texels = self.source[::-1]
        internal, kind = gl.GL_RGBA8, gl.GL_UNSIGNED_BYTE
        if self._is_color:
            texels, internal, kind = srgb_bytes_to_linear(texels), gl.GL_RGBA16F, gl.GL_FLOAT
        height, width = texels.shape[:2]
        self._texid = gl.glGenTextures(1)
        gl.glActiveTexture(gl.GL_TEXTURE0 + _BASE_UNIT)
        gl.glBindTexture(gl.GL_TEXTURE_2D, self._texid)
        gl.glTexImage2D(gl.GL_TEXTURE_2D, 0, internal, width, height, 0, gl.GL_RGBA, kind, np.ascontiguousarray(texels))
        gl.glGenerateMipmap(gl.GL_TEXTURE_2D)
        gl.glTexParameteri(gl.GL_TEXTURE_2D, gl.GL_TEXTURE_MIN_FILTER, gl.GL_LINEAR_MIPMAP_LINEAR)
        gl.glTexParameteri(gl.GL_TEXTURE_2D, gl.GL_TEXTURE_MAG_FILTER, gl.GL_LINEAR)


@dataclass(frozen=True, eq=False)
class _Item:
    """A node made ready: its uploaded primitive, program defines and uniforms that no view changes."""

    primitive: Any
    defines: dict[str, int]
    uniforms: dict[str, Any]
    transform: NDArray[np.float64]
    textures: dict[int, Any]
    centre: NDArray[np.float64]
    mirrored: bool


class SceneRenderer(pyrender.Renderer):  # type: ignore[misc]
    """Draws one pass at a time of a scene into a :class:`Target`. Every call needs its context to be current.

    Meshes, textures and programs stay on the device from call to call; a new scene that shares mesh and material
    objects with the last one uploads only what is new.

    Parameters
    ----------
    zero_to_one : bool
        Depth clips to [0, 1] (:meth:`GLContext.clip_depth_zero_to_one`).
    """

    def __init__(self, zero_to_one: bool) -> None:
        super().__init__(1, 1)
        self._scene: Scene | None = None
        self._items: list[_Item] = []
        self._uploads: dict[tuple[int, int], tuple[Any, Any, Any]] = {}  # (mesh, material) ids -> them, pyrender mesh
        self._textures: dict[tuple[int, bool], tuple[Any, _Texture]] = {}  # (image id, is colour) -> image, texture
        self._environments: dict[int, tuple[Environment, int]] = {}  # id -> it, its texture
        self._programs: dict[tuple[Any, ...], _Program] = {}
        self._empty_vertex_array = gl.glGenVertexArrays(1)
        self._query = int(np.ravel(gl.glGenQueries(1))[0])  # an array in some PyOpenGL versions
        self._zero_to_one = zero_to_one
        self.max_side_px = int(gl.glGetIntegerv(gl.GL_MAX_TEXTURE_SIZE))

    def __del__(self) -> None:
        """Nothing: pyrender's would delete by number in whatever context is current by then. The owner closes."""

    def load(self, scene: Scene) -> None:
        """Upload what is new in ``scene`` and forget what is not in it."""
        if scene is self._scene:
            return
        uploads, textures, items = {}, {}, []
        graph = pyrender.Scene()
        for node in scene.nodes:
            if not len(node.mesh.faces):
                continue
            key = (id(node.mesh), id(node.material))
            material, used = node.material, []
            for image, is_color in (
                (material.base_color_texture, True),
                (material.emissive_texture, True),
                (material.metallic_roughness_texture, False),
            ):
                name = (id(image), is_color)
                if image is not None and name not in textures:
                    textures[name] = self._textures.get(name) or (image, _Texture(image, is_color))
                used.append(None if image is None else textures[name][1])
            if key not in uploads:
                uploads[key] = self._uploads.get(key) or (node.mesh, material, _upload_mesh(node.mesh, used))
            mesh = uploads[key][2]
            graph.add(mesh)
            items.append(_item(scene, node, mesh.primitives[0], used))
        self._scene = None
        with opengl_errors("uploading meshes and textures"):
            self._update_context(graph, 0)
            self._load_environments(scene)
        self._uploads, self._textures, self._items, self._scene = uploads, textures, items, scene

    def _load_environments(self, scene: Scene) -> None:
        wanted = {id(one): one for one in (scene.environment, scene.background) if isinstance(one, Environment)}
        for key in self._environments.keys() - wanted.keys():
            gl.glDeleteTextures([self._environments.pop(key)[1]])
        for key in wanted.keys() - self._environments.keys():
            packed = wanted[key].packed
            rows = -(-len(packed) // _ENVIRONMENT_ROW)
            texels = np.zeros((rows * _ENVIRONMENT_ROW, 4), np.float32)
            texels[: len(packed)] = packed
            texture = gl.glGenTextures(1)
            self._bind_environment(texture)
            gl.glTexImage2D(
                gl.GL_TEXTURE_2D, 0, gl.GL_RGBA32F, _ENVIRONMENT_ROW, rows, 0, gl.GL_RGBA, gl.GL_FLOAT, texels
            )
            for name in (gl.GL_TEXTURE_MIN_FILTER, gl.GL_TEXTURE_MAG_FILTER):
                gl.glTexParameteri(gl.GL_TEXTURE_2D, name, gl.GL_NEAREST)
            self._environments[key] = wanted[key], int(texture)

    @staticmethod
    def _bind_environment(texture: int) -> None:
        gl.glActiveTexture(gl.GL_TEXTURE0 + _ENVIRONMENT_UNIT)
        gl.glBindTexture(gl.GL_TEXTURE_2D, texture)

    def draw(self, view: View, target: Target, previous: Target | None, options: PassOptions) -> bool:
        """Draw the loaded scene's next layer behind ``previous`` (None: the first); False if nothing was left to draw.

        Raises
        ------
        CaptureError
            If OpenGL fails.
        """
        scene = self._scene
        if scene is None:
            raise CaptureError("No scene is loaded: call load(scene) before draw().")
        with opengl_errors(f"drawing scene {scene.name!r} at {target.width}x{target.height}"):
            self._set_state(target, previous)
            common = {
                **view.uniforms(),
                **_light_uniforms(scene),
                "previous": _PREVIOUS_UNIT,
                "base_texture": _BASE_UNIT,
                "emissive_texture": _EMISSIVE_UNIT,
                "metallic_roughness_texture": _ROUGHNESS_UNIT,
                "environment": _ENVIRONMENT_UNIT,
                "first_layer": previous is None,
                "zero_to_one": self._zero_to_one,
                "lens_reach": -1.0 if options.lens_reach_m is None else float(options.lens_reach_m),
                "stop_at_opaque": options.stop_at_opaque,
                "lod_bias": float(options.lod_bias),
            }
            surface = {"SURFACE": 1} if options.surface else {}
            around = {}
            if scene.environment is not None:
                around = {"ENVIRONMENT": 1}
                self._bind_environment(self._environments[id(scene.environment)][1])
            prepared: set[_Program] = set()
            to_camera = np.linalg.inv(view.camera.pose)
            # Front to back, so that the depth test spares shading; ties keep the scene's order.
            depths = [-(to_camera[2, :3] @ item.centre + to_camera[2, 3]) for item in self._items]
            gl.glBeginQuery(gl.GL_ANY_SAMPLES_PASSED, self._query)
            try:
                for index in np.argsort(depths, kind="stable"):
                    item = self._items[index]
                    program = self._program("surface", {**item.defines, **surface, **around}, prepared, common)
                    program.set(item.uniforms)
                    program.set({"model_view": to_camera @ item.transform})
                    self._draw_item(item, cull=options.lens_reach_m == 0.0 and "DOUBLE_SIDED" not in item.defines)
                if scene.background is not None:
                    self._prepare_sky(scene.background, surface, prepared, common)
                    gl.glDepthFunc(gl.GL_GEQUAL)
                    gl.glDisable(gl.GL_CULL_FACE)
                    gl.glBindVertexArray(self._empty_vertex_array)
                    gl.glDrawArrays(gl.GL_TRIANGLES, 0, 3)
                    gl.glBindVertexArray(0)
            finally:
                gl.glEndQuery(gl.GL_ANY_SAMPLES_PASSED)
            gl.glUseProgram(0)
            return bool(np.ravel(gl.glGetQueryObjectuiv(self._query, gl.GL_QUERY_RESULT))[0])

    def _prepare_sky(
        self,
        sky: tuple[float, float, float] | Gradient | Environment,
        defines: dict[str, int],
        prepared: set[_Program],
        common: dict[str, Any],
    ) -> None:
        if isinstance(sky, Environment):
            self._program("sky", {**defines, "ENVIRONMENT": 1}, prepared, common)
            self._bind_environment(self._environments[id(sky)][1])
            return
        top, bottom = (sky.top, sky.bottom) if isinstance(sky, Gradient) else (sky, sky)
        self._program("sky", defines, prepared, common).set({"sky_top": np.array(top), "sky_bottom": np.array(bottom)})

    def _set_state(self, target: Target, previous: Target | None) -> None:
        for capability in (gl.GL_BLEND, gl.GL_MULTISAMPLE, gl.GL_CULL_FACE, gl.GL_SCISSOR_TEST, gl.GL_DITHER):
            gl.glDisable(capability)
        gl.glEnable(gl.GL_DEPTH_TEST)
        gl.glDepthFunc(gl.GL_GREATER)
        target.clear()
        gl.glActiveTexture(gl.GL_TEXTURE0 + _PREVIOUS_UNIT)
        gl.glBindTexture(gl.GL_TEXTURE_2D, 0 if previous is None else previous.inverse_depth)

    def _program(self, stem: str, defines: dict[str, int], prepared: set[_Program], common: dict[str, Any]) -> _Program:
        key = (stem, *sorted(defines.items()))
        program = self._programs.get(key)
        if program is None:
            program = self._programs[key] = _Program(stem, defines)
        gl.glUseProgram(program.id)
        if program not in prepared:
            program.set(common)
            prepared.add(program)
        return program

    def _draw_item(self, item: _Item, cull: bool) -> None:
        for unit, texture in item.textures.items():
            gl.glActiveTexture(gl.GL_TEXTURE0 + unit)
            texture._bind()
        # The window is upside down (see View), which turns every triangle round; a mirroring transform turns it back.
        gl.glFrontFace(gl.GL_CCW if item.mirrored else gl.GL_CW)
        (gl.glEnable if cull else gl.glDisable)(gl.GL_CULL_FACE)
        primitive = item.primitive
        primitive._bind()
        gl.glDrawElements(gl.GL_TRIANGLES, primitive.indices.size, gl.GL_UNSIGNED_INT, None)
        primitive._unbind()

    def delete(self) -> None:
        """Free everything; the context must be current."""
        super().delete()
        for program in self._programs.values():
            gl.glDeleteProgram(program.id)
        gl.glDeleteVertexArrays(1, [self._empty_vertex_array])
        gl.glDeleteQueries(1, [self._query])
        for _, texture in self._environments.values():
            gl.glDeleteTextures([texture])
        self._environments = {}
        self._programs, self._items, self._uploads, self._textures, self._scene = {}, [], {}, {}, None


def _item(scene: Scene, node: Node, primitive: Any, textures: list[Any]) -> _Item:
    material, linear = node.material, node.transform[:3, :3]
    determinant = float(np.linalg.det(linear))
    if determinant == 0.0:
        raise SceneError(f"A node of scene {scene.name!r} has a transform that flattens it; it must be invertible.")
    defines = {"LIT": 1} if not (scene.unlit or material.unlit) else {}
    # Attributes lie in the order in which pyrender packs them: position, normal, texture coordinates, colour.
    location = 2
    if primitive.texcoord_0 is not None:
        defines["UV_LOCATION"] = location
        location += 1
    if primitive.color_0 is not None:
        defines["COLOR_LOCATION"] = location
    units = {}
    kinds = (("BASE_TEXTURE", _BASE_UNIT), ("EMISSIVE_TEXTURE", _EMISSIVE_UNIT), ("ROUGHNESS_TEXTURE", _ROUGHNESS_UNIT))
    for (name, unit), texture in zip(kinds, textures, strict=True):
        if texture is not None and "UV_LOCATION" in defines:
            defines[name], units[unit] = 1, texture
    if material.alpha_mode != "opaque":
        defines[material.alpha_mode.upper()] = 1
    if material.double_sided:
        defines["DOUBLE_SIDED"] = 1
    bounds = primitive.bounds.astype(np.float64)
    return _Item(
        primitive=primitive,
        defines=defines,
        uniforms={
            "model": node.transform,
            "normal_matrix": np.linalg.inv(linear).T,
            "base_color": np.array(material.base_color),
            "emissive": np.array(material.emissive),
            "metallic": float(material.metallic),
            "roughness": float(material.roughness),
            "alpha_cutoff": float(material.alpha_cutoff),
        },
        transform=node.transform,
        textures=units,
        centre=linear @ bounds.mean(axis=0) + node.transform[:3, 3],
        mirrored=determinant < 0.0,
    )


def _upload_mesh(mesh: trimesh.Trimesh, textures: list[Any]) -> Any:
    """A pyrender mesh of one primitive; the material only tells pyrender which textures it owns."""
    visual, faces = mesh.visual, np.asarray(mesh.faces)
    positions, normals = np.asarray(mesh.vertices), np.asarray(mesh.vertex_normals)
    uv = getattr(visual, "uv", None)
    colors = None
    if visual.defined and visual.kind == "texture":
        colors = _linear_colors(visual.vertex_attributes.get("color"))
    elif visual.defined and visual.kind == "face":  # one colour a face: no vertex can be shared
        positions, normals = positions[faces.ravel()], normals[faces.ravel()]
        colors = srgb_bytes_to_linear(np.repeat(np.asarray(visual.face_colors), 3, axis=0))
        uv, faces = None, np.arange(len(positions)).reshape(-1, 3)
    elif visual.defined and visual.kind == "vertex":
        colors = srgb_bytes_to_linear(np.asarray(visual.vertex_colors))
    primitive = pyrender.Primitive(
        positions=positions,
        normals=normals,
        texcoord_0=None if uv is None or len(uv) != len(positions) else np.asarray(uv),
        color_0=colors,
        material=pyrender.MetallicRoughnessMaterial(
            baseColorTexture=textures[0], emissiveTexture=textures[1], metallicRoughnessTexture=textures[2]
        ),
    )
    primitive._indices = faces.astype(np.uint32)  # the property would store float32, which skips above 2**24
    return pyrender.Mesh([primitive])


def srgb_bytes_to_linear(colors: NDArray[np.uint8]) -> NDArray[np.float32]:
    """8-bit sRGB colours with linear alpha, (..., 4), to linear float32."""
    linear = linear_from_srgb(np.arange(256) / 255.0)[colors]
    linear[..., 3] = colors[..., 3] / np.float32(255.0)
    return linear


def _linear_colors(colors: Any) -> NDArray[np.float32] | None:
    """glTF vertex colours, floats or normalised integers, RGB or RGBA, as linear float32 RGBA."""
    if colors is None:
        return None
    array = np.asarray(colors)
    scale = np.iinfo(array.dtype).max if array.dtype.kind in "iu" else 1.0
    linear = np.ones((len(array), 4), np.float32)
    linear[:, : array.shape[1]] = array / scale
    return linear


def _light_uniforms(scene: Scene) -> dict[str, Any]:
    parts = scene.lighting.arrays()
    values: dict[str, Any] = {
        "ambient_sky": np.array(scene.ambient.sky),
        "ambient_ground": np.array(scene.ambient.ground),
        "directional_count": len(parts["directional_color"]),
        "point_count": len(parts["point_color"]),
    }
    if values["directional_count"]:
        values |= {name: parts[name] for name in ("directional_to_light", "directional_color")}
    if values["point_count"]:
        values |= {name: parts[name] for name in ("point_position", "point_color")}
        values["point_cone"] = np.concatenate([parts["point_axis"], parts["point_cone"][:, 1:]], axis=1)
        values["point_cone_inner"] = parts["point_cone"][:, 0]
    return values
