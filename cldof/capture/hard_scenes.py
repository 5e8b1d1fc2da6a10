"""Built-in scenes that each make one thing hard for a depth-of-field method, and look good while they do.

Every function says what is hard and why. Apertures are chosen for clear, not garish blur: the largest circle of
confusion is 2-3 % of the image height in radius, and more only where a scene is about that.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from trimesh.transformations import euler_from_matrix

from .scene import Ambient, DirectionalLight, Gradient, Material, Node, PointLight, Scene
from .shapes import ball, band, block, knot, lathe, leaf, merge, moved, pipe, quad, ring, star
from .staging import Light, Vector, aimed_camera, floor, glow, leaf_material, merged, mirrored, paint, printed
from .textures import checker, coverage, noise, picture, planks, poster, rgb, speckle, tiles, windows

__all__ = ["HARD_SCENES"]

_Path = NDArray[np.float64]


def _pine(at: float, foot: float, tall: float, wide: float, tiers: int) -> Any:
    """A pine cut from paper at z = 0: tiers that taper upwards, each overhanging the one above."""
    heights, halves = [foot, foot + 0.1 * tall], [0.06 * wide, 0.05 * wide]
    for tier in range(tiers):
        low, high = (foot + tall * (0.1 + 0.9 * k / tiers) for k in (tier, tier + 1))
        reach = 0.5 * wide * (1.0 - 0.8 * tier / tiers)
        heights += [low + 1e-4 * tall, high]
        halves += [reach, 0.0 if tier == tiers - 1 else 0.42 * reach]
    y, half = np.array(heights), np.array(halves)
    left, right = (np.stack([at + side * half, y, np.zeros_like(y)], axis=1) for side in (-1.0, 1.0))
    return band(right, left)


def _card(x: _Path, top: _Path, bottom: float, z: float, material: Material) -> Node:
    lower = np.stack([x, np.full_like(x, bottom), np.full_like(x, z)], axis=1)
    upper = np.stack([x, top, np.full_like(x, z)], axis=1)
    return Node(band(lower, upper), material=material)


def _silhouettes() -> Scene:
    """Nine paper cards, one close behind the other, all with jagged edges.

    At most pixels more surfaces lie behind each other than layers are captured, and neighbours in depth differ by
    little blur, so that what belongs to which depth layer decides how every edge looks.
    """
    rng = np.random.default_rng(31)
    eye_y = 1.0
    depths = [0.78, 1.0, 1.35, 1.8, 2.3, 3.1, 4.3, 6.2, 9.0]
    colors = ["#14213d", "#1f3054", "#2c4a6b", "#3f6580", "#74506b", "#a85a6b", "#d0766b", "#e59a77", "#f2bd8c"]
    nodes: list[Node] = []
    half = math.tan(math.radians(16.5))
    for i, (z, color) in enumerate(zip(depths, colors, strict=True)):
        grain = speckle(rng, (256, 256), color, color, 40.0) * (0.9 + 0.2 * noise(rng, 256, 256, 90.0, 2)[..., None])
        paper = printed(grain, unlit=True)
        reach = 2.6 * half * z
        x = np.linspace(-reach, reach, 300)
        u = x / (half * z)
        # Hills rise with distance, so that all cards show; the middle stays open on the near ones.
        base = (-0.98, -0.86, -0.80, -0.70, -0.56, -0.40, -0.20, 0.0, 0.16)[i]
        valley = 0.16 * np.minimum(np.abs(u), 1.6) ** 1.5 * (i < 6)
        hills = 0.05 * np.sin(2.1 * u + 1.7 * i) + 0.03 * np.sin(5.3 * u + 2.9 * i)
        top = base + valley + hills * (1.0 + 0.25 * i)
        if i < 7:
            count = (7, 11, 15, 19, 25, 32, 44)[i]
            for k in range(count):
                spot = 2.4 * ((k + float(rng.uniform(0.1, 0.9))) / count * 2.0 - 1.0)
                if i < 2:  # near trees frame the view
                    spot = math.copysign(0.62 + 0.75 * abs(spot), spot)
                tall = (1.35, 1.05, 0.72, 0.6, 0.56, 0.38, 0.28)[i] * float(rng.uniform(0.75, 1.2))
                foot = float(np.interp(spot, u, top)) - 0.06 * tall
                pine = _pine(spot, foot, tall, 0.44 * tall, 7 if i < 4 else 5)
                nodes.append(Node(moved(pine, (0.0, eye_y, -z), scale=(half * z, half * z, 1.0)), material=paper))
        else:
            peaks = np.abs((1.3 * u + 0.4 * i + 0.5) % 1.0 - 0.5)
            top = top + (0.42 if i == 8 else 0.26) * (0.5 - peaks) + 0.03 * np.abs(np.sin(17 * u)) * (0.5 - peaks)
        nodes.append(_card(x, eye_y + half * z * top, eye_y - 2.2 * half * z, -z, paper))
    # A full moon and birds in the plane of focus.
    moon_z = 12.0
    moon = moved(ball(0.75, 64), (0.9, eye_y + 2.1, -moon_z), scale=(1, 1, 0.02))
    nodes.append(Node(moon, material=Material(base_color=(*rgb("#fff3d6"), 1.0), unlit=True)))
    ink = Material(base_color=(*rgb("#3a2038"), 1.0), unlit=True)
    for bx, by, size in ((-0.26, 0.36, 0.085), (-0.12, 0.43, 0.06), (-0.37, 0.47, 0.05), (0.05, 0.33, 0.045)):
        s = np.linspace(-1, 1, 41)
        wing = 0.42 * np.abs(s) ** 0.7 - 0.28 * s * s
        thick = 0.12 * (1 - np.abs(s)) ** 0.8
        low, high = (
            np.stack([bx + size * s, eye_y + by + size * edge, np.full_like(s, -2.25)], axis=1)
            for edge in (wing - 0.5 * thick, wing + 0.5 * thick)
        )
        nodes.append(Node(band(low, high), material=ink))
    horizon, top_sky = rgb("#f9d9a8"), rgb("#c9849a")
    return Scene(
        "silhouettes",
        merged(nodes),
        camera=aimed_camera((0.0, eye_y, 0.0), (0.0, eye_y, -1.0), 33.0, 0.2),
        background=Gradient(top=top_sky, bottom=mirrored(horizon, top_sky)),
        focus_distance_m=2.25,
        aperture_radius_m=0.0195,
    )


def _bough(start: Vector, end: Vector, sag: float, radius: float, phase: float) -> tuple[_Path, NDArray[np.float64]]:
    """Centre line and radii of a knotty branch."""
    t = np.linspace(0, 1, 60)[:, None]
    line = np.asarray(start) * (1 - t) + np.asarray(end) * t
    bend = np.sin(math.pi * t) * sag + 0.1 * sag * np.sin(9 * t + phase) + 0.05 * sag * np.sin(23 * t + 2 * phase)
    radii = radius * (1.0 - 0.6 * t[:, 0]) * (1.0 + 0.08 * np.sin(31 * t[:, 0] + phase))
    return line + bend * np.array([0.25, 1.0, 0.15]), radii


def _petal(size: float) -> Any:
    """Round, cupped, from the origin along +x, facing +y."""
    t = np.linspace(0, 1, 9)
    half = 0.46 * size * np.sqrt(np.maximum(0.0, 1.0 - (2.0 * t**1.25 - 1.0) ** 2))
    sides = (np.stack([size * t, 0.3 * size * t**2, side * half], axis=1) for side in (1.0, -1.0))
    return band(*sides)


def _blossom(rng: np.random.Generator, size: float) -> Any:
    """Five petals around the z axis, opening towards +z."""
    petals = []
    for k in range(5):
        petal = moved(_petal(size), turn_deg=(90, 0, 0))
        petals.append(moved(petal, turn_deg=(0, 0, 72.0 * k + float(rng.uniform(-6, 6)))))
    return merge(petals)


def _branches() -> Scene:
    """A branch nearer than the plane in focus crosses one beyond it, and a butterfly hovers between.

    Where they cross, a near blur lies over a far blur over a sharp edge: blurs of both signs, with nothing to anchor
    them, and each needs what it hides.
    """
    rng = np.random.default_rng(52)
    nodes: list[Node] = []
    bark = printed(planks(rng, (128, 256), 3, ("#3b2a22", "#7a5c4a")), 0.9)
    petal_colors = [("#f7c9d4", "#fdeef0"), ("#f3b3c6", "#fbe3ea"), ("#fbe9ee", "#ffffff")]
    petals = [leaf_material(rng, a, b) for a, b in petal_colors]
    heart, green = paint("#d9a531", 0.8), leaf_material(rng, "#5f8f3c", "#b9d98a")
    # (start, end, sag, radius, twigs): the first nearer than focus, the second beyond it.
    boughs: list[tuple[Vector, Vector, float, float, int, float]] = [
        ((-0.30, 0.17, -0.60), (0.30, -0.14, -0.62), 0.02, 0.0105, 14, 0.018),
        ((-0.62, -0.42, -1.50), (0.66, 0.42, -1.44), 0.06, 0.021, 22, 0.036),
    ]
    for number, (start, end, sag, radius, twigs, bloom) in enumerate(boughs):
        line, radii = _bough(start, end, sag, radius, 1.3 + number)
        nodes.append(Node(pipe(line, radii.tolist(), 14), material=bark))
        for k in range(twigs):
            root = line[int((k + 0.5) / twigs * 59)]
            # Blossoms leave the middle free, where the branches cross and the butterfly is.
            side = 1.0 if k % 2 else -1.0
            reach = bloom * float(rng.uniform(1.2, 3.0))
            tip = root + np.array(
                [float(rng.uniform(-0.6, 0.6)) * reach, side * reach, float(rng.uniform(-0.4, 0.4)) * reach]
            )
            nodes.append(Node(pipe(np.stack([root, (root + tip) / 2 + 0.004, tip]), 0.16 * radius, 6), material=bark))
            for _ in range(3):
                spot = tip + rng.uniform(-0.7, 0.7, 3) * bloom
                facing = (float(rng.uniform(-50, 50)), float(rng.uniform(-50, 50)), float(rng.uniform(0, 72)))
                flower = moved(_blossom(rng, bloom * float(rng.uniform(0.75, 1.05))), spot.tolist(), facing)
                nodes.append(Node(flower, material=petals[int(rng.integers(3))]))
                nodes.append(Node(moved(ball(0.17 * bloom, 10), spot.tolist()), material=heart))
            if k % 3 == 0:
                turn = (float(rng.uniform(-40, 40)), float(rng.uniform(-60, 60)), 60.0 * side)
                shoot = leaf(2.2 * bloom, 0.9 * bloom, steps=6)
                nodes.append(Node(moved(shoot, tip.tolist(), turn), material=green))

    # The butterfly, in the plane of focus at 0.95 m, wings towards the camera.
    fore, hind = _wing(rng, "#e8792b", "#f8c15c"), _wing(rng, "#d9602a", "#f3a64b")
    body = paint("#2a1d18", 0.6)
    bx, by, bz = 0.015, 0.012, -0.95
    for side in (-1.0, 1.0):
        for material, up, size, first, last in ((fore, 0.008, 0.115, 4.0, 62.0), (hind, -0.004, 0.086, -72.0, 8.0)):
            angle = np.radians(np.linspace(first, last, 40))
            t = np.linspace(0, 1, 40)
            outline = size * (0.72 + 0.28 * t**1.5 if first > 0 else 0.86 + 0.14 * np.sin(math.pi * t))
            outline = outline * (1.0 + 0.018 * np.cos(2 * math.pi * 6 * t))  # scalloped
            root, rim = (
                np.stack([bx + side * r * np.cos(angle), by + up + r * np.sin(angle), bz + 0.12 * r + 0 * t], axis=1)
                for r in (0.004 + 0 * t, outline)
            )
            nodes.append(Node(band(root, rim), material=material))
        s = np.linspace(0, 1, 12)
        feeler = np.stack([bx + side * 0.022 * s, by + 0.028 + 0.04 * s**0.8, bz + 0.01 * s], axis=1)
        nodes.append(Node(pipe(feeler, 0.0007, 6), material=body))
        nodes.append(Node(moved(ball(0.0017, 10), feeler[-1].tolist()), material=body))
    nodes.append(Node(moved(ball(0.006, 20), (bx, by - 0.005, bz), scale=(1.0, 4.6, 1.0)), material=body))
    nodes.append(Node(moved(ball(0.0065, 16), (bx, by + 0.026, bz)), material=body))

    # An orchard far behind.
    backdrop = speckle(rng, (512, 512), "#6f9a58", "#c3d79a", 7.0)
    ramp = np.linspace(0, 1, 512, dtype=np.float32)[:, None, None]
    sky = np.array(rgb("#a9d2e8"), np.float32) * (1.1 - 0.3 * ramp)
    edge = np.clip((ramp - 0.42 - 0.16 * (noise(rng, 512, 512, 9.0, 3)[..., None] - 0.5)) * 18, 0, 1)
    spots = coverage(
        (512, 512),
        [(float(a), float(b), float(r)) for a, b, r in rng.uniform((0, 0.45, 0.004), (1, 0.95, 0.012), (160, 3))],
    )
    scenery = sky * (1 - edge) + backdrop * edge
    scenery += spots[..., None] * (np.array(rgb("#ffe3ea"), np.float32) - scenery) * 0.85
    nodes.append(Node(quad((-5.0, -5.0, -6.0), (10, 0, 0), (0, 10, 0)), material=printed(scenery, unlit=True)))
    return Scene(
        "branches",
        merged(nodes),
        camera=aimed_camera((0.0, 0.0, 0.0), (0.0, 0.0, -1.0), 31.0, 0.15),
        lights=(DirectionalLight((0.45, -0.8, -0.7), (0.85, 0.8, 0.72)),),
        ambient=Ambient((0.5, 0.52, 0.56), (0.3, 0.32, 0.26)),
        background=rgb("#a9d2e8"),
        focus_distance_m=0.95,
        aperture_radius_m=0.0165,
    )


def _wing(rng: np.random.Generator, inner: str, outer: str) -> Material:
    """A butterfly's wing: glowing cells between dark veins, a dark rim with white dots at its end."""
    # s from the body to the rim (row 0 is the rim), t from one edge to the other.
    s, t = np.meshgrid(np.linspace(1, 0, 192), np.linspace(0, 1, 256), indexing="ij")
    color = np.array(rgb(inner)) + (np.array(rgb(outer)) - np.array(rgb(inner))) * s[..., None]
    vein = (np.abs((6 * t) % 1 - 0.5) < 0.035 / (0.3 + s)) | (np.abs(s - 0.48 - 0.1 * np.sin(7 * t)) < 0.014)
    rim = (s > 0.84 - 0.04 * np.abs(np.sin(6 * math.pi * t))) | (t < 0.03) | (t > 0.96)
    dots = (s > 0.885) & (s < 0.95) & (np.abs(np.sin(12 * math.pi * t)) > 0.75) & (t > 0.06) & (t < 0.94)
    color = np.where((vein | rim)[..., None], rgb("#221512"), color)
    color = np.where(dots[..., None], rgb("#fff4dd"), color) * (0.9 + 0.2 * noise(rng, 192, 256, 30.0, 2)[..., None])
    return Material(
        base_color=(1.0, 1.0, 1.0, 1.0), base_color_texture=picture(color), roughness=0.6, double_sided=True
    )


