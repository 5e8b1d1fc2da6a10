"""The layered method end to end: against its float64 twin, and what every method promises (DESIGN section 4)."""

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cldof import Camera, InputError, LayeredFrame, Lens
from cldof.host.device import Device
from cldof.host.passes import Local
from cldof.lens import GAUSSIAN_SIGMA
from cldof.methods import FrameShape, gaussian
from cldof.methods.layered import MAX_LAYERS, Layered, LayerStack, layer_coc, matting_functions
from tests.frames import noise_frame, plane_frame
from tests.oracles import layered as oracle
from tests.running import inverse_depth, render_frame, run_program
from tests.tolerances import assert_close


def render(device: Device, frame: LayeredFrame, lens: Lens, **options) -> np.ndarray:
    return render_frame(device, Layered(**options), frame, lens)


def twin(frame: LayeredFrame, lens: Lens, **options) -> np.ndarray:
    method = Layered(**options)
    stack = method.plan(frame, lens).structure
    c1, c0 = lens.coc_coefficients(frame.camera)
    layers = layer_coc(stack)
    sigma = (lambda k: stack.step_sigma(k)) if method.cascade else (lambda k: GAUSSIAN_SIGMA * abs(layers[k]))
    return oracle.render(
        frame.color,
        frame.depth,
        c1,
        c0,
        layers,
        stack.front,
        lambda k: gaussian.fir_taps(sigma(k)) if sigma(k) > 0 else np.ones(1),
        cascade=method.cascade,
        paper=method.matting == "paper",
        opaque=frame.is_opaque,
        guard=frame.guard_px,
    )


SIZES = [(1, 1), (1, 29), (31, 1), (37, 21), (131, 67), (64, 8)]


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("opaque", [True, False], ids=["opaque", "void"])
@pytest.mark.parametrize("cascade", [True, False], ids=["cascade", "single"])
def test_meets_the_oracle(device: Device, size: tuple[int, int], opaque: bool, cascade: bool) -> None:
    frame = noise_frame(*size, opaque=opaque, seed=size[0])
    lens = Lens(8.0 / frame.camera.focal_px, 1.7)
    options = {"cascade": cascade, "engine": "fir"}
    assert_close(render(device, frame, lens, **options), twin(frame, lens, **options), "layered")


@pytest.mark.parametrize("options", [{"matting": "paper"}, {"sigma_step": 0.4}, {"layers": 5}, {"layers": 3}])
def test_options_meet_the_oracle(device: Device, options: dict) -> None:
    frame = noise_frame(90, 70, guard_px=9)
    lens = Lens(10.0 / frame.camera.focal_px, 2.0)
    assert_close(render(device, frame, lens, engine="fir", **options), twin(frame, lens, **options), "layered")


@pytest.mark.parametrize("layers", [1, 2, 6])
def test_any_number_of_peels(device: Device, layers: int) -> None:
    frame = noise_frame(75, 44, layers)
    lens = Lens(6.0 / frame.camera.focal_px, 1.5)
    assert_close(render(device, frame, lens, engine="fir"), twin(frame, lens), "layered")


@pytest.mark.parametrize("focus", [0.7, math.inf], ids=["all behind focus", "all in front"])
def test_one_sided_frames(device: Device, focus: float) -> None:
    frame = noise_frame(75, 44)
    lens = Lens(5.0 / frame.camera.focal_px, focus)
    assert_close(render(device, frame, lens, engine="fir"), twin(frame, lens), "layered")


@pytest.mark.parametrize("cascade", [True, False])
def test_engines_agree(device: Device, cascade: bool) -> None:
    frame = noise_frame(130, 90)
    lens = Lens(14.0 / frame.camera.focal_px, 1.7)
    images = [render(device, frame, lens, engine=engine, cascade=cascade) for engine in ("fir", "iir", "auto")]
    # FIR taps end at 3 sigma, which takes 1.4e-3 off a step edge at each of up to seven steps.
    assert np.abs(images[0] - images[1]).max() < 1e-2
    assert np.abs(images[0] - images[1]).mean() < 1e-3
    assert np.abs(images[2] - images[1]).max() < 1e-2


