"""The light-field method end to end: its twin, its promises, and the paper's boundary cases."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cldof import Camera, InputError, LayeredFrame, Lens, Lighting
from cldof.host.device import Device
from cldof.lens import DiscAperture, PolygonAperture
from cldof.methods import FrameShape
from cldof.methods.lightfield import LightField, Views, _radical_inverse, lens_views
from cldof.metrics import psnr
from tests.frames import noise_frame, plane_frame
from tests.opengl import require_opengl
from tests.oracles import lightfield as oracle
from tests.oracles import shading as shading_oracle
from tests.running import render_frame
from tests.shaded import LIGHTS, environment, mirrored_by, shaded_frame
from tests.tolerances import assert_close

PAPER = {"peels": 1, "support": "2x2", "lookup": "winner", "dither": False, "pattern": "halton"}


def render(device: Device, frame: LayeredFrame, lens: Lens, **options) -> np.ndarray:
    return render_frame(device, LightField(**options), frame, lens)


def forms_of(device: Device) -> list[str]:
    """The warps that a device can do."""
    can = {"views": device.traits.has_long_loops, "atomic": True, "packed": device.traits.has_int64_atomics}
    return [form for form, does in can.items() if does]


def lens_for(frame: LayeredFrame, coc_px: float, focus_m: float = 2.0, **more) -> Lens:
    """CoC radius at infinity is ``coc_px / focus_m``."""
    return Lens(coc_px / frame.camera.focal_px, focus_m, **more)


def twin(frame: LayeredFrame, lens: Lens, **options) -> np.ndarray:
    method = LightField(**options)
    plan = method.plan(frame, lens)
    shape = FrameShape.of(frame)
    with np.errstate(divide="ignore"):
        inv_depth = np.float32(1.0) / frame.depth
    there = (inv_depth > 0) | (frame.color[..., 3] > 0)
    inv_depth = np.where(there, inv_depth, np.float32(-1.0 if frame.is_opaque else 0.0))
    count = method.peels or frame.layer_count
    return oracle.render(
        frame.color[:count],
        inv_depth[:count],
        lens_views(method, plan.structure),
        *lens.coc_coefficients(frame.camera),
        pitch=shape.pitch,
        guard=frame.guard_px,
        glass=frame.has_glass,
        void=not frame.is_opaque,
        support=method.support,
        lookup=method.lookup,
        cos4=float(plan.params["lens"]["cos4"]),
        **(shading(frame, lens, method.lookup) if plan.summary["eyes"] else {}),
    )


def shading(frame: LayeredFrame, lens: Lens, lookup: str) -> dict[str, Any]:
    """How the twin shades what rays hit: the winner's surface, where the ray meets it, normals between pixels of it."""
    assert frame.lighting is not None
    normals = frame.surface["normal"].astype(np.float64)
    with np.errstate(divide="ignore"):
        inv_depth = np.float32(1.0) / frame.depth
    cells = oracle.cells(inv_depth, frame.color[..., 3], *lens.coc_coefficients(frame.camera))
    cells &= lookup == "bilinear"
    focal, middle_x, middle_y = frame.inputs["lighting"][1, :3].astype(np.float64)
    right, up, back, centre = frame.camera.pose[:3].T

    def mirrored(hits: oracle.Hits, view: np.ndarray) -> np.ndarray:
        at = hits.m, hits.y, hits.x
        across = (hits.ray_x / 256 + 0.5 - middle_x) / focal
        above = (middle_y - hits.ray_y / 256 - 0.5) / focal
        ray = across[..., None] * right + above[..., None] * up - back
        where = centre + ray / np.maximum(hits.inv_depth, 1e-9)[..., None]
        eye = centre + lens.aperture_radius_m * (float(view[0]) * right - float(view[1]) * up)
        f0 = frame.surface["specular"][at].astype(np.float64)
        x, y = np.clip(hits.ray_x >> 8, 0, frame.width - 2), np.clip(hits.ray_y >> 8, 0, frame.height - 2)
        fx, fy = ((ray & 255)[..., None] / 256 for ray in (hits.ray_x, hits.ray_y))
        is_between = cells[hits.m, y, x] & (x == hits.ray_x >> 8) & (y == hits.ray_y >> 8)
        is_between &= np.isin(hits.x - x, (0, 1)) & np.isin(hits.y - y, (0, 1))
        above = normals[hits.m, y, x] * (1 - fx) + normals[hits.m, y, x + 1] * fx
        below = normals[hits.m, y + 1, x] * (1 - fx) + normals[hits.m, y + 1, x + 1] * fx
        normal = np.where(is_between[..., None], above * (1 - fy) + below * fy, normals[at])
        length = np.linalg.norm(normal, axis=-1, keepdims=True)
        normal = np.where(length > 1e-6, normal / np.maximum(length, 1e-6), 0.0)
        rough = shading_oracle.roughness(frame.surface["shininess"][at].astype(np.float64))
        return shading_oracle.specular(where, normal, f0, rough, eye, frame.lighting)

    matte = frame.color.astype(np.float64)
    matte[..., :3] = np.maximum(matte[..., :3] - matte[..., 3:] * mirrored_by(frame, (0.0, 0.0)), 0.0)
    return {"mirrored": mirrored, "matte": matte}


