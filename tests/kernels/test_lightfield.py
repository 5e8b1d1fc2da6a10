"""The light field's passes against the serial twin: warps to the last bit, in every form."""

import math
from dataclasses import replace

import numpy as np
import pytest

from cldof.host.device import Device
from cldof.host.passes import Buffer, FrameProgram, Role
from cldof.lens import DiscAperture
from cldof.methods import FrameShape
from cldof.methods.base import row_pitch
from cldof.methods.lightfield import _LENS, _SLOTS, LightField, Views, _Builder, lens_views
from tests.frames import noise_frame
from tests.oracles import lightfield as oracle
from tests.running import run_program
from tests.tolerances import assert_close

SIZES = [(1, 1), (1, 29), (31, 1), (37, 21), (53, 40)]
FORMS = ["views", "atomic", "packed"]
C1, C0 = -9.0, 5.0


def lens_of(c1: float = C1, c0: float = C0, reach: int = 40) -> np.generic:
    lens = np.zeros((), _LENS)
    lens["c1"], lens["c0"], lens["cell"], lens["reach"] = c1, c0, 0.1, reach
    return lens[()]


def layers(width: int, height: int, seed: int = 0, peels: int = 3) -> tuple[np.ndarray, np.ndarray]:
    """Colours and inverse depth of blocks, slopes, glass and empty slots, with many equal depths."""
    frame = noise_frame(width, height, peels, seed=seed)
    inv_depth = 1.0 / frame.depth
    rng = np.random.default_rng(seed)
    inv_depth = np.where(rng.random(inv_depth.shape) < 0.5, np.round(inv_depth * 4) / 4, inv_depth)
    inv_depth = np.sort(inv_depth, axis=0)[::-1]
    inv_depth[1:][rng.random(inv_depth[1:].shape) < 0.2] = -1.0
    return frame.color, np.ascontiguousarray(inv_depth, np.float32)


def builder_for(device: Device, shape: FrameShape, method: LightField, views: int) -> _Builder:
    structure = Views(views, DiscAperture(), 0, panes=2 if shape.has_glass else 0)
    builder = _Builder(method, shape, structure, device.traits)
    builder.passes = []
    return builder


def packed_slots(some: oracle.Slots, shape: FrameShape) -> dict[str, np.ndarray]:
    """The twin's slots as lightfield_slots writes them; what is not written is garbage."""
    lines = shape.layers * shape.height
    arrays = {
        "slot_at": np.full((lines, shape.pitch), 7, np.uint32),
        "slot_key": np.full((lines, shape.pitch), 7, np.uint32),
        "slot_coc": np.full((lines, shape.pitch), np.nan, np.float32),
        "slot_edge": np.full((lines, shape.pitch), 7, np.uint32),
        "slot_plane": np.full((lines, shape.pitch), 99, np.uint8),
        "slot_count": np.zeros(lines, np.int32),
    }
    codes = (some.edges & 255).astype(np.uint32)
    edge = codes[:, 0] | codes[:, 1] << 8 | codes[:, 2] << 16 | codes[:, 3] << 24
    for i, at in enumerate(some.at):
        line = at // shape.pitch
        to = line, arrays["slot_count"][line]
        arrays["slot_at"][to], arrays["slot_key"][to], arrays["slot_coc"][to] = at, some.key[i], some.coc[i]
        arrays["slot_edge"][to], arrays["slot_plane"][to] = edge[i], some.plane[i]
        arrays["slot_count"][line] += 1
    return arrays


def warp(device: Device, shape: FrameShape, some: oracle.Slots, method: LightField, views: int) -> np.ndarray:
    """Winners as uint64[views][planes][height][width]."""
    builder = builder_for(device, shape, method, views)
    (builder._warp_by_view if builder.warp == "views" else builder._warp_by_slot)(0, views)
    inputs = packed_slots(some, shape)
    buffers = [
        replace(b, role=Role.INPUT) if b.name in _SLOTS else replace(b, role=Role.OUTPUT) if b.name == "winners" else b
        for b in builder.buffers
        if b.name in (*_SLOTS, "winners", "views")
    ]
    program = FrameProgram.of(buffers, builder.passes)
    height, width = shape.output_size
    out = (views, builder.planes, height, row_pitch(width), 2)
    params = {"lens": lens_of()} if builder.warp == "views" else {}
    words = run_program(device, program, inputs, params, "winners", out).view(np.uint32)[..., :width, :]
    return words[..., 1].astype(np.uint64) << np.uint64(32) | words[..., 0].astype(np.uint64)


