"""What a user would take instead of cldof, measured on the same scenes; each is optional and skipped visibly.

No peer shares cldof's lights, so they draw scenes with base colours only. Everything from the scene in memory to the
image counts, as capture and blur count for cldof; warm-up is left out for both. Mitsuba and VTK run in a process of
their own: both bring drivers (LLVM, EGL) that end the process when they do not like what they find.

==========  =============================================================================================
mitsuba     Mitsuba 3, ``thinlens``, stratified samples (``multijitter``), box filter; with a denoiser too
vtk         VTK's depth-of-field pass, 8 bits, with the radius corrected for its tangent of degrees
opencv      one RGBD image cut into 48 slices by CoC, each blurred by a disc (``cv2.filter2D``)
==========  =============================================================================================
"""

from __future__ import annotations

import importlib
import importlib.util
import json
import math
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..camera import Camera
from ..capture.scene import Gradient, Node, Scene
from ..errors import CldofError
from ..frame import LayeredFrame
from ..images import linear_from_srgb, srgb_from_linear
from ..lens import Lens
from .cases import CaseKey, build_scene, timed
from .times import Times

if TYPE_CHECKING:
    from .cases import Case

__all__ = ["PEERS", "Peer", "PeerMissingError"]

Image = NDArray[np.float32]
Drawn = tuple[Image, Times, str]

_OPENCV_SLICES = 48
_TIMEOUT_S = 300
_CONVERGED = "converged"
_CONVERGED_SAMPLES = 1024
_LLVM_VARIABLE = "DRJIT_LIBLLVM_PATH"
# Dr.Jit aborts with these; newest first among those that work.
_LLVM_VERSIONS = (21, 20, 19, 18, 17)


class PeerMissingError(CldofError):
    """A peer is not installed, or does not run here."""


@dataclass
class Peer:
    """One tool.

    Parameters
    ----------
    name : str
    modules : tuple of str
        What has to be importable.
    install : str
        What pip is told.
    settings : tuple of str
    device : str
        What does the work, for the table.
    needs_capture : bool
        It starts from a captured image, whose time counts.
    """

    name: str
    modules: tuple[str, ...]
    install: str
    settings: tuple[str, ...]
    device: str
    needs_capture: bool = False
    _drawn: dict[tuple[Any, ...], dict[str, Drawn]] = field(default_factory=dict)
    _failed: dict[tuple[Any, ...], str] = field(default_factory=dict)

    def check(self) -> None:
        """Raise unless it is installed.

        Raises
        ------
        PeerMissingError
        """
        missing = [module for module in self.modules if importlib.util.find_spec(module) is None]
        if missing:
            raise PeerMissingError(f"{self.name}: {', '.join(missing)} is not installed (pip install {self.install})")

    def draw(self, case: Case, setting: str, runs: int, seed: int) -> Drawn:
        """The image, its times, and a remark; all settings of a case are drawn at the first call."""
        self.check()
        key = (case.key, runs, seed)
        if key in self._failed:
            raise PeerMissingError(self._failed[key])
        if key not in self._drawn:
            try:
                self._drawn = {key: self._draw_all(case, runs, seed)}
            except PeerMissingError as error:
                self._failed[key] = str(error)
                raise
        drawn = self._drawn[key]
        if setting not in drawn:
            raise PeerMissingError(f"{self.name}: {setting} does not run here")
        return drawn[setting]

    def converged(self, case: Case) -> Image | None:
        """Its own image with many samples, where it has one; after :meth:`draw`.

        A path tracer filters textures otherwise than a rasteriser (no mip levels), so that its images differ from
        cldof's reference by more than noise. Against its own it shows its noise alone.
        """
        for key, drawn in self._drawn.items():
            if key[0] == case.key and _CONVERGED in drawn:
                return drawn[_CONVERGED][0]
        return None

    def _draw_all(self, case: Case, runs: int, seed: int) -> dict[str, Drawn]:
        if self.name == "opencv":
            return {self.settings[0]: _opencv(case.frame(1)[0], case.lens, runs)}
        _simple_nodes(case.scene)  # refuses before a process is started
        return _in_process(self.name, self.settings, case, runs, seed)


