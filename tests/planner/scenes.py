"""Frames of a wall with boxes in front of it and windows through it: cases for which a planner has something to do."""

import numpy as np

from cldof import Camera, LayeredFrame, Lens

__all__ = ["Box", "lens_for", "wall_frame"]

Box = tuple[int, int, int, int, float]
"""x0, y0, x1, y1 in px, depth in metres."""


def wall_frame(
    width: int,
    height: int,
    boxes: list[Box],
    *,
    wall_m: float = 2.0,
    tilt: float = 0.0,
    smooth: bool = False,
    bright: float = 1.0,
    opaque: bool = True,
    seed: int = 0,
) -> LayeredFrame:
    """Boxes before or behind a wall: nearer ones hide it, farther ones are seen through a hole of theirs.

    Parameters
    ----------
    boxes : list of (x0, y0, x1, y1, depth in metres)
    wall_m, tilt : float
        Depth of the wall in the middle, and by how much its inverse depth changes over the width, as a share.
    smooth : bool
        Paint everything with gradients and not with noise.
    bright : float
        The brightest colour.
    opaque : bool
        False lets the void through the wall's holes.
    """
    rng = np.random.default_rng(seed)

    def paint() -> np.ndarray:
        color = np.ones((height, width, 4), np.float32)
        if smooth:
            x, y = np.linspace(0, 1, width), np.linspace(0, 1, height)
            for channel in range(3):
                color[..., channel] = 0.5 + 0.2 * (rng.random() * x + rng.random() * y[:, None])
        else:
            cells = rng.random((height // 3 + 1, width // 3 + 1, 3), np.float32)
            color[..., :3] = cells.repeat(3, 0).repeat(3, 1)[:height, :width]
        color[..., :3] *= bright
        return color

    inverse = (1.0 + tilt * np.linspace(-0.5, 0.5, width)) / wall_m
    wall = np.broadcast_to(1.0 / inverse, (height, width)).astype(np.float32)
    # Slots per pixel, near to far.
    depth = np.full((3, height, width), np.inf, np.float32)
    color = np.zeros((3, height, width, 4), np.float32)
    depth[0], color[0] = wall, paint()
    for x0, y0, x1, y1, at in boxes:
        place = (slice(y0, y1), slice(x0, x1))
        picture = paint()[place]
        if at > wall.max():
            if opaque:
                depth[0][place], color[0][place] = at, picture
            else:
                depth[0][place], color[0][place] = np.inf, 0.0
            depth[1][place], color[1][place] = np.inf, 0.0
        else:
            depth[1][place], color[1][place] = depth[0][place], color[0][place]
            depth[0][place], color[0][place] = at, picture
    # Where boxes overlap the order may be wrong: the nearer one first.
    wrong = depth[1] < depth[0]
    depth[1][wrong], color[1][wrong] = np.inf, 0.0
    return LayeredFrame(color, depth, Camera(width, height, 40.0))


def lens_for(frame: LayeredFrame, coc_px: float, focus_m: float) -> Lens:
    """A CoC radius of ``coc_px`` at half the focus distance, or at 2 m for a focus far away."""
    return Lens(coc_px * min(focus_m, 2.0) / frame.camera.focal_px, focus_m)