@pytest.mark.parametrize("size", [(1, 1), (1, 29), (31, 1), (37, 21), (67, 34)])
@pytest.mark.parametrize("opaque", [True, False], ids=["opaque", "void"])
def test_meets_the_twin(device: Device, size: tuple[int, int], opaque: bool) -> None:
    frame = noise_frame(*size, opaque=opaque, seed=size[0])
    options = {"views": 7, "mip": False}
    lens = lens_for(frame, 8.0, 1.7)
    assert_close(render(device, frame, lens, **options), twin(frame, lens, **options), "lightfield")


@pytest.mark.parametrize(
    "options",
    [
        {"support": "none"},
        {"support": "2x2", "lookup": "winner"},
        {"support": "3x3", "peels": 2},
        {"pattern": "halton", "dither": False},
        PAPER,
    ],
)
def test_options_meet_the_twin(device: Device, options: dict) -> None:
    frame = noise_frame(48, 40, guard_px=5)
    lens = lens_for(frame, 9.0)
    options = {"views": 5, "mip": False, **options}
    assert_close(render(device, frame, lens, **options), twin(frame, lens, **options), "lightfield")


def test_slanted_rays_are_weaker(device: Device) -> None:
    frame = noise_frame(48, 40, guard_px=5)
    radius_m = 9.0 / frame.camera.focal_px
    lens = Lens(radius_m, 2.0, focal_length_mm=radius_m * 1e3)  # f/0.5: cos^4 at the rim is 1/4
    options = {"views": 6, "mip": False}
    image = render(device, frame, lens, **options)
    assert_close(image, twin(frame, lens, **options), "lightfield")
    assert np.abs(image - render(device, frame, lens, cos4=False, **options)).max() > 1e-3
    flat = plane_frame(np.ones((20, 30, 4), np.float32), 1.3)
    np.testing.assert_allclose(render(device, flat, lens, **options), 1.0, rtol=1e-6)


@pytest.mark.parametrize("options", [{}, {"peels": 1}, {"lookup": "winner", "support": "2x2"}])
@pytest.mark.parametrize("around", [False, True], ids=["hemisphere", "environment"])
def test_views_are_shaded_from_their_own_points(device: Device, options: dict, around: bool) -> None:
    lighting = Lighting(LIGHTS.lights, LIGHTS.ambient, environment()) if around else LIGHTS
    frame = shaded_frame(48, 37, lighting, guard_px=4)
    lens = Lens(0.3, 2.0)
    options = {"views": 5, "mip": False, **options}
    image = render(device, frame, lens, **options)
    assert_close(image, twin(frame, lens, **options), "lightfield_shaded")
    assert np.abs(image - render(device, frame, lens, view_dependent=False, **options)).max() > 0.05


def test_batches_of_shaded_views_give_the_same_bits(device: Device) -> None:
    frame = shaded_frame(48, 37)
    first = render(device, frame, Lens(0.1, 2.0), views=10)
    for options in ({"memory_mb": 0.05}, {"warp": "atomic"}, {"cull": False}):
        np.testing.assert_array_equal(render(device, frame, Lens(0.1, 2.0), views=10, **options), first)