def _plane() -> Scene:
    """A tiled floor from the feet to the horizon, through the plane in focus.

    One continuous surface takes every blur there is, with detail everywhere: depth layers show as bands or seams, and
    what is barely out of focus as too sharp or too soft.
    """
    rng = np.random.default_rng(64)
    inks = ("#ece3d0", "#28536b", "#c2502f", "#d9a13b", "#3f7d6e", "#7b2d3b", "#8d8577")
    haze = rgb("#e8dccb")
    nodes = []
    # Two patches, the finer one in front, as textures are filtered alike in both directions.
    for (left, far, right, near), count, texels in (
        ((-1.2, -1.8, 1.2, -0.1), (17, 24), 84),
        ((-3.2, -4.8, 3.2, -1.8), (30, 64), 28),
    ):
        mosaic = tiles(rng, count, texels, inks)
        mesh = quad((left, 0.0, near), (right - left, 0, 0), (0, 0, far - near), steps=16)
        nodes.append(Node(mesh, material=printed(mosaic, unlit=True)))
    # Beyond, tiles are hardly more than pixels.
    mean = tiles(rng, (12, 12), 12, inks).mean(axis=(0, 1))
    depth = np.linspace(1, 0, 256, dtype=np.float32)[:, None, None] ** 0.5
    far_floor = (mean * (1 - depth) + np.array(haze, np.float32) * depth) * np.ones((1, 8, 1), np.float32)
    nodes.append(
        Node(quad((-60.0, 0.0, -4.8), (120, 0, 0), (0, 0, -60.0), steps=16), material=printed(far_floor, unlit=True))
    )
    top = rgb("#7fa6c4")
    return Scene(
        "plane",
        tuple(nodes),
        camera=aimed_camera((0.0, 0.42, 0.0), (0.0, 0.0, -1.02), 33.0, 0.15),
        background=Gradient(top=top, bottom=mirrored(haze, top)),
        focus_distance_m=1.05,
        aperture_radius_m=0.0185,
    )


