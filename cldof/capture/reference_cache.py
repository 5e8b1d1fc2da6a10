"""References kept on disk, for benchmarks that ask for the same ones again and again.

A file's name is a digest of all that the image depends on: meshes, materials, textures, lights and sky, camera, lens,
views, aperture, jitter, seed, the OpenGL driver, and the code that draws. What cannot be read, or turns out damaged, is
drawn again and replaced; files appear whole or not at all, so that several processes may share a folder.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import struct
import warnings
import weakref
import zipfile
import zlib
from collections.abc import Mapping
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from ..camera import Camera
from ..errors import OutputError
from ..files import atomic_write, parse_json, read_arrays
from ..lens import Aperture, Lens
from .accumulate import Reference, accumulate, view_plan
from .peel import DepthPeeler, Progress
from .scene import Environment, Scene

__all__ = ["ReferenceCache", "scene_digest"]

_FORMAT_VERSION = 1
# Fields of a scene that a picture taken through a given camera and lens does not depend on.
_NOT_SEEN = {"name", "camera", "focus_distance_m", "aperture_radius_m", "view_from_deg"}
# What decides the pixels, beside every shader.
_SOURCES = (
    "lens.py",
    "camera.py",
    "images.py",
    "lighting.py",
    "capture/accumulate.py",
    "capture/draw.py",
    "capture/peel.py",
)


class ReferenceCache:
    """A folder of references; it grows without limit and may be deleted at any time.

    Parameters
    ----------
    folder : str or Path
        Made when the first reference is written.
    """

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder)
        self._digests: weakref.WeakKeyDictionary[Scene, str] = weakref.WeakKeyDictionary()

    def accumulate(
        self,
        peeler: DepthPeeler,
        scene: Scene,
        camera: Camera,
        lens: Lens,
        views: int = 256,
        shape: Aperture | str | None = None,
        jitter: bool = False,
        seed: int = 0,
        progress: Progress | None = None,
        noise_floor: bool = True,
        view_dependent: bool = True,
    ) -> Reference:
        """As :func:`cldof.capture.accumulate.accumulate`, read from disk where it was drawn before.

        ``progress`` is not called for what is read. A folder that cannot be written to is warned of, no more.
        """
        plan = view_plan(lens, views, shape, jitter, seed, noise_floor)
        if scene not in self._digests:
            self._digests[scene] = scene_digest(scene)
        key = _digest(
            {
                "format": _FORMAT_VERSION,
                "code": _code_digest(),
                "opengl": peeler.device,
                "scene": self._digests[scene],
                "camera": camera.to_dict(),
                "lens": [lens.aperture_radius_m, lens.focus_distance_m],
                "plan": plan,  # follows from views, aperture, jitter and seed
                "view_dependent": view_dependent,
            }
        )
        path = self.folder / f"{key[:40]}.npz"
        found = _read(path, key, (camera.height, camera.width, 4))
        if found is not None:
            return found
        made = accumulate(
            peeler, scene, camera, lens, views, shape, jitter, seed, progress, noise_floor, view_dependent
        )
        try:
            _write(path, key, made)
        except (OutputError, OSError) as error:
            warnings.warn(f"A reference could not be kept in {self.folder}: {error}", stacklevel=2)
        return made


def scene_digest(scene: Scene) -> str:
    """SHA-256 of all of a scene that shows: geometry, transforms, materials, textures, lights, sky; in hexadecimal."""
    return _digest({f.name: getattr(scene, f.name) for f in dataclasses.fields(scene) if f.name not in _NOT_SEEN})


def _read(path: Path, key: str, shape: tuple[int, int, int]) -> Reference | None:
    """None for a file that is absent, damaged or of another key."""
    try:
        arrays = read_arrays(path, ("header", "image"))
        header, image = parse_json(bytes(arrays["header"])), arrays["image"]
        if header["key"] != key or image.shape != shape or image.dtype != np.float32:
            return None
        noise = header["noise_rms"]
        views, seconds = int(header["views"]), float(header["seconds"])
        return Reference(image, views, None if noise is None else float(noise), seconds, is_cached=True)
    except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile, zlib.error, RuntimeError):
        return None


def _write(path: Path, key: str, made: Reference) -> None:
    header = {"key": key, "noise_rms": made.noise_rms, "views": made.views, "seconds": made.seconds}
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(path) as stream:
        np.savez(stream, header=np.frombuffer(json.dumps(header).encode(), np.uint8), image=made.image)


@cache
def _code_digest() -> str:
    package = resources.files(__package__.rpartition(".")[0])
    texts = {name: package.joinpath(*name.split("/")).read_bytes() for name in _SOURCES}
    for shader in package.joinpath("capture", "shaders").iterdir():
        if shader.is_file():
            texts[shader.name] = shader.read_bytes()
    return _digest(texts)


def _digest(value: Any) -> str:
    digest = hashlib.sha256()
    _feed(digest, value, {})
    return digest.hexdigest()


def _feed(digest: Any, value: Any, seen: dict[int, bytes]) -> None:
    """Add a value with its type and size, so that no two values run into each other. Objects are read once each."""
    if value is None or isinstance(value, bool | int | str):
        _feed_bytes(digest, type(value).__name__, str(value).encode())
    elif isinstance(value, float):
        _feed_bytes(digest, "float", struct.pack("<d", value))
    elif isinstance(value, bytes):
        _feed_bytes(digest, "bytes", value)
    elif isinstance(value, np.ndarray | np.generic):
        array = np.ascontiguousarray(value)
        _feed_bytes(digest, f"array {array.dtype.str} {array.shape}", array.tobytes())
    elif isinstance(value, tuple | list):
        _feed_bytes(digest, "sequence", str(len(value)).encode())
        for each in value:
            _feed(digest, each, seen)
    elif isinstance(value, Mapping):
        _feed_bytes(digest, "mapping", str(len(value)).encode())
        for name in sorted(value):
            _feed(digest, name, seen)
            _feed(digest, value[name], seen)
    else:
        if id(value) not in seen:
            inner = hashlib.sha256()
            _feed(inner, _parts(value), seen)
            seen[id(value)] = inner.digest()
        _feed_bytes(digest, type(value).__name__, seen[id(value)])


def _feed_bytes(digest: Any, kind: str, data: bytes) -> None:
    digest.update(f"{kind} {len(data)}:".encode())
    digest.update(data)


def _parts(value: Any) -> dict[str, Any]:
    """What an object's appearance depends on."""
    if isinstance(value, trimesh.Trimesh):
        visual = value.visual
        kind = visual.kind if visual.defined else None
        parts = {"vertices": value.vertices, "normals": value.vertex_normals, "faces": value.faces, "kind": kind}
        if kind == "texture":
            parts |= {"uv": visual.uv, "color": visual.vertex_attributes.get("color")}
        elif kind is not None:
            parts["color"] = visual.face_colors if kind == "face" else visual.vertex_colors
        return {
            name: part if part is None or isinstance(part, str) else np.asarray(part) for name, part in parts.items()
        }
    if hasattr(value, "tobytes") and hasattr(value, "mode"):  # a PIL image
        return {"mode": value.mode, "size": tuple(value.size), "pixels": value.convert("RGBA").tobytes()}
    if isinstance(value, Environment):
        return {"image": value.image}
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {f.name: getattr(value, f.name) for f in dataclasses.fields(value) if f.name not in _NOT_SEEN}
    raise TypeError(f"{type(value).__name__} has no digest; cldof.capture.reference_cache must learn about it.")
