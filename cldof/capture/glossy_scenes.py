"""Built-in scenes of polished things under an environment map."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ..lighting import Environment
from .scene import Material, Node, Scene
from .shapes import ball, block, moved, quad
from .staging import aimed_camera, merged, paint
from .textures import noise, picture, rgb, tiles

__all__ = ["mirrors"]


def _hall(rng: np.random.Generator) -> NDArray[np.float32]:
    """A dusky hall with rows of lit windows, coloured banners and a pale ceiling; (256, 512, 3), linear."""
    height, width = 256, 512
    up = np.cos((np.arange(height) + 0.5) / height * math.pi)[:, None]
    wall = np.array(rgb("#2c3a55"), np.float32) * (0.75 + 0.5 * noise(rng, height, width, 9.0)[..., None])
    ceiling = np.array(rgb("#7f8fb0"), np.float32)
    share = np.clip((up - 0.78) / 0.1, 0.0, 1.0)[..., None]
    image = wall * (1.0 - share) + ceiling * share
    image *= np.clip(0.35 + 0.65 * (up + 0.35) / 0.3, 0.35, 1.0)[..., None]

    def panel(azimuth: float, elevation: float, wide: float, tall: float, color: str, light: float) -> None:
        """Degrees from -z towards +x and up."""
        x = (((np.arange(width) + 0.5) / width - 0.5) * 360.0 - azimuth + 180.0) % 360.0 - 180.0
        y = 90.0 - (np.arange(height) + 0.5) / height * 180.0 - elevation
        inside = np.clip(wide / 2 - np.abs(x), -0.5, 0.5)[None, :] + 0.5, np.clip(tall / 2 - np.abs(y), -0.5, 0.5) + 0.5
        mask = (inside[0] * inside[1][:, None])[..., None]
        image[:] = image * (1.0 - mask) + mask * light * np.array(rgb(color), np.float32)

    warm, cool, banners = "#ffd9a0", "#bcd7ff", ("#b3263a", "#1f7a6d", "#d98e2b", "#4a3f9a")
    for k in range(30):
        azimuth = 12.0 * k
        panel(azimuth, 17.0, 6.5, 16.0, warm if k % 3 else cool, 1.5)
        panel(azimuth + 6.0, 17.0, 2.2, 20.0, banners[k % 4], 0.8)
        panel(azimuth + 4.0, 38.0, 7.0, 9.0, cool, 1.2)
        panel(azimuth, 57.0, 5.0, 5.0, warm, 1.8)
        # The hall's own floor: lit squares and carpets.
        panel(azimuth, -16.0, 6.0, 9.0, cool if k % 2 else warm, 0.9)
        panel(azimuth + 6.0, -32.0, 7.0, 10.0, banners[(k + 1) % 4], 0.9)
        panel(azimuth, -46.0, 8.0, 7.0, warm, 0.7)
    return image.astype(np.float32)


def mirrors() -> Scene:
    """Polished metal and lacquer in a hall.

    Mirrors show the hall, which is far away whatever the mirror's own distance is: behind a lens it is blurred even in
    a mirror in focus. Who knows one colour for each surface shows it sharp.
    """
    rng = np.random.default_rng(41)
    around = Environment(_hall(rng))
    floor_tiles = tiles(rng, (8, 8), 120, ("#d6d9de", "#b4b9c2", "#c4b083"))
    floor = Material((1.0, 1.0, 1.0, 1.0), picture(floor_tiles), metallic=1.0, roughness=0.08)
    nodes = [Node(quad((-0.56, 0.0, -0.36), (1.12, 0, 0), (0, 0, -0.6), steps=8), material=floor)]
    steel, gold, copper = paint("#d4d8de", 0.08, 1.0), paint("#e6b65c", 0.08, 1.0), paint("#d98a63", 0.09, 1.0)
    dome = moved(ball(0.2, 192), (0.03, -0.13, -0.6))
    for mesh, material in (
        (moved(block((0.1, 0.07, 0.08), 0.002, 1), (-0.115, 0.035, -0.47), (0, 24, 0)), steel),
        (moved(block((0.07, 0.03, 0.07), 0.002, 1), (0.1, 0.015, -0.46), (0, -30, 0)), gold),
        (dome, copper),
        (moved(block((0.17, 0.19, 0.016), 0.002, 1), (0.175, 0.1, -0.63), (-9, -18, 0)), steel),
        (moved(block((0.16, 0.17, 0.016), 0.002, 1), (-0.2, 0.09, -0.66), (-10, 26, 0)), gold),
        (moved(block((0.2, 0.26, 0.016), 0.002, 1), (0.0, 0.13, -0.82), (-6, 8, 0)), steel),
        (moved(block((0.14, 0.2, 0.14), 0.002, 1), (-0.33, 0.1, -0.84), (0, 15, 0)), copper),
        (moved(block((0.14, 0.24, 0.14), 0.002, 1), (0.34, 0.12, -0.84), (0, -25, 0)), gold),
    ):
        nodes.append(Node(mesh, material=material))
    return Scene(
        "mirrors",
        merged(nodes),
        camera=aimed_camera((0.0, 0.21, 0.0), (0.0, 0.085, -0.6), 34.0, 0.05),
        background=around,
        environment=around,
        focus_distance_m=0.62,
        aperture_radius_m=0.03,
    )
