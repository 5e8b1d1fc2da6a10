"""Single passes of the multiview method: culling structures and layers."""

import numpy as np
import pytest

from cldof import Lens
from cldof.host.device import Device
from cldof.host.passes import Buffer, FrameProgram, Pass, Role, read, read_write, write
from cldof.methods.base import row_pitch, struct_scalar
from cldof.methods.multiview import _PLACES, _SIZE, _STEPS, Cone
from tests.frames import noise_frame
from tests.oracles import multiview as oracle
from tests.running import padded, run_pass, run_program
from tests.tolerances import assert_close


def size_of(width: int, height: int, peels: int = 1, layers: int = 32) -> np.generic:
    cells = -(-width // 16), -(-height // 16)
    return np.array((width, height, row_pitch(width), peels, layers, *cells), _SIZE)[()]


def places(**values: float) -> np.ndarray:
    """The same for all layers, 0 where nothing is said."""
    out = np.zeros(1, _PLACES)
    for name, value in values.items():
        out[name] = value
    return out


def _lists(cells: tuple[int, int], levels: int, reach: int) -> FrameProgram:
    """From an N-buffer ``first`` to ``lists``."""
    nbytes = 4 * cells[0] * cells[1]
    constant = {
        "bright": np.zeros(levels * cells[0] * cells[1], np.uint32),
        "coc": np.zeros(32, np.float32),
        "places": places(reach=reach),
    }
    buffers = [
        Buffer("first", levels * nbytes, Role.INPUT),
        Buffer("lists", nbytes, Role.OUTPUT),
        Buffer("sets", nbytes),
        *(Buffer(name, data.nbytes, Role.CONSTANT, data) for name, data in constant.items()),
    ]
    inputs = [read("first"), *(read(name) for name in constant)]
    size = size_of(16 * cells[0], 16 * cells[1])
    args = (
        write("lists"),
        write("sets"),
        *inputs,
        size,
        size,
        np.int32(levels),
        np.int32(1),
        np.float32(1.0),
        np.float32(0.499),
    )
    return FrameProgram.of(buffers, [Pass("multiview", "multiview_lists", args, cells)])


@pytest.mark.parametrize("cells", [(1, 1), (1, 9), (7, 5), (13, 8)])
def test_nbuffer_is_the_union_over_squares(device: Device, cells: tuple[int, int]) -> None:
    """The first level comes from inverse depth: a plane a cell, each at the middle of a random layer."""
    across, down = cells
    layer = np.random.default_rng(3).integers(0, 32, (down, across))
    levels = max(cells).bit_length()
    width, height = 16 * across, 16 * down
    size, pitch = size_of(width, height), row_pitch(width)
    inverse = padded((32.0 - layer.astype(np.float32)).repeat(16, 0).repeat(16, 1), pitch, -1.0)
    nbytes = levels * across * down * 4
    # Layer k is half a unit around 32 - k.
    steps = struct_scalar(_STEPS, 32.0, 1.0, 1.0, 0.0, 0.5)
    buffers = [Buffer("inv_depth", inverse.nbytes, Role.INPUT), Buffer("nbuffer", nbytes, Role.OUTPUT)]
    args = (write("nbuffer"), read("inv_depth"), read("inv_depth"), size, steps)
    passes = [Pass("multiview", "multiview_cells", args, cells)]
    for level in range(1, levels):
        args = (read_write("nbuffer"), size, np.int32(level))
        passes.append(Pass("multiview", "multiview_nbuffer", args, cells))
    found = run_program(
        device, FrameProgram.of(buffers, passes), {"inv_depth": inverse}, {}, "nbuffer", (levels, down, across)
    )
    masks = (1 << layer).astype(np.uint32)
    np.testing.assert_array_equal(found.view(np.uint32), oracle.nbuffer(masks, levels))


@pytest.mark.parametrize("cells", [(1, 1), (1, 9), (7, 5), (13, 8)])
@pytest.mark.parametrize("reach", [0, 1, 2, 5])
def test_lists_hold_what_is_within_reach(device: Device, cells: tuple[int, int], reach: int) -> None:
    across, down = cells
    rng = np.random.default_rng(reach)
    masks = (1 << rng.integers(0, 32, (down, across))).astype(np.uint32)
    levels = max(cells).bit_length()
    found = run_program(
        device, _lists(cells, levels, reach), {"first": oracle.nbuffer(masks, levels)}, {}, "lists", (down, across)
    )
    out = found.view(np.uint32)
    for j in range(down):
        for i in range(across):
            window = masks[max(0, j - reach) : j + reach + 1, max(0, i - reach) : i + reach + 1]
            assert out[j, i] == np.bitwise_or.reduce(window.ravel())


@pytest.mark.parametrize("size", [(1, 1), (37, 21), (131, 67)])
@pytest.mark.parametrize("half", [0.5, 1.3, 3.25, 14.0])
@pytest.mark.parametrize("scale", [1, 2, 3])
def test_cone_meets_the_oracle(device: Device, size: tuple[int, int], half: float, scale: int) -> None:
    width, height = size
    image = np.random.default_rng(2).random((height * scale, width * scale, 4), np.float32)
    pitch, fine_pitch = row_pitch(width), row_pitch(width * scale)
    cells = np.full((-(-height // 16), -(-width // 16)), 4, np.uint32)
    fine_cells = np.full((-(-height * scale // 16), -(-width * scale // 16)), 4, np.uint32)
    out = run_pass(
        device,
        "multiview",
        "multiview_cone",
        [
            padded(image, fine_pitch, 0.0),
            fine_cells,
            cells,
            places(window=half),
            size_of(width * scale, height * scale),
            size_of(width, height),
            np.int32(2),
            np.int32(0),
        ],
        (height, pitch, 4),
        (-(-pitch // 64), -(-height // 16)),
        defines=(("MULTIVIEW_SCALE", scale),),
    )
    window = Cone.of(half, scale)[:3]
    assert_close(out[:, :width], oracle.cone(image.astype(np.float64), *window, scale), "multiview_cone")


def test_extent_meets_the_oracle(device: Device) -> None:
    frame = noise_frame(75, 44)
    lens = Lens(9.0 / frame.camera.focal_px, 1.7)
    c1, c0 = lens.coc_coefficients(frame.camera)
    inverse = (1.0 / frame.depth).astype(np.float32)
    pitch = row_pitch(75)
    rows = np.stack([padded(one, pitch, -1.0) for one in inverse])
    out = run_pass(
        device,
        "multiview",
        "multiview_extent",
        [rows, size_of(75, 44, 3), np.float32(c1)],
        (3, 44, pitch),
        (pitch // device.lanes, 44, 3),
    )
    assert (out[..., 75:] == np.float32(1e30)).all()
    far = oracle.slots(inverse.astype(np.float64), c1, c0).far
    assert_close(out[..., :75] * c1 + c0, far, "multiview_extent")