# A new peer is one entry here and one function below.
PEERS: dict[str, Peer] = {
    "mitsuba": Peer(
        "mitsuba",
        ("mitsuba",),
        "mitsuba mitsuba-oidn",
        ("16 samples", "64 samples", "256 samples", "16 samples + denoiser"),
        "CPU (LLVM)",
    ),
    "vtk": Peer("vtk", ("vtk",), "vtk", ("depth-of-field pass",), "OpenGL"),
    "opencv": Peer("opencv", ("cv2",), "opencv-python-headless", ("48 slices",), "CPU", needs_capture=True),
}


def _in_process(name: str, settings: tuple[str, ...], case: Case, runs: int, seed: int) -> dict[str, Drawn]:
    with tempfile.TemporaryDirectory(prefix="cldof-peer-") as folder:
        job, result = Path(folder, "job.json"), Path(folder, "result.npz")
        lens = case.lens
        job.write_text(
            json.dumps(
                {
                    "peer": name,
                    "settings": settings,
                    "case": list(case.key),
                    "lens": [lens.aperture_radius_m, lens.focus_distance_m],
                    "runs": runs,
                    "seed": seed,
                }
            ),
            encoding="utf-8",
        )
        command = [sys.executable, "-m", "cldof.benchmark.peers", str(job), str(result)]
        environment = dict(os.environ)
        root = str(Path(__file__).resolve().parents[2])
        environment["PYTHONPATH"] = os.pathsep.join([root, *filter(None, [environment.get("PYTHONPATH")])])
        llvm = _llvm()
        if name == "mitsuba" and llvm:
            environment.setdefault(_LLVM_VARIABLE, llvm)
        try:
            done = subprocess.run(
                command, env=environment, capture_output=True, text=True, timeout=_TIMEOUT_S, check=False
            )
        except subprocess.TimeoutExpired:
            raise PeerMissingError(f"{name}: gave no image within {_TIMEOUT_S} s") from None
        if done.returncode != 0 or not result.exists():
            last = (done.stderr.strip().splitlines() or ["no message"])[-1]
            raise PeerMissingError(f"{name}: does not run here (exit code {done.returncode}: {last[:200]})")
        with np.load(result, allow_pickle=False) as data:
            return {
                setting: (
                    data[f"image {setting}"],
                    Times(**json.loads(str(data[f"times {setting}"]))),
                    str(data[f"note {setting}"]),
                )
                for setting in (*settings, _CONVERGED)
                if f"image {setting}" in data
            }


@cache
def _llvm() -> str | None:
    """A libLLVM that Dr.Jit can work with; it would take any by itself, and abort with some."""
    folders = [Path("/usr/lib/x86_64-linux-gnu"), Path("/usr/lib/aarch64-linux-gnu"), Path("/usr/lib64")]
    for version in _LLVM_VERSIONS:
        folders_of = [*folders, Path(f"/usr/lib/llvm-{version}/lib")]
        for folder in folders_of:
            for name in (f"libLLVM.so.{version}.1", f"libLLVM-{version}.so", f"libLLVM-{version}.so.1"):
                if (folder / name).exists():
                    return str(folder / name)
    return None


def _work(job_path: str, result_path: str) -> None:
    """The other process."""
    job = json.loads(Path(job_path).read_text(encoding="utf-8"))
    key = CaseKey(*job["case"])
    scene, lens = build_scene(key), Lens(*job["lens"])
    draw: Callable[..., dict[str, Drawn]] = {"mitsuba": _mitsuba, "vtk": _vtk}[job["peer"]]
    drawn = draw(scene, scene.camera_for(key.width, key.height), lens, job["settings"], job["runs"], job["seed"])
    arrays: dict[str, Any] = {}
    for setting, (image, times, note) in drawn.items():
        arrays |= {f"image {setting}": image, f"times {setting}": json.dumps(asdict(times)), f"note {setting}": note}
    np.savez(result_path, **arrays)