def test_only_what_is_glossy_pays_for_shading(device: Device) -> None:
    """Without lighting, with nothing that mirrors, through a pinhole or if told so: no pass and no bit is different."""
    glossy = shaded_frame(48, 37)
    matte = {**glossy.surface, "specular": np.zeros_like(glossy.surface["specular"])}
    plain = LayeredFrame(glossy.color, glossy.depth, glossy.camera)
    still = LayeredFrame(glossy.color, glossy.depth, glossy.camera, lighting=glossy.lighting, **matte)
    lens = Lens(0.1, 2.0)
    expected = render(device, plain, lens)
    np.testing.assert_array_equal(render(device, still, lens), expected)
    np.testing.assert_array_equal(render(device, glossy, lens, view_dependent=False), expected)
    np.testing.assert_array_equal(render(device, glossy, Lens(0.0, 2.0)), render(device, plain, Lens(0.0, 2.0)))

    def kernels(frame: LayeredFrame, lens: Lens, **options) -> set[str]:
        method = LightField(**options)
        program = method.program(FrameShape.of(frame), method.plan(frame, lens), device.traits)
        return {step.kernel for step in program.passes}

    assert "shading_split" in kernels(glossy, lens)
    for frame, radius, options in ((still, 0.1, {}), (glossy, 0.0, {}), (glossy, 0.1, {"view_dependent": False})):
        assert "shading_split" not in kernels(frame, Lens(radius, 2.0), **options)


def test_highlights_move_with_the_lens(device: Device) -> None:
    """A polished floor under lamps, against the reference that shades every view from its own point."""
    require_opengl()
    from cldof.capture.accumulate import accumulate
    from cldof.capture.peel import DepthPeeler
    from cldof.capture.scenes import builtin_scene

    scene = builtin_scene("floor")
    camera = scene.camera_for(144, 144)
    assert scene.aperture_radius_m is not None
    assert scene.focus_distance_m is not None
    lens = Lens(scene.aperture_radius_m, scene.focus_distance_m)
    with DepthPeeler(144, 144) as peeler:
        frame = peeler.peel(scene, camera, layers=3, lens=lens, guard_px=5, surface=True)
        reference = accumulate(peeler, scene, camera, lens, 64, "disc", noise_floor=False).image

    for peels, gain in ((None, 1.0), (1, 0.5)):
        shaded, still = (
            psnr(render(device, frame, lens, peels=peels, views=64, view_dependent=flag), reference)
            for flag in (True, False)
        )
        assert shaded > still + gain


@pytest.mark.parametrize("opaque", [True, False], ids=["opaque", "void"])
@pytest.mark.parametrize("lookup", ["bilinear", "winner", "jitter"])
@pytest.mark.parametrize("mip", [True, False])
def test_forms_batches_and_culling_give_the_same_bits(device: Device, opaque: bool, lookup: str, mip: bool) -> None:
    """One view a work-item, atomics, all views at once, three at a time, one at a time."""
    frame = noise_frame(75, 43, 3, opaque=opaque, guard_px=3)
    lens = lens_for(frame, 26.0)
    options = {"views": 10, "lookup": lookup, "mip": mip}
    first = render(device, frame, lens, **options)
    view_mb = 3 * 43 * 80 * 8 / 1e6
    forms = forms_of(device)
    for warp in forms:
        for memory in (1000.0, 3.5 * view_mb, 1e-6):
            other = render(device, frame, lens, warp=warp, memory_mb=memory, **options)
            np.testing.assert_array_equal(other, first)
    np.testing.assert_array_equal(render(device, frame, lens, cull=False, **options), first)


def wall_with_things() -> LayeredFrame:
    """Large things before a wall, so that much of the wall behind them can be culled."""
    rng = np.random.default_rng(8)
    depth = np.full((2, 160, 220), np.inf, np.float32)
    color = np.zeros((2, 160, 220, 4), np.float32)
    depth[0], color[0] = 6.0, rng.random((160, 220, 4))
    y, x = np.mgrid[:160, :220]
    for cy, cx, radius, z in ((70, 60, 55, 1.2), (90, 167, 48, 2.6)):
        inside = (y - cy) ** 2 + (x - cx) ** 2 < radius**2
        depth[1][inside], color[1][inside] = depth[0][inside], color[0][inside]
        depth[0][inside] = z + 1e-4 * (x - cx)[inside]
        color[0][inside] = rng.random((160, 220, 4))[inside]
    color[..., 3] = np.where(depth < np.inf, 1.0, 0.0)
    return LayeredFrame(color, depth, Camera(220, 160, 40.0))