def _lights() -> Scene:
    """Lamps hundreds of times brighter than white far behind a railing in focus, with thin rods before the lens.

    Every lamp becomes a disc with a rim that the rods cut. A ray that misses a lamp or a rod is seen at once, and a
    filter that mixes lamp and rod bleeds.
    """
    rng = np.random.default_rng(97)
    nodes: list[Node] = []
    # Houses along a river at night, 14 to 45 m away.
    walls = ["#10151f", "#161b27", "#0d1119", "#1b1d28"]
    panes = ("#ffc36b", "#ffe0a3", "#ff9d4d", "#bcd4ff")
    x = -22.0
    while x < 22.0:
        wide, tall, depth = float(rng.uniform(1.6, 3.6)), float(rng.uniform(3.2, 8.4)), float(rng.uniform(19, 30))
        front = windows(rng, (int(tall * 2.4), int(wide * 2.6)), walls[int(rng.integers(4))], panes, 0.34)
        nodes.append(Node(quad((x, -1.2, -depth), (wide, 0, 0), (0, tall, 0)), material=printed(front, unlit=True)))
        x += 0.86 * wide
    quay = speckle(rng, (64, 512), "#141a24", "#1d2430", 12.0)
    nodes.append(Node(quad((-26.0, -2.6, -18.0), (52, 0, 0), (0, 1.7, 0)), material=printed(quay, unlit=True)))
    water = speckle(rng, (256, 256), "#070b14", "#18233a", 20.0)
    nodes.append(Node(quad((-26.0, -2.6, 2.0), (52, 0, 0), (0, 0, -20.0)), material=printed(water, unlit=True)))
    glows = [
        glow(c, r)
        for c, r in (("#ffb259", 26.0), ("#ffd79a", 30.0), ("#ff5a3c", 24.0), ("#9fc4ff", 28.0), ("#7dffb0", 20.0))
    ]
    # Street lamps along the quay, windows that shine, a string of bulbs, and what the water gives back.
    lamps: list[tuple[float, float, float, float, int]] = []
    for k in range(17):
        lx = -12.0 + 1.5 * k
        lamps.append((lx, 0.55, -17.5, 0.05, k % 2))
        for ripple in range(3):
            lamps.append((lx + float(rng.uniform(-0.15, 0.15)), -1.15 - 0.3 * ripple, -17.4, 0.03, k % 2))
    for _ in range(46):
        lamps.append(
            (
                float(rng.uniform(-9, 9)),
                float(rng.uniform(0.9, 5.2)),
                -18.6,
                float(rng.uniform(0.03, 0.05)),
                int(rng.integers(5)),
            )
        )
    for k in range(26):
        u = k / 25 * 2 - 1
        lamps.append((3.4 * u, 1.3 + 0.5 * u * u + 0.02 * math.sin(9 * u), -7.0 - u, 0.018, (1, 2, 1, 3, 4)[k % 5]))
    for lx, ly, lz, radius, kind in lamps:
        nodes.append(Node(moved(ball(radius, 10), (lx, ly, lz)), material=glows[kind]))

    # The railing in focus, at 1.6 m: turned posts, twisted bars and rings between two rails.
    iron = paint("#3c4652", 0.35, 0.6)
    rail_z = -1.6
    for y, thick in ((-0.44, 0.018), (0.08, 0.011), (0.19, 0.016)):
        nodes.append(Node(pipe([(-2.4, y, rail_z), (2.4, y, rail_z)], thick, 16), material=iron))
    for k in range(-14, 15):
        px = 0.155 * k
        bar = star(4, 0.011, 0.0078, 0.52, twist=6.0, layers=24)
        nodes.append(Node(moved(bar, (px, -0.44, rail_z)), material=iron))
        nodes.append(Node(moved(ring(0.05, 0.006, 32, 10), (px + 0.0775, 0.135, rail_z), (90, 0, 0)), material=iron))
        if k % 3 == 0:
            nodes.append(Node(moved(ball(0.02, 16), (px, -0.08, rail_z)), material=iron))
    # Reeds before the lens, out of focus.
    reed = paint("#a9b56a", 0.7)
    for k in range(13):
        rx = -0.24 + 0.04 * k + float(rng.uniform(-0.012, 0.012))
        t = np.linspace(0, 1, 14)
        lean = float(rng.uniform(-0.09, 0.09))
        tall = 0.62 * float(rng.uniform(0.65, 1.0))
        stem = np.stack([rx + lean * t**2, -0.3 + tall * t, -0.72 + 0.05 * np.sin(k + t)], axis=1)
        nodes.append(Node(pipe(stem, np.linspace(0.0042, 0.0014, 14).tolist(), 8), material=reed))
    return Scene(
        "lights",
        merged(nodes),
        camera=aimed_camera((0.0, 0.06, 0.0), (0.0, 0.06, -1.0), 33.0, 0.2),
        lights=(
            DirectionalLight((0.5, -0.5, -0.8), (0.16, 0.2, 0.3)),
            PointLight((-0.9, 0.7, -0.3), (0.75, 0.5, 0.26)),
            PointLight((1.4, 0.8, -2.4), (0.7, 0.42, 0.2)),
        ),
        ambient=Ambient((0.07, 0.09, 0.14), (0.04, 0.04, 0.05)),
        background=Gradient(top=rgb("#05070f"), bottom=rgb("#33304a")),
        focus_distance_m=1.6,
        aperture_radius_m=0.0185,
    )


