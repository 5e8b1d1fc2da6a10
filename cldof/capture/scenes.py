"""The built-in scenes: procedural, seeded, the same on every machine, made to show what a lens does.

Each comes with a camera, a focus and an aperture of which the largest circle of confusion is 2-3 % of the image height
in radius. Where a floor or a wall takes shadows they are painted into its texture from the real meshes, since captures
light each surface on its own.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from ..errors import SceneError
from . import hard_scenes
from .glossy_scenes import mirrors
from .scene import Ambient, DirectionalLight, Gradient, Material, Node, PointLight, Scene
from .shapes import ball, block, knot, lathe, leaf, merge, moved, pipe, quad, ring, star
from .staging import Light, aimed_camera, floor, glow, leaf_material, merged, mirrored, paint, plant, printed
from .textures import bricks, checker, coverage, noise, picture, planks, poster, rgb, speckle

__all__ = ["SHOW", "TEST", "BuiltinScene", "builtin_scene", "builtin_scenes"]

SHOW, TEST = "to show off", "to test"


class BuiltinScene(NamedTuple):
    """A line of the list that ``cldof scenes`` prints.

    ``group`` is :data:`SHOW` or :data:`TEST`; scenes to test say what they are hard for.
    """

    description: str
    make: Callable[[], Scene]
    group: str = SHOW


def builtin_scenes() -> dict[str, BuiltinScene]:
    """All built-in scenes by name; ``make()`` builds one in about a second."""
    return {
        "row": BuiltinScene("varied objects receding from 1 to 20 m, focus in the middle", _row),
        "fence": BuiltinScene("a picket fence close to the lens before a house in focus", _fence),
        "foliage": BuiltinScene("leaves close to the lens that let a birdhouse and far trees through", _foliage),
        "tabletop": BuiltinScene("chess pieces at arm's length, shallow focus, bright HDR lamps far behind", _tabletop),
        "glass": BuiltinScene("a tinted glass pane between sculptures, prints on a far wall", _glass),
        "floating": BuiltinScene("shapes in mid-air over a transparent background", _floating),
        "mirrors": BuiltinScene("polished metal in a hall: reflections that the lens blurs", mirrors, TEST),
        **{name: BuiltinScene(text, make, TEST) for name, (text, make) in hard_scenes.HARD_SCENES.items()},
    }


def builtin_scene(name: str) -> Scene:
    """Build one by name.

    Raises
    ------
    SceneError
        If there is no such scene; the message lists those there are.
    """
    scenes = builtin_scenes()
    if name not in scenes:
        raise SceneError(f"There is no built-in scene {name!r}; there are {', '.join(scenes)}.")
    return scenes[name].make()


def _zoo(rng: np.random.Generator) -> list[Any]:
    """Half-metre objects that stand on y = 0."""
    bell = lathe([(0, 0), (0.22, 0), (0.23, 0.02), (0.17, 0.1), (0.09, 0.24), (0.05, 0.36), (0.1, 0.44), (0, 0.5)])
    angle = np.linspace(0, 1, 40)
    belly = np.stack([0.11 + 0.13 * np.sin(angle * 2.9) ** 2 - 0.07 * angle, 0.5 * angle], axis=1).tolist()
    vase = lathe([(0, 0), (0.11, 0), *belly, (0.02, 0.5)])
    spring = np.linspace(0, 5 * 2 * math.pi, 260)
    coil = pipe(
        np.stack([0.19 * np.cos(spring), 0.035 + 0.43 * spring / spring[-1], 0.19 * np.sin(spring)], 1), 0.033, 14
    )
    return [
        moved(ball(0.25), (0, 0.25, 0)),
        moved(block((0.4, 0.4, 0.4), 0.045), (0, 0.2, 0)),
        moved(knot(0.24, 0.055), (0, 0.31, 0), (0, 0, 90)),
        lathe([(0, 0), (0.25, 0), (0.255, 0.012), (0.02, 0.52), (0, 0.53)]),
        moved(ring(0.19, 0.075), (0, 0.26, 0), (90, 0, 0)),
        star(5, 0.27, 0.14, 0.5, twist=0.9),
        vase,
        coil,
        lathe([(0, 0), (0.19, 0), (0.2, 0.012), (0.2, 0.388), (0.19, 0.4), (0, 0.4)]),
        moved(knot(0.24, 0.05, 3, 2), (0, 0.3, 0)),
        bell,
        star(3, 0.28, 0.15, 0.46, twist=-0.6),
    ]


def _row() -> Scene:
    rng = np.random.default_rng(11)
    light = Light((-0.55, -1.0, -0.45), (0.85, 0.79, 0.7), Ambient((0.42, 0.45, 0.5), (0.30, 0.26, 0.22)))
    eye = (0.0, 0.68, 0.0)
    colors = ["#e4572e", "#2e86ab", "#f2c14e", "#3f8f5b", "#8e5fa8", "#e76f8a", "#2a9d8f", "#d98324", "#4f6d9f"]
    colors += ["#c8553d", "#87b38d", "#b8416a"]
    shapes = _zoo(rng)
    nodes, casters = [], []
    count = 15
    for i in range(count):
        depth = 1.3 * (20.0 / 1.3) ** (i / (count - 1))
        # Left, right and between in turn, closing in on the middle with distance.
        sway = (-0.19, 0.17, -0.04, 0.24, -0.24)[i % 5] * (1.05 - 0.35 * i / count)
        mesh = moved(shapes[i % len(shapes)], (sway * depth, 0.0, -depth), (0, float(rng.uniform(0, 90)), 0), 0.66)
        nodes.append(Node(mesh, material=paint(colors[i % len(colors)], (0.35, 0.6, 0.25)[i % 3])))
        casters.append(mesh)
    haze = rgb("#d7dfe6")
    near_area, far_area = (-3.0, -7.0, 3.0, 0.0), (-40.0, -70.0, 40.0, -7.0)
    tones = ("#d9cbb8", "#b9a58c")
    near_albedo = checker(rng, (1512, 1296), (14, 12), tones)
    # Tiles of half a metre; the far part is coarser, and wide enough for any image shape.
    far_albedo = checker(rng, (1260, 1600), (126, 160), tones)
    side_albedo = checker(rng, (700, 700), (14, 14), tones)
    fade = (haze, eye, 9.0, 55.0)
    nodes.append(floor(near_albedo, near_area, light, casters, fade=fade))
    nodes.append(floor(far_albedo, far_area, light, casters, fade=fade, softness_m=0.05))
    for left in (-10.0, 3.0):
        nodes.append(floor(side_albedo, (left, -7.0, left + 7.0, 0.0), light, casters, fade=fade))
    top = rgb("#6f9bc4")
    return Scene(
        "row",
        merged(nodes),
        camera=aimed_camera(eye, (0.0, 0.26, -3.0), 33.0, 0.3),
        lights=light.lights(),
        ambient=light.ambient,
        background=Gradient(top=top, bottom=mirrored(haze, top)),
        focus_distance_m=4.1,
        aperture_radius_m=0.027,
    )


def _pot(radius: float, height: float) -> Any:
    r = radius
    wall = [(0.68 * r, 0), (0.92 * r, 0.8 * height), (r, 0.8 * height), (1.03 * r, height), (0.9 * r, height)]
    return lathe([(0, 0), *wall, (0.86 * r, 0.86 * height), (0, 0.86 * height)])


def _fence() -> Scene:
    rng = np.random.default_rng(23)
    light = Light((0.5, -0.9, -0.62), (0.92, 0.84, 0.7), Ambient((0.36, 0.4, 0.48), (0.2, 0.18, 0.15)))
    nodes: list[Node] = []
    casters: list[Any] = []

    def add(mesh: Any, material: Material, casts: bool = True) -> None:
        nodes.append(Node(mesh, material=material))
        if casts:
            casters.append(mesh)

    wall_z = -5.6
    palette = ["#a4523c", "#b5634a", "#8f4433", "#bd7355", "#9c5a45"]
    wall = bricks(rng, (1300, 2200), 58, 30, palette, "#b8ab9c")
    rows = np.linspace(1, 0, 1300, dtype=np.float32)[:, None, None]
    wall *= 0.72 + 0.28 * np.clip(rows * 6, 0, 1)  # darker where it meets the ground
    add(quad((-3.6, 0.0, wall_z), (7.2, 0, 0), (0, 4.2, 0)), printed(wall, 0.9), casts=False)

    white, teal = paint("#ece6da", 0.5), paint("#1f6f78", 0.4)
    # A door with four panels and a brass knob.
    door_x = -0.78
    for dx, width in ((-0.49, 0.09), (0.49, 0.09)):
        add(moved(block((width, 2.1, 0.12), 0.012), (door_x + dx, 1.05, wall_z + 0.03)), white)
    add(moved(block((1.16, 0.14, 0.16), 0.015), (door_x, 2.12, wall_z + 0.04)), white)
    add(moved(block((0.9, 2.05, 0.06), 0.008), (door_x, 1.025, wall_z + 0.02)), teal)
    for y, tall in ((0.5, 0.62), (1.45, 0.92)):
        for dx in (-0.2, 0.2):
            add(moved(block((0.3, tall, 0.05), 0.02), (door_x + dx, y, wall_z + 0.045)), paint("#2b8a92", 0.35))
    add(moved(ball(0.035, 24), (door_x + 0.38, 1.0, wall_z + 0.1)), paint("#d9a441", 0.25, 0.6))
    add(moved(block((1.3, 0.14, 0.42), 0.02), (door_x, 0.07, wall_z + 0.2)), paint("#a9a094", 0.9))
    # A window with a lamp behind it, a sill and shutters.
    win_x, win_y = 0.95, 1.42
    inside = noise(rng, 128, 128, 3, 2)[..., None] * np.array(rgb("#ffcf87"), np.float32) * 0.5 + np.array(
        rgb("#5b4634"), np.float32
    )
    add(quad((win_x - 0.45, win_y - 0.55, wall_z + 0.012), (0.9, 0, 0), (0, 1.1, 0)), printed(inside, unlit=True))
    for dx in (-0.45, 0.0, 0.45):
        add(moved(block((0.06, 1.16, 0.08), 0.01), (win_x + dx, win_y, wall_z + 0.03)), white)
    for dy in (-0.55, 0.05, 0.55):
        add(moved(block((0.96, 0.06, 0.08), 0.01), (win_x, win_y + dy, wall_z + 0.03)), white)
    add(moved(block((1.16, 0.07, 0.2), 0.015), (win_x, win_y - 0.62, wall_z + 0.09)), white)
    for side in (-1, 1):
        shutter_x = win_x + side * 0.72
        add(moved(block((0.42, 1.16, 0.05), 0.01), (shutter_x, win_y, wall_z + 0.02)), teal)
        for k in range(9):
            slat = moved(
                block((0.34, 0.075, 0.02), 0.006), (shutter_x, win_y - 0.48 + 0.12 * k, wall_z + 0.06), (35, 0, 0)
            )
            add(slat, paint("#2b8a92", 0.4))
    # Flowers on the sill and pots by the wall.
    green = [leaf_material(rng, "#3f7d3a", "#8fbf6a"), leaf_material(rng, "#5a8f3c", "#b4d17c")]
    petals = ["#e63b5a", "#f4a63a", "#f6e05a", "#d65db1", "#ffffff"]
    add(moved(block((0.9, 0.16, 0.17), 0.015), (win_x, win_y - 0.505, wall_z + 0.13)), paint("#7a4a2f", 0.8))
    for i in range(11):
        x = win_x - 0.4 + 0.08 * i
        node, mesh = plant(rng, (x, win_y - 0.43, wall_z + 0.14), 0.14, 5, green[i % 2])
        nodes.append(node)
        casters.append(mesh)
        bloom = (x + float(rng.uniform(-0.02, 0.02)), win_y - 0.33 + float(rng.uniform(0, 0.07)), wall_z + 0.19)
        add(moved(ball(0.034, 16), bloom, scale=(1, 0.8, 1)), paint(petals[i % 5], 0.6))
    for x, z, r, tall, leaves in (
        (-1.75, -5.2, 0.24, 0.4, 26),
        (-0.02, -5.25, 0.2, 0.34, 22),
        (2.0, -5.1, 0.28, 0.46, 30),
    ):
        add(moved(_pot(r, tall), (x, 0, z)), paint("#b8623f", 0.85))
        node, mesh = plant(rng, (x, 0.9 * tall, z), 2.2 * r, leaves, green[leaves % 2])
        nodes.append(node)
        casters.append(mesh)
    # A bench of slats under the window.
    wood = printed(planks(rng, (64, 512), 1, ("#7a5230", "#b98952")), 0.6)
    for k in range(3):
        add(moved(block((1.25, 0.035, 0.11), 0.01), (0.95, 0.46, wall_z + 0.32 + 0.13 * k)), wood)
    for dx in (-0.5, 0.5):
        add(moved(block((0.06, 0.45, 0.36), 0.015), (0.95 + dx, 0.225, wall_z + 0.45)), paint("#2f3437", 0.5))

    # The fence itself: pickets and two rails, at three quarters of a metre.
    picket_z = -0.78
    whitewash = paint("#f1ede2", 0.55)
    for i in range(-11, 12):
        x = 0.086 * i + 0.03
        board = merge(
            [
                moved(block((0.024, 0.92, 0.012), 0.004, 3), (0, 0.46, 0)),
                moved(block((0.017, 0.017, 0.0115), 0.003, 3), (0, 0.92, 0), (0, 0, 45)),
            ]
        )
        lean = float(rng.uniform(-0.8, 0.8))
        add(moved(board, (x, 0.345 + float(rng.uniform(-0.006, 0.006)), picket_z), (0, 0, lean)), whitewash)
    for y in (0.55, 0.985):
        add(moved(block((2.4, 0.028, 0.012), 0.004, 3), (0, y, picket_z - 0.014)), whitewash)

    area = (-6.0, wall_z, 6.0, 0.4)
    paving = checker(rng, (1200, 2400), (12, 24), ("#a89f8d", "#958c7b"))
    nodes.append(floor(paving, area, light, casters, softness_m=0.04))
    return Scene(
        "fence",
        merged(nodes),
        camera=aimed_camera((0.0, 1.12, 0.0), (0.1, 1.08, -5.0), 33.0, 0.2),
        lights=light.lights(),
        ambient=light.ambient,
        background=rgb("#b9cfe0"),
        focus_distance_m=5.4,
        aperture_radius_m=0.0145,
    )


def _tree(rng: np.random.Generator, x: float, z: float, tall: float) -> list[Any]:
    """Trunk and crown as two meshes."""
    trunk = pipe([(x, 0, z), (x + 0.02 * tall, 0.45 * tall, z)], [0.035 * tall, 0.022 * tall], 10)
    lumps = []
    for _ in range(9):
        around, up = rng.uniform(0, 2 * math.pi), rng.uniform(0.42, 0.86)
        reach = 0.17 * tall * math.sin(math.pi * (up - 0.3) / 0.75)
        lump = ball(float(rng.uniform(0.13, 0.19)) * tall, 18)
        lumps.append(moved(lump, (x + reach * math.cos(around), up * tall, z + reach * math.sin(around))))
    return [trunk, merge(lumps)]


def _foliage() -> Scene:
    rng = np.random.default_rng(5)
    light = Light((0.62, -0.85, -0.5), (1.0, 0.9, 0.7), Ambient((0.36, 0.42, 0.5), (0.16, 0.19, 0.1)))
    eye = (0.0, 1.5, 0.0)
    nodes: list[Node] = []
    casters: list[Any] = []

    def add(mesh: Any, material: Material) -> None:
        nodes.append(Node(mesh, material=material))
        casters.append(mesh)

    # The birdhouse in focus, on a post.
    x, y, z = 0.07, 1.36, -3.0
    wood = printed(planks(rng, (256, 256), 4, ("#a8743f", "#dcb078")), 0.7)
    red, dark = paint("#c8402f", 0.5), paint("#1c1512", 0.9)
    add(moved(block((0.44, 0.4, 0.4), 0.012), (x, y, z)), wood)
    add(moved(block((0.30, 0.30, 0.395), 0.01), (x, y + 0.2, z), (0, 0, 45)), wood)
    for side in (-1, 1):
        roof = moved(block((0.44, 0.03, 0.54), 0.01), (x + side * 0.152, y + 0.29, z), (0, 0, -side * 42))
        add(roof, red)
    add(moved(ball(0.075, 32), (x, y + 0.04, z + 0.2), scale=(1, 1, 0.06)), dark)
    add(moved(ring(0.08, 0.012, 48, 12), (x, y + 0.04, z + 0.205), (90, 0, 0)), paint("#efe3c8", 0.5))
    add(pipe([(x, y - 0.1, z + 0.19), (x, y - 0.1, z + 0.33)], 0.011, 12), paint("#efe3c8", 0.5))
    add(moved(block((0.52, 0.03, 0.5), 0.01), (x, y - 0.21, z)), red)
    post = printed(planks(rng, (128, 512), 1, ("#6d5136", "#9a7a52")), 0.8)
    add(pipe([(x, 0.0, z), (x, y - 0.2, z)], 0.045, 20), post)
    # A bird on the perch.
    blue, cream = paint("#2f78c4", 0.5), paint("#f0c27a", 0.6)
    bx, by, bz = x + 0.005, y - 0.045, z + 0.31
    add(moved(ball(0.045, 28), (bx, by, bz), (0, 25, 20), (1.3, 0.95, 0.9)), blue)
    add(moved(ball(0.036, 28), (bx - 0.008, by - 0.012, bz + 0.016), (0, 25, 20), (1.15, 0.85, 0.8)), cream)
    add(moved(ball(0.03, 24), (bx + 0.05, by + 0.045, bz + 0.004)), blue)
    add(
        moved(lathe([(0, 0), (0.009, 0), (0, 0.028)], 12), (bx + 0.077, by + 0.044, bz + 0.01), (0, 0, -90)),
        paint("#e8a33a"),
    )
    add(moved(ball(0.005, 10), (bx + 0.064, by + 0.054, bz + 0.024)), dark)
    add(moved(block((0.09, 0.012, 0.03), 0.005), (bx - 0.085, by - 0.012, bz), (0, 25, 18)), blue)

    # Trees from 7 to 24 m, flowers in the grass between.
    crowns = ["#5f8a3a", "#7fa044", "#4f7a48", "#98a948", "#c9903a", "#6b9150"]
    trees = np.array(
        [
            (-2.6, -8, 3.4), (2.7, -9, 3.8), (-5.0, -12, 4.8), (5.4, -13, 5.0), (0.8, -16, 4.4), (-2.4, -18, 5.2),
            (9.0, -20, 6.4), (-9.5, -21, 6.5), (4.0, -23, 6.0), (-6.0, -24, 6.6), (-14.0, -22, 6.5), (14.0, -23, 6.5),
        ]
    )  # fmt: skip
    for i, (tx, tz, tall) in enumerate(trees.tolist()):
        trunk, crown = _tree(rng, tx, tz, tall)
        add(trunk, paint("#5a4230", 0.9))
        add(crown, paint(crowns[i % len(crowns)], 0.9))
    petals = ["#f3d34a", "#e9e4f0", "#d9567c", "#8d6fc4", "#ef8b3b"]
    for i in range(90):
        fz = -3.6 - 8.5 * float(rng.random()) ** 1.4
        fx = float(rng.uniform(-0.42, 0.42)) * -fz * 1.6
        tall = float(rng.uniform(0.18, 0.42))
        add(pipe([(fx, 0, fz), (fx + 0.02, tall, fz)], 0.006, 5), paint("#5c8a3d", 0.8))
        add(moved(ball(0.055, 12), (fx + 0.02, tall, fz), scale=(1, 0.6, 1)), paint(petals[i % 5], 0.7))

    haze = rgb("#dfe6e4")
    fade = (haze, eye, 12.0, 70.0)
    grass = speckle(rng, (1400, 1400), "#6f8f3f", "#93a951", 40.0) * (
        0.7 + 0.6 * noise(rng, 1400, 1400, 300, 2)[..., None]
    )
    nodes.append(floor(grass, (-20.0, -34.0, 20.0, 0.0), light, casters, fade=fade, softness_m=0.1))
    far_grass = speckle(rng, (512, 1024), "#6f8f3f", "#93a951", 40.0)
    nodes.append(floor(far_grass, (-90.0, -100.0, 90.0, -34.0), light, (), fade=fade))

    # Branches with leaves right before the lens.
    leafy = [
        leaf_material(rng, a, b) for a, b in (("#3d7a34", "#a5cf72"), ("#5d8f34", "#cfe08a"), ("#7f9a35", "#e3e09a"))
    ]
    bunches: list[list[Any]] = [[], [], []]
    bark = []
    for start, end, count in (
        ((-0.50, 1.74, -0.95), (0.14, 1.655, -0.76), 30),
        ((0.52, 1.72, -0.92), (0.09, 1.625, -0.84), 20),
        ((-0.36, 1.20, -0.86), (-0.10, 1.52, -0.74), 22),
        ((0.44, 1.16, -0.95), (0.10, 1.40, -0.80), 22),
    ):
        t = np.linspace(0, 1, 24)[:, None]
        line = np.asarray(start) * (1 - t) + np.asarray(end) * t
        line = line + 0.018 * np.sin(7 * t + start[0] * 9) * np.array([0.3, 1.0, 0.6])
        bark.append(pipe(line, np.linspace(0.006, 0.002, 24).tolist(), 8))
        for k in range(count):
            root = line[int((k + 0.5) / count * 23)]
            length = float(rng.uniform(0.06, 0.10))
            turn = (
                float(rng.uniform(-50, 20)),
                (1 if k % 2 else -1) * float(rng.uniform(35, 100)),
                float(rng.uniform(-45, 35)),
            )
            heading = 0.0 if end[0] > start[0] else 180.0
            turn = (turn[0] + 65.0, turn[1] * 0.4 + heading, turn[2])
            bunches[k % 3].append(moved(leaf(length, 0.5 * length, steps=8), tuple(root.tolist()), turn))
    nodes.append(Node(merge(bark), material=paint("#5b4332", 0.8)))
    nodes += [Node(merge(bunch), material=material) for bunch, material in zip(bunches, leafy, strict=True)]

    top = rgb("#86b2d6")
    return Scene(
        "foliage",
        merged(nodes),
        camera=aimed_camera(eye, (0.0, 1.49, -3.0), 31.0, 0.2),
        lights=light.lights(),
        ambient=light.ambient,
        background=Gradient(top=top, bottom=mirrored(haze, top)),
        focus_distance_m=2.8,
        aperture_radius_m=0.0125,
    )


def _chessman(kind: str) -> Any:
    """A turned chess piece, 1 unit tall when it is a pawn."""
    foot = [(0, 0), (0.36, 0), (0.38, 0.03), (0.38, 0.09), (0.33, 0.14), (0.34, 0.18), (0.27, 0.22)]
    tall = {"pawn": 0.62, "rook": 0.78, "bishop": 1.02, "queen": 1.25, "king": 1.32}[kind]
    t = np.linspace(0, 1, 14)
    waist = 0.13 + 0.12 * (1 - t) ** 2.2
    stem = np.stack([waist, 0.22 + (tall - 0.22) * t], axis=1).tolist()
    collar = [(0.22, tall), (0.24, tall + 0.025), (0.22, tall + 0.05), (0.13, tall + 0.06)]

    def bulb(radius: float, centre: float, stretch: float, start: float) -> list[tuple[float, float]]:
        angle = np.linspace(start, math.pi / 2, 18)
        return [(radius * math.cos(a), centre + stretch * radius * math.sin(a)) for a in angle]

    parts = []
    if kind == "pawn":
        parts.append(lathe([*foot, *stem, *collar, *bulb(0.2, tall + 0.2, 1.0, -0.9)], 36))
    elif kind == "bishop":
        parts.append(lathe([*foot, *stem, *collar, *bulb(0.19, tall + 0.26, 1.35, -0.9)], 36))
        parts.append(moved(ball(0.05, 20), (0, tall + 0.54, 0)))
    elif kind == "rook":
        crown = [(0.2, tall + 0.06), (0.27, tall + 0.12), (0.28, tall + 0.3), (0.2, tall + 0.3), (0.19, tall + 0.2)]
        parts.append(lathe([*foot, *stem, *collar, *crown, (0, tall + 0.2)], 36))
        for k in range(6):
            a = k * math.pi / 3
            spot = (0.238 * math.cos(a), tall + 0.325, 0.238 * math.sin(a))
            parts.append(moved(block((0.08, 0.08, 0.14), 0.012, 3), spot, (0, -math.degrees(a), 0)))
    else:
        crown = [
            (0.14, tall + 0.08),
            (0.18, tall + 0.22),
            (0.27, tall + 0.42),
            (0.24, tall + 0.43),
            (0.18, tall + 0.36),
        ]
        parts.append(lathe([*foot, *stem, *collar, *crown, *bulb(0.17, tall + 0.36, 0.9, 0.1)], 36))
        if kind == "queen":
            parts.append(moved(ball(0.06, 20), (0, tall + 0.55, 0)))
            for k in range(9):
                a = k * math.tau / 9
                parts.append(moved(ball(0.036, 14), (0.25 * math.cos(a), tall + 0.44, 0.25 * math.sin(a))))
        else:
            parts.append(moved(block((0.085, 0.3, 0.08), 0.015, 3), (0, tall + 0.6, 0)))
            parts.append(moved(block((0.23, 0.085, 0.079), 0.015, 3), (0, tall + 0.645, 0)))
    return merge(parts)


def _tabletop() -> Scene:
    rng = np.random.default_rng(42)
    light = Light((0.6, -1.0, -0.25), (0.72, 0.62, 0.47), Ambient((0.26, 0.25, 0.27), (0.2, 0.13, 0.08)))
    nodes: list[Node] = []
    casters: list[Any] = []
    cell, board_y = 0.05, 0.016
    ivory = Material(base_color=(*rgb("#ead9b5"), 1.0), roughness=0.3)
    ebony = Material(base_color=(*rgb("#3a1f16"), 1.0), roughness=0.25)
    pieces = {kind: _chessman(kind) for kind in ("pawn", "rook", "bishop", "queen", "king")}
    # (piece, colour, file, rank): rank 0 is nearest to the camera.
    position = [
        ("pawn", ivory, -2, 0), ("rook", ivory, 3, 0), ("king", ivory, 0, 1), ("pawn", ivory, 1, 1),
        ("bishop", ivory, -3, 2), ("queen", ebony, 1, 3), ("pawn", ivory, -1, 3), ("pawn", ebony, 2, 4),
        ("bishop", ebony, -2, 4), ("pawn", ebony, -3, 5), ("pawn", ivory, 0, 5), ("rook", ebony, -1, 7),
        ("king", ebony, 1, 6), ("pawn", ebony, 3, 6), ("rook", ebony, 3, 7), ("pawn", ebony, -4, 6),
    ]  # fmt: skip
    nearest = -0.27
    for kind, material, file, rank in position:
        spot = ((file + 0.5) * cell, board_y, nearest - (rank + 0.5) * cell)
        mesh = moved(pieces[kind], spot, (0, float(rng.uniform(-22, 22)), 0), 0.048)
        name = f"{'white' if material is ivory else 'black'} {kind}" if kind in ("king", "queen") else None
        nodes.append(Node(mesh, material=material, name=name))
        casters.append(mesh)
    middle = nearest - 4 * cell
    board = checker(rng, (1536, 1536), (8, 8), ("#e0bd87", "#7a4526"))
    grain = planks(rng, (1536, 1536), 8, ("#c9c9c9", "#ffffff"))
    area = (-4 * cell, nearest - 8 * cell, 4 * cell, nearest)
    nodes.append(floor(board * grain, area, light, casters, height=board_y, softness_m=0.003))
    frame = printed(planks(rng, (64, 512), 1, ("#4a2716", "#7b4526")), 0.35)
    border = 0.026
    for dx, dz, size in (
        (0, 4 * cell + border / 2, (8 * cell + 2 * border, 0.02, border)),
        (0, -4 * cell - border / 2, (8 * cell + 2 * border, 0.02, border)),
        (4 * cell + border / 2, 0, (border, 0.02, 8 * cell)),
        (-4 * cell - border / 2, 0, (border, 0.02, 8 * cell)),
    ):
        rim = moved(block(size, 0.003), (dx, 0.0085, middle + dz))
        nodes.append(Node(rim, material=frame))
        casters.append(rim)
    table = planks(rng, (1024, 2048), 9, ("#5d3b22", "#a87443"))
    nodes.append(floor(table, (-1.6, -1.45, 1.6, -0.05), light, casters, softness_m=0.006))
    # A dim room behind: a wall, a shelf of books, and strings of lamps far brighter than white.
    wall = speckle(rng, (256, 512), "#2b3440", "#37424f", 6.0)
    wall *= np.linspace(1.25, 0.5, 256, dtype=np.float32)[:, None, None]
    nodes.append(Node(quad((-3.4, -1.2, -3.6), (6.8, 0, 0), (0, 3.6, 0)), material=printed(wall, unlit=True)))
    spines = ["#7d2f2a", "#2f5a66", "#a5793a", "#47603f", "#5b4370", "#8b8171", "#27405f"]
    x = -1.5
    while x < 1.5:
        wide, tall = float(rng.uniform(0.035, 0.08)), float(rng.uniform(0.3, 0.46))
        book = moved(block((wide - 0.004, tall, 0.25), 0.006, 2), (x + wide / 2, -0.28 + tall / 2, -3.2))
        nodes.append(Node(book, material=paint(spines[int(rng.integers(7))], 0.8)))
        x += wide
    nodes.append(Node(moved(block((3.4, 0.05, 0.34), 0.01), (0, -0.305, -3.2)), material=paint("#4a3222", 0.6)))
    lamp, glows = ball(0.017, 16), [glow("#ffb057", 14.0), glow("#ffd9a0", 17.0), glow("#ff7a4a", 11.0)]
    for string, (sag, top, depth) in enumerate(((0.16, 0.40, -2.9), (0.18, 0.26, -2.3), (0.12, 0.62, -3.2))):
        for k in range(15):
            u = (k + 0.5 * (string % 2)) / 14 - 0.5
            spot = (2.9 * u, top + sag * (4 * u * u) - sag + 0.02 * math.sin(9 * u), depth)
            nodes.append(Node(moved(lamp, spot), material=glows[(k + string) % 3]))
    return Scene(
        "tabletop",
        merged(nodes),
        camera=aimed_camera((-0.05, 0.165, 0.0), (0.012, 0.092, -0.5), 30.0, 0.08),
        lights=(*light.lights(), PointLight((0.5, 0.6, -1.3), (0.30, 0.17, 0.07))),
        ambient=light.ambient,
        background=rgb("#141a22"),
        focus_distance_m=0.425,
        aperture_radius_m=0.0058,
    )


def _glass() -> Scene:
    rng = np.random.default_rng(8)
    light = Light((-0.4, -1.0, -0.55), (0.72, 0.69, 0.62), Ambient((0.56, 0.56, 0.58), (0.46, 0.42, 0.37)))
    nodes: list[Node] = []
    casters: list[Any] = []

    def add(mesh: Any, material: Material, casts: bool = True, name: str | None = None) -> None:
        nodes.append(Node(mesh, material=material, name=name))
        if casts:
            casters.append(mesh)

    wall_z = -7.0
    plaster = speckle(rng, (700, 1600), "#dcd8d0", "#e9e5dd", 9.0)
    plaster *= np.linspace(0.92, 1.0, 700, dtype=np.float32)[:, None, None]
    add(quad((-8.0, 0, wall_z), (16, 0, 0), (0, 5.0, 0)), printed(plaster, 0.95), casts=False)
    add(moved(block((16.0, 0.14, 0.05), 0.01), (0, 0.07, wall_z + 0.02)), paint("#f2efe8", 0.5))
    inks = [
        ("#f3ead7", "#d1495b", "#edae49", "#00798c", "#30638e"),
        ("#1d3557", "#e63946", "#f1faee", "#a8dadc", "#ffb703"),
        ("#fbe3c0", "#e76f51", "#2a9d8f", "#264653", "#8ab17d", "#e9c46a"),
        ("#fffaf0", "#22223b", "#c9184a", "#ffb703", "#219ebc"),
    ]
    for i, x in enumerate((-2.05, -0.68, 0.68, 2.05)):
        face = poster(rng, (640, 460), inks[i], i)
        add(quad((x - 0.5, 1.0, wall_z + 0.05), (1.0, 0, 0), (0, 1.4, 0)), printed(face, 0.6), casts=False)
        black = paint("#24211f", 0.4)
        for dx in (-0.52, 0.52):
            add(moved(block((0.05, 1.49, 0.07), 0.008), (x + dx, 1.7, wall_z + 0.04)), black, casts=False)
        for dy in (-0.72, 0.72):
            add(moved(block((1.09, 0.05, 0.07), 0.008), (x, 1.7 + dy, wall_z + 0.04)), black, casts=False)

    # Plinths: one before the pane, the one in focus behind it, two farther back.
    white = paint("#efece6", 0.6)
    bronze, coral, cobalt, lime = (
        paint(c, r, m)
        for c, r, m in (("#b9783a", 0.35, 0.55), ("#e4604e", 0.4, 0), ("#2c62b8", 0.35, 0), ("#9bb83c", 0.5, 0))
    )
    for px, pz, tall, wide in (
        (-0.46, -1.62, 0.98, 0.28),
        (0.26, -3.5, 1.0, 0.44),
        (-1.35, -4.9, 0.85, 0.44),
        (1.5, -5.4, 1.05, 0.44),
    ):
        add(moved(block((wide, tall, wide), 0.012), (px, tall / 2, pz)), white)
    add(moved(ring(0.085, 0.032, 72, 24), (-0.46, 1.097, -1.62), (90, 0, 20)), coral)
    add(moved(knot(0.27, 0.062, 2, 3), (0.26, 1.33, -3.5), (0, 20, 90)), bronze, name="bronze knot")
    add(moved(star(6, 0.24, 0.14, 0.55, 1.1), (-1.35, 0.85, -4.9)), cobalt)
    add(moved(ball(0.25), (1.5, 1.3, -5.4)), lime)

    # The pane: tinted, with a band of printed dots, held by steel posts.
    pane_z, pane_w, pane_h = -2.3, 2.1, 1.36
    dots = [
        ((c + 0.5 + 0.5 * (r % 2)) / 60, 0.56 + (r - 3.0) / 69, 0.0026 + 0.0008 * (3 - abs(r - 3)))
        for r in range(7)
        for c in range(60)
    ]
    dotted = coverage((663, 1024), [(x, y * 663 / 1024, r) for x, y, r in dots])
    alpha = 0.20 + 0.62 * dotted
    tint = (
        np.array(rgb("#58b7a4"), np.float32) * (1 - dotted[..., None])
        + np.array(rgb("#f4fbfa"), np.float32) * dotted[..., None]
    )
    pane = Material(
        base_color=(1.0, 1.0, 1.0, 1.0),
        base_color_texture=picture(tint, alpha),
        alpha_mode="blend",
        double_sided=True,
        unlit=True,
    )
    left = -0.5
    add(quad((left, 0.38, pane_z), (pane_w, 0, 0), (0, pane_h, 0)), pane, casts=False)
    steel = paint("#aeb4b8", 0.35, 0.3)
    for px in (left, left + pane_w):
        add(pipe([(px, 0.0, pane_z), (px, 1.78, pane_z)], 0.018, 20), steel)
    add(pipe([(left - 0.02, 1.76, pane_z), (left + pane_w + 0.02, 1.76, pane_z)], 0.02, 20), steel)
    add(pipe([(left, 0.36, pane_z), (left + pane_w, 0.36, pane_z)], 0.012, 16), steel)

    area = (-8.0, wall_z, 8.0, 0.0)
    parquet = planks(rng, (1400, 2048), 36, ("#9c7448", "#cfa877"))
    nodes.append(floor(parquet, area, light, casters, softness_m=0.06))
    return Scene(
        "glass",
        merged(nodes),
        camera=aimed_camera((0.0, 1.42, 0.0), (0.02, 1.24, -3.5), 33.0, 0.3),
        lights=light.lights(),
        ambient=light.ambient,
        background=rgb("#e8e4dc"),
        focus_distance_m=3.45,
        aperture_radius_m=0.044,
    )


def _floating() -> Scene:
    rng = np.random.default_rng(77)
    colors = ["#ef476f", "#ffd166", "#06d6a0", "#118ab2", "#f78c6b", "#9b5de5", "#83d483"]
    shapes = [
        ball(0.2),
        moved(block((0.3, 0.3, 0.3), 0.05), (0, 0, 0)),
        knot(0.26, 0.06),
        ring(0.18, 0.07),
        moved(star(5, 0.24, 0.12, 0.12), (0, -0.06, 0)),
        moved(lathe([(0, 0), (0.18, 0), (0.19, 0.01), (0.015, 0.38), (0, 0.39)]), (0, -0.18, 0)),
    ]
    nodes = []
    count = 26
    for i in range(count):
        depth = 1.15 * (14.0 / 1.15) ** (((i + 0.5) / count) ** 0.8)
        around = i * math.pi * (3 - math.sqrt(5)) + 0.4
        reach = depth * (0.16 + 0.13 * math.sqrt((i * 7 % count) / count))
        spot = (reach * math.cos(around), reach * math.sin(around), -depth)
        turn = tuple(rng.uniform(0, 360, 3).tolist())
        mesh = moved(shapes[i % len(shapes)], spot, turn, min(1.0, 0.3 + 0.2 * depth))
        nodes.append(Node(mesh, material=paint(colors[i % len(colors)], (0.25, 0.4, 0.6)[i % 3])))
    subject = moved(knot(0.34, 0.075), (0.0, 0.0, -3.0), (25, 20, 0))
    nodes.append(Node(subject, material=paint("#f4f1ea", 0.3), name="knot"))
    return Scene(
        "floating",
        merged(nodes),
        camera=aimed_camera((0.0, 0.0, 0.0), (0.0, 0.0, -1.0), 33.0, 0.3),
        lights=(
            DirectionalLight((-0.5, -1.0, -0.6), (0.8, 0.77, 0.7)),
            DirectionalLight((0.8, 0.2, -0.3), (0.16, 0.2, 0.28)),
        ),
        ambient=Ambient((0.4, 0.42, 0.46), (0.3, 0.26, 0.26)),
        background=None,
        focus_distance_m=2.9,
        aperture_radius_m=0.03,
    )