def test_aperture_zero_is_the_pinhole_image(device: Device) -> None:
    image = np.random.default_rng(4).random((47, 61, 4), np.float32)
    image[..., 3] = 1.0
    np.testing.assert_array_equal(render(device, plane_frame(image, 3.0), Lens(0.0, 2.0)), image)
    for opaque in (True, False):  # glass is composed in another order
        frame = noise_frame(61, 47, opaque=opaque, guard_px=3)
        np.testing.assert_allclose(render(device, frame, Lens(0.0, 2.0)), frame.pinhole_image(), atol=1e-6)


@pytest.mark.parametrize("depth", [0.3, 1.0, 1.99, 2.01, 7.0, math.inf])
@pytest.mark.parametrize("cascade", [True, False])
def test_a_constant_stays_constant(device: Device, depth: float, cascade: bool) -> None:
    image = np.broadcast_to(np.float32((0.2, 3.0, 0.7, 1.0)), (40, 70, 4))
    frame = plane_frame(image, depth)
    out = render(device, frame, Lens(20.0 / frame.camera.focal_px, 2.0), cascade=cascade)
    np.testing.assert_allclose(out, image, rtol=1e-5)


@pytest.mark.parametrize("is_cpu", [True, False])
def test_little_local_memory_takes_shorter_segments(device: Device, is_cpu: bool) -> None:
    """The same bits on a device with 16 or 32 KiB as with all there is, on an image wider than the segments."""
    frame = noise_frame(300, 20, 3)
    shape, method = FrameShape.of(frame), Layered()
    plan = method.plan(frame, Lens(6.0 / frame.camera.focal_px, 2.0))
    inputs = {"color": frame.color, "inv_depth": inverse_depth(device, frame)}
    images = []
    for local_bytes in (device.traits.local_mem_bytes, 1 << 15, 1 << 14):
        traits = dataclasses.replace(device.traits, local_mem_bytes=local_bytes, is_cpu=is_cpu)
        program = method.program(shape, plan, traits)
        asked = [sum(one.nbytes for one in step.args if isinstance(one, Local)) for step in program.passes]
        assert max(asked) <= local_bytes
        images.append(run_program(device, program, inputs, dict(plan.params), "image", (20, 300, 4)))
    np.testing.assert_array_equal(images[0], images[1])
    if not is_cpu:  # a CPU's rows leave so little room there that wider blurs become recursive
        np.testing.assert_array_equal(images[0], images[2])


def test_the_plane_in_focus_stays(device: Device) -> None:
    image = np.random.default_rng(0).random((33, 81, 4), np.float32)
    image[..., 3] = 1.0
    frame = plane_frame(image, 2.0)
    out = render(device, frame, Lens(50.0 / frame.camera.focal_px, 2.0))
    np.testing.assert_array_equal(out, image)


def test_the_plane_in_focus_stays_between_blurred_things(device: Device) -> None:
    """In focus on the left, far behind on the right: pixels that no blur reaches keep their value."""
    image = np.random.default_rng(1).random((40, 400, 4), np.float32)
    image[..., 3] = 1.0
    depth = np.full((40, 400), 2.0, np.float32)
    depth[:, 300:] = 9.0
    frame = LayeredFrame(image, depth, Camera(400, 40, 40.0))
    out = render(device, frame, Lens(8.0 / frame.camera.focal_px, 2.0))
    np.testing.assert_allclose(out[:, :200], image[:, :200], atol=1e-6)
    assert np.abs(out[:, 320:] - image[:, 320:]).max() > 0.1


