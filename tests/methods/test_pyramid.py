"""The pyramid method end to end: against its float64 twin, and what it promises beyond test_promises.py."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cldof import Camera, InputError, LayeredFrame, Lens
from cldof.host.device import Device
from cldof.methods.pyramid import MAX_STEPS, Pyramid, SubImages, blur_radius
from cldof.metrics import psnr
from tests.frames import noise_frame, plane_frame
from tests.oracles import pyramid as oracle
from tests.references import judged
from tests.running import render_frame
from tests.tolerances import assert_close

PAPER = {"matting": "paper", "radius": "paper", "hidden": "interpolated", "normalise": False}


def render(device: Device, frame: LayeredFrame, lens: Lens, **options) -> np.ndarray:
    return render_frame(device, Pyramid(**options), frame, lens)


def rule_last(method: Pyramid, frame: LayeredFrame, lens: Lens) -> int:
    """imax: r(imax - 2) < r(z -> inf) < r(imax - 1)."""
    if method.sub_images is not None:
        return method.sub_images[1]
    chosen = method.plan(frame, lens).structure
    if method.matting == "seamless":
        return chosen.last
    last = 0
    factor = method.perceived_blur if method.radius == "paper" else None
    while oracle.radius(last - 1, factor) <= lens.coc_coefficients(frame.camera).c0 / 2.0:
        last += 1
    return last


def twin(frame: LayeredFrame, lens: Lens, **options) -> np.ndarray:
    method = Pyramid(**options)
    chosen = method.plan(frame, lens).structure
    c1, c0 = lens.coc_coefficients(frame.camera)
    mattings = oracle.mattings(
        chosen.first,
        chosen.last,
        rule_last(method, frame, lens),
        c1,
        c0,
        paper=method.matting == "paper",
        perceived_blur=method.perceived_blur if method.radius == "paper" else None,
    )
    inverse = 1.0 / frame.depth.astype(np.float64)
    if frame.is_opaque:
        inverse[np.isinf(frame.depth) & (frame.color[..., 3] == 0)] = oracle.EMPTY
    return oracle.render(
        frame.color.astype(np.float64),
        inverse,
        mattings,
        sources=frame.layer_count if method.hidden == "peels" else 1,
        opaque=frame.is_opaque,
        divide=method.normalise,
        guard=frame.guard_px,
    )


SIZES = [(1, 1), (1, 29), (31, 1), (37, 21), (131, 67), (64, 8)]


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("opaque", [True, False], ids=["opaque", "void"])
@pytest.mark.parametrize("options", [{}, PAPER], ids=["default", "paper"])
def test_meets_the_oracle(device: Device, size: tuple[int, int], opaque: bool, options: dict) -> None:
    frame = noise_frame(*size, opaque=opaque, seed=size[0])
    lens = Lens(8.0 / frame.camera.focal_px, 1.7)
    assert_close(render(device, frame, lens, **options), twin(frame, lens, **options), "pyramid")


@pytest.mark.parametrize(
    "options",
    [
        {"sub_images": (-1, 2)},
        {"sub_images": (-5, 5)},
        {"sub_images": (-1, 1), **PAPER},
        {"sub_images": (-3, 6), **PAPER},
        {"radius": "paper", "perceived_blur": 1.3},
        {"matting": "paper"},
        {"hidden": "interpolated"},
        {"normalise": False},
    ],
    ids=str,
)
def test_options_meet_the_oracle(device: Device, options: dict) -> None:
    frame = noise_frame(90, 70, guard_px=9)
    lens = Lens(14.0 / frame.camera.focal_px, 2.0)
    assert_close(render(device, frame, lens, **options), twin(frame, lens, **options), "pyramid")


@pytest.mark.parametrize("layers", [1, 2, 6])
def test_any_number_of_peels(device: Device, layers: int) -> None:
    frame = noise_frame(75, 44, layers)
    lens = Lens(6.0 / frame.camera.focal_px, 1.5)
    assert_close(render(device, frame, lens), twin(frame, lens), "pyramid")


@pytest.mark.parametrize("focus", [0.7, math.inf], ids=["all behind focus", "all in front"])
@pytest.mark.parametrize("options", [{}, PAPER], ids=["default", "paper"])
def test_one_sided_frames(device: Device, focus: float, options: dict) -> None:
    frame = noise_frame(75, 44)
    lens = Lens(5.0 / frame.camera.focal_px, focus)
    assert_close(render(device, frame, lens, **options), twin(frame, lens, **options), "pyramid")


def constant(depth: float, height: int = 40, width: int = 70) -> LayeredFrame:
    return plane_frame(np.broadcast_to(np.float32((0.2, 3.0, 0.7, 1.0)), (height, width, 4)), depth)


@pytest.mark.parametrize("depth", [0.3, 1.0, 1.99, 2.0, 2.01, 7.0, math.inf])
@pytest.mark.parametrize("options", [{}, PAPER], ids=["default", "paper"])
def test_a_constant_stays_constant(device: Device, depth: float, options: dict) -> None:
    """Without division too: wherever a plane is parallel to the image some sub-image holds all of it."""
    frame = constant(depth)
    out = render(device, frame, Lens(20.0 / frame.camera.focal_px, 2.0), **options)
    np.testing.assert_allclose(out, np.broadcast_to(np.float32((0.2, 3.0, 0.7, 1.0)), out.shape), rtol=1e-6)


@pytest.mark.parametrize("options", [{}, PAPER], ids=["default", "paper"])
def test_aperture_zero_is_the_pinhole_image(device: Device, options: dict) -> None:
    for opaque in (True, False):
        frame = noise_frame(61, 47, opaque=opaque, guard_px=3)
        np.testing.assert_allclose(render(device, frame, Lens(0.0, 2.0), **options), frame.pinhole_image(), atol=1e-6)


@pytest.mark.parametrize("options", [{}, PAPER], ids=["default", "paper"])
def test_the_plane_in_focus_stays(device: Device, options: dict) -> None:
    image = np.random.default_rng(0).random((33, 81, 4), np.float32)
    image[..., 3] = 1.0
    frame = plane_frame(image, 2.0)
    out = render(device, frame, Lens(50.0 / frame.camera.focal_px, 2.0), **options)
    np.testing.assert_allclose(out, image, atol=1e-6)


def test_the_plane_in_focus_stays_beside_blurred_things(device: Device) -> None:
    """In focus on the left, far behind on the right: pixels that no blur reaches keep their value."""
    image = np.random.default_rng(1).random((40, 400, 4), np.float32)
    image[..., 3] = 1.0
    depth = np.full((40, 400), 2.0, np.float32)
    depth[:, 300:] = 9.0
    frame = LayeredFrame(image, depth, Camera(400, 40, 40.0))
    out = render(device, frame, Lens(8.0 / frame.camera.focal_px, 2.0))
    np.testing.assert_allclose(out[:, :300], image[:, :300], atol=1e-6)
    assert np.abs(out[:, 320:] - image[:, 320:]).max() > 0.1


def tilted_plane(degrees: float, width: int = 128, height: int = 96) -> LayeredFrame:
    """A white plane through focus at 2 m."""
    camera = Camera(width, height, 40.0)
    y = (np.arange(height) + 0.5 - height / 2) / camera.focal_px
    inverse = np.clip((1.0 - math.tan(math.radians(degrees)) * y) / 2.0, 0.02, 4.0)
    depth = np.broadcast_to(1.0 / inverse[:, None], (height, width)).astype(np.float32)
    return LayeredFrame(np.ones((height, width, 4), np.float32), depth, camera)


@pytest.mark.parametrize("degrees", [0.0, 45.0, 85.0])
@pytest.mark.parametrize("coc_px", [2.0, 4.0, 12.0])
@pytest.mark.parametrize("options", [{}, {**PAPER, "normalise": True}], ids=["default", "paper"])
def test_opaque_in_opaque_out(device: Device, degrees: float, coc_px: float, options: dict) -> None:
    frame = tilted_plane(degrees)
    out = render(device, frame, Lens(coc_px / frame.camera.focal_px, 2.0), **options)
    np.testing.assert_allclose(out, 1.0, atol=1e-5)


@pytest.mark.parametrize("degrees", [0.0, 45.0])
@pytest.mark.parametrize("options", [{}, PAPER], ids=["default", "paper"])
def test_matting_leaves_no_seams_on_gentle_slopes(device: Device, degrees: float, options: dict) -> None:
    """Coverage before any division: three overlapping sub-images hide their seams."""
    frame = tilted_plane(degrees)
    out = render(device, frame, Lens(4.0 / frame.camera.focal_px, 2.0), **{**options, "normalise": False})
    np.testing.assert_allclose(out[..., 3], 1.0, atol=1e-3)


@pytest.mark.parametrize("i", [-5, -4, -3, -2, -1, 1, 2, 3, 4, 5])
@pytest.mark.parametrize("options", [{}, PAPER], ids=["default", "paper"])
def test_a_point_at_z_i_is_blurred_by_r_i(device: Device, i: int, options: dict) -> None:
    """Energy kept, and within 10 % the spread of eq. 13, which is twice eq. 12; the mean over places in the pyramid."""
    method = Pyramid(**options)
    sigma = abs(oracle.radius(i, 2.0 if method.radius == "paper" else None))
    unit = 2 ** abs(i)
    side = 2 * math.ceil(5 * sigma) + 41
    fits = []
    for shift in range(0, unit, max(1, unit // 4)):
        image = np.zeros((side, side, 4), np.float32)
        image[..., 3] = 1.0
        at = side // 2 + shift - unit // 2
        image[at, side // 2, :3] = 1e4
        frame = plane_frame(image, 1.0 if i < 0 else 4.0)
        # |C| = sigma / GAUSSIAN_SIGMA at 1 or 4 m, focus at 2 m
        lens = Lens(2.0 * sigma / frame.camera.focal_px / (0.5 if i < 0 else 0.25), 2.0)
        light = render(device, frame, lens, **options)[..., 0].astype(np.float64)
        # The unknown beyond the edges is filled from inside, also with a little of the point's light.
        assert light.sum() == pytest.approx(1e4, rel=2e-2)
        fits.append(oracle.gaussian_fit(light.sum(axis=1), at))
    assert np.mean(fits) == pytest.approx(sigma, rel=0.1)


def test_a_blurred_silhouette_is_not_dark(device: Device) -> None:
    """White before white: whatever the depths, the result is white where the paper's matting needs no division."""
    depth = np.full((96, 128), 6.0, np.float32)
    depth[30:60, 40:90] = 1.1
    frame = LayeredFrame(np.ones((96, 128, 4), np.float32), depth, Camera(128, 96, 40.0))
    lens = Lens(9.0 / frame.camera.focal_px, 2.0)
    np.testing.assert_allclose(render(device, frame, lens), 1.0, atol=1e-5)
    assert render(device, frame, lens, **PAPER)[..., :3].min() > 0.999


