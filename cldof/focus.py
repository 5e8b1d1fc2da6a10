"""Where to focus, and how a lens moves over a sequence.

Depths are planar, in metres, as everywhere. What a pixel "shows" is the layer that gives most of its light: of a pane
with a statue behind it that is the statue, unless the pane is more than half opaque.

The circle of confusion is ``C = c1 * (1/z - 1/focus)`` with ``c1`` in proportion to the aperture radius. So a focus
that moves evenly in ``1/focus`` changes every blur evenly, and one stop of f-number is one step in the logarithm: that
is how :class:`LensTrack` goes from key to key.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from .camera import Camera
from .errors import FrameError, InputError, SceneError
from .frame import LayeredFrame
from .lens import Aperture, DiscAperture, Lens

if TYPE_CHECKING:
    from .capture.scene import Node, Scene
    from .renderer import Renderer, Result

__all__ = ["LensKey", "LensTrack", "autofocus", "find_node", "focus_at", "focus_on", "render_track"]

# focus_at looks this far (px) for a surface around a pixel that shows none, so that a wire can be hit.
_REACH_PX = 2
# The middle of the image, as a share of its width and height, that autofocus looks at.
_CENTRAL = 0.4
# A surface counts when it fills this share of the (weighted) middle within this relative range of inverse depth.
_SHARE, _THICKNESS = 0.08, 0.1
# Points that stand for a node, and by how much (relative) one may lie behind what the frame shows and yet be it:
# a point is anywhere in its pixel, the depth is that of the pixel's middle.
_POINTS, _TOLERANCE = 8192, 0.01


def focus_at(frame: LayeredFrame, x: float, y: float, reach_px: int = _REACH_PX) -> float:
    """Distance of what is seen at a pixel of the image.

    Parameters
    ----------
    frame : LayeredFrame
    x, y : float
        Pixels from the image's top left corner (guard band not counted), x right, y down.
    reach_px : int
        Where the pixel itself shows sky or nothing, the nearest surface that is no farther off than this is taken.

    Returns
    -------
    float
        Metres; ``inf`` for sky.

    Raises
    ------
    FrameError
        The pixel is outside of the image, or nothing is there.
    """
    camera, guard = frame.camera, frame.guard_px
    if not (0 <= x < camera.width and 0 <= y < camera.height):
        raise FrameError(
            f"Pixel ({x:g}, {y:g}) is outside the image of {camera.width}x{camera.height} (x right, y down, from 0)."
        )
    if reach_px < 0:
        raise InputError(f"reach_px is {reach_px}; it must be at least 0.")
    column, row = int(x) + guard, int(y) + guard
    here = float(_shown_depth(frame, slice(row, row + 1), slice(column, column + 1))[0, 0])
    if math.isfinite(here):
        return here
    rows, columns = (slice(max(0, middle - reach_px), middle + reach_px + 1) for middle in (row, column))
    around = _shown_depth(frame, rows, columns)
    surfaces = around[np.isfinite(around)]
    if surfaces.size:
        return float(surfaces.min())
    if math.isinf(here):
        return here
    raise FrameError(f"Nothing is seen at pixel ({x:g}, {y:g}), nor within {reach_px} px of it: choose another pixel.")


def autofocus(frame: LayeredFrame) -> float:
    """Distance of the nearest surface in the middle of the image that is large enough to be meant.

    Pixels within the middle 40 % of width and height count, those near the centre more. From near to far, the first
    range of 10 % of inverse depth that holds 8 % of them is the subject, and its median is the answer, so specks and
    single wires are passed over. Where the middle holds no such surface, the whole image is searched, at last for any.

    Returns
    -------
    float
        Metres; ``inf`` when there is nothing but sky.

    Raises
    ------
    FrameError
        The frame is empty.
    """
    guard = frame.guard_px
    inner = slice(guard, -guard or None)
    depth = _shown_depth(frame, inner, inner)
    height, width = depth.shape
    across, down = (np.abs((np.arange(n) + 0.5) * 2.0 / n - 1.0) for n in (width, height))
    central = np.multiply.outer(np.cos(down * np.pi / 2.0), np.cos(across * np.pi / 2.0))
    central[down > _CENTRAL] = 0.0
    central[:, across > _CENTRAL] = 0.0
    for weight, share in ((central, _SHARE), (np.ones_like(central), _SHARE), (np.ones_like(central), 0.0)):
        found = _nearest_mass(depth, weight, share)
        if found is not None:
            return found
    if np.isinf(depth).any():
        return math.inf
    raise FrameError("Nothing is in sight: the frame holds no surface to focus on.")


def focus_on(
    scene: Scene, node: Node | str | int, frame: LayeredFrame | None = None, camera: Camera | None = None
) -> float:
    """Distance of one node of a scene.

    Parameters
    ----------
    scene : Scene
    node : Node, str or int
        As :func:`find_node` takes it.
    frame : LayeredFrame, optional
        A capture of the scene: the answer is then the median depth of the pixels that show the node. Where none does
        (hidden, or outside of the image), and without a frame, it is the depth of the centre of its bounding box.
    camera : Camera, optional
        Of which the depth is meant; by default the frame's, else the scene's.

    Returns
    -------
    float
        Metres.

    Raises
    ------
    SceneError
        No such node, or it lies behind the camera.
    """
    found = find_node(scene, node)
    if frame is not None:
        camera = camera or frame.camera
    elif camera is None:
        camera = scene.camera_for(512, 512)
    to_camera = np.linalg.inv(camera.pose) @ found.transform
    if frame is not None:
        visible = _visible_depth(frame, _surface_points(found.mesh) @ to_camera[:3, :3].T + to_camera[:3, 3])
        if visible.size:
            return float(np.median(visible))
    corners = np.asarray(found.mesh.vertices) @ to_camera[:3, :3].T + to_camera[:3, 3]
    depth = -float(corners[:, 2].min() + corners[:, 2].max()) / 2.0
    if depth <= 0.0:
        raise SceneError(f"Node {node!r} lies behind the camera; its centre is {-depth:.4g} m back.")
    return depth


def find_node(scene: Scene, node: Node | str | int) -> Node:
    """A node by itself, by name or by number.

    Parameters
    ----------
    scene : Scene
    node : Node, str or int
        A name must be one node's; text that is a number counts as one, if nothing has that name.

    Raises
    ------
    SceneError
        With the names that there are.
    """
    if not isinstance(node, str | int):
        if not any(node is each for each in scene.nodes):
            raise SceneError(f"The node is not one of scene {scene.name!r}.")
        return node
    total = len(scene.nodes)
    named = [each for each in scene.nodes if each.name is not None and each.name == node]
    if len(named) == 1:
        return named[0]
    if len(named) > 1:
        numbers = ", ".join(str(index) for index, each in enumerate(scene.nodes) if each.name == node)
        raise SceneError(f"Scene {scene.name!r} has {len(named)} nodes named {node!r}; say which: {numbers}.")
    if isinstance(node, int) or node.isdecimal():
        if 0 <= int(node) < total:
            return scene.nodes[int(node)]
        raise SceneError(f"Scene {scene.name!r} has nodes 0 to {total - 1}; there is no node {node}.")
    names = sorted({each.name for each in scene.nodes if each.name is not None})
    listed = ", ".join(names[:20]) + (f" and {len(names) - 20} more" if len(names) > 20 else "")
    raise SceneError(
        f"Scene {scene.name!r} has no node {node!r}; "
        + (f"named are {listed}" if names else "its nodes have no names")
        + f", numbers go from 0 to {total - 1}."
    )


@dataclass(frozen=True)
class LensKey:
    """Where a lens is at one frame of a sequence; what is None goes on from the other keys.

    Parameters
    ----------
    frame : float
        Number of the frame, from 0; fractions are legal.
    focus_distance_m : float, optional
        Metres; ``inf`` is legal.
    aperture_radius_m : float, optional
        Metres; 0 is a pinhole.
    """

    frame: float
    focus_distance_m: float | None = None
    aperture_radius_m: float | None = None

    def __post_init__(self) -> None:
        if not math.isfinite(self.frame):
            raise InputError(f"A key's frame is {self.frame}; it must be a finite number.")
        Lens(
            0.0 if self.aperture_radius_m is None else self.aperture_radius_m,
            1.0 if self.focus_distance_m is None else self.focus_distance_m,
        )

    @classmethod
    def photographic(
        cls, frame: float, focal_length_mm: float, f_number: float, focus_distance_m: float | None = None
    ) -> LensKey:
        """A key by f-number; ``inf`` is a pinhole."""
        lens = Lens.photographic(focal_length_mm, f_number, focus_distance_m or math.inf)
        return cls(frame, focus_distance_m, lens.aperture_radius_m)


@dataclass(frozen=True)
class LensTrack:
    """A lens that moves from key to key: focus evenly in ``1/distance``, the aperture evenly in stops.

    Where an aperture opens from a pinhole or closes to one, infinitely many stops away, its radius moves evenly.
    Before the first key and after the last nothing moves.

    Parameters
    ----------
    keys : sequence of LensKey
        In any order; each frame once for the focus and once for the aperture. One key at least must give each.
    aperture : Aperture or str
    focal_length_mm : float, optional
        Only remembered, as in :class:`~cldof.Lens`.
    ease : {"linear", "smooth"}
        "smooth" starts and stops gently at every key: ``3 t^2 - 2 t^3``.

    Raises
    ------
    InputError
    """

    keys: Sequence[LensKey]
    aperture: Aperture | str = field(default_factory=DiscAperture)
    focal_length_mm: float | None = None
    ease: str = "linear"

    def __post_init__(self) -> None:
        keys = tuple(sorted(self.keys, key=lambda key: key.frame))
        object.__setattr__(self, "keys", keys)
        object.__setattr__(self, "aperture", Aperture.of(self.aperture))
        if self.ease not in ("linear", "smooth"):
            raise InputError(f"ease is {self.ease!r}; choose one of linear, smooth.")
        for name in ("focus_distance_m", "aperture_radius_m"):
            frames = [key.frame for key in keys if getattr(key, name) is not None]
            if not frames:
                raise InputError(f"No key gives {name}; one at least must.")
            for frame in frames:
                if frames.count(frame) > 1:
                    raise InputError(f"Frame {frame:g} has two keys that give {name}; give one.")
        for key in keys:
            self.lens(key.frame)

    @classmethod
    def rack(cls, lens: Lens, to_focus_m: float, frames: int, ease: str = "linear") -> LensTrack:
        """From a lens's focus to another distance over so many frames, the first and the last exactly there."""
        if frames < 2:
            raise InputError(f"frames is {frames}; a rack focus needs at least 2.")
        keys = [LensKey(0, lens.focus_distance_m, lens.aperture_radius_m), LensKey(frames - 1, to_focus_m)]
        return cls(keys, lens.aperture, lens.focal_length_mm, ease)

    def lens(self, frame: float) -> Lens:
        """The lens at a frame; exactly a key's numbers at that key."""
        focus = self._between("focus_distance_m", frame, _inverse_mean)
        radius = self._between("aperture_radius_m", frame, _stops_mean)
        return Lens(radius, focus, self.focal_length_mm, Aperture.of(self.aperture))

    def lenses(self, count: int) -> list[Lens]:
        """The lenses of frames 0 to ``count - 1``."""
        return [self.lens(frame) for frame in range(count)]

    def _between(self, name: str, frame: float, mean: Any) -> float:
        keys = [(key.frame, getattr(key, name)) for key in self.keys if getattr(key, name) is not None]
        after = bisect_right([at for at, _ in keys], frame)
        if after == 0 or after == len(keys):
            return float(keys[max(0, after - 1)][1])
        (start, first), (end, second) = keys[after - 1 : after + 1]
        t = (frame - start) / (end - start)
        if self.ease == "smooth":
            t = t * t * (3.0 - 2.0 * t)
        return float(first if t == 0.0 or first == second else mean(first, second, t))


