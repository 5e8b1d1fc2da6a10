"""Filters by themselves: Gaussian engines from 0.05 to 500 px, pull-push from one pixel, deep levels of odd sizes."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from cldof import Camera, LayeredFrame, Lens
from cldof.host.device import Device
from cldof.host.passes import FrameProgram, Local, Role
from cldof.methods import FrameShape, gaussian
from cldof.methods.base import row_pitch
from cldof.methods.lightfield import LightField
from cldof.methods.pyramid import Pyramid
from tests.oracles import gaussian as oracle
from tests.running import inverse_depth, padded, run_pass, run_program
from tests.stability import driver_of

from .conftest import record

SIGMAS = [0.05, 0.2, 0.35, 0.5, 1.0, 2.0, 5.5, 10.0, 30.0, 100.0, 500.0]
ENGINES = ["fir", "iir"]


def blurred(device: Device, engine: str, image: np.ndarray, sigma: float) -> np.ndarray:
    """An image through one engine, both directions."""
    height, width = image.shape[:2]
    pitch = row_pitch(width)
    extent = [np.int32(n) for n in (width, height, pitch)]
    shape = (height, pitch, 4)
    if engine == "fir":
        taps = gaussian.fir_taps(sigma)
        radius = len(taps) // 2
        halo, segment = (radius + 4) & ~3, 64
        local = 8 * (segment + 2 * halo) * 16
        if local > device.traits.local_mem_bytes:
            pytest.skip(f"sigma {sigma} needs {local} bytes of local memory, more than this device has")
        args = [
            padded(image, pitch),
            gaussian.half_taps(taps),
            *extent,
            np.int32(radius),
            np.int32(segment),
            Local(local),
        ]
        out = run_pass(device, "blur", "blur_fir", args, shape, (-(-pitch // segment), -(-height // 8)), (1, 1))
        return out[:, :width].astype(np.float64)
    sections = gaussian.iir_sections(sigma)
    args = [padded(image, pitch), sections, *extent]
    rows = run_pass(device, "blur", "blur_iir_rows", args, shape, (-(-height // (device.lanes // 4)),))
    args = [padded(rows[:, :width], pitch), sections, *extent]
    out = run_pass(device, "blur", "blur_iir_columns", args, shape, (-(-width // (device.lanes // 4)),))
    return out[:, :width].astype(np.float64)


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("sigma", SIGMAS)
def test_a_gaussian_engine(device: Device, engine: str, sigma: float) -> None:
    """Against the sampled Gaussian in float64: noise, an edge and a lamp of 1e6; energy, symmetry, edges, signs."""

    def check(invariant: str, value: float, bound: float) -> None:
        record(
            "filters", f"{engine}, sigma 0.05..500", invariant, f"blur {engine}", driver_of(device.info), value, bound
        )

    width, height = 113, 79
    rng = np.random.default_rng(0)
    exact = oracle.exact_taps(sigma)
    noise = rng.random((height, width, 4), np.float32)
    out = blurred(device, engine, noise, sigma)
    assert np.isfinite(out).all()
    # FIR taps end at 3 sigma; the exponentials are fitted to 2e-6.
    bound = {"fir": 2e-3, "iir": 1e-5}[engine]
    check("off from the exact Gaussian", np.abs(out[..., :1] - oracle.blur(noise[..., :1], exact)).max(), bound)
    edge = np.zeros((height, width, 4), np.float32)
    edge[:, width // 2 :] = 1.0
    off = np.abs(blurred(device, engine, edge, sigma)[..., :1] - oracle.blur(edge[..., :1], exact)).max()
    check("edge off from the exact Gaussian", off, bound)
    mirrored = blurred(device, engine, np.ascontiguousarray(noise[::-1, ::-1]), sigma)
    check("asymmetry", np.abs(mirrored[::-1, ::-1] - out).max(), 5e-6)
    turned = blurred(device, engine, np.ascontiguousarray(noise.swapaxes(0, 1)), sigma)
    check("rows against columns", np.abs(turned.swapaxes(0, 1) - out).max(), 5e-6)
    constant = blurred(device, engine, np.full((height, width, 4), 1e6, np.float32), sigma)
    check("constant off by, share", np.abs(constant / 1e6 - 1.0).max(), 1e-5)
    lamp = np.zeros((height, width, 4), np.float32)
    lamp[height // 2, width // 2] = 1e6
    out = blurred(device, engine, lamp, sigma) / 1e6
    check("negative light / peak", max(0.0, -out.min()) / out.max(), 0.0)
    if sigma <= 10.0:
        check("lamp's energy off by, share", np.abs(out.sum(axis=(0, 1)) - 1.0).max(), 5e-3)
    expected = oracle.blur(lamp[..., :1], exact)[..., 0] / 1e6
    ring = np.abs(out[..., 0] - expected).max() / expected.max()
    # What is left at the cut of FIR taps is exp(-4.5) of the peak.
    check("lamp off from the Gaussian / peak", ring, {"fir": 2e-2, "iir": 2e-5}[engine])
    column = out[:, width // 2, 0]
    check("light rises outwards / peak", max(0.0, np.diff(column[height // 2 :]).max()) / out.max(), 1e-5)


@pytest.mark.parametrize("sigma", [0.5, 2.0, 5.5])
def test_engines_are_the_same_filter(device: Device, sigma: float) -> None:
    image = np.random.default_rng(1).random((61, 83, 4), np.float32)
    difference = np.abs(blurred(device, "fir", image, sigma) - blurred(device, "iir", image, sigma)).max()
    record("filters", "FIR against IIR", "difference", "blur", driver_of(device.info), difference, 3e-3)


@pytest.mark.parametrize("size", [(1, 1), (37, 21), (61, 67), (129, 3)], ids=lambda size: f"{size[0]}x{size[1]}")
def test_pull_push_from_one_pixel(device: Device, size: tuple[int, int]) -> None:
    """One known pixel fills all levels of all sub-images, out to the margins, with its own colour and depth."""
    width, height = size
    color = np.zeros((height, width, 4), np.float32)
    depth = np.full((height, width), np.inf, np.float32)
    x, y = width // 3, height // 2
    color[y, x], depth[y, x] = (0.25, 1e6, 1e-6, 1.0), 0.7
    # The frame's image is opaque where anything is known to be: holes are unknown, not void.
    frame = LayeredFrame(color, depth, Camera(width, height, 40.0))
    method = Pyramid(hidden="interpolated")
    lens = Lens(60.0 / frame.camera.focal_px, 2.0)
    shape = FrameShape.of(frame)._replace(is_opaque=True)
    plan = method.plan(frame, lens)
    program = method.program(shape, plan, device.traits)
    end = max(n for n, step in enumerate(program.passes) if step.kernel == "pyramid_push") + 1
    table = program.buffers["table"].data
    inv = inverse_depth(device, frame)
    inv[:, :, :width][np.isinf(depth)[None]] = -1.0
    for name, expected in (("rgb_fill", color[y, x].astype(np.float64)), ("rgb_fill_inv", np.array([1.0 / 0.7]))):
        buffers = [
            dataclasses.replace(buffer, role=Role.OUTPUT) if buffer.name == name else buffer
            for buffer in program.buffers.values()
            if buffer.role is not Role.OUTPUT
        ]
        nbytes = program.buffers[name].nbytes
        inputs = {"color": frame.color, "inv_depth": inv}
        data = run_program(
            device, FrameProgram.of(buffers, program.passes[:end]), inputs, dict(plan.params), name, (nbytes // 4,)
        ).reshape(-1, len(expected))
        worst = 0.0
        for levels in table:
            for offset, w, h, pitch in levels[1:][levels[1:, 1] > 0]:
                level = data[offset : offset + pitch * h].reshape(h, pitch, -1)[:, :w]
                # A sub-image that culls the pixel has nothing, everywhere.
                if (level[..., 0] > 0).any():
                    worst = max(worst, float(np.abs(level / expected - 1.0).max()))
        driver = driver_of(device.info)
        record(
            "filters",
            "pull-push from one pixel",
            f"{name.removeprefix('rgb_')} off by, share",
            "pyramid",
            driver,
            worst,
            1e-6,
        )


@pytest.mark.parametrize(
    "size", [(1, 1), (3, 2), (17, 31), (129, 65), (63, 127)], ids=lambda size: f"{size[0]}x{size[1]}"
)
def test_deepest_levels_of_odd_sizes(device: Device, size: tuple[int, int]) -> None:
    """The light field's pyramid and the pyramid method at blurs wider than the frame: constants stay, means stay."""
    width, height = size
    image = np.full((height, width, 4), 3.0, np.float32)
    image[..., 3] = 1.0
    frame = LayeredFrame(image, np.full((height, width), 4.0, np.float32), Camera(width, height, 40.0))
    lens = Lens(3e3 / frame.camera.focal_px, 2.0)
    for name, method in (("lightfield", LightField(views=4)), ("pyramid", Pyramid())):
        plan = method.plan(frame, lens)
        program = method.program(FrameShape.of(frame), plan, device.traits)
        inputs = {"color": frame.color, "inv_depth": inverse_depth(device, frame)}
        out = run_program(device, program, inputs, dict(plan.params), "image", (height, width, 4))
        off = np.abs(out - image).max() / 3.0
        record(
            "filters", "deepest levels of odd sizes", "constant off by, share", name, driver_of(device.info), off, 1e-5
        )