def _simple_nodes(scene: Scene) -> tuple[Node, ...]:
    """The nodes of a scene that peers can draw as it is.

    Raises
    ------
    PeerMissingError
        It has something that they would draw in another way.
    """
    for node in scene.nodes:
        material, visual = node.material, node.mesh.visual
        if material.alpha_mode != "opaque":
            raise PeerMissingError("peers are compared on scenes without transparency or cut-outs only")
        if material.emissive_texture is not None or (visual.defined and visual.kind in ("vertex", "face")):
            raise PeerMissingError("peers are compared on scenes without vertex colours or emissive textures only")
    return scene.nodes


def _world_vertices(node: Node) -> NDArray[np.float64]:
    vertices = np.asarray(node.mesh.vertices, np.float64)
    moved: NDArray[np.float64] = vertices @ node.transform[:3, :3].T + node.transform[:3, 3]
    return moved


def _texture_coordinates(node: Node) -> NDArray[np.float32] | None:
    """(N, 2), v upwards, or None."""
    uv = getattr(node.mesh.visual, "uv", None)
    if node.material.base_color_texture is None or uv is None or len(uv) != len(node.mesh.vertices):
        return None
    return np.asarray(uv, np.float32)


def _texels(node: Node) -> NDArray[np.float32]:
    """Linear light of the base colour and emission, (H, W, 3), row 0 at the top; one texel without a texture."""
    material = node.material
    base = np.array(material.base_color[:3], np.float32)
    if _texture_coordinates(node) is None:
        texels = base.reshape(1, 1, 3)
    else:
        texels = linear_from_srgb(np.asarray(material.base_color_texture.convert("RGB"), np.float32) / 255.0) * base
    return np.asarray(texels + np.array(material.emissive, np.float32), np.float32)


def _sky(scene: Scene) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """(bottom, top) of the background."""
    if scene.background is None:
        return None
    if isinstance(scene.background, Gradient):
        return np.array(scene.background.bottom), np.array(scene.background.top)
    return np.array(scene.background), np.array(scene.background)


def _timed(draw: Callable[[], Image], runs: int, warm_up: int = 1) -> tuple[Image, Times]:
    for _ in range(warm_up):
        draw()
    image, times = timed(draw, runs)
    return image, times