def _sky() -> Scene:
    """Twigs and wires, some a pixel wide, before a sky at infinity.

    Between them nothing has a depth. Infinity must work, thin things must neither vanish nor leave holes, and the sky
    must close behind them.
    """
    rng = np.random.default_rng(18)
    bark, dark = paint("#4a3a30", 0.85), paint("#2d2622", 0.85)
    wood: list[Any] = []
    buds: list[Any] = []

    def grow(start: _Path, heading: _Path, length: float, radius: float, level: int) -> None:
        steps = 7
        points, direction = [start], heading
        for _ in range(steps):
            direction = direction + rng.normal(0, 0.16, 3) * np.array([1.0, 1.0, 0.6]) + np.array([0.0, 0.05, 0.0])
            direction /= np.linalg.norm(direction)
            points.append(points[-1] + direction * length / steps)
        line = np.array(points)
        wood.append(pipe(line, np.linspace(radius, 0.55 * radius, steps + 1).tolist(), 9 if level < 2 else 6))
        if level == 4:
            buds.append(moved(ball(1.9 * radius, 8), line[-1].tolist(), scale=(1, 1.5, 1)))
            return
        for k in range(3 if level < 2 else 2):
            at = line[steps - 2 * k]
            turn = rng.normal(0, 0.62, 3) * np.array([1.0, 0.75, 0.7])
            child = direction + turn
            grow(at, child / np.linalg.norm(child), 0.74 * length, 0.58 * radius, level + 1)

    for start, heading, length, radius in (
        ((-0.85, 0.75, -2.5), (0.9, 0.5, 0.05), 0.62, 0.026),
        ((0.95, 0.62, -2.35), (-0.8, 0.75, -0.05), 0.55, 0.022),
        ((-0.5, 0.95, -1.12), (0.75, 0.75, 0.0), 0.3, 0.009),
        ((2.2, 1.0, -5.6), (-0.6, 0.95, 0.1), 1.15, 0.045),
        ((-2.4, 0.9, -6.5), (0.4, 1.0, 0.0), 1.3, 0.05),
    ):
        direction = np.asarray(heading)
        grow(np.asarray(start), direction / np.linalg.norm(direction), length, radius, 0)
    nodes = [Node(merge(wood), material=bark), Node(merge(buds), material=paint("#a0603f", 0.7))]
    # Wires sag across, one right before the lens, and birds sit on the one in focus.
    s = np.linspace(-1, 1, 60)
    wires: list[tuple[float, float, float, float]] = [
        (1.53, 1.66, -1.0, 0.0016), (1.42, 1.36, -2.4, 0.0034), (1.55, 1.50, -2.46, 0.0034),
        (2.75, 2.35, -7.0, 0.008), (2.95, 2.55, -7.0, 0.008), (3.15, 2.75, -7.0, 0.008),
    ]  # fmt: skip
    for left, right, z, radius in wires:
        reach = -0.62 * z
        line = np.stack([s * reach, (left + right) / 2 + (right - left) / 2 * s + 0.06 * reach * s * s, z + 0 * s], 1)
        nodes.append(Node(pipe(line, radius, 8), material=dark))
    feather = paint("#3d4650", 0.6)
    for bx in (-0.24, -0.1, 0.31, 0.52):
        u = bx / 1.488
        by = 1.39 - 0.03 * u + 0.0893 * u * u + 0.047
        nodes.append(Node(moved(ball(0.034, 20), (bx, by, -2.4), (0, 0, 58), (1.5, 0.95, 0.9)), material=feather))
        nodes.append(Node(moved(ball(0.022, 16), (bx + 0.024, by + 0.046, -2.4)), material=feather))
        nodes.append(
            Node(
                moved(block((0.07, 0.012, 0.02), 0.004, 2), (bx - 0.036, by - 0.052, -2.4), (0, 0, 55)),
                material=feather,
            )
        )
        beak = moved(lathe([(0, 0), (0.006, 0), (0, 0.02)], 10), (bx + 0.043, by + 0.046, -2.4), (0, 0, -90))
        nodes.append(Node(beak, material=paint("#d7973a", 0.5)))
    top, horizon = rgb("#3f78b5"), rgb("#f6dcc0")
    return Scene(
        "sky",
        merged(nodes),
        camera=aimed_camera((0.0, 1.2, 0.0), (0.0, 1.52, -2.4), 33.0, 0.25),
        lights=(DirectionalLight((0.75, -0.45, -0.4), (1.0, 0.82, 0.6)),),
        ambient=Ambient((0.32, 0.38, 0.48), (0.34, 0.28, 0.22)),
        background=Gradient(top=top, bottom=mirrored(horizon, top)),
        focus_distance_m=2.4,
        aperture_radius_m=0.02,
    )


