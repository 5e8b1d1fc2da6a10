"""Is a glTF document fit to be read? Asked before anything follows its numbers or opens its files.

Readers trust a document's counts, offsets and names. Here a file that was cut, damaged or made to do harm is told apart
from a sound one: every range lies within what is there, nodes form a tree, nothing unpacks to more than a stated size,
and no name leads out of the file's own folder or onto a network.
"""

from __future__ import annotations

import base64
import binascii
import io
from pathlib import Path
from typing import Any
from urllib.parse import unquote

from ..errors import SceneError
from ..images import check_picture

__all__ = ["check_gltf", "file_within"]

# Bytes that all accessors together may unpack to: 90 million vertices with normals.
_MOST_GEOMETRY = 1 << 31
# Pixels of all images together: 1 GiB as RGBA.
_MOST_PIXELS = 1 << 28
_COMPONENT_BYTES = {5120: 1, 5121: 1, 5122: 2, 5123: 2, 5125: 4, 5126: 4}
_COMPONENTS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
_LISTS = ("accessors", "bufferViews", "buffers", "cameras", "images", "materials", "meshes", "nodes", "scenes")
_UNREAD_IMAGES = {"image/ktx2"}

Bytes = bytes | memoryview


def file_within(folder: Path, name: str) -> Path:
    """The file of that name in a folder or below it.

    Raises
    ------
    SceneError
        For a URL, an absolute path, or one that leads out of the folder, also by a link or in disguise (``%2e%2e``).
    """
    for spelling in (name, unquote(name), name.replace("\\", "/")):
        path = folder / spelling.strip()
        is_far = "://" in spelling or spelling.strip().lower().startswith(("file:", "http:", "https:", "ftp:"))
        if is_far or "\0" in spelling or not path.resolve().is_relative_to(folder.resolve()):
            raise SceneError(f"it refers to {name!r}, which is outside of its own folder; put the file beside it.")
    path = folder / name
    return path if path.is_file() else folder / unquote(name)


def check_gltf(document: dict[str, Any], chunk: Bytes, folder: Path) -> None:
    """Raise what is wrong with a glTF document.

    Parameters
    ----------
    document : dict
        The JSON.
    chunk : bytes or memoryview
        Contents of the buffer without a name: the binary chunk of a .glb, else empty.
    folder : Path
        Where the file is, which names are relative to.

    Raises
    ------
    SceneError
        Without the file's name, which the caller knows.
    """
    for name in _LISTS:
        entries = document.get(name, [])
        if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
            raise SceneError(f"its {name} are not a list of objects.")
    buffers = [_buffer(buffer, index, chunk, folder) for index, buffer in enumerate(document.get("buffers", []))]
    views = [_view(view, index, buffers) for index, view in enumerate(document.get("bufferViews", []))]
    geometry = sum(_accessor(one, index, document, views) for index, one in enumerate(document.get("accessors", [])))
    if geometry > _MOST_GEOMETRY:
        raise SceneError(f"its geometry takes {geometry} bytes; at most {_MOST_GEOMETRY} are read.")
    _check_tree(document)
    pixels = sum(_image(one, index, views, folder) for index, one in enumerate(document.get("images", [])))
    if pixels > _MOST_PIXELS:
        raise SceneError(f"its images have {pixels} pixels; at most {_MOST_PIXELS} are read.")


def _whole(entry: dict[str, Any], key: str, what: str, default: int | None = None) -> int:
    value = entry.get(key, default)
    if isinstance(value, bool) or not isinstance(value, int) or value < 0:
        raise SceneError(f"{what} has {key} {value!r}, which must be a whole number, 0 or more.")
    return value


def _index(entry: dict[str, Any], key: str, what: str, count: int) -> int:
    value = _whole(entry, key, what)
    if value >= count:
        raise SceneError(f"{what} refers to {key} {value}; there are {count}.")
    return value


def _from_uri(uri: Any, what: str, folder: Path) -> Bytes | None:
    """What a URI holds; None for a file that is missing."""
    if not isinstance(uri, str):
        raise SceneError(f"{what} has the URI {uri!r}, which is no text.")
    if uri.startswith("data:"):
        head, _, payload = uri.partition(",")
        if not head.endswith(";base64"):
            raise SceneError(f"{what} has data that is not in base64.")
        try:
            return base64.b64decode(payload)
        except (binascii.Error, ValueError) as error:
            raise SceneError(f"{what} has damaged data ({error}).") from error
    path = file_within(folder, uri)
    return path.read_bytes() if path.is_file() else None