@pytest.mark.parametrize("coc_px", [0.0, 3.0, 12.0, 60.0])
@pytest.mark.parametrize("focus", [1.2, 2.0, 6.0])
def test_culling_changes_nothing(device: Device, coc_px: float, focus: float) -> None:
    frame = wall_with_things()
    lens = lens_for(frame, coc_px, focus)
    whole = render(device, frame, lens, cull=False, views=12)
    np.testing.assert_array_equal(render(device, frame, lens, views=12), whole)


def test_aperture_zero_is_the_pinhole_image(device: Device) -> None:
    image = np.random.default_rng(4).random((47, 61, 4), np.float32)
    image[..., 3] = 1.0
    np.testing.assert_array_equal(render(device, plane_frame(image, 3.0), Lens(0.0, 2.0)), image)
    for opaque in (True, False):
        frame = noise_frame(61, 47, 6, opaque=opaque, guard_px=3, seed=3)
        out = render(device, frame, Lens(0.0, 2.0))
        assert frame.panes >= 3
        np.testing.assert_allclose(out, frame.pinhole_image(), atol=1e-6)


@pytest.mark.parametrize("depth", [0.3, 1.0, 1.99, 2.01, 7.0, math.inf])
@pytest.mark.parametrize("options", [{}, {"lookup": "jitter"}, {"views": 12, "mip": False}, PAPER])
def test_a_constant_stays_constant(device: Device, depth: float, options: dict) -> None:
    image = np.broadcast_to(np.float32((0.2, 1e6, 0.7, 1.0)), (40, 70, 4))
    frame = plane_frame(image, depth)
    np.testing.assert_allclose(render(device, frame, lens_for(frame, 40.0), **options), image, rtol=1e-5)


@pytest.mark.parametrize("options", [{}, {"support": "3x3"}, {"support": "2x2"}, {"lookup": "jitter"}, PAPER])
def test_the_plane_in_focus_stays(device: Device, options: dict) -> None:
    """To the last bit but for the mean over views; whatever is blurred far beside it."""
    image = np.random.default_rng(1).random((40, 300, 4), np.float32)
    image[..., 3] = 1.0
    depth = np.full((40, 300), 2.0, np.float32)
    depth[:, 200:] = 9.0
    frame = LayeredFrame(image, depth, Camera(300, 40, 40.0))
    out = render(device, frame, lens_for(frame, 16.0), **options)
    np.testing.assert_allclose(out[:, :180], image[:, :180], atol=1e-6)
    assert np.abs(out[:, 220:] - image[:, 220:]).max() > 0.1


@pytest.mark.parametrize("depth", [1.2, 2.0, 9.0])
@pytest.mark.parametrize("alpha", [1 / 255, 0.5, 0.99])
@pytest.mark.parametrize("opaque", [True, False], ids=["wall", "void"])
def test_glass_lets_through_what_its_alpha_says(device: Device, depth: float, alpha: float, opaque: bool) -> None:
    color = np.zeros((2, 30, 50, 4), np.float32)
    color[0] = np.float32((0.1, 0.5, 0.2, 1.0)) * np.float32(alpha)
    z = np.full((2, 30, 50), np.inf, np.float32)
    z[0] = depth
    if opaque:
        color[1], z[1] = (0.9, 0.3, 4.0, 1.0), 20.0
    frame = LayeredFrame(color, z, Camera(50, 30, 40.0))
    inner = slice(8, -8)  # farther out some rays leave the frame
    out = render(device, frame, lens_for(frame, 14.0))[inner, inner]
    np.testing.assert_allclose(out, frame.pinhole_image()[inner, inner], atol=2e-5, rtol=2e-5)