def _pencil(length: float, radius: float, barrel: Material, tip: Material, wood: Material) -> list[Node]:
    """A pencil along +y from its end at the origin: barrel, sharpened wood, lead."""
    cone = 5.2 * radius
    shoulder = length - cone
    angle = np.linspace(0, 2 * math.pi, 7)
    side = []
    for a, b in pairwise(angle):
        foot = np.array([[radius * math.cos(v), 0.0, radius * math.sin(v)] for v in (b, a)])
        side.append(quad(foot[0], foot[1] - foot[0], (0.0, shoulder, 0.0)))
    rim = 0.32 * radius
    return [
        Node(merge(side), material=barrel),
        Node(moved(lathe([(0.985 * radius, 0), (rim, 0.74 * cone)], 30), (0, shoulder, 0)), material=wood),
        Node(moved(lathe([(rim, 0.74 * cone), (0.04 * rim, cone), (0, cone)], 20), (0, shoulder, 0)), material=tip),
        Node(moved(lathe([(0, 0), (radius, 0.0002)], 6), (0, 0, 0)), material=wood),
    ]


def _near() -> Scene:
    """Pencils that lean towards the lens, one of them until its tip touches the near plane.

    One object takes every blur from none to 6 % of the image height, and what is nearest is blurred most: clamped
    circles of confusion, guard bands that are too narrow and lost surfaces at the near plane show.
    """
    rng = np.random.default_rng(73)
    near = 0.1
    nodes: list[Node] = []
    casters: list[Any] = []
    wood = printed(planks(rng, (64, 128), 1, ("#d9b07a", "#edcf9e")), 0.7)
    colors = ["#e23d3d", "#f08a24", "#f2c230", "#5aa845", "#2b8f8a", "#2f6fc4", "#6b4fb0", "#c94f8f", "#7a4a2f"]
    eye, aim = (0.0, 0.17, 0.0), (0.0, 0.15, -0.4)
    camera = aimed_camera(eye, aim, 36.0, near)
    cup = np.array([0.03, 0.0, -0.5])
    # The first lies on the cup's rim, and its tip is as near as can be; the others lean in it.
    nearest = (camera.pose @ (-0.02, -0.012, -1.0005 * near, 1.0))[:3].tolist()
    tips: list[Vector] = [
        (nearest[0], nearest[1], nearest[2]), (-0.10, 0.255, -0.47), (-0.05, 0.235, -0.40), (0.0, 0.262, -0.5),
        (0.066, 0.262, -0.37), (0.15, 0.228, -0.46), (0.105, 0.245, -0.57), (-0.03, 0.24, -0.6), (0.17, 0.21, -0.53),
    ]  # fmt: skip
    for k, tip in enumerate(tips):
        lean = np.sign(np.subtract(tip, cup))
        # The end stands in the cup, opposite to where the pencil leans.
        end = (
            cup + np.array((-0.022, 0.012, -0.018)) * (lean[0], 1.0, lean[2]) if k else np.array((0.036, 0.113, -0.56))
        )
        axis = np.subtract(tip, end)
        length = float(np.linalg.norm(axis))
        axis /= length
        across = np.cross(axis, (0.0, 0.0, 1.0))
        across /= np.linalg.norm(across)
        rotation = np.stack([across, axis, np.cross(across, axis)], axis=1)
        transform = np.eye(4)
        transform[:3, :3], transform[:3, 3] = rotation, end
        color = colors[k % len(colors)]
        for part in _pencil(length, 0.0062, paint(color, 0.35), paint(color, 0.6), wood):
            nodes.append(Node(_turned(part.mesh, transform), material=part.material))
            casters.append(nodes[-1].mesh)
    clay = printed(speckle(rng, (128, 256), "#e9e2d4", "#d7cdbb", 14.0), 0.5)
    mug = lathe(
        [(0, 0), (0.043, 0), (0.045, 0.006), (0.047, 0.1), (0.0475, 0.104), (0.044, 0.104), (0.042, 0.012), (0, 0.012)],
        64,
    )
    mug = moved(mug, cup.tolist())
    nodes.append(Node(mug, material=clay))
    casters.append(mug)
    # Things on the desk: an eraser, a pad with a print, a ball of wool, a window's light on the wall behind.
    rubber = moved(block((0.05, 0.014, 0.024), 0.003), (-0.1, 0.007, -0.40), (0, 28, 0))
    nodes.append(Node(rubber, material=paint("#f0f0ee", 0.8)))
    casters.append(rubber)
    pad = poster(rng, (420, 300), ("#fffaf0", "#22223b", "#c9184a", "#ffb703", "#219ebc"), 2)
    sheet = quad((0.1, 0.004, -0.36), (0.16, 0.0, -0.05), (-0.07, 0.0, -0.22))
    nodes.append(Node(sheet, material=printed(pad, unlit=True)))
    wool = merge(
        [
            moved(ring(0.042, 0.006, 48, 10), (-0.17, 0.045, -0.66), tuple(rng.uniform(0, 180, 3).tolist()))
            for _ in range(16)
        ]
    )
    nodes.append(Node(wool, material=paint("#b8415e", 0.9)))
    casters.append(wool)
    light = Light((0.5, -1.0, -0.35), (0.75, 0.68, 0.56), Ambient((0.42, 0.42, 0.44), (0.3, 0.24, 0.18)))
    desk = planks(rng, (1024, 1536), 7, ("#7d5636", "#b98a5a"))
    nodes.append(floor(desk, (-1.2, -1.3, 1.2, -0.08), light, casters, softness_m=0.008))
    wall = speckle(rng, (256, 512), "#8fa3a0", "#a9bab5", 6.0)
    nodes.append(Node(quad((-2.4, -0.4, -1.5), (4.8, 0, 0), (0, 2.4, 0)), material=printed(wall, unlit=True)))
    prints = [
        ("#f3ead7", "#d1495b", "#edae49", "#00798c"),
        ("#1d3557", "#e63946", "#f1faee", "#a8dadc"),
        ("#fbe3c0", "#e76f51", "#2a9d8f", "#264653"),
    ]
    for k, ink in enumerate(prints):
        face = poster(rng, (400, 300), ink, (0, 3, 1)[k])
        nodes.append(
            Node(quad((-0.52 + 0.37 * k, 0.16, -1.49), (0.3, 0, 0), (0, 0.4, 0)), material=printed(face, unlit=True))
        )
    return Scene(
        "near",
        merged(nodes),
        camera=camera,
        lights=light.lights(),
        ambient=light.ambient,
        background=rgb("#8fa3a0"),
        focus_distance_m=0.4,
        aperture_radius_m=0.0048,
    )