def _buffer(buffer: dict[str, Any], index: int, chunk: Bytes, folder: Path) -> memoryview:
    what = f"buffer {index}"
    length = _whole(buffer, "byteLength", what)
    content = chunk if "uri" not in buffer else _from_uri(buffer["uri"], what, folder)
    if content is None:
        raise SceneError(f"{what} is in {buffer['uri']!r}, which is missing.")
    if length > len(content):
        raise SceneError(f"{what} should have {length} bytes and has {len(content)}; the file is cut short.")
    return memoryview(content)[:length]


def _view(view: dict[str, Any], index: int, buffers: list[memoryview]) -> memoryview:
    what = f"buffer view {index}"
    buffer = buffers[_index(view, "buffer", what, len(buffers))]
    start, length = _whole(view, "byteOffset", what, 0), _whole(view, "byteLength", what)
    if start + length > len(buffer):
        raise SceneError(f"{what} ends at byte {start + length} of a buffer of {len(buffer)}.")
    return buffer[start : start + length]


def _accessor(accessor: dict[str, Any], index: int, document: dict[str, Any], views: list[memoryview]) -> int:
    """Bytes that it unpacks to."""
    what = f"accessor {index}"
    count = _whole(accessor, "count", what)
    kind, component = accessor.get("type"), accessor.get("componentType")
    if kind not in _COMPONENTS or component not in _COMPONENT_BYTES:
        raise SceneError(f"{what} has type {kind!r} of component type {component!r}, which glTF does not know.")
    item = _COMPONENTS[kind] * _COMPONENT_BYTES[component]
    if count * item > _MOST_GEOMETRY:
        raise SceneError(f"{what} has {count} items; at most {_MOST_GEOMETRY // item} are read.")
    if "bufferView" in accessor:
        number = _index(accessor, "bufferView", what, len(views))
        stride = _whole(document["bufferViews"][number], "byteStride", f"buffer view {number}", item)
        end = _whole(accessor, "byteOffset", what, 0) + (count - 1) * stride + item if count else 0
        if stride < item or end > len(views[number]):
            raise SceneError(f"{what} ends at byte {end}, with {stride} from item to item, of {len(views[number])}.")
    return count * item


def _check_tree(document: dict[str, Any]) -> None:
    """Nodes have one parent at most and none is its own ancestor: otherwise following them takes for ever."""
    nodes, scenes = document.get("nodes", []), document.get("scenes", [])
    if scenes:
        roots = scenes[_index({"scene": document.get("scene", 0)}, "scene", "the file", len(scenes))].get("nodes", [])
    else:
        roots = []
    lists = [(roots, "the scene"), *((node.get("children", []), f"node {i}") for i, node in enumerate(nodes))]
    parents = [0] * len(nodes)
    for children, what in lists:
        if not isinstance(children, list):
            raise SceneError(f"{what} has nodes {children!r}, which are no list.")
        for child in children:
            parents[_index({"node": child}, "node", what, len(nodes))] += 1
    if parents and max(parents) > 1:
        raise SceneError(f"node {parents.index(max(parents))} has two parents; the nodes of a scene are a tree.")
    # With one parent each, what hangs below a root or a node outside of the scene is a tree; a loop hangs nowhere.
    reached, stack = 0, [node for node, count in enumerate(parents) if count == 0] + roots
    while stack:
        reached += 1
        stack += nodes[stack.pop()].get("children", [])
    if reached < len(nodes):
        raise SceneError(f"{len(nodes) - reached} of its nodes are their own ancestors; nodes are a tree.")


def _image(image: dict[str, Any], index: int, views: list[memoryview], folder: Path) -> int:
    """Pixels that it decodes to; 0 for one that is not read."""
    what = f"image {index}"
    if image.get("mimeType") in _UNREAD_IMAGES:
        return 0
    if "bufferView" in image:
        content: Bytes | None = views[_index(image, "bufferView", what, len(views))]
    else:
        content = _from_uri(image.get("uri", ""), what, folder)
    if content is None:
        raise SceneError(f"{what} is in {image.get('uri')!r}, which is missing.")
    width, height = check_picture(io.BytesIO(content), what, SceneError)
    return width * height