def _mitsuba(scene: Scene, camera: Camera, lens: Lens, settings: list[str], runs: int, seed: int) -> dict[str, Drawn]:
    import drjit as dr
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    sky = _sky(scene)

    class Unlit(mi.SamplingIntegrator):  # type: ignore[misc]
        """The base colour of what a ray meets first."""

        def sample(self, scene: Any, sampler: Any, ray: Any, medium: Any = None, active: Any = True) -> Any:
            hit = scene.ray_intersect(ray, active)
            seen = active & hit.is_valid()
            color = hit.bsdf(ray).eval_diffuse_reflectance(hit, seen)
            if sky is None:
                return dr.select(seen, color, 0.0), seen, []
            bottom, top = mi.Color3f(*sky[0].tolist()), mi.Color3f(*sky[1].tolist())
            height = 0.5 + 0.5 * ray.d.y
            return dr.select(seen, color, bottom + (top - bottom) * height), mi.Bool(True), []

    mi.register_integrator("unlit", lambda properties: Unlit(properties))
    # Mitsuba's cameras look along +z with x to the left.
    to_world = camera.pose @ np.diag([-1.0, 1.0, -1.0, 1.0])
    parts: dict[str, Any] = {
        "type": "scene",
        "integrator": {"type": "unlit"},
        "sensor": {
            "type": "thinlens",
            "to_world": mi.ScalarTransform4f(to_world.tolist()),
            "fov": camera.yfov_deg,
            "fov_axis": "y",
            "aperture_radius": max(lens.aperture_radius_m, 1e-9),
            "focus_distance": min(lens.focus_distance_m, 1e7),
            "near_clip": camera.near,
            "far_clip": min(camera.far, 1e7),
            "film": {
                "type": "hdrfilm",
                "width": camera.width,
                "height": camera.height,
                "pixel_format": "rgba",
                "component_format": "float32",
                "rfilter": {"type": "box"},
            },
            "sampler": {"type": "multijitter"},
        },
    }
    for number, node in enumerate(_simple_nodes(scene)):
        texture = {"type": "bitmap", "bitmap": mi.Bitmap(_texels(node)), "raw": True}
        properties = mi.Properties()
        properties["bsdf"] = mi.load_dict({"type": "diffuse", "reflectance": texture})
        uv = _texture_coordinates(node)
        mesh = mi.Mesh(
            f"node{number}",
            len(node.mesh.vertices),
            len(node.mesh.faces),
            props=properties,
            has_vertex_texcoords=uv is not None,
        )
        values = mi.traverse(mesh)
        values["vertex_positions"] = mi.Float(_world_vertices(node).astype(np.float32).ravel())
        values["faces"] = mi.UInt32(np.asarray(node.mesh.faces, np.uint32).ravel())
        if uv is not None:
            values["vertex_texcoords"] = mi.Float((uv * (1, -1) + (0, 1)).astype(np.float32).ravel())
        values.update()
        parts[f"node{number}"] = mesh
    world = mi.load_dict(parts)

    def render(samples: int, denoise: Callable[..., Any] | None) -> Image:
        image = np.array(mi.render(world, spp=samples, seed=seed), np.float32)
        if denoise is not None:
            image[..., :3] = denoise(np.ascontiguousarray(image[..., :3]), hdr=True)
        return image

    drawn = {}
    for setting in settings:
        samples, note = int(setting.split()[0]), ""
        denoise: Callable[..., Any] | None = None
        if "denoiser" in setting:
            try:
                denoise = importlib.import_module("mitsuba_oidn").denoise
            except (ImportError, OSError):
                continue
            note = "colour only, no auxiliary images"
        drawn[setting] = (*_timed(lambda s=samples, d=denoise: render(s, d), runs), note)  # type: ignore[misc]
    # In parts with seeds of their own: one wavefront of all samples would take gigabytes.
    parts_of = [
        np.array(mi.render(world, spp=_CONVERGED_SAMPLES // 4, seed=seed + 1 + part), np.float64) for part in range(4)
    ]
    drawn[_CONVERGED] = (np.mean(parts_of, axis=0).astype(np.float32), Times.of([0.0]), f"{_CONVERGED_SAMPLES} samples")
    return drawn


def _vtk(scene: Scene, camera: Camera, lens: Lens, settings: list[str], runs: int, seed: int) -> dict[str, Drawn]:
    import vtk
    from vtk.util import numpy_support

    renderer = vtk.vtkRenderer()
    for node in _simple_nodes(scene):
        data = vtk.vtkPolyData()
        points = vtk.vtkPoints()
        points.SetData(numpy_support.numpy_to_vtk(_world_vertices(node), deep=True))
        data.SetPoints(points)
        faces = np.asarray(node.mesh.faces, np.int64)
        cells = vtk.vtkCellArray()
        cells.SetData(3, numpy_support.numpy_to_vtkIdTypeArray(faces.ravel(), deep=True))
        data.SetPolys(cells)
        mapper = vtk.vtkPolyDataMapper()
        actor = vtk.vtkActor()
        actor.GetProperty().LightingOff()
        texels, uv = srgb_from_linear(_texels(node)), _texture_coordinates(node)
        if uv is None:
            actor.GetProperty().SetColor(*(float(value) for value in texels[0, 0]))
        else:
            data.GetPointData().SetTCoords(numpy_support.numpy_to_vtk(uv, deep=True))
            picture = vtk.vtkImageData()
            height, width = texels.shape[:2]
            picture.SetDimensions(width, height, 1)
            rows = np.ascontiguousarray(np.rint(texels[::-1] * 255.0).astype(np.uint8)).reshape(-1, 3)
            picture.GetPointData().SetScalars(numpy_support.numpy_to_vtk(rows, deep=True))
            texture = vtk.vtkTexture()
            texture.SetInputData(picture)
            texture.InterpolateOn()
            texture.MipmapOn()
            texture.RepeatOn()
            actor.SetTexture(texture)
        mapper.SetInputData(data)
        actor.SetMapper(mapper)
        renderer.AddActor(actor)

    sky = _sky(scene)
    if sky is not None:
        bottom, top = sky
        # Seen between the lower and the upper edge of the image, which is all that a flat gradient can do.
        pitch = math.asin(float(np.clip(-camera.pose[1, 2], -1.0, 1.0)))
        edges = [math.sin(pitch + side * math.radians(camera.yfov_deg) / 2.0) for side in (-1.0, 1.0)]
        low, high = (srgb_from_linear(bottom + (top - bottom) * (0.5 + 0.5 * edge)).tolist() for edge in edges)
        renderer.GradientBackgroundOn()
        renderer.SetBackground(*low)
        renderer.SetBackground2(*high)

    eye, forward = camera.pose[:3, 3], -camera.pose[:3, 2]
    view = renderer.GetActiveCamera()
    view.SetPosition(*eye)
    view.SetFocalPoint(*(eye + forward * min(lens.focus_distance_m, 1e5)))
    view.SetViewUp(*camera.pose[:3, 1])
    view.SetViewAngle(camera.yfov_deg)
    half = camera.yfov_deg / 2.0
    view.SetFocalDisk(lens.aperture_radius_m * abs(math.tan(half)) / math.tan(math.radians(half)))
    renderer.ResetCameraClippingRange()

    steps, blur = vtk.vtkRenderStepsPass(), vtk.vtkDepthOfFieldPass()
    blur.SetDelegatePass(steps)
    blur.AutomaticFocalDistanceOff()
    renderer.SetPass(blur)
    window = vtk.vtkRenderWindow()
    window.SetOffScreenRendering(1)
    window.SetMultiSamples(0)
    window.SetSize(camera.width, camera.height)
    window.AddRenderer(renderer)

    def draw() -> Image:
        window.Render()
        grabbed = vtk.vtkUnsignedCharArray()
        window.GetPixelData(0, 0, camera.width - 1, camera.height - 1, 0, grabbed, 0)
        rows = numpy_support.vtk_to_numpy(grabbed).reshape(camera.height, camera.width, 3)[::-1]
        image = np.ones((camera.height, camera.width, 4), np.float32)
        image[..., :3] = linear_from_srgb(rows.astype(np.float32) / 255.0)
        return image

    # Its first frame is black.
    return {settings[0]: (*_timed(draw, runs, warm_up=3), "8 bits; radius corrected for its tangent of degrees")}


def _opencv(frame: LayeredFrame, lens: Lens, runs: int) -> Drawn:
    import cv2

    c1, c0 = lens.coc_coefficients(frame.camera)
    color = np.ascontiguousarray(frame.color[0])
    with np.errstate(divide="ignore"):
        coc = (np.float32(c1) / frame.depth[0] + np.float32(c0)).astype(np.float32)
    guard = frame.guard_px

    def draw() -> Image:
        edges = np.linspace(coc.min(), coc.max(), _OPENCV_SLICES + 1, dtype=np.float32)
        number = np.clip(np.searchsorted(edges, coc, side="right") - 1, 0, _OPENCV_SLICES - 1)
        total = np.zeros_like(color)
        for index in range(_OPENCV_SLICES - 1, -1, -1):  # far to near
            inside = number == index
            if not inside.any():
                continue
            part = np.where(inside[..., None], color, np.float32(0.0))
            radius = abs(float(edges[index] + edges[index + 1])) / 2.0
            if radius > 0.3:
                part = cv2.filter2D(part, -1, _disc(radius), borderType=cv2.BORDER_CONSTANT)
            total = part + (1.0 - np.clip(part[..., 3:], 0.0, 1.0)) * total
        alpha = total[..., 3:]
        if frame.is_opaque:
            total = np.where(alpha > 1e-3, total / np.maximum(alpha, 1e-3), total)
        inner = slice(guard, -guard or None)
        # Convolution by DFT leaves rounding below zero.
        return np.ascontiguousarray(np.clip(total[inner, inner], 0.0, None))

    return (*_timed(draw, runs), "one layer of colour and depth")


def _disc(radius: float) -> NDArray[np.float32]:
    """A disc with an antialiased rim that sums to 1."""
    reach = math.ceil(radius + 0.5)
    y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    kernel = np.clip(radius + 0.5 - np.hypot(x, y), 0.0, 1.0)
    return np.asarray(kernel / kernel.sum(), np.float32)


if __name__ == "__main__":
    _work(*sys.argv[1:3])
