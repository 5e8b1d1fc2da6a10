"""Depth of field for RGBD arrays made in numpy: no scene and no OpenGL, only an OpenCL device.

A bright disc floats before a striped wall. Each is a layer with colour and depth of its own, so the wall behind the
disc is known and shows through the disc's blurred rim.
"""

import argparse

import numpy as np

import cldof
from cldof.images import save_image

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("output", nargs="?", default="render_npz.png")
parser.add_argument("--size", type=int, default=512)
arguments = parser.parse_args()

size = arguments.size
y, x = (np.mgrid[:size, :size] + 0.5) / size

# Linear light, premultiplied alpha, (layers, H, W, 4); depth in metres, inf where nothing is.
color = np.zeros((2, size, size, 4), np.float32)
depth = np.full((2, size, size), np.inf, np.float32)
inside = np.hypot(x - 0.4, y - 0.5) < 0.22
color[0][inside] = (0.9, 0.25, 0.05, 1.0)
depth[0][inside] = 0.8

# A layer holds the n-th surface of each pixel: where there is no disc, the wall is the first one.
wall = np.ones((size, size, 4), np.float32)
wall[..., :3] = np.where(np.sin(60 * x + 20 * y)[..., None] > 0, (0.05, 0.2, 0.4), (0.8, 0.8, 0.7))
color[0][~inside], depth[0][~inside] = wall[~inside], 3.0
color[1][inside], depth[1][inside] = wall[inside], 3.0

camera = cldof.Camera(size, size, yfov_deg=40.0)
frame = cldof.LayeredFrame(color, depth, camera)
lens = cldof.Lens(aperture_radius_m=0.025, focus_distance_m=3.0)

with cldof.Renderer(method="layered") as renderer:
    result = renderer.render(frame, lens)

save_image(arguments.output, result.image, {"lens": lens.to_dict()})
print(f"{arguments.output}: blur radius of the disc {abs(float(lens.coc_radius_px(camera, 0.8))):.1f} px")
