"""What a lens calls for: the plan of each f-number, in words, without any scene: two walls made of numbers."""

import numpy as np

import cldof

HEIGHT, WIDTH = 240, 320
rng = np.random.default_rng(0)
cells = rng.random((HEIGHT // 8, WIDTH // 8, 3), np.float32)
picture = cells.repeat(8, 0).repeat(8, 1)

# A wall at 2 m with a box at 1 m before it; the second layer is the wall behind the box.
depth = np.full((2, HEIGHT, WIDTH), np.inf, np.float32)
color = np.zeros((2, HEIGHT, WIDTH, 4), np.float32)
depth[0], color[0, ..., :3], color[0, ..., 3] = 2.0, picture, 1.0
box = np.s_[100:140, 60:120]
depth[1][box], color[1][box] = depth[0][box], color[0][box]
depth[0][box], color[0][box] = 1.0, (0.9, 0.4, 0.1, 1.0)
frame = cldof.LayeredFrame(color, depth, cldof.Camera(WIDTH, HEIGHT, yfov_deg=40.0))

with cldof.Renderer("layered") as renderer:
    stats = renderer.stats(frame)
    for f_number in (2.0, 16.0, float("inf")):
        lens = cldof.Lens.photographic(50.0, f_number, focus_distance_m=2.0)
        near, focus, far = stats.blur_shares(lens, frame.camera)
        print(f"f/{f_number:g}: {near:.0%} blurred in front, {focus:.0%} in focus, {far:.0%} blurred behind")
        result = renderer.render(frame, lens)
        print(result.plan.explain(), "\n")
        assert f_number < float("inf") or np.array_equal(result.image, frame.pinhole_image())
