"""Rack focus: from the nearest thing in the middle to the farthest surface, while the lens stops down; writes PNGs."""

import argparse
from pathlib import Path

import numpy as np

import cldof
from cldof.capture.peel import DepthPeeler
from cldof.capture.scenes import builtin_scene
from cldof.focus import LensKey, LensTrack, autofocus, render_track
from cldof.images import save_image

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("folder", type=Path)
parser.add_argument("--scene", default="row")
parser.add_argument("--frames", type=int, default=24)
parser.add_argument("--size", type=int, default=512)
arguments = parser.parse_args()

scene = builtin_scene(arguments.scene)
camera = scene.camera_for(arguments.size, arguments.size)
with DepthPeeler() as peeler:
    frame = peeler.peel(scene, camera, layers=4, guard_px=arguments.size // 16)

near, far = autofocus(frame), float(frame.depth[0][np.isfinite(frame.depth[0])].max())
last = arguments.frames - 1
# Focus reaches the far end two thirds of the way; the aperture closes by two stops from there to the end.
keys = [
    LensKey(0, near, scene.aperture_radius_m),
    LensKey(2 * last / 3, far, scene.aperture_radius_m),
    LensKey(last, aperture_radius_m=scene.aperture_radius_m / 4),
]
lenses = LensTrack(keys, ease="smooth").lenses(arguments.frames)
with cldof.Renderer(method="layered") as renderer:
    for number, result in enumerate(render_track(renderer, frame, lenses)):
        path = arguments.folder / f"{number:03}.png"
        save_image(path, result.image)
        print(f"{path}  focus {lenses[number].focus_distance_m:6.2f} m  {result.wall_ms:7.1f} ms")
