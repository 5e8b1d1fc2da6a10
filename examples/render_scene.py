"""A scene to a picture: capture layers with OpenGL, blur them with OpenCL."""

import argparse
import math

import cldof
from cldof.capture.peel import DepthPeeler
from cldof.capture.scenes import builtin_scene  # cldof.capture.load.load_scene reads model files
from cldof.images import save_image

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("output", nargs="?", default="render_scene.png")
parser.add_argument("--scene", default="foliage")
parser.add_argument("--size", type=int, default=768)
arguments = parser.parse_args()

scene = builtin_scene(arguments.scene)
camera = scene.camera_for(arguments.size, arguments.size)
lens = cldof.Lens(scene.aperture_radius_m, scene.focus_distance_m)

# The lens sees past the frame: capture as many pixels more as the largest blur reaches.
guard_px = math.ceil(0.03 * arguments.size)
with DepthPeeler() as peeler:
    frame = peeler.peel(scene, camera, layers=4, lens=lens, guard_px=guard_px)

with cldof.Renderer(method="layered", profile=True) as renderer:
    result = renderer.render(frame, lens)
    for timing in result.timings:
        print(f"{timing.ms:8.2f} ms  {timing.label}")

save_image(arguments.output, result.image, {"lens": lens.to_dict(), "camera": camera.to_dict()})
print(arguments.output)