def render_track(
    renderer: Renderer, frame: LayeredFrame, lenses: Iterable[Lens], in_flight: int = 2
) -> Iterator[Result]:
    """Render one captured frame through one lens after the other; the capture stays on the device.

    Parameters
    ----------
    renderer : Renderer
    frame : LayeredFrame
        With a guard band for the largest blur of all lenses.
    lenses : iterable of Lens
        For instance :meth:`LensTrack.lenses`.
    in_flight : int
        How many frames may be on their way at a time (the renderer's ``frames_in_flight``).

    Yields
    ------
    Result
        In order.
    """
    pending: deque[Any] = deque()
    for lens in lenses:
        if len(pending) >= in_flight:
            yield pending.popleft().result()
        pending.append(renderer.render_async(frame, lens))
    while pending:
        yield pending.popleft().result()


def _inverse_mean(first: float, second: float, t: float) -> float:
    inverse = (1.0 - t) / first + t / second
    return 1.0 / inverse if inverse > 0.0 else math.inf


def _stops_mean(first: float, second: float, t: float) -> float:
    if first == 0.0 or second == 0.0:
        return (1.0 - t) * first + t * second
    return math.exp((1.0 - t) * math.log(first) + t * math.log(second))


def _shown_depth(frame: LayeredFrame, rows: slice, columns: slice) -> NDArray[np.float32]:
    """Depth of the layer that gives a pixel most of what is seen there; ``inf`` for sky, NaN for nothing."""
    alpha = frame.color[:, rows, columns, 3]
    past = np.cumprod(1.0 - alpha, axis=0)
    past = np.concatenate([np.ones_like(past[:1]), past[:-1]])
    share = past * alpha
    best = share.argmax(axis=0)[None]
    depth = np.take_along_axis(frame.depth[:, rows, columns], best, axis=0)[0]
    # More of the void than of any layer is nothing to focus on.
    void = np.take_along_axis(share, best, axis=0)[0] <= np.prod(1.0 - alpha, axis=0)
    return np.where(void, np.float32(np.nan), depth)