def test_mirror_symmetry(device: Device) -> None:
    """Sizes at which the pyramids' grids are symmetric."""
    frame = noise_frame(128, 64, seed=5)
    mirrored = LayeredFrame(frame.color[:, ::-1, ::-1], frame.depth[:, ::-1, ::-1], frame.camera)
    lens = Lens(6.0 / frame.camera.focal_px, 1.7)
    straight, turned = render(device, frame, lens), render(device, mirrored, lens)
    # A seamless ramp may be as narrow as a thousandth of an interval.
    assert np.quantile(np.abs(turned[::-1, ::-1] - straight), 0.999) < 2e-5


def test_brightness_of_lamps_is_kept(device: Device) -> None:
    image = np.full((90, 90, 4), 0.1, np.float32)
    image[..., 3] = 1.0
    image[40:44, 50:54, :3] = 1e6
    frame = plane_frame(image, 5.0)
    out = render(device, frame, Lens(14.0 / frame.camera.focal_px, 2.0))
    assert np.isfinite(out).all()
    assert out[..., 0].sum(dtype=np.float64) == pytest.approx(image[..., 0].sum(dtype=np.float64), rel=1e-3)


def test_peels_show_what_interpolation_guesses(device: Device) -> None:
    """A near post before a wall whose hidden part is red: only peels know."""
    color = np.ones((2, 60, 120, 4), np.float32)
    color[:, :, 50:70, 1:3] = 0.0  # what the post hides, and the post
    color[0, :, 50:70] = (0.0, 0.0, 1.0, 1.0)
    depth = np.full((2, 60, 120), 2.0, np.float32)
    depth[0, :, 50:70] = 1.0
    depth[1, :, :50] = depth[1, :, 70:] = np.inf
    color[1, :, :50] = color[1, :, 70:] = 0.0
    frame = LayeredFrame(color, depth, Camera(120, 60, 40.0))
    lens = Lens(9.0 / frame.camera.focal_px, 2.0)
    red = [render(device, frame, lens, hidden=hidden)[30, 52] for hidden in ("peels", "interpolated")]
    assert red[0][1] + 0.02 < red[1][1]  # green: the white around the post, drawn under it


