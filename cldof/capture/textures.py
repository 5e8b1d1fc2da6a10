"""Procedural textures for the built-in scenes: linear (H, W, 3) floats, seeded, turned into 8-bit sRGB at the end.

Painters work in texel coordinates with row 0 at the top, as images do.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image, ImageDraw, ImageFilter

from ..images import linear_from_srgb, srgb_from_linear

__all__ = [
    "bricks",
    "checker",
    "coverage",
    "noise",
    "picture",
    "planks",
    "poster",
    "rgb",
    "shadow_mask",
    "speckle",
    "tiles",
    "veins",
    "windows",
]

_Array = NDArray[np.float32]


def rgb(code: str) -> tuple[float, float, float]:
    """Linear colour of an sRGB hex code such as ``"#d94f3d"``."""
    red, green, blue = linear_from_srgb([int(code[i : i + 2], 16) / 255.0 for i in (1, 3, 5)]).tolist()
    return red, green, blue


def picture(linear: ArrayLike, alpha: ArrayLike | None = None) -> Any:
    """The PIL image that a material takes."""
    data = np.rint(srgb_from_linear(linear) * 255.0).astype(np.uint8)
    if alpha is not None:
        data = np.dstack([data, np.rint(np.clip(alpha, 0.0, 1.0) * 255.0).astype(np.uint8)])
    return Image.fromarray(data)


def noise(rng: np.random.Generator, height: int, width: int, cells: float, octaves: int = 4) -> _Array:
    """Smooth value noise in about [0, 1], ``cells`` blobs across the longer side, halving in size and weight."""
    total = np.zeros((height, width), np.float32)
    weight = 0.0
    for octave in range(octaves):
        scale = cells * 2**octave / max(height, width)
        grid = rng.random((max(2, math.ceil(height * scale) + 1), max(2, math.ceil(width * scale) + 1)), np.float32)
        layer = Image.fromarray(grid).resize((width, height), Image.Resampling.BICUBIC)
        total += 0.5**octave * np.asarray(layer)
        weight += 0.5**octave
    return total / np.float32(weight)


def checker(rng: np.random.Generator, size: tuple[int, int], squares: tuple[int, int], colors: Sequence[str]) -> _Array:
    """A board of two softly marbled colours with fine joints; ``squares`` down and across."""
    height, width = size
    y, x = np.mgrid[:height, :width].astype(np.float32)
    v, u = y * squares[0] / height, x * squares[1] / width
    odd = ((np.floor(u) + np.floor(v)) % 2)[..., None]
    cloud = noise(rng, height, width, 3.0 * max(squares), 3)[..., None]
    tile = rng.uniform(0.9, 1.06, (squares[0] + 1, squares[1] + 1)).astype(np.float32)
    board = np.where(odd, np.array(rgb(colors[0]), np.float32), np.array(rgb(colors[1]), np.float32))
    board = board * (0.82 + 0.36 * cloud) * tile[np.floor(v).astype(int), np.floor(u).astype(int)][..., None]
    edge = np.minimum(np.abs(u - np.rint(u)) * width / squares[1], np.abs(v - np.rint(v)) * height / squares[0])
    return np.asarray(board * (1.0 - 0.35 * np.exp(-((edge / 1.5) ** 2)))[..., None], np.float32)


def planks(rng: np.random.Generator, size: tuple[int, int], boards: int, colors: Sequence[str]) -> _Array:
    """Wooden boards running along the rows, with grain, each cut from another tree."""
    height, width = size
    dark, light = (np.array(rgb(c), np.float32) for c in colors)
    rows = np.linspace(0, height, boards + 1).astype(int)
    out = np.empty((height, width, 3), np.float32)
    for top, bottom in pairwise(rows.tolist()):
        tall = bottom - top
        stretched = noise(rng, tall, max(8, width // 12), 6.0 + 3 * rng.random(), 3)
        flow = np.asarray(Image.fromarray(stretched).resize((width, tall), Image.Resampling.BICUBIC))
        v = np.linspace(0, 1, tall, dtype=np.float32)[:, None]
        rings = 0.5 + 0.5 * np.sin((v * (5 + 4 * rng.random()) + 5.0 * flow) * 2 * math.pi)
        fibre = np.asarray(
            Image.fromarray(rng.random((tall, max(2, width // 40)), np.float32)).resize(
                (width, tall), Image.Resampling.BICUBIC
            )
        )
        tone = (0.55 * rings + 0.3 * flow + 0.15 * fibre)[..., None]
        joint = np.minimum(np.arange(tall), tall - 1 - np.arange(tall))[:, None, None] / max(1.5, 0.012 * tall)
        out[top:bottom] = (dark + (light - dark) * tone) * rng.uniform(0.82, 1.1) * (1 - 0.6 * np.exp(-(joint**2)))
    return out


def bricks(
    rng: np.random.Generator, size: tuple[int, int], courses: int, across: int, colors: Sequence[str], mortar: str
) -> _Array:
    """A wall in running bond, each brick with a colour of its own, worn edges and weather."""
    height, width = size
    y, x = np.mgrid[:height, :width].astype(np.float32)
    wobble = noise(rng, height, width, courses * 3.0, 2) - 0.5
    v = y * courses / height + 0.10 * wobble
    row = np.floor(v).astype(int)
    u = x * across / width + 0.5 * (row % 2) + 0.05 * wobble
    column = np.floor(u).astype(int)
    palette = np.array([rgb(c) for c in colors], np.float32)
    pick = rng.integers(0, len(colors), (courses + 2, across + 3))
    tone = rng.uniform(0.8, 1.15, pick.shape).astype(np.float32)
    brick = palette[pick[row, column]] * tone[row, column][..., None]
    grain = noise(rng, height, width, courses * 6.0, 3)[..., None]
    ratio = (height / courses) / (width / across)
    gap = np.minimum(np.minimum(v - row, 1 - (v - row)), np.minimum(u - column, 1 - (u - column)) / ratio)
    inside = np.clip((gap - 0.055) / 0.05, 0, 1)[..., None]
    wall = inside * brick * (0.7 + 0.6 * grain) + (1 - inside) * np.array(rgb(mortar), np.float32) * (0.8 + 0.4 * grain)
    weather = noise(rng, height, width, 4.0, 4)[..., None]
    return np.asarray(wall * (0.75 + 0.5 * weather), np.float32)


def speckle(rng: np.random.Generator, size: tuple[int, int], color: str, other: str, cells: float) -> _Array:
    """Two colours clouded into each other: plaster, stone, soil, grass from afar."""
    cloud = np.clip((noise(rng, *size, cells, 5) - 0.3) / 0.4, 0, 1)[..., None]
    a, b = np.array(rgb(color), np.float32), np.array(rgb(other), np.float32)
    return np.asarray(a + (b - a) * cloud, np.float32)


def poster(rng: np.random.Generator, size: tuple[int, int], colors: Sequence[str], kind: int) -> _Array:
    """A framed abstract print: 0 circles, 1 stripes, 2 hills under a sun, 3 blocks."""
    height, width = size
    over = 2
    canvas = Image.new("RGB", (width * over, height * over), colors[0])
    draw = ImageDraw.Draw(canvas)
    w, h = canvas.size
    ink = list(colors[1:])
    if kind == 0:
        for i in range(9):
            r = w * rng.uniform(0.07, 0.24)
            x, y = rng.uniform(0.15, 0.85) * w, rng.uniform(0.12, 0.88) * h
            draw.ellipse((x - r, y - r, x + r, y + r), fill=ink[i % len(ink)])
            r *= 0.55
            draw.ellipse((x - r, y - r, x + r, y + r), fill=colors[0] if i % 2 else ink[(i + 1) % len(ink)])
    elif kind == 1:
        y = 0.1 * h
        i = 0
        while y < 0.9 * h:
            tall = rng.uniform(0.02, 0.08) * h
            draw.rectangle((0.1 * w, y, rng.uniform(0.55, 0.9) * w, min(y + tall, 0.9 * h)), fill=ink[i % len(ink)])
            y += tall + 0.018 * h
            i += 1
    elif kind == 2:
        r = 0.17 * w
        x, y = 0.62 * w, 0.32 * h
        draw.ellipse((x - r, y - r, x + r, y + r), fill=ink[0])
        for i, base in enumerate(np.linspace(0.48, 0.86, 4)):
            xs = np.linspace(0, w, 80)
            phase = rng.uniform(0, 6)
            ys = h * (base + 0.07 * np.sin(xs / w * (4 + i) + phase) + 0.03 * np.sin(xs / w * 11 + phase))
            line = [(float(a), float(b)) for a, b in zip(xs, ys, strict=True)]
            draw.polygon([*line, (w, h), (0, h)], fill=ink[(i + 1) % len(ink)])
    else:
        for i in range(5):
            for j in range(4):
                x, y = (0.1 + 0.2 * j) * w, (0.08 + 0.168 * i) * h
                box = (x + 0.01 * w, y + 0.01 * w, x + 0.19 * w, y + 0.158 * h)
                shape = draw.ellipse if rng.random() < 0.4 else draw.rectangle
                shape(box, fill=ink[int(rng.integers(len(ink)))])
    flat = np.asarray(canvas.resize((width, height), Image.Resampling.LANCZOS), np.float32) / 255.0
    return linear_from_srgb(flat)


def tiles(rng: np.random.Generator, count: tuple[int, int], texels: int, colors: Sequence[str]) -> _Array:
    """Square encaustic tiles, ``count`` down and across, ``texels`` wide, each with a motif, a colour and a turn.

    ``colors[0]`` is the ground, the last one the joints.
    """
    over = 4
    b, a = (np.mgrid[: texels * over, : texels * over].astype(np.float32) + 0.5) / (texels * over)
    centre, diamond = np.hypot(a - 0.5, b - 0.5), np.abs(a - 0.5) + np.abs(b - 0.5)
    motifs = [
        (np.abs(np.hypot(a, b) - 0.5) < 0.14) | (np.abs(np.hypot(1 - a, 1 - b) - 0.5) < 0.14),
        (centre < 0.38) & ~((centre < 0.26) & (centre > 0.13)),
        (diamond < 0.44) & (centre > 0.16),
        (a + b < 1.0) ^ (diamond < 0.24),
    ]
    small = [m.reshape(texels, over, texels, over).mean(axis=(1, 3), dtype=np.float32) for m in motifs]
    inside = np.stack([np.rot90(m, k) for m in small for k in range(4)])[rng.integers(0, 16, count)][..., None]
    palette = np.array([rgb(c) for c in colors], np.float32)
    tone = rng.uniform(0.85, 1.1, (*count, 1, 1, 1)).astype(np.float32)
    ink = palette[rng.integers(1, len(colors) - 1, count)][:, :, None, None]
    board = (palette[0] + (ink - palette[0]) * inside) * tone
    gap = max(1, round(0.018 * texels))
    for edge in (slice(0, gap), slice(-gap, None)):
        board[:, :, edge] = board[:, :, :, edge] = palette[-1]
    flat = board.transpose(0, 2, 1, 3, 4).reshape(count[0] * texels, count[1] * texels, 3)
    return np.asarray(flat * (0.85 + 0.3 * noise(rng, flat.shape[0], flat.shape[1], 60.0, 3)[..., None]), np.float32)


def windows(
    rng: np.random.Generator, cells: tuple[int, int], wall: str, lit: Sequence[str], share: float, texels: int = 12
) -> _Array:
    """A building's front at night, ``cells`` windows down and across, of which ``share`` are lit."""
    palette = np.array([rgb(c) for c in lit], np.float32)
    on = rng.random(cells) < share
    color = palette[rng.integers(0, len(lit), cells)] * rng.uniform(0.35, 1.0, (*cells, 1)).astype(np.float32)
    color = np.where(on[..., None], color, 0.35 * np.array(rgb(wall), np.float32))
    y, x = np.mgrid[: cells[0] * texels, : cells[1] * texels]
    inside = (np.abs(y % texels / texels - 0.5) < 0.3) & (np.abs(x % texels / texels - 0.5) < 0.25)
    return np.asarray(
        np.where(inside[..., None], color[y // texels, x // texels], np.array(rgb(wall), np.float32)), np.float32
    )


def veins(rng: np.random.Generator, size: tuple[int, int], color: str, light: str) -> _Array:
    """A leaf's face: midrib along the rows' middle, side veins sweeping to the tip, a lighter rim."""
    height, width = size
    t = np.abs(np.linspace(-1, 1, height, dtype=np.float32))[:, None]
    s = np.linspace(0, 1, width, dtype=np.float32)[None, :]
    side = np.abs(((s - 0.28 * t) * 9) % 1 - 0.5)
    rib = np.maximum(np.exp(-((t / 0.035) ** 2)), 0.6 * np.exp(-((side / 0.07) ** 2)) * (1 - 0.6 * t))
    mottle = noise(rng, height, width, 10.0, 4)
    a, b = np.array(rgb(color), np.float32), np.array(rgb(light), np.float32)
    return np.asarray((a + (b - a) * (0.75 * rib)[..., None]) * (0.75 + 0.5 * mottle)[..., None], np.float32)


def shadow_mask(
    meshes: Sequence[Any],
    direction: Sequence[float],
    area: tuple[float, float, float, float],
    size: tuple[int, int],
    blur_m: float,
    height: float = 0.0,
) -> _Array:
    """How much of the light along ``direction`` the meshes keep from the plane y = ``height``: (H, W), 0 to 1.

    Triangles are projected and filled, then softened by ``blur_m``. ``area`` is (x of the left edge, z of the top row,
    x of the right edge, z of the bottom row) in metres.
    """
    rows, columns = size
    left, far, right, near = area
    mask = Image.new("L", (columns, rows), 0)
    draw = ImageDraw.Draw(mask)
    down = np.asarray(direction, dtype=float)
    for mesh in meshes:
        points = np.asarray(mesh.vertices)
        reach = np.maximum(points[:, 1] - height, 0.0) / -down[1]
        x = (points[:, 0] + reach * down[0] - left) / (right - left) * columns
        y = (points[:, 2] + reach * down[2] - far) / (near - far) * rows
        flat = np.stack([x, y], axis=1)[np.asarray(mesh.faces)]
        for triangle in flat.reshape(len(flat), 6).tolist():
            draw.polygon(triangle, fill=255)
    soft = mask.filter(ImageFilter.GaussianBlur(blur_m * columns / abs(right - left)))
    return np.asarray(soft, np.float32) / 255.0


def coverage(size: tuple[int, int], discs: Sequence[tuple[float, float, float]]) -> _Array:
    """Alpha of discs (x, y, radius in units of the width, y down), anti-aliased."""
    height, width = size
    over = 4
    canvas = Image.new("L", (width * over, height * over), 0)
    draw = ImageDraw.Draw(canvas)
    for x, y, r in discs:
        cx, cy, cr = (v * width * over for v in (x, y, r))
        draw.ellipse((cx - cr, cy - cr, cx + cr, cy + cr), fill=255)
    return np.asarray(canvas.resize((width, height), Image.Resampling.BOX), np.float32) / 255.0
