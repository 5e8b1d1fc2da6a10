"""Float64 twin of kernels/stats.cl, slot by slot from the frame itself."""

import numpy as np

from cldof import LayeredFrame

__all__ = ["tile_stats"]


def tile_stats(frame: LayeredFrame, tile: int = 16, bins: int = 64) -> dict[str, np.ndarray]:
    """Statistics by their definition; keys are the attributes of SceneStats."""
    color, depth = frame.color.astype(np.float64), frame.depth.astype(np.float64)
    peels, height, width = depth.shape
    shape = (peels, -(-height // tile), -(-width // tile))
    inverse = 1.0 / depth
    there = color[..., 3] > 0.0
    has_depth = there | (depth < np.inf) | (not frame.is_opaque)
    first, last = frame.inverse_depth_range
    found = {name: np.zeros(shape) for name in ("nearest", "farthest", "slots", "solid", "step", "luminance")}
    found["low"], found["high"] = np.full((*shape, 4), np.inf), np.zeros((*shape, 4))
    found["bins"] = np.zeros((*shape, bins), bool)
    for m, ty, tx in np.ndindex(shape):
        box = (m, slice(ty * tile, (ty + 1) * tile), slice(tx * tile, (tx + 1) * tile))
        at = (m, ty, tx)
        is_there, w, c = there[box], inverse[box], color[box]
        found["slots"][at] = is_there.sum()
        found["solid"][at] = (is_there & (c[..., 3] >= 1.0)).sum()
        found["nearest"][at] = w[is_there].max(initial=-1.0)
        found["farthest"][at] = w[is_there].min(initial=np.inf)
        if is_there.any():
            found["luminance"][at] = (c[is_there][:, :3] @ (0.2126, 0.7152, 0.0722)).mean()
            found["low"][at], found["high"][at] = c[is_there].min(axis=0), c[is_there].max(axis=0)
        if last > first:
            number = np.clip((w[is_there] - first) * bins / (last - first), 0, bins - 1).astype(int)
            found["bins"][at][number] = True
        elif is_there.any():
            found["bins"][at][0] = True
        for y, x in np.ndindex(is_there.shape):
            gy, gx = ty * tile + y, tx * tile + x
            for ny, nx in ((gy, gx + 1), (gy + 1, gx)):
                if ny < height and nx < width and has_depth[m, gy, gx] and has_depth[m, ny, nx]:
                    step = abs(inverse[m, gy, gx] - inverse[m, ny, nx])
                    found["step"][at] = max(found["step"][at], step)
    return found