@settings(max_examples=25)
@given(
    width=st.integers(1, 90),
    height=st.integers(1, 60),
    layers=st.integers(1, 4),
    seed=st.integers(0, 10**6),
    opaque=st.booleans(),
    paper=st.booleans(),
    aperture_px=st.floats(0.0, 60.0),
    focus=st.one_of(st.floats(0.2, 50.0), st.just(math.inf)),
)
def test_random_frames_keep_the_promises(
    device: Device,
    width: int,
    height: int,
    layers: int,
    seed: int,
    opaque: bool,
    paper: bool,
    aperture_px: float,
    focus: float,
) -> None:
    frame = noise_frame(width, height, layers, seed=seed, opaque=opaque)
    options = {**PAPER, "normalise": True} if paper else {}
    out = render(device, frame, Lens(aperture_px / frame.camera.focal_px, focus), **options)
    assert np.isfinite(out).all()
    assert out.min() >= 0.0
    assert out.max() <= 1.0 + 1e-5
    assert (out[..., 3] <= 1.0).all()
    if opaque:
        assert (out[..., 3] == 1.0).all()


def test_sub_images_follow_the_rule() -> None:
    """r(imax - 2) < r(z -> inf) < r(imax - 1), and the nearest depth is in the first."""
    frame = constant(math.inf)
    method = Pyramid(**PAPER)
    for blur_px in (0.5, 1.6, 3.0, 20.0, 100.0):
        lens = Lens(2.0 * blur_px / frame.camera.focal_px * 3.0, 3.0)
        last = method.plan(frame, lens).structure.last
        # On a small frame the number of steps is held down.
        if last < math.ceil(math.log2(frame.width)):
            assert oracle.radius(last - 2, 2.0) < blur_px < oracle.radius(last - 1, 2.0)
    near = constant(0.9)
    lens = Lens(20.0 / near.camera.focal_px, 2.0)
    chosen = Pyramid().plan(near, lens)
    sigma = chosen.summary["largest_near_sigma_px"]
    assert blur_radius(-chosen.structure.first - 1) < sigma <= blur_radius(-chosen.structure.first)


