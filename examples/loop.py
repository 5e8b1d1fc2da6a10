"""Once per frame: focus moves from near to far, the output array is used again, milliseconds are printed."""

import argparse
import time

import numpy as np

import cldof
from cldof.capture.peel import DepthPeeler
from cldof.capture.scenes import builtin_scene

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--frames", type=int, default=30)
parser.add_argument("--size", type=int, default=768)
arguments = parser.parse_args()

scene = builtin_scene("row")
camera = scene.camera_for(arguments.size, arguments.size)
with DepthPeeler() as peeler:
    frame = peeler.peel(scene, camera, layers=4, guard_px=24)

image = np.empty((camera.height, camera.width, 4), np.float32)
with cldof.Renderer(method="layered") as renderer:
    # Even steps in 1/distance look even.
    for index, focus in enumerate(1.0 / np.linspace(1 / 1.4, 1 / 15.0, arguments.frames)):
        start = time.perf_counter()
        renderer.render(frame, cldof.Lens(scene.aperture_radius_m, focus), out=image)
        print(f"frame {index:3}  focus {focus:6.2f} m  {(time.perf_counter() - start) * 1e3:7.1f} ms")