def skip_without(device: Device, form: str) -> None:
    if form == "packed" and not device.traits.has_int64_atomics:
        pytest.skip(f"{device.traits.name} has no 64-bit atomics")
    if form == "views" and not device.traits.has_long_loops:
        pytest.skip(f"{device.traits.name} breaks long loops off")


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("support", ["none", "2x2", "3x3", "surface"])
@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("glass", [False, True])
def test_warp_is_the_twin_to_the_bit(
    device: Device, form: str, support: str, size: tuple[int, int], glass: bool
) -> None:
    skip_without(device, form)
    guard = 4 if size == (53, 40) else 0
    color, inv_depth = layers(*size, seed=size[0])
    shape = FrameShape(3, size[1], size[0], guard, True, glass)
    planes = 3 if glass else 1
    some = oracle.slots(inv_depth, color[..., 3], shape.pitch, C1, C0, planes, support)
    method = LightField(views=5, support=support, warp=form)
    expected = [
        oracle.warp(some, view, shape.output_size, planes, guard, support)
        for view in lens_views(method, Views(5, DiscAperture(), 0))
    ]
    np.testing.assert_array_equal(warp(device, shape, some, method, 5), expected)


@pytest.mark.parametrize("form", FORMS)
def test_planted_ties_fall_the_same_way_every_time(device: Device, form: str) -> None:
    """Everything at one depth and mapped on top of each other by wide supports: only the tie rule decides."""
    skip_without(device, form)
    size = (70, 50)
    shape = FrameShape(3, size[1], size[0], 0, True, False)
    inv_depth = np.full((3, size[1], size[0]), 0.3, np.float32)
    inv_depth[:, 10:30, 20:40] = 0.9
    some = oracle.slots(inv_depth, np.ones_like(inv_depth), shape.pitch, C1, C0, 1, "3x3")
    method = LightField(views=7, support="3x3", warp=form)
    expected = [
        oracle.warp(some, view, shape.output_size, 1, 0, "3x3")
        for view in lens_views(method, Views(7, DiscAperture(), 0))
    ]
    for _ in range(20):
        np.testing.assert_array_equal(warp(device, shape, some, method, 7), expected)


def test_the_nearest_wins_and_then_the_first(device: Device) -> None:
    """Said without the twin: two pixels move onto a third, which is farther; a tie of two peels goes to the first."""
    shape = FrameShape(2, 1, 3, 0, True, False)
    # C = -1, 0, 1 px for w = 2/3, 5/9, 4/9; seen from the right rim of the lens.
    inv_depth = np.array([[[4 / 9, 5 / 9, 2 / 3]], [[4 / 9, 5 / 9, 2 / 3]]], np.float32)
    some = oracle.slots(inv_depth, np.ones_like(inv_depth), shape.pitch, C1, C0, 1, "none")
    view = np.array([1.0, 0.0, 0.0, 0.0], np.float32)
    winners = oracle.warp(some, view, (1, 3), 1, 0, "none")[0, 0]
    assert [int(w) & oracle.NONE for w in winners] == [oracle.NONE, 2, oracle.NONE]
    for form in ("views", "atomic") if device.traits.has_long_loops else ("atomic",):
        found = warp(device, shape, some, LightField(views=1, warp=form, support="none"), 1)
        # One view stands at the centre, where nothing moves.
        assert [int(w) & oracle.NONE for w in found[0, 0, 0]] == [0, 1, 2]


def test_depth_keys_keep_the_order_of_floats() -> None:
    values = np.float32([-np.inf, -3e38, -1.0, -1e-38, 0.0, 1e-38, 0.25, np.nextafter(np.float32(0.25), 1), 1.0, 3e38])
    assert (np.diff(oracle.depth_key(values).astype(np.int64)) < 0).all()
    assert oracle.depth_key(np.float32([0.0]))[0] == 0x7FFFFFFF


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("glass", [False, True])
def test_slots_are_those_of_the_twin(device: Device, size: tuple[int, int], glass: bool) -> None:
    check_slots(device, *layers(*size, seed=size[1]), glass)