def test_a_fixed_range_is_kept() -> None:
    frame = noise_frame(40, 30)
    for coc_px in (1.0, 9.0, 80.0):
        plan = Pyramid(sub_images=(-3, 2)).plan(frame, Lens(coc_px / frame.camera.focal_px, 1.7))
        assert plan.structure == SubImages(-3, 2)


def test_an_enormous_aperture_is_planned_and_rendered(device: Device) -> None:
    frame = noise_frame(50, 40)
    lens = Lens(5000.0 / frame.camera.focal_px, 1.7)
    assert Pyramid().plan(frame, lens).structure.first >= -MAX_STEPS
    assert np.isfinite(render(device, frame, lens)).all()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"sub_images": (1, 3)}, "sub_images is"),
        ({"sub_images": (-10, 3)}, "from -9 to 0"),
        ({"sub_images": 4}, "sub_images is 4"),
        ({"sub_images": (-1.5, 2)}, "sub_images"),
        ({"perceived_blur": 0.0}, "perceived_blur"),
        ({"matting": "soft"}, "choose one of seamless, paper"),
        ({"radius": "eq13"}, "choose one of fitted, paper"),
        ({"hidden": "guessed"}, "choose one of peels, interpolated"),
    ],
)
def test_bad_options_are_refused(options: dict, message: str) -> None:
    with pytest.raises(InputError, match=message):
        Pyramid(**options)


@pytest.mark.parametrize("name", ["row", "tabletop", "glass", "plane"])
def test_scenes_are_close_to_their_reference(device: Device, name: str) -> None:
    """At least 27 dB against a Gaussian lens; docs/methods/pyramid.md has the table at 512x512."""
    scene = judged(name, "gaussian")
    frame = scene.with_peels(4)
    reached = psnr(render(device, frame, scene.lens), scene.reference)
    without = psnr(frame.pinhole_image(), scene.reference)
    assert reached >= 27.0
    assert reached >= without + 4.0