@pytest.mark.parametrize("degrees", [0.0, 45.0, 85.0])
def test_an_opaque_plane_stays_opaque(device: Device, degrees: float) -> None:
    """A plane through focus crosses all layers; seams between them must not show as coverage lost before division."""
    camera = Camera(128, 96, 40.0)
    slope = math.tan(math.radians(degrees))
    y = (np.arange(96) + 0.5 - 48) / camera.focal_px
    inverse = np.clip((1.0 - slope * y) / 2.0, 0.02, 4.0)
    depth = np.broadcast_to(1.0 / inverse[:, None], (96, 128)).astype(np.float32)
    color = np.ones((96, 128, 4), np.float32)
    out = render(device, LayeredFrame(color, depth, camera), Lens(4.0 / camera.focal_px, 2.0))
    np.testing.assert_allclose(out, 1.0, atol=1e-5)


@pytest.mark.parametrize(("degrees", "darkest"), [(45.0, 0.998), (80.0, 0.99), (85.0, 0.98)])
def test_a_slope_lets_little_through_to_what_is_behind(device: Device, degrees: float, darkest: float) -> None:
    """White through focus before a black sky: where one blurred layer hands over to the next, a seam would be dark."""
    camera = Camera(128, 96, 40.0)
    y = (np.arange(96) + 0.5 - 48) / camera.focal_px
    inverse = np.clip((1.0 - math.tan(math.radians(degrees)) * y) / 2.0, 0.02, 4.0)
    depth = np.full((2, 96, 128), np.inf, np.float32)
    depth[0] = 1.0 / inverse[:, None]
    color = np.ones((2, 96, 128, 4), np.float32)
    color[1, ..., :3] = 0.0
    out = render(device, LayeredFrame(color, depth, camera), Lens(6.0 / camera.focal_px, 2.0))
    assert out[..., :3].min() > darkest


@pytest.mark.parametrize("depth", [1.2, 1.99, 2.0, 2.4, 9.0])
@pytest.mark.parametrize("alpha", [1 / 255, 0.15, 0.5, 0.9, 0.99])
@pytest.mark.parametrize("opaque", [True, False], ids=["wall", "void"])
def test_glass_lets_through_what_its_alpha_says(device: Device, depth: float, alpha: float, opaque: bool) -> None:
    """A pane that fills the view, wherever it is between the layers, before a wall or before nothing."""
    color = np.zeros((2, 24, 40, 4), np.float32)
    color[0] = np.float32((0.1, 0.5, 0.2, 1.0)) * np.float32(alpha)
    z = np.full((2, 24, 40), np.inf, np.float32)
    z[0] = depth
    if opaque:
        color[1], z[1] = (0.9, 0.3, 4.0, 1.0), 20.0
    frame = LayeredFrame(color, z, Camera(40, 24, 40.0))
    out = render(device, frame, Lens(14.0 / frame.camera.focal_px, 2.0))
    np.testing.assert_allclose(out, frame.pinhole_image(), atol=2e-5, rtol=2e-5)


def test_mirror_symmetry(device: Device) -> None:
    frame = noise_frame(128, 64, seed=5)
    mirrored = LayeredFrame(frame.color[:, ::-1, ::-1], frame.depth[:, ::-1, ::-1], frame.camera)
    lens = Lens(6.0 / frame.camera.focal_px, 1.7)
    straight, turned = render(device, frame, lens), render(device, mirrored, lens)
    np.testing.assert_allclose(turned[::-1, ::-1], straight, atol=2e-5)


def test_same_input_same_bits(device: Device) -> None:
    frame = noise_frame(100, 50, opaque=False)
    lens = Lens(12.0 / frame.camera.focal_px, 1.7)
    first = render(device, frame, lens)
    for _ in range(3):
        np.testing.assert_array_equal(render(device, frame, lens), first)