def test_two_panes_pass_in_front_of_each_other(device: Device) -> None:
    """Half the view each, at different depths before a wall: where both are, the light passes both."""
    color = np.zeros((3, 30, 90, 4), np.float32)
    z = np.full((3, 30, 90), np.inf, np.float32)
    near, far, wall = (np.float32(c) for c in ((0.5, 0, 0, 0.5), (0, 0.5, 0, 0.5), (0, 0, 1, 1)))
    color[0], z[0] = far, 3.0
    color[1], z[1] = wall, 6.0
    color[0, :, :45], z[0, :, :45] = near, 1.5
    color[1, :, :45], z[1, :, :45] = far, 3.0
    color[2, :, :45], z[2, :, :45] = wall, 6.0
    frame = LayeredFrame(color, z, Camera(90, 30, 40.0))
    out = render(device, frame, lens_for(frame, 24.0, 6.0), views=64)[15]
    share = out[:, 0] / 0.5  # of rays that pass the near pane
    assert share[20] == pytest.approx(1.0)
    assert share[80] == pytest.approx(0.0)
    assert 0.3 < share[45] < 0.7
    # Behind the near pane half of the far one's light, and all of it elsewhere.
    np.testing.assert_allclose(out[15:75, 1], 0.5 - 0.25 * share[15:75], atol=1e-5)
    np.testing.assert_allclose(out[15:75, 3], 1.0, atol=1e-6)


@pytest.mark.parametrize("blades", [3, 5])
def test_a_light_shows_the_aperture(device: Device, blades: int) -> None:
    """A far point shows the shape upright, one before focus shows it turned; the energy is kept."""
    aperture = PolygonAperture(blades=blades, rotation_deg=90.0)
    for depth, turned in ((math.inf, False), (1.0, True)):
        image = np.zeros((81, 81, 4), np.float32)
        image[..., 3] = 1.0
        image[40, 40, :3] = 1e4
        frame = plane_frame(image, depth)
        lens = lens_for(frame, 40.0, aperture=aperture)
        light = render(device, frame, lens, views=256)[..., 0].astype(np.float64)
        assert light.sum() == pytest.approx(1e4, rel=1e-4)
        # One corner points up: the light's third moment along y is positive upwards.
        y = 40 - np.arange(81)[:, None] * np.ones(81)
        skew = float((light * y**3).sum())
        assert (skew < 0) == turned or blades == 5
        rim = np.hypot(*(np.argwhere(light > 1.0) - 40).T).max()
        assert rim == pytest.approx(20.0, abs=2.0)


# Figure 7 of the paper: red in front on the left, a gradient of green and blue behind.
WIDTH, EDGE = 96, 48
RIM = 4  # pixels beside the edge that are looked at


def boundary(focus_on_back: bool, bright: float = 1.0) -> tuple[LayeredFrame, Lens, np.ndarray]:
    """The frame, the lens, and what 4096 rays through it see, (WIDTH, 3)."""
    x = (np.arange(WIDTH) + 0.5) / WIDTH
    color = np.zeros((2, 32, WIDTH, 4), np.float32)
    color[..., 3] = 1.0
    color[1, ..., 1], color[1, ..., 2] = x * bright, (1.0 - x) * bright
    color[0] = color[1]
    color[0, :, :EDGE] = (1, 0, 0, 1)
    color[1, :, EDGE:] = 0.0
    depth = np.full((2, 32, WIDTH), 2.0, np.float32)
    depth[0, :, :EDGE] = 1.0
    depth[1, :, EDGE:] = np.inf
    camera = Camera(WIDTH, 32, 40.0)
    lens = Lens(16.0 / camera.focal_px, 2.0 if focus_on_back else 1.0)
    front, back = (float(lens.coc_radius_px(camera, z)) for z in (1.0, 2.0))
    pixel = np.arange(WIDTH)
    truth = np.zeros((WIDTH, 3))
    for v in DiscAperture().samples(4096, 5)[:, 0]:
        u = np.clip((pixel - v * back + 0.5) / WIDTH, 0.5 / WIDTH, 1.0 - 0.5 / WIDTH)
        behind = np.stack([0.0 * u, u * bright, (1.0 - u) * bright], axis=1)
        truth += np.where((pixel - v * front < EDGE - 0.5)[:, None], [1.0, 0.0, 0.0], behind)
    return LayeredFrame(color, depth, camera), lens, truth / 4096


