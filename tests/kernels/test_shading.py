"""What surfaces mirror, on every device, against the float64 twin."""

from dataclasses import replace

import numpy as np
import pytest

from cldof import Environment, LayeredFrame, Lighting, PointLight
from cldof.host.device import Device
from cldof.host.passes import Buffer, FrameProgram, Role
from cldof.methods.base import FrameShape
from cldof.methods.shading import split_pass
from tests.oracles import shading as oracle
from tests.running import inverse_depth, run_program
from tests.shaded import LIGHTS, environment, mirrored_by, shaded_frame
from tests.tolerances import assert_close

SUNS_ONLY = Lighting(LIGHTS.lights[:1])
AROUND = replace(LIGHTS, environment=environment())


def matte_of(device: Device, frame: LayeredFrame, output: str = "matte") -> np.ndarray:
    shape = FrameShape.of(frame)
    one, made = split_pass(shape, device.traits)
    buffers = [Buffer(name, frame.inputs[name].nbytes, Role.INPUT) for name in frame.inputs if name != "albedo"]
    buffers += [Buffer("color", frame.color.nbytes, Role.INPUT)]
    buffers += [Buffer("inv_depth", shape.layers * shape.height * shape.pitch * 4, Role.INPUT)]
    buffers += [replace(buffer, role=Role.OUTPUT) for buffer in made]
    inputs = {**frame.inputs, "color": frame.color, "inv_depth": inverse_depth(device, frame)}
    sizes = {
        "matte": frame.color.shape,
        "surface": (shape.layers, 7, shape.height, shape.pitch),
    }
    return run_program(device, FrameProgram.of(buffers, [one]), inputs, {}, output, sizes[output])


@pytest.mark.parametrize("lighting", [LIGHTS, SUNS_ONLY, AROUND], ids=["lights", "sun", "environment"])
@pytest.mark.parametrize("size", [(1, 1), (37, 21), (64, 9)])
def test_mirrored_light_meets_the_oracle(device: Device, lighting: Lighting, size: tuple[int, int]) -> None:
    frame = shaded_frame(*size, lighting, seed=size[0])
    mirrored = frame.color[..., 3:] * mirrored_by(frame, (0.0, 0.0))
    found = frame.color.astype(np.float64) - matte_of(device, frame)
    assert_close(found[..., :3], mirrored, "shading_split")
    assert (found[..., 3] == 0.0).all()


def test_surfaces_become_planes(device: Device) -> None:
    frame = shaded_frame(37, 21)
    planes = matte_of(device, frame, "surface")
    surface = frame.surface
    np.testing.assert_allclose(np.moveaxis(planes[:, :3, :, :37], 1, -1), surface["normal"], atol=1e-6)
    np.testing.assert_array_equal(np.moveaxis(planes[:, 3:6, :, :37], 1, -1), surface["specular"])
    rough = oracle.roughness(surface["shininess"].astype(np.float64))
    np.testing.assert_allclose(planes[:, 6, :, :37], rough, rtol=1e-6)
    assert (planes[:, 3:6, :, 37:] == 0.0).all()


def test_the_length_of_a_normal_does_not_matter(device: Device) -> None:
    """Captures interpolate normals, and callers may hand in any: planes hold unit ones, and light is the same."""
    frame = shaded_frame(37, 21)
    lengths = np.random.default_rng(3).uniform(0.25, 4.0, frame.depth.shape).astype(np.float32)
    surface = {name: frame.surface[name] for name in ("specular", "shininess", "albedo") if name in frame.surface}
    scaled = LayeredFrame(
        frame.color, frame.depth, frame.camera, normal=frame.surface["normal"] * lengths[..., None],
        lighting=frame.lighting, **surface,
    )  # fmt: skip
    planes = matte_of(device, scaled, "surface")[:, :3, :, :37]
    norms = np.linalg.norm(frame.surface["normal"], axis=-1)
    np.testing.assert_allclose(np.linalg.norm(planes, axis=1)[norms > 0], 1.0, atol=1e-6)
    np.testing.assert_allclose(matte_of(device, scaled), matte_of(device, frame), atol=5e-3)


def test_what_mirrors_nothing_keeps_its_bits(device: Device) -> None:
    frame = shaded_frame(37, 21)
    still = (frame.surface["specular"] == 0.0).all(-1)
    assert 0.1 < still.mean() < 0.9
    np.testing.assert_array_equal(matte_of(device, frame)[still], frame.color[still])


@pytest.mark.parametrize("shininess", [0.0, 1e8, 1e30])
def test_extreme_surfaces_are_finite(device: Device, shininess: float) -> None:
    """Any normal (none, tiny, edge-on, away), full reflectance, a light inside the surface and one at the eye."""
    frame = shaded_frame(32, 8)
    shape = frame.depth.shape
    normal = np.zeros((*shape, 3), np.float32)
    normal[..., 0] = np.linspace(-1.0, 1.0, shape[2])
    normal[..., 2] = np.array([0.0, 1.0, -1.0, 1e-3, 1e-30, 0.0, 0.0, 1.0])[None, :, None]
    eye, back = frame.camera.pose[:3, 3], frame.camera.pose[:3, 2]
    near = tuple((eye - frame.depth[0, 4, 16] * back).tolist())
    lights = (PointLight(tuple(eye.tolist()), (9.0, 9.0, 9.0)), PointLight(near, (9.0, 9.0, 9.0)))
    extreme = LayeredFrame(
        frame.color, frame.depth, frame.camera, normal=normal, specular=np.ones_like(normal),
        shininess=np.full(shape, shininess, np.float32), lighting=Lighting(lights, environment=environment(1)),
    )  # fmt: skip
    matte = matte_of(device, extreme)
    assert np.isfinite(matte).all() and (matte >= 0.0).all()


def test_a_constant_environment_is_the_same_from_everywhere() -> None:
    environment = Environment(np.full((4, 8, 3), 0.3, np.float32))
    assert np.ptp(environment.packed[:, :3]) < 1e-6


def test_octahedral_maps_show_the_picture() -> None:
    """A smooth function of direction, looked up in all directions, and what a matte surface makes of it."""
    height, width = 128, 256
    row, column = np.mgrid[:height, :width] + 0.5
    theta, phi = row / height * np.pi, (column / width - 0.5) * 2 * np.pi
    towards = np.stack([np.sin(theta) * np.sin(phi), np.cos(theta), -np.sin(theta) * np.cos(phi)], axis=-1)
    made = Environment((0.5 + 0.5 * towards).astype(np.float32))
    directions = np.random.default_rng(0).normal(size=(500, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    np.testing.assert_allclose(oracle.octahedral(made.levels[0], directions), 0.5 + 0.5 * directions, atol=3e-3)
    # The cosine lobe takes 2/3 of a linear function; 16 x 16 texels are coarse.
    np.testing.assert_allclose(oracle.octahedral(made.irradiance, directions), 0.5 + directions / 3.0, atol=0.03)
    contrast = [np.ptp(level[..., 1]) for level in made.levels]
    assert (np.diff(contrast) < 0.0).all()
