"""Reflections through a lens: what polished things show is shaded from points all over the lens."""

import argparse
import math

import cldof
from cldof.capture.peel import DepthPeeler
from cldof.capture.scenes import builtin_scene
from cldof.images import save_image

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("output", nargs="?", default="glossy.png")
parser.add_argument("--scene", default="mirrors")
parser.add_argument("--size", type=int, default=512)
arguments = parser.parse_args()

scene = builtin_scene(arguments.scene)
camera = scene.camera_for(arguments.size, arguments.size)
lens = cldof.Lens(scene.aperture_radius_m, scene.focus_distance_m)

# Surface buffers and lights come with the frame; a frame of your own takes them as arrays and a cldof.Lighting.
with DepthPeeler() as peeler:
    frame = peeler.peel(scene, camera, layers=4, lens=lens, guard_px=math.ceil(0.06 * arguments.size), surface=True)
print(f"glossy through this lens: {frame.is_glossy_through(lens)}")

with cldof.Renderer(method="multiview") as renderer:
    result = renderer.render(frame, lens)
print(f"shaded from {result.plan.summary['eyes']} points of the lens in {result.wall_ms:.0f} ms")

save_image(arguments.output, result.image, {"lens": lens.to_dict(), "camera": camera.to_dict()})
print(arguments.output)