def _turned(mesh: Any, transform: NDArray[np.float64]) -> Any:
    """A copy moved by a rigid transform."""
    turn = np.degrees(euler_from_matrix(transform, axes="sxyz"))
    return moved(mesh, transform[:3, 3].tolist(), turn.tolist())


def _floor_scene() -> Scene:
    """A polished floor and metal under eight lamps: highlights brighter than white on surfaces in and out of focus.

    A highlight belongs to the lamp's mirror image, not to the floor, and moves with the point on the lens that looks.
    Surface buffers of this scene have high shininess in all layers.
    """
    rng = np.random.default_rng(29)
    nodes: list[Node] = []
    marble = checker(rng, (1440, 1440), (18, 18), ("#c9c2b4", "#3a3f46"))
    dark = Material(base_color=(1.0, 1.0, 1.0, 1.0), base_color_texture=picture(marble), roughness=0.2)
    nodes.append(Node(quad((-5.4, 0.0, 1.0), (10.8, 0, 0), (0, 0, -10.8), steps=16), material=dark))
    wall = speckle(rng, (256, 512), "#3b2f3d", "#54414f", 7.0)
    plaster = Material(base_color=(1.0, 1.0, 1.0, 1.0), base_color_texture=picture(wall), roughness=0.9)
    nodes.append(Node(quad((-6.0, 0.0, -9.0), (12, 0, 0), (0, 6, 0)), material=plaster))
    gold, steel, copper = paint("#e0aa4e", 0.22, 1.0), paint("#c9ced4", 0.22, 1.0), paint("#c9744f", 0.28, 1.0)
    jade, ink, coral = paint("#2f8f6b", 0.12), paint("#28406e", 0.12), paint("#d4503f", 0.14)
    t = np.linspace(0, 1, 40)
    belly = np.stack([0.085 + 0.1 * np.sin(math.pi * t**0.8) ** 1.5 + 0.03 * t**8 - 0.02 * t, 0.52 * t], axis=1)
    vase = lathe([(0, 0), *belly.tolist(), (0.08, 0.52), (0.05, 0.44), (0, 0.44)])
    for mesh, material in (
        (moved(ball(0.11), (-0.24, 0.11, -1.15)), steel),
        (moved(ring(0.09, 0.035), (0.3, 0.035, -1.25), (0, 0, 0)), gold),
        (moved(vase, (0.1, 0.0, -2.35), scale=0.95), jade),
        (moved(ball(0.17), (-0.36, 0.17, -2.2)), gold),
        (moved(knot(0.2, 0.05), (0.62, 0.24, -2.6), (0, 30, 90)), copper),
        (moved(star(6, 0.18, 0.11, 0.42, 0.9), (-0.85, 0.0, -3.1)), ink),
        (moved(ball(0.26), (0.75, 0.26, -4.2)), steel),
        (moved(vase, (-0.2, 0.0, -4.4), scale=1.3), coral),
        (moved(ball(0.3), (-1.5, 0.3, -5.2)), copper),
        (moved(knot(0.3, 0.07, 3, 2), (1.9, 0.35, -5.8)), gold),
        (moved(vase, (0.55, 0.0, -6.4), scale=1.6), ink),
    ):
        nodes.append(Node(mesh, material=material))
    for x in (-2.6, -0.9, 0.9, 2.6):
        column = lathe([(0, 0), (0.26, 0), (0.26, 0.12), (0.19, 0.2), (0.17, 2.6), (0.24, 2.75), (0.24, 2.9), (0, 2.9)])
        nodes.append(Node(moved(column, (1.35 * x, 0.0, -7.6)), material=paint("#b9a894", 0.3)))
    # Eight lamps on stalks and chains, with the light that they give.
    lights = []
    for k, (lx, ly, lz) in enumerate(
        (
            (-0.6, 0.78, -2.3), (0.82, 1.0, -2.1), (-1.0, 1.0, -3.9), (1.0, 1.12, -4.3),
            (0.12, 1.3, -5.0), (-1.6, 1.35, -6.2), (1.7, 1.5, -6.6), (-0.5, 1.2, -7.3),
        )
    ):  # fmt: skip
        color = ("#ffd9a3", "#ffb877", "#ffe6c4", "#a9c8ff")[k % 4]
        strength = 0.34 * (0.6 + 0.4 * ly) ** 2
        red, green, blue = rgb(color)
        lights.append(PointLight((lx, ly, lz), (strength * red, strength * green, strength * blue)))
        nodes.append(Node(moved(ball(0.05, 24), (lx, ly, lz)), material=glow(color, 16.0)))
        rod = pipe([(lx, ly + 0.045, lz), (lx, 4.0, lz)], 0.006, 8)
        nodes.append(Node(rod, material=paint("#6b5a45", 0.4, 0.7)))
    return Scene(
        "floor",
        merged(nodes),
        camera=aimed_camera((0.0, 0.58, 0.0), (0.0, 0.3, -2.3), 35.0, 0.3),
        lights=tuple(lights),
        ambient=Ambient((0.12, 0.11, 0.14), (0.05, 0.045, 0.05)),
        background=rgb("#1a151d"),
        focus_distance_m=2.25,
        aperture_radius_m=0.042,
    )


