"""Run single passes from tests: arrays in, arrays out."""

from typing import Any

import numpy as np

from cldof import LayeredFrame, Lens
from cldof.host.device import Device
from cldof.host.passes import Access, Buffer, FrameProgram, Mode, Pass, Role, read, write
from cldof.host.scheduler import compile
from cldof.methods import FrameShape, Method
from cldof.planner import stats_params
from cldof.renderer import _preparation_program

__all__ = ["inverse_depth", "padded", "render_frame", "run_pass", "run_program"]


def run_program(
    device: Device,
    program: FrameProgram,
    inputs: dict[str, np.ndarray],
    params: dict[str, Any],
    output: str,
    shape: tuple,
) -> np.ndarray:
    """Compile, submit, wait and download one float32 output."""
    held = {name: device.pool.to_device(np.ascontiguousarray(array)) for name, array in inputs.items()}
    waits = [event for one in held.values() for event in one.waits]
    with compile(program, device) as batch:
        submission = batch.submit({name: one.buffer for name, one in held.items()}, params, waits)
        submission.wait()
        result = device.pool.to_host(batch.output(output), shape, np.float32)
    for one in held.values():
        device.pool.free_input(one)
    return result


def run_pass(
    device: Device,
    source: str,
    kernel: str,
    args: list[Any],
    shape: tuple[int, ...],
    global_size: tuple[int, ...],
    local_size: tuple[int, ...] | None = None,
    defines: tuple = (),
) -> np.ndarray:
    """Run one kernel whose first argument is the output, float32 of `shape`.

    Arrays among `args` become inputs, everything else is handed on.
    """
    out = Buffer("out", int(np.prod(shape)) * 4, Role.OUTPUT)
    inputs, buffers, arguments = {}, [out], [write("out")]
    for index, value in enumerate(args):
        if isinstance(value, np.ndarray):
            name = f"in{index}"
            inputs[name] = value
            buffers.append(Buffer(name, value.nbytes, Role.INPUT))
            arguments.append(read(name))
        else:
            assert not isinstance(value, Access) or value.mode is not Mode.WRITE
            arguments.append(value)
    one = Pass(source, kernel, tuple(arguments), global_size, local_size, defines)
    return run_program(device, FrameProgram.of(buffers, [one]), inputs, {}, "out", shape)


def padded(image: np.ndarray, pitch: int, fill: float = np.nan) -> np.ndarray:
    """Rows padded to a pitch; the padding is NaN unless told otherwise, so that reading it shows."""
    result = np.full((*image.shape[:1], pitch, *image.shape[2:]), fill, np.float32)
    result[:, : image.shape[1]] = image
    return result


def inverse_depth(device: Device, frame: LayeredFrame, with_stats: bool = False) -> np.ndarray:
    """What the renderer derives from a frame once; (layers, height, pitch)."""
    shape = FrameShape.of(frame)
    program = _preparation_program(shape, device.traits.is_cpu, with_stats)
    inputs = {"color": frame.color, "depth": frame.depth}
    params = dict(stats_params(frame)) if with_stats else {}
    size = (shape.layers, shape.height, shape.pitch)
    return run_program(device, program, inputs, params, "inv_depth", size)


def render_frame(device: Device, method: Method, frame: LayeredFrame, lens: Lens) -> np.ndarray:
    """A whole frame by a method, on a device whose buffers are checked."""
    shape = FrameShape.of(frame)
    plan = method.plan(frame, lens)
    program = method.program(shape, plan, device.traits)
    arrays = {"color": frame.color, "inv_depth": inverse_depth(device, frame), **frame.inputs}
    inputs = {name: arrays[name] for name, buffer in program.buffers.items() if buffer.role is Role.INPUT}
    return run_program(device, program, inputs, dict(plan.params), "image", (*shape.output_size, 4))