def boundary_errors(device: Device, focus_on_back: bool) -> dict[str, tuple[float, float]]:
    """Largest error on the front's side and on the back's side of the edge, for the paper's form and with all peels."""
    frame, lens, truth = boundary(focus_on_back)
    errors = {}
    for name, options in (("paper", PAPER), ("peeled", {})):
        error = np.abs(render(device, frame, lens, **options)[16, :, :3] - truth).max(axis=1)
        errors[name] = (float(error[EDGE - RIM : EDGE].max()), float(error[EDGE : EDGE + RIM].max()))
    return errors


def test_figure_7a_back_in_focus_seen_past_the_edge(device: Device) -> None:
    """The back beside the edge mixes with the blurred front. Both forms are right, to the noise of 36 views."""
    errors = boundary_errors(device, focus_on_back=True)
    assert errors["paper"][1] < 0.07
    assert errors["peeled"][1] < 0.035


def test_figure_7b_back_in_focus_seen_through_the_front(device: Device) -> None:
    """The front's rim lets the back through, which one view does not have: the paper's form keeps half of it out."""
    errors = boundary_errors(device, focus_on_back=True)
    assert 0.4 < errors["paper"][0] < 0.5
    assert errors["peeled"][0] < 0.035


def test_figure_7c_front_in_focus_beside_the_back(device: Device) -> None:
    """The back's blur reaches behind the front: the paper's form leaves it out, seen as far as colours differ."""
    errors = boundary_errors(device, focus_on_back=False)
    assert 0.015 < errors["paper"][1] < 0.035
    assert errors["peeled"][1] < 1e-3


def test_figure_7d_front_in_focus(device: Device) -> None:
    """The front stays as it is up to its last pixel. Both forms are right."""
    errors = boundary_errors(device, focus_on_back=False)
    assert errors["paper"][0] < 1e-6
    assert errors["peeled"][0] < 1e-6


@pytest.mark.parametrize("bright", [1.0, 100.0, 1e6])
@pytest.mark.parametrize("options", [{}, {"peels": 1}, {"lookup": "winner"}, {"lookup": "jitter"}, {"views": 12}])
def test_no_light_leaks(device: Device, bright: float, options: dict) -> None:
    """A front in focus before something bright: the back's energy is right to 0.5 %, and none of it is in front."""
    frame, lens, truth = boundary(False, bright)
    image = render(device, frame, lens, **options)[16, :, :3].astype(np.float64)
    assert (image[:EDGE, 1:] == 0.0).all()
    inner = slice(EDGE, WIDTH - 10)  # light from beyond the frame is unknown
    assert image[inner, 1:].sum() == pytest.approx(truth[inner, 1:].sum(), rel=5e-3)


def test_same_input_same_bits(device: Device) -> None:
    frame = noise_frame(100, 50, opaque=False)
    lens = lens_for(frame, 20.0)
    first = render(device, frame, lens)
    for warp in forms_of(device):
        for _ in range(3):
            np.testing.assert_array_equal(render(device, frame, lens, warp=warp), first)


@settings(max_examples=20)
@given(
    width=st.integers(1, 80),
    height=st.integers(1, 50),
    layers=st.integers(1, 4),
    seed=st.integers(0, 10**6),
    opaque=st.booleans(),
    guard=st.integers(0, 5),
    aperture_px=st.floats(0.0, 200.0),
    focus=st.floats(0.2, 50.0),
    support=st.sampled_from(["surface", "none", "2x2", "3x3"]),
    lookup=st.sampled_from(["bilinear", "winner", "jitter"]),
    warp=st.sampled_from(["views", "atomic"]),
)
def test_random_frames_keep_the_promises(
    device: Device, width: int, height: int, layers: int, seed: int, opaque: bool, guard: int, aperture_px: float,
    focus: float, support: str, lookup: str, warp: str,
) -> None:  # fmt: skip
    frame = noise_frame(width, height, layers, seed=seed, opaque=opaque, guard_px=guard)
    warp = warp if warp in forms_of(device) else "auto"
    options = {"support": support, "lookup": lookup, "warp": warp, "views": 9}
    out = render(device, frame, lens_for(frame, aperture_px, focus), **options)
    assert np.isfinite(out).all()
    assert out.min() >= 0.0
    assert out.max() <= 1.0 + 1e-5
    assert (out[..., 3] <= 1.0).all()
    if opaque:
        assert out[..., 3].min() >= 1.0 - 2e-3