def _flat() -> Scene:
    """A board of pinned things, all of it in focus.

    Nothing may change: any pixel that differs from the pinhole image by more than the little blur there is was computed
    for nothing.
    """
    rng = np.random.default_rng(84)
    light = DirectionalLight((0.55, -0.75, -0.9), (0.72, 0.69, 0.64))
    nodes: list[Node] = []
    wall_z = -3.0
    cork = speckle(rng, (900, 900), "#b98a5c", "#d8b184", 60.0) * (
        0.8 + 0.4 * noise(rng, 900, 900, 300.0, 2)[..., None]
    )
    nodes.append(Node(quad((-3.0, -3.0, wall_z), (6, 0, 0), (0, 6, 0), steps=4), material=printed(cork, 0.95)))
    inks = [
        ("#f3ead7", "#d1495b", "#edae49", "#00798c", "#30638e"),
        ("#1d3557", "#e63946", "#f1faee", "#a8dadc", "#ffb703"),
        ("#fbe3c0", "#e76f51", "#2a9d8f", "#264653", "#8ab17d"),
        ("#fffaf0", "#22223b", "#c9184a", "#ffb703", "#219ebc"),
    ]
    pins = [paint(c, 0.25) for c in ("#d62839", "#1b6ca8", "#f4b400", "#3c9d5d")]

    def pin(x: float, y: float) -> None:
        head = moved(ball(0.016, 20), (x, y, wall_z + 0.028))
        nodes.append(Node(head, material=pins[int(rng.integers(4))]))
        nodes.append(Node(pipe([(x, y, wall_z), (x, y, wall_z + 0.02)], 0.003, 8), material=paint("#b9bdc2", 0.3, 0.6)))

    for x, y, wide, tall, kind, lean in (
        (-0.52, 0.48, 0.46, 0.62, 2, -4.0), (0.04, 0.52, 0.44, 0.44, 0, 3.0), (0.56, 0.42, 0.44, 0.6, 1, -2.0),
        (-0.52, -0.38, 0.52, 0.42, 3, 3.0), (0.52, -0.5, 0.5, 0.5, 2, 5.0), (-0.28, -0.75, 0.36, 0.26, 0, -6.0),
        (-1.15, 0.2, 0.5, 0.7, 1, 2.0), (1.15, 0.1, 0.5, 0.66, 0, -3.0),
    ):  # fmt: skip
        face = poster(rng, (int(640 * tall), int(640 * wide)), inks[kind], kind)
        face[:10], face[-10:], face[:, :10], face[:, -10:] = (rgb("#fbf8f1"),) * 4
        card = moved(
            quad((-wide / 2, -tall / 2, 0.0), (wide, 0, 0), (0, tall, 0)), (x, y, wall_z + 0.004), (0, 0, lean)
        )
        nodes.append(Node(card, material=printed(face, 0.7)))
        pin(x, y + 0.42 * tall)
    # Pressed leaves, keys and rings of string.
    greens = [
        leaf_material(rng, a, b) for a, b in (("#4d7a3a", "#a9c97c"), ("#a8632a", "#e6b35c"), ("#8a2f2a", "#d9825c"))
    ]
    for k in range(12):
        x, y = -0.02 + 0.1 * math.cos(2.4 * k) + 0.015 * k, -0.2 - 0.035 * k + 0.05 * math.sin(3.1 * k)
        mesh = moved(leaf(0.24, 0.1, bend=0.05, fold=0.1), (x, y, wall_z + 0.02), (90, 0, 0))
        mesh = moved(mesh, turn_deg=(0, 0, 0))
        centre = np.array([x, y, 0.0])
        turned = moved(moved(mesh, (-centre).tolist()), (x, y, 0.0), (0, 0, 47.0 * k))
        nodes.append(Node(turned, material=greens[k % 3]))
        if k % 4 == 0:
            pin(x, y)
    brass = paint("#c99a3b", 0.3, 0.8)
    for x, y, lean in ((0.86, 0.02, 8.0), (0.93, 0.0, -9.0), (-0.83, -0.1, 5.0)):
        shaft = pipe([(0, 0, 0), (0, -0.17, 0)], 0.008, 12)
        bit = merge([moved(block((0.035, 0.012, 0.008), 0.002, 2), (0.022, -0.165 + 0.022 * j, 0)) for j in range(3)])
        bow = moved(ring(0.035, 0.008, 40, 12), (0, 0.036, 0), (90, 0, 0))
        nodes.append(Node(moved(merge([shaft, bit, bow]), (x, y, wall_z + 0.012), (0, 0, lean)), material=brass))
    s = np.linspace(0, 1, 160)
    for (x0, y0), (x1, y1) in (((-0.52, 0.74), (0.04, 0.70)), ((0.04, 0.70), (0.56, 0.67))):
        string = np.stack(
            [x0 + (x1 - x0) * s, y0 + (y1 - y0) * s - 0.16 * np.sin(math.pi * s), np.full_like(s, wall_z + 0.016)], 1
        )
        nodes.append(Node(pipe(string, 0.0035, 8), material=paint("#b23a48", 0.9)))
    return Scene(
        "flat",
        merged(nodes),
        camera=aimed_camera((0.0, 0.0, 0.0), (0.0, 0.0, -1.0), 33.0, 0.3),
        lights=(light,),
        ambient=Ambient((0.42, 0.43, 0.45), (0.36, 0.33, 0.3)),
        background=None,
        focus_distance_m=3.0,
        aperture_radius_m=0.012,
    )


HARD_SCENES: dict[str, tuple[str, Callable[[], Scene]]] = {
    "silhouettes": ("paper cards close behind each other: more surfaces than layers, all of them edges", _silhouettes),
    "branches": ("crossing branches, focus between them: near blur over far blur over sharp edges", _branches),
    "plane": ("a tiled floor through focus: bands, seams, wrong sharpness close to focus", _plane),
    "lights": ("small HDR lamps behind rods: bleeding, broken highlights, noise", _lights),
    "sky": ("twigs and wires before a sky at infinity: lost thin things, holes, infinite depth", _sky),
    "near": ("pencils up to the near plane: very large blur on one object, guard bands, clamps", _near),
    "floor": ("a polished floor under lamps: highlights that move with the lens, high shininess", _floor_scene),
    "flat": ("a pin board, everything in focus: work for nothing, needless blur", _flat),
}