def test_slopes_too_steep_for_a_byte_are_edges(device: Device) -> None:
    """Straight slopes of 6 to 9 px of CoC a pixel, each in a row of its own: beyond 7.5 px they end at every pixel."""
    slopes = np.linspace(6.0, 9.0, 31, dtype=np.float32)[:, None]
    row = 0.1 + slopes / abs(C1) * np.arange(24, dtype=np.float32)
    inv_depth = np.stack([row, np.full_like(row, 0.0), np.full_like(row, -1.0)]).astype(np.float32)
    color = np.ones((*inv_depth.shape, 4), np.float32)
    color[2] = 0.0
    inner = oracle.edges(inv_depth, oracle.coc(inv_depth, C1, C0))[0, :, 2:-2, 1]
    is_end = np.abs((inner & 255) - 128) <= 7  # as the kernels read the byte
    assert not is_end[:15].any() and is_end[17:].all()
    check_slots(device, color, inv_depth, False)


def check_slots(device: Device, color: np.ndarray, inv_depth: np.ndarray, glass: bool) -> None:
    size = inv_depth.shape[2], inv_depth.shape[1]
    shape = FrameShape(3, size[1], size[0], 0, True, glass)
    some = oracle.slots(inv_depth, color[..., 3], shape.pitch, C1, C0, 3 if glass else 1, "surface")
    expected = packed_slots(some, shape)
    builder = builder_for(device, shape, LightField(cull=False, mip=False), 1)
    program = builder.build()
    padded = np.full((3, size[1], shape.pitch), -1.0, np.float32)
    padded[..., : size[0]] = inv_depth
    count = expected["slot_count"][:, None] > np.arange(shape.pitch)
    for name in _SLOTS:
        if name == "slot_plane" and not glass:
            continue
        step = replace(program, buffers=dict(program.buffers), passes=program.passes[:1])
        step.buffers[name] = Buffer(name, step.buffers[name].nbytes, Role.OUTPUT)
        for unused in set(step.buffers) - {*_SLOTS, "cells", "color", "inv_depth", "tile_open"}:
            del step.buffers[unused]
        shape_out = expected[name].shape
        shape_out = (expected[name].nbytes // 4,) if name == "slot_plane" else shape_out
        raw = run_program(device, step, {"color": color, "inv_depth": padded}, {"lens": lens_of()}, name, shape_out)
        found = raw.view(expected[name].dtype).reshape(expected[name].shape)
        if name == "slot_coc":
            np.testing.assert_allclose(found[count], expected[name][count], atol=2e-3)
        elif name == "slot_edge":
            # A difference at a rounding boundary may fall to either side; a missing edge may not be found.
            bytes_ = [x[count].view(np.uint8).astype(int) for x in (found, expected[name])]
            assert (np.abs((bytes_[0] - bytes_[1] + 128) % 256 - 128) <= 1).mean() >= 0.998
            ends = [np.abs(x - 128) <= 7 for x in bytes_]
            assert (ends[0] == ends[1]).mean() >= 0.998
        else:
            valid = count if name != "slot_count" else np.ones(len(found), bool)
            np.testing.assert_array_equal(found[valid], expected[name][valid])


@pytest.mark.parametrize("size", [(1, 1), (1, 9), (8, 1), (37, 21), (64, 32)])
def test_pyramid_meets_the_twin(device: Device, size: tuple[int, int]) -> None:
    color, inv_depth = layers(*size, seed=2)
    shape = FrameShape(3, size[1], size[0], 0, True, False)
    for levels in (1, 2):
        structure = Views(4, DiscAperture(), levels)
        builder = _Builder(LightField(views=4), shape, structure, device.traits)
        builder.passes = []
        builder._pyramid()
        buffers = [b for b in builder.buffers if b.name in ("color", "inv_depth", "mip_depths")]
        buffers.append(replace(next(b for b in builder.buffers if b.name == "mips"), role=Role.OUTPUT))
        padded = np.full((3, size[1], shape.pitch), -1.0, np.float32)
        padded[..., : size[0]] = inv_depth
        program = FrameProgram.of(buffers, builder.passes)
        found = run_program(
            device, program, {"color": color, "inv_depth": padded}, {"lens": lens_of()}, "mips",
            (buffers[-1].nbytes // 16, 4),
        )  # fmt: skip
        expected = []
        level = [(c.astype(np.float64), w) for c, w in zip(color, inv_depth, strict=True)]
        for _ in range(levels):
            level = [oracle.shrink(c, w, C1, C0) for c, w in level]
            expected += [c.reshape(-1, 4) for c, _ in level]
        assert_close(found, np.concatenate(expected), "lightfield_shrink")


@pytest.mark.parametrize("support", ["2x2", "surface"])
@pytest.mark.parametrize("slope", [0.0, 0.01, 0.07, 0.3, 0.85])
@pytest.mark.parametrize("turn", [0.0, 0.4, 1.1, 2.3])
def test_a_slope_has_no_pin_holes(support: str, slope: float, turn: float) -> None:
    """A plane whose CoC grows by `slope` px per pixel, stretched or squeezed; from 1 on it is edge-on."""
    y, x = np.mgrid[:40, :40].astype(np.float64)
    c = slope * (math.cos(turn) * (x - 20) + math.sin(turn) * (y - 20))
    inv_depth = ((c + 400.0) / 400.0).astype(np.float32)[None]
    some = oracle.slots(inv_depth, np.ones_like(inv_depth), 48, 400.0, -400.0, 1, support)
    for view in lens_views(LightField(views=12), Views(12, DiscAperture(), 0)):
        winners = oracle.warp(some, view, (40, 40), 1, 0, support)[0]
        holes = winners[19:22, 19:22] & np.uint64(oracle.NONE) == oracle.NONE
        if support == "surface" or slope <= 0.3:
            assert not holes.any()


def edge_of_slots(inside: np.ndarray, c: float) -> oracle.Slots:
    """Something of CoC c px before a wall of CoC 8 px that goes on behind it."""
    inv_depth = np.full((2, *inside.shape), (400.0 - 8.0) / 400.0, np.float32)
    inv_depth[0][inside] = (400.0 - c) / 400.0
    return oracle.slots(inv_depth, np.ones_like(inv_depth), 48, -400.0, 400.0, 1, "surface")


@pytest.mark.parametrize("turn", [0.05, 0.35, 0.65, 2.0, -1.3])
@pytest.mark.parametrize("c", [0.4, 0.7])
def test_silhouettes_move_by_parts_of_a_pixel(turn: float, c: float) -> None:
    """A straight edge: over all views a pixel is covered as by the true line, of which each pixel says in or out."""
    y, x = np.mgrid[:48, :48] - 23.7

    def inside(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return math.cos(turn) * x + math.sin(turn) * y <= 0.3

    some = edge_of_slots(inside(x, y), c)
    blind = np.where(oracle.end_reach(some.edges, 0)[0], oracle.UNKNOWN, some.edges)
    views = lens_views(LightField(views=64), Views(64, DiscAperture(), 0))
    truth = np.mean([inside(x - c * v[0], y - c * v[1]) for v in views], axis=0)
    errors = []
    for slots in (some, some._replace(edges=blind)):
        winners = [oracle.warp(slots, v, (48, 48), 1, 0, "surface")[0] & np.uint64(oracle.NONE) for v in views]
        seen = np.isin(winners, slots.at[np.abs(slots.coc) < 256]).mean(axis=0)
        errors.append(math.sqrt(np.square(seen - truth)[12:36, 12:36].mean()))
    assert errors[0] < 0.55 * errors[1]


def test_silhouettes_in_focus_stay() -> None:
    y, x = np.mgrid[:48, :48] - 23.7
    some = edge_of_slots(np.hypot(x, y) <= 9.0, 0.0)
    known = oracle.end_reach(some.edges, 0)[0] & (some.edges != oracle.UNKNOWN)
    assert known.sum() > 20
    there = some.at[some.coc == 0]
    for view in lens_views(LightField(views=12), Views(12, DiscAperture(), 0)):
        winner = (oracle.warp(some, view, (48, 48), 1, 0, "surface")[0] & np.uint64(oracle.NONE)).ravel()
        np.testing.assert_array_equal(winner[there], there)
        assert np.isin(winner, there).sum() == len(there)