def test_an_enormous_aperture_is_planned_and_rendered(device: Device) -> None:
    frame = noise_frame(50, 40)
    out = render(device, frame, lens_for(frame, 1e7))
    assert np.isfinite(out).all()
    assert out[..., 3].min() >= 1.0 - 2e-3


def test_memory_is_eight_bytes_a_pixel_and_view() -> None:
    """Four for each of the two words of a winner, on top of what the layers need; batches stay below the limit."""

    class Traits:
        is_cpu, compute_units, max_alloc_bytes, has_int64_atomics, name = True, 2, 1 << 40, False, ""
        has_long_loops = True

    frame = noise_frame(64, 48, 2)
    lens = lens_for(frame, 10.0)
    color = frame.color.copy()
    color[..., 3] = 1.0
    frame = LayeredFrame(color, frame.depth, frame.camera)
    shape = FrameShape.of(frame)

    def winners(**options) -> int:
        method = LightField(**options)
        return method.program(shape, method.plan(frame, lens), Traits()).buffers["winners"].nbytes  # type: ignore[arg-type]

    for views in (12, 36, 128):
        assert winners(views=views) == views * 64 * 48 * 8
    assert winners(views=36, memory_mb=0.1) == 4 * 64 * 48 * 8
    assert winners(views=36, memory_mb=1e-3) == 64 * 48 * 8


@pytest.mark.parametrize(
    ("is_cpu", "has_int64_atomics", "has_long_loops", "kernels"),
    [
        (True, True, True, {"lightfield_views"}),
        (True, False, True, {"lightfield_views"}),
        (True, False, False, {"lightfield_clear", "lightfield_depths", "lightfield_sources"}),
        (False, True, True, {"lightfield_clear", "lightfield_packed"}),
        (False, False, True, {"lightfield_clear", "lightfield_depths", "lightfield_sources"}),
    ],
)
def test_the_warp_follows_the_device(
    device: Device, is_cpu: bool, has_int64_atomics: bool, has_long_loops: bool, kernels: set
) -> None:
    frame = noise_frame(64, 48, 2)
    method = LightField()
    can = {"has_int64_atomics": has_int64_atomics, "has_long_loops": has_long_loops}
    traits = replace(device.traits, is_cpu=is_cpu, **can)
    program = method.program(FrameShape.of(frame), method.plan(frame, lens_for(frame, 10.0)), traits)
    warps = {"lightfield_views", "lightfield_clear", "lightfield_packed", "lightfield_depths", "lightfield_sources"}
    assert {step.kernel for step in program.passes} & warps == kernels


def test_halton_views() -> None:
    np.testing.assert_allclose(_radical_inverse(np.arange(1, 6), 2), [1 / 2, 1 / 4, 3 / 4, 1 / 8, 5 / 8])
    np.testing.assert_allclose(_radical_inverse(np.arange(1, 5), 3), [1 / 3, 2 / 3, 1 / 9, 4 / 9])
    for pattern in ("halton", "spiral"):
        points = lens_views(LightField(views=64, pattern=pattern), Views(64, DiscAperture(), 0))
        assert np.hypot(*points[:, :2].T).max() <= 1.0 + 1e-6
        np.testing.assert_allclose(points[:, :2].mean(axis=0), 0.0, atol=1e-6)
        assert np.abs(points[:, 2:]).max() <= 127
        assert (points[:, 2:] == np.round(points[:, 2:])).all()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"views": 0}, "views is 0"),
        ({"views": True}, "views is True"),
        ({"views": 4096}, "1 to 1024"),
        ({"peels": 0}, "peels is 0"),
        ({"support": "4x4"}, "choose one of none, 2x2, 3x3, surface"),
        ({"lookup": "nearest"}, "choose one of winner, bilinear, jitter"),
        ({"pattern": "grid"}, "choose one of spiral, halton"),
        ({"warp": "fast"}, "choose one of auto"),
        ({"memory_mb": 0}, "memory_mb is 0"),
    ],
)
def test_bad_options_are_refused(options: dict, message: str) -> None:
    with pytest.raises(InputError, match=message):
        LightField(**options)