@pytest.mark.parametrize("depth", [1.2, 6.0], ids=["near", "far"])
@pytest.mark.parametrize("cascade", [True, False])
def test_a_point_keeps_its_energy_and_gets_the_right_width(device: Device, depth: float, cascade: bool) -> None:
    """A small light on black: its spread over x and y is the thin lens's CoC radius times GAUSSIAN_SIGMA."""
    image = np.zeros((121, 121, 4), np.float32)
    image[..., 3] = 1.0
    image[60, 60, :3] = 1e4
    frame = plane_frame(image, depth)
    lens = Lens(24.0 / frame.camera.focal_px, 2.0)
    light = render(device, frame, lens, sigma_step=0.5, cascade=cascade)[..., 0].astype(np.float64)
    assert light.sum() == pytest.approx(1e4, rel=1e-3)
    y, _ = np.mgrid[-60:61, -60:61]
    sigma = math.sqrt((light * y**2).sum() / light.sum())
    # Between two layers the blur is a mixture of theirs, whose variance lies between.
    expected = GAUSSIAN_SIGMA * abs(float(lens.coc_radius_px(frame.camera, depth)))
    assert sigma == pytest.approx(expected, rel=0.05)


@settings(max_examples=25)
@given(
    width=st.integers(1, 90),
    height=st.integers(1, 60),
    layers=st.integers(1, 4),
    seed=st.integers(0, 10**6),
    opaque=st.booleans(),
    aperture_px=st.floats(0.0, 60.0),
    focus=st.floats(0.2, 50.0),
)
def test_random_frames_keep_the_promises(
    device: Device, width: int, height: int, layers: int, seed: int, opaque: bool, aperture_px: float, focus: float
) -> None:
    frame = noise_frame(width, height, layers, seed=seed, opaque=opaque)
    out = render(device, frame, Lens(aperture_px / frame.camera.focal_px, focus))
    assert np.isfinite(out).all()
    assert out.min() >= -1e-3, "the recursive Gaussian has tails of -1.7e-4"
    assert out.max() <= 1.0 + 2e-3
    assert (out[..., 3] <= 1.0).all()
    if opaque:
        assert (out[..., 3] == 1.0).all()


def test_matting_weights_have_no_gap() -> None:
    """Whatever the CoC, some layer holds it fully; a gap would be a seam."""
    for kind in ("seamless", "paper"):
        coc = layer_coc(LayerStack(5, 4, 1.0))
        functions = matting_functions(coc, -30.0, 10.0, kind)
        w = np.linspace(0.0, 2.0, 20001)
        up = np.clip(w[:, None] * functions[:, 0] + functions[:, 1], 0, 1)
        down = np.clip(w[:, None] * functions[:, 2] + functions[:, 3], 0, 1)
        assert ((up * down).max(axis=1) == 1.0).all()


def test_layers_reach_the_coc_range() -> None:
    frame = noise_frame(40, 30)
    lens = Lens(11.0 / frame.camera.focal_px, 1.7)
    plan = Layered().plan(frame, lens)
    coc = layer_coc(plan.structure)
    assert coc[0] <= -plan.summary["largest_near_coc_px"] < coc[1]
    assert coc[-2] < plan.summary["largest_far_coc_px"] <= coc[-1]


def test_few_layers_take_larger_steps() -> None:
    frame = noise_frame(40, 30)
    lens = Lens(40.0 / frame.camera.focal_px, 1.7)
    few, many = (Layered(layers=n).plan(frame, lens).structure for n in (5, 20))
    assert few.total <= 5 < many.total <= 20
    assert few.sigma_step > many.sigma_step
    fixed = Layered(sigma_step=1.0).plan(frame, lens).structure
    assert fixed.sigma_step == 1.0


def test_an_enormous_aperture_is_planned_and_rendered(device: Device) -> None:
    frame = noise_frame(50, 40)
    lens = Lens(5000.0 / frame.camera.focal_px, 1.7)
    assert Layered().plan(frame, lens).structure.total <= MAX_LAYERS
    assert np.isfinite(render(device, frame, lens)).all()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"layers": 2}, "layers is 2"),
        ({"layers": 33}, "from 3 to 32"),
        ({"sigma_step": 0.0}, "sigma_step"),
        ({"matting": "soft"}, "choose one of seamless, paper"),
        ({"engine": "box"}, "choose one of auto, fir, iir"),
    ],
)
def test_bad_options_are_refused(options: dict, message: str) -> None:
    with pytest.raises(InputError, match=message):
        Layered(**options)