def _nearest_mass(depth: NDArray[np.float32], weight: NDArray[np.float64], share: float) -> float | None:
    """From near to far, the first narrow range of inverse depth that holds a share of the weight: its median."""
    surface = np.isfinite(depth) & (weight > 0.0)
    if not surface.any():
        return None
    inverse, mass = 1.0 / depth[surface].astype(np.float64), weight[surface]
    order = np.argsort(-inverse, kind="stable")
    inverse, total = inverse[order], np.concatenate([[0.0], np.cumsum(mass[order])])
    # For each pixel: those from it to the range's far end, of which there are enough or not.
    end = np.searchsorted(-inverse, -inverse * (1.0 - _THICKNESS), side="right")
    enough = total[end] - total[:-1] >= share * float(weight.sum())
    if not enough.any():
        return None
    start = int(np.argmax(enough))
    middle = (total[start] + total[end[start]]) / 2.0
    return 1.0 / float(inverse[max(start, int(np.searchsorted(total, middle)) - 1)])


def _surface_points(mesh: Any) -> NDArray[np.float64]:
    """Points spread evenly over a mesh's area, the same on every call; (N, 3), mesh coordinates."""
    corners = np.asarray(mesh.vertices, np.float64)[np.asarray(mesh.faces)]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    if not area.sum() > 0.0:
        return np.asarray(corners.reshape(-1, 3))
    random = np.random.default_rng(0)
    steps = np.cumsum(area)
    face = np.searchsorted(steps, (np.arange(_POINTS) + random.random(_POINTS)) / _POINTS * steps[-1])
    u, v = random.random((2, _POINTS))
    u, v = np.where(u + v > 1.0, (1.0 - u, 1.0 - v), (u, v))
    first, second, third = corners[np.minimum(face, len(corners) - 1)].transpose(1, 0, 2)
    return np.asarray(first + u[:, None] * (second - first) + v[:, None] * (third - first))


def _visible_depth(frame: LayeredFrame, points: NDArray[np.float64]) -> NDArray[np.float32]:
    """Depths of the image's pixels that show one of the points (camera coordinates); each pixel once."""
    camera, guard = frame.camera, frame.guard_px
    depth = -points[:, 2]
    front = depth > 0.0
    depth, points = depth[front], points[front]
    column = np.floor(camera.width / 2.0 + camera.focal_px * points[:, 0] / depth).astype(np.int64)
    row = np.floor(camera.height / 2.0 - camera.focal_px * points[:, 1] / depth).astype(np.int64)
    inside = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
    column, row, depth = column[inside], row[inside], depth[inside]
    inner = slice(guard, -guard or None)
    shown = _shown_depth(frame, inner, inner)
    seen = np.abs(shown[row, column] / depth - 1.0) <= _TOLERANCE
    pixels = np.unique(row[seen] * camera.width + column[seen])
    visible: NDArray[np.float32] = shown.reshape(-1)[pixels]
    return visible
