"""The multiview method end to end: against its float64 twin, and what every method promises (DESIGN section 4)."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import gaussian_filter

from cldof import Camera, InputError, LayeredFrame, Lens, Renderer
from cldof.host.device import Device, DeviceInfo
from cldof.host.passes import FrameProgram
from cldof.lens import GaussianAperture, PolygonAperture
from cldof.methods import FrameShape
from cldof.methods.multiview import _ALL_CENTRED_PX, _CENTRED_PX, MAX_LAYERS, Multiview, ray_sets, shift_scales, turn_px
from tests.frames import noise_frame, plane_frame
from tests.oracles import multiview as oracle
from tests.running import inverse_depth, run_program
from tests.tolerances import assert_close


def render(device: Device, frame: LayeredFrame, lens: Lens, one_ray: np.ndarray | None = None, **options) -> np.ndarray:
    """Render; with ``one_ray``, (2,) right and down per px of C, every pixel sends this ray alone.

    It then meets layers in their middle and in whole pixels: as geometry has it, not as blur asks for.
    """
    method = Multiview(**options)
    shape = FrameShape.of(frame)
    plan = method.plan(frame, lens)
    program = method.program(shape, plan, device.traits)
    params = dict(plan.params)
    if one_ray is not None:
        params["given"] = params["given"].copy()
        params["given"]["haste"] = 1e9
        middles = method.layering(frame, lens).coc
        params["given"]["coc"][: len(middles)] = middles
        buffers = dict(program.buffers)
        for name, data in (
            ("points", np.broadcast_to(np.float32(one_ray), (plan_rays(program), 2))),
            ("ray_sets0", np.repeat(np.int32([[0, 1]]), 16, 0)),
        ):
            data = np.ascontiguousarray(data)
            buffers[name] = replace(buffers[name], nbytes=data.nbytes, data=data)
        program = FrameProgram(buffers, program.passes)
    inputs = {"color": frame.color, "inv_depth": inverse_depth(device, frame)}
    size = tuple(side // method.supersample for side in shape.output_size)
    return run_program(device, program, inputs, params, "image", (*size, 4))


def plan_rays(program: FrameProgram) -> int:
    return program.buffers["points"].nbytes // 8


def twin(device: Device, frame: LayeredFrame, lens: Lens, **options) -> np.ndarray:
    method = Multiview(adaptive=False, **options)
    layers = method.layering(frame, lens)
    rays = ray_sets(method, lens.aperture, 1)
    first, count = next(each for each in rays.ranges[0] if each[1] == method.rays)
    factor = method.supersample
    windows = [window and window[:3] for window in method.windows(layers, lens.aperture)]
    full = _CENTRED_PX if layers.refined else _ALL_CENTRED_PX
    inverse = inverse_depth(device, frame)[..., : frame.width].astype(np.float64)
    met = layers.met(rays.farthest, lens.aperture, not method.halvings(layers.delta_px))
    scales = shift_scales(layers.coc, factor, lens.aperture, method.antialias)
    return oracle.render(
        frame.color,
        inverse,
        *(value / factor for value in lens.coc_coefficients(frame.camera)),
        np.array([-1e20, *layers.limits[1:-1], 1e20]),
        met,
        windows,
        rays.points[first : first + count].astype(np.float64),
        scales,
        turn_px(scales * met),
        opaque=frame.is_opaque,
        guard=frame.guard_px // factor,
        scale=factor,
        least=_CENTRED_PX if method.is_centred else math.inf,
        full=full if method.is_centred else math.inf,
        halvings=method.halvings(layers.delta_px),
        limits=layers.limits,
    )


SIZES = [(1, 1), (1, 29), (31, 1), (37, 21), (131, 67), (64, 8)]


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("opaque", [True, False], ids=["opaque", "void"])
@pytest.mark.parametrize("cone", [True, False], ids=["cone", "ray"])
def test_meets_the_oracle(device: Device, size: tuple[int, int], opaque: bool, cone: bool) -> None:
    frame = noise_frame(*size, opaque=opaque, seed=size[0])
    lens = Lens(8.0 / frame.camera.focal_px, 1.7)
    options = {"cone": cone, "rays": 13}
    assert_close(
        render(device, frame, lens, adaptive=False, **options), twin(device, frame, lens, **options), "multiview"
    )


@pytest.mark.parametrize(
    "options", [{"delta_px": 2.0}, {"layers": 5}, {"rays": 1}, {"rays": 3}, {"seed": 7}, {"centred": True}]
)
def test_options_meet_the_oracle(device: Device, options: dict) -> None:
    frame = noise_frame(90, 70, guard_px=9)
    lens = Lens(10.0 / frame.camera.focal_px, 2.0)
    options = {"rays": 9, **options}
    image = render(device, frame, lens, adaptive=False, **options)
    assert_close(image, twin(device, frame, lens, **options), "multiview")


@pytest.mark.parametrize(
    "aperture", [PolygonAperture(5, rotation_deg=20.0), PolygonAperture(6, ratio=2.0), GaussianAperture()]
)
def test_apertures_meet_the_oracle(device: Device, aperture: object) -> None:
    frame = noise_frame(90, 70)
    lens = Lens(10.0 / frame.camera.focal_px, 2.0, aperture=aperture)
    image = render(device, frame, lens, adaptive=False, rays=9)
    assert_close(image, twin(device, frame, lens, rays=9), "multiview")


@pytest.mark.parametrize(("supersample", "antialias"), [(2, True), (3, True), (3, False)])
@pytest.mark.parametrize("opaque", [True, False], ids=["opaque", "void"])
@pytest.mark.parametrize("size", [(2, 1), (25, 14), (44, 22)])
def test_supersampled_peels_meet_the_oracle(
    device: Device, supersample: int, antialias: bool, opaque: bool, size: tuple[int, int]
) -> None:
    guard = 2 * supersample
    frame = noise_frame(size[0] * supersample, size[1] * supersample, opaque=opaque, guard_px=guard)
    lens = Lens(8.0 * supersample / frame.camera.focal_px, 1.7)
    options = {"supersample": supersample, "antialias": antialias, "rays": 9}
    image = render(device, frame, lens, adaptive=False, **options)
    assert image.shape == (size[1], size[0], 4)
    assert_close(image, twin(device, frame, lens, **options), "multiview")
    np.testing.assert_array_equal(render(device, frame, lens, adaptive=False, cull=False, **options), image)


def test_supersampled_peels_in_focus_are_box_filtered_or_their_middles(device: Device) -> None:
    image = np.random.default_rng(1).random((60, 90, 4), np.float32)
    image[..., 3] = 1.0
    frame = plane_frame(image, 2.0)
    lens = Lens(9.0 / frame.camera.focal_px, 2.0)
    smooth = render(device, frame, lens, supersample=3)
    np.testing.assert_allclose(smooth, image.reshape(20, 3, 30, 3, 4).mean((1, 3)), atol=1e-6)
    sharp = render(device, frame, lens, supersample=3, antialias=False)
    np.testing.assert_array_equal(sharp, image[1::3, 1::3])


@pytest.mark.parametrize("blur_px", [0.3, 0.6, 1.0, 2.0, 3.5, 8.0])
def test_supersampled_blur_is_as_wide_as_the_lens_says(device: Device, blur_px: float) -> None:
    """Down to a fraction of a pixel, which single samples cannot show: the width of a line's blur."""
    total = second = 0.0
    for place in range(93, 96):
        image = np.zeros((45, 189, 4), np.float32)
        image[..., 3] = 1.0
        image[:, place, :3] = 1.0
        frame = plane_frame(image, 8.0)
        lens = Lens(3 * blur_px / (1.0 / 2.0 - 1.0 / 8.0) / frame.camera.focal_px, 2.0)
        light = render(device, frame, lens, supersample=3, rays=256)[7, :, 0].astype(float)
        away = np.arange(63) - (place - 1) / 3.0
        total += light.sum()
        second += (light * away**2).sum()
    assert total == pytest.approx(1.0, rel=0.01)
    # A disc, a line of a third and the box of the pixel, at all places in the pixel.
    assert second / total == pytest.approx(blur_px**2 / 4.0 + 1.0 / 108.0 + 1.0 / 12.0, rel=0.12)


def test_bright_light_takes_more_rays(device: Device) -> None:
    """Four times as many where a lamp's disc may reach, and only there."""
    image = np.random.default_rng(0).random((96, 400, 4), np.float32)
    image[..., 3] = 1.0
    image[40:43, 40:43, :3] = 50.0
    frame = plane_frame(image, 9.0)
    lens = Lens(20.0 / frame.camera.focal_px, 2.0)
    options = {"cone": False, "adaptive": False}
    boosted = render(device, frame, lens, rays=16, **options)
    plain = render(device, frame, lens, rays=16, highlights=False, **options)
    many = render(device, frame, lens, rays=64, highlights=False, **options)
    np.testing.assert_array_equal(boosted[16:64, 16:64], many[16:64, 16:64])
    np.testing.assert_array_equal(boosted[:, 100:], plain[:, 100:])
    assert np.abs(many - plain)[:, 100:].max() > 0.0


def test_layers_are_met_where_their_content_is(device: Device) -> None:
    """A wall anywhere inside a thick layer is blurred as the lens says, not as the middle of the layer would be."""
    for depth in (3.0, 3.3, 3.7, 4.2, 5.0):
        image = np.zeros((121, 121, 4), np.float32)
        image[..., 3] = 1.0
        image[60, 60, :3] = 1.0
        image = np.concatenate([image, image])  # the lower half stands at infinity and stretches the layers
        z = np.full((242, 121), depth, np.float32)
        z[121:] = np.inf
        frame = LayeredFrame(image, z, Camera(121, 242, 40.0))
        lens = Lens(50.0 / frame.camera.focal_px, 2.0)
        light = render(device, frame, lens, delta_px=5.0, rays=256, cone=False, centred=True)[:121, :, 0].astype(
            np.float64
        )
        y, x = np.mgrid[-60:61, -60:61]
        radius = math.sqrt(2.0 * (light * (x**2 + y**2)).sum() / light.sum())
        assert radius == pytest.approx(abs(float(lens.coc_radius_px(frame.camera, depth))), rel=0.04)


@pytest.mark.parametrize("layers", [1, 2, 6])
@pytest.mark.parametrize("focus", [0.7, 1.7, math.inf], ids=["all behind focus", "between", "all in front"])
def test_any_number_of_peels_and_one_sided_frames(device: Device, layers: int, focus: float) -> None:
    frame = noise_frame(75, 44, layers)
    lens = Lens(6.0 / frame.camera.focal_px, focus)
    image = render(device, frame, lens, adaptive=False, rays=8)
    assert_close(image, twin(device, frame, lens, rays=8), "multiview")


@pytest.mark.parametrize("jitter", [False, True])
@pytest.mark.parametrize("opaque", [True, False], ids=["opaque", "void"])
def test_culling_changes_no_bit(device: Device, jitter: bool, opaque: bool) -> None:
    frame = noise_frame(131, 167, opaque=opaque, guard_px=5)
    lens = Lens(5.0 / frame.camera.focal_px, 1.7)
    options = {"rays": 12, "jitter": jitter}
    lists = render(device, frame, lens, **options)
    np.testing.assert_array_equal(render(device, frame, lens, cull=False, **options), lists)


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("jitter", [False, True])
@pytest.mark.parametrize("opaque", [True, False], ids=["opaque", "void"])
def test_peels_and_layers_agree(device: Device, size: tuple[int, int], jitter: bool, opaque: bool) -> None:
    frame = noise_frame(*size, opaque=opaque, seed=size[0])
    lens = Lens(8.0 / frame.camera.focal_px, 1.7)
    options = {"rays": 7, "cone": False, "jitter": jitter, "centred": opaque}
    layers, peels = (render(device, frame, lens, traversal=kind, **options) for kind in ("layers", "peels"))
    np.testing.assert_allclose(peels, layers, atol=2e-6)


@pytest.mark.parametrize("steps", [1, 2, 4])
@pytest.mark.parametrize("size", [(1, 29), (37, 21), (131, 67)])
@pytest.mark.parametrize("opaque", [True, False], ids=["opaque", "void"])
def test_binary_search_meets_the_oracle(device: Device, size: tuple[int, int], opaque: bool, steps: int) -> None:
    frame = noise_frame(*size, opaque=opaque, seed=size[0], guard_px=3)
    lens = Lens(8.0 / frame.camera.focal_px, 1.7)
    options = {"traversal": "peels", "rays": 7, "layers": 6, "refine_steps": steps}
    image = render(device, frame, lens, adaptive=False, **options)
    assert_close(image, twin(device, frame, lens, **options), "multiview")
    for jitter in (False, True):
        culled, whole = (render(device, frame, lens, cull=cull, jitter=jitter, **options) for cull in (True, False))
        np.testing.assert_array_equal(culled, whole)


def hills(width: int = 96, height: int = 80) -> LayeredFrame:
    """A floor through focus, balls before and behind it, a wall; every slot's colour is its own number."""
    camera = Camera(width, height, 40.0)
    y, x = np.mgrid[:height, :width].astype(float)
    surfaces = [np.full((height, width), 1 / 6.0), np.clip((y - 20) / height * 1.1, 1e-3, None)]
    for cx, cy, radius, near in ((24, 30, 14, 0.95), (60, 44, 18, 0.7), (75, 20, 9, 0.4), (40, 60, 10, 0.3)):
        inside = 1.0 - ((x - cx) ** 2 + (y - cy) ** 2) / radius**2
        for side in (1.0, -1.0):
            surfaces.append(np.where(inside > 0, near + side * 0.04 * np.sqrt(np.maximum(inside, 0)), 0.0))
    inverse = np.sort(np.stack(surfaces), axis=0)[:1:-1]
    with np.errstate(divide="ignore"):
        depth = (1.0 / inverse).astype(np.float32)
    color = np.zeros((*depth.shape, 4), np.float32)
    color[..., 0] = np.arange(depth.size).reshape(depth.shape)
    color[..., 3] = depth < np.inf
    color[..., 0] *= color[..., 3]
    return LayeredFrame(color, depth, camera)


def test_rays_hit_what_dense_marching_hits(device: Device) -> None:
    """One ray per pixel through smooth surfaces: the same pixel of a peel or its neighbour, within a layer.

    Where that is not so the ray grazes a silhouette: half a layer to and fro decides what it meets.
    """
    frame = hills()
    lens = Lens(12.0 / frame.camera.focal_px, 1.9)
    layers = Multiview().layering(frame, lens)
    inverse = np.where(frame.color[..., 3] > 0, 1.0 / frame.depth.astype(np.float64), -1.0)
    columns = oracle.slots(inverse, *lens.coc_coefficients(frame.camera))
    # Pixels of which no ray leaves the frame.
    reach = math.ceil(np.abs(layers.coc).max()) + 1
    inner = (slice(reach, -reach), slice(reach, -reach))
    agree, explained = [], []
    for point in lens.aperture.samples(16, seed=2):
        image = render(device, frame, lens, one_ray=point, cone=False)
        found = image[..., 0].astype(int)
        peel, row, column = np.unravel_index(found, frame.depth.shape)
        coc = columns.near[peel, row, column]
        same = []
        for offset in (0.0, -0.5, 0.5):
            moved = oracle.Slots(*(end + offset * layers.delta_px for end in columns))
            hits = oracle.march(moved, point, layers.delta_px / 16)
            beside = (abs(row - hits.row) <= 1) & (abs(column - hits.column) <= 1)
            same.append((beside & (abs(coc - hits.coc) <= 1.5 * layers.delta_px))[inner])
        agree.append(same[0].mean())
        explained.append(np.any(same, axis=0).mean())
    assert np.mean(agree) >= 0.995
    assert np.mean(explained) >= 0.999


def test_binary_search_hits_the_very_pixel(device: Device) -> None:
    """Against dense marching: as many hits within a pixel, but for 0.2 %, and far more in the pixel itself.

    Hits that differ graze a silhouette: a step of less than a layer to and fro decides what is met.
    """
    frame = hills()
    lens = Lens(12.0 / frame.camera.focal_px, 1.9)
    inverse = np.where(frame.color[..., 3] > 0, 1.0 / frame.depth.astype(np.float64), -1.0)
    columns = oracle.slots(inverse, *lens.coc_coefficients(frame.camera))
    shares: dict[tuple[int, int], list[tuple[float, ...]]] = {}
    for point in lens.aperture.samples(16, seed=2):
        moves = (0.0, -0.4, 0.4)
        exact = [oracle.march(oracle.Slots(*(end + move for end in columns)), point, 1 / 32) for move in moves]
        for layers, steps in ((32, 0), (32, 2), (8, 0), (8, 2)):
            options = {"traversal": "peels", "layers": layers, "refine_steps": steps}
            reach = math.ceil(Multiview(**options).layering(frame, lens).largest.max()) + 1
            image = render(device, frame, lens, one_ray=point, **options)
            peel, row, column = np.unravel_index(image[..., 0].astype(int), frame.depth.shape)
            coc = columns.near[peel, row, column]
            off = [
                np.where(
                    abs(coc + move - hits.coc) <= 1.0, np.maximum(abs(row - hits.row), abs(column - hits.column)), 99
                )[reach:-reach, reach:-reach]
                for move, hits in zip(moves, exact, strict=True)
            ]
            found = ((off[0] == 0).mean(), (off[0] <= 1).mean(), (np.min(off, axis=0) <= 1).mean())
            shares.setdefault((layers, steps), []).append(found)
    share = {key: np.mean(found, axis=0) for key, found in shares.items()}
    assert share[32, 0][1] >= 0.995  # what is the default
    assert share[32, 2][1] >= 0.993
    assert share[32, 2][2] >= 0.999
    assert share[32, 2][0] >= 0.95
    assert share[8, 2][0] >= 0.85
    for layers in (8, 32):
        assert 1.0 - share[layers, 2][0] < 0.5 * (1.0 - share[layers, 0][0]), share


@pytest.mark.parametrize("layers", [12, 32])
def test_thin_layers_hit_as_often_as_false_position(device: Device, layers: int) -> None:
    """Looking once into each of many thin layers finds at least as many of the hits as the paper's search in them."""
    frame = hills()
    lens = Lens(12.0 / frame.camera.focal_px, 1.9)
    plan = Multiview(layers=layers).layering(frame, lens)
    inverse = np.where(frame.color[..., 3] > 0, 1.0 / frame.depth.astype(np.float64), -1.0)
    columns = oracle.slots(inverse, *lens.coc_coefficients(frame.camera))
    reach = math.ceil(np.abs(plan.coc).max()) + 1
    inner = (slice(reach, -reach), slice(reach, -reach))
    shares = []
    for point in lens.aperture.samples(6, seed=2):
        image = render(device, frame, lens, one_ray=point, cone=False, layers=layers)
        peel, row, column = np.unravel_index(image[..., 0].astype(int), frame.depth.shape)
        once = oracle.Hits(peel, row, column, columns.near[peel, row, column])
        exact = oracle.march(columns, point, 1.0 / 16.0)
        searched = oracle.false_position(columns, plan.limits, point)
        shares.append(
            [
                (
                    (abs(found.row - exact.row) <= 1)
                    & (abs(found.column - exact.column) <= 1)
                    & (abs(found.coc - exact.coc) <= 1.0)
                )[inner].mean()
                for found in (once, searched)
            ]
        )
    thin, search = np.mean(shares, axis=0)
    assert thin >= 0.99, search
    assert thin >= search - 0.002


def test_aperture_zero_is_the_pinhole_image(device: Device) -> None:
    for guard in (0, 3):
        frame = noise_frame(61, 47, guard_px=guard)
        np.testing.assert_allclose(render(device, frame, Lens(0.0, 2.0)), frame.pinhole_image(), atol=1e-6)
        color = frame.color.copy()
        color[..., :3] /= np.maximum(color[..., 3:], 1e-6)
        color[..., 3] = 1.0
        opaque = LayeredFrame(color, frame.depth, frame.camera, guard_px=guard)
        np.testing.assert_array_equal(render(device, opaque, Lens(0.0, 2.0)), opaque.pinhole_image())
    frame = noise_frame(61, 47, opaque=False)
    np.testing.assert_allclose(render(device, frame, Lens(0.0, 2.0)), frame.pinhole_image(), atol=1e-6)


@pytest.mark.parametrize("depth", [0.3, 1.0, 1.99, 2.01, 7.0, math.inf])
@pytest.mark.parametrize("jitter", [False, True])
def test_a_constant_stays_constant(device: Device, depth: float, jitter: bool) -> None:
    image = np.broadcast_to(np.float32((0.2, 3.0, 0.7, 1.0)), (40, 70, 4))
    frame = plane_frame(image, depth)
    out = render(device, frame, Lens(20.0 / frame.camera.focal_px, 2.0), jitter=jitter)
    np.testing.assert_allclose(out, image, rtol=2e-5)


def test_the_plane_in_focus_stays_between_blurred_things(device: Device) -> None:
    image = np.random.default_rng(1).random((40, 400, 4), np.float32)
    image[..., 3] = 1.0
    depth = np.full((40, 400), 2.0, np.float32)
    depth[:, 300:] = 9.0
    frame = LayeredFrame(image, depth, Camera(400, 40, 40.0))
    lens = Lens(8.0 / frame.camera.focal_px, 2.0)
    out = render(device, frame, lens)
    np.testing.assert_array_equal(out[:, :256], image[:, :256])
    all_rays = render(device, frame, lens, adaptive=False)
    np.testing.assert_allclose(all_rays[:, :256], image[:, :256], rtol=1e-5)
    assert np.abs(out[:, 320:] - image[:, 320:]).max() > 0.1


@pytest.mark.parametrize("degrees", [0.0, 45.0, 80.0])
@pytest.mark.parametrize("samples", [1, 3])
def test_a_slope_lets_nothing_through(device: Device, degrees: float, samples: int) -> None:
    """White through focus before a black sky: where a layer ends, the next one must take over without a gap."""
    height, width = 96 * samples, 128 * samples
    camera = Camera(width, height, 40.0)
    y = (np.arange(height) + 0.5 - height / 2) / camera.focal_px
    inverse = np.clip((1.0 - math.tan(math.radians(degrees)) * y) / 2.0, 0.02, 4.0)
    depth = np.full((2, height, width), np.inf, np.float32)
    depth[0] = 1.0 / inverse[:, None]
    color = np.ones((2, height, width, 4), np.float32)
    color[1, ..., :3] = 0.0
    frame = LayeredFrame(color, depth, camera)
    lens = Lens(6.0 * samples / camera.focal_px, 2.0)
    if samples == 1:
        assert render(device, frame, lens, cone=False)[..., :3].min() > 0.999
    assert render(device, frame, lens, supersample=samples)[..., :3].min() > 0.98


@pytest.mark.parametrize("depth", [1.2, 1.99, 2.0, 9.0])
@pytest.mark.parametrize("alpha", [1 / 255, 0.5, 0.99])
@pytest.mark.parametrize("opaque", [True, False], ids=["wall", "void"])
def test_glass_lets_through_what_its_alpha_says(device: Device, depth: float, alpha: float, opaque: bool) -> None:
    color = np.zeros((2, 24, 40, 4), np.float32)
    color[0] = np.float32((0.1, 0.5, 0.2, 1.0)) * np.float32(alpha)
    z = np.full((2, 24, 40), np.inf, np.float32)
    z[0] = depth
    if opaque:
        color[1], z[1] = (0.9, 0.3, 4.0, 1.0), 20.0
    frame = LayeredFrame(color, z, Camera(40, 24, 40.0), guard_px=0)
    out = render(device, frame, Lens(3.0 / frame.camera.focal_px, 2.0))[8:-8, 8:-8]
    np.testing.assert_allclose(out, frame.pinhole_image()[8:-8, 8:-8], atol=2e-5, rtol=2e-5)


def test_highlights_stay_finite_and_keep_their_energy(device: Device) -> None:
    image = np.zeros((121, 121, 4), np.float32)
    image[..., 3] = 1.0
    image[60, 60, :3] = 1e6
    frame = plane_frame(image, 1.2)
    lens = Lens(24.0 / frame.camera.focal_px, 2.0)
    light = render(device, frame, lens)[..., 0].astype(np.float64)
    assert light.sum() == pytest.approx(1e6, rel=1e-4)
    y, x = np.mgrid[-60:61, -60:61]
    radius = math.sqrt(2.0 * (light * (x**2 + y**2)).sum() / light.sum())
    assert radius == pytest.approx(abs(float(lens.coc_radius_px(frame.camera, 1.2))), rel=0.04)


@pytest.mark.parametrize("depth", [1.0, 9.0], ids=["before focus", "behind focus"])
def test_bokeh_is_the_right_way_up(device: Device, depth: float) -> None:
    """A triangle with a corner on top: upright behind the focus, upside down before it; as lens.py says."""
    image = np.zeros((81, 81, 4), np.float32)
    image[..., 3] = 1.0
    image[40, 40, :3] = 1e3
    frame = plane_frame(image, depth)
    lens = Lens(40.0 / frame.camera.focal_px, 2.0, aperture=PolygonAperture(3, rotation_deg=90.0))
    light = render(device, frame, lens, rays=256)[..., 0]
    rows = np.flatnonzero(light.sum(axis=1) > 1.0) - 40
    corner, base = (rows.min(), rows.max()) if depth > 2.0 else (rows.max(), rows.min())
    assert abs(corner) > 1.5 * abs(base)


def test_same_input_same_bits(device: Device) -> None:
    frame = noise_frame(100, 50, opaque=False)
    lens = Lens(12.0 / frame.camera.focal_px, 1.7)
    first = render(device, frame, lens, jitter=True)
    for _ in range(3):
        np.testing.assert_array_equal(render(device, frame, lens, jitter=True), first)


@settings(max_examples=25)
@given(
    width=st.integers(1, 90),
    height=st.integers(1, 60),
    layers=st.integers(1, 4),
    seed=st.integers(0, 10**6),
    opaque=st.booleans(),
    jitter=st.booleans(),
    rays=st.integers(1, 20),
    aperture_px=st.floats(0.0, 60.0),
    focus=st.floats(0.2, 50.0),
)
def test_random_frames_keep_the_promises(
    device: Device,
    width: int,
    height: int,
    layers: int,
    seed: int,
    opaque: bool,
    jitter: bool,
    rays: int,
    aperture_px: float,
    focus: float,
) -> None:
    frame = noise_frame(width, height, layers, seed=seed, opaque=opaque)
    lens = Lens(aperture_px / frame.camera.focal_px, focus)
    out = render(device, frame, lens, rays=rays, jitter=jitter)
    assert np.isfinite(out).all()
    assert out.min() >= 0.0
    assert out.max() <= 1.0 + 1e-4
    assert (out[..., 3] <= 1.0).all()
    if opaque:
        np.testing.assert_allclose(out[..., 3], 1.0, atol=1e-6)


def smooth_wall(depth: float, size: tuple[int, int] = (160, 120)) -> LayeredFrame:
    """Patches of a few pixels in random colours, behind a comb that is in focus."""
    rng = np.random.default_rng(4)
    width, height = size
    color = np.ones((2, height, width, 4), np.float32)
    color[1, ..., :3] = rng.random((height // 4, width // 4, 3)).repeat(4, 0).repeat(4, 1)
    color[0, ..., :3] = 0.2
    color[0, :, np.arange(width) % 40 >= 8] = 0.0
    z = np.full((2, height, width), 2.0, np.float32)
    z[1] = depth
    z[0][color[0, ..., 3] == 0.0] = np.inf
    # What is first comes first.
    gap = color[0, ..., 3] == 0.0
    color[0][gap], z[0][gap] = color[1][gap], z[1][gap]
    return LayeredFrame(color, z, Camera(width, height, 40.0))


def squared_error(image: np.ndarray, exact: np.ndarray, seen_from_px: float = 0.0) -> float:
    difference = (image - exact)[20:-20, 20:-20, :3].astype(np.float64)
    if seen_from_px:
        difference = gaussian_filter(difference, (seen_from_px, seen_from_px, 0.0))
    return float(np.square(difference).mean())


def test_jitter_turns_copies_of_edges_into_noise(device: Device) -> None:
    """Seen from where pixels blend, 32 jittered cones are as good as 64 that are the same in every pixel."""
    frame = smooth_wall(9.0)
    lens = Lens(30.0 / frame.camera.focal_px, 2.0)
    exact = render(device, frame, lens, rays=1024, cone=False)
    errors = {
        (rays, jitter): squared_error(render(device, frame, lens, rays=rays, jitter=jitter), exact, 1.5)
        for rays, jitter in ((32, True), (32, False), (64, False))
    }
    assert errors[32, True] <= errors[64, False]
    assert errors[32, True] <= 0.7 * errors[32, False]


@pytest.mark.parametrize("rays", [8, 16])
def test_cones_gain_two_decibels_on_strong_blur(device: Device, rays: int) -> None:
    frame = smooth_wall(9.0)
    lens = Lens(40.0 / frame.camera.focal_px, 2.0)
    exact = render(device, frame, lens, rays=1024, cone=False)
    cone, ray = (squared_error(render(device, frame, lens, rays=rays, cone=cone), exact) for cone in (True, False))
    assert 10.0 * math.log10(ray / cone) >= 2.0


@pytest.mark.parametrize("options", [{}, {"jitter": True}, {"traversal": "peels"}, {"aperture": GaussianAperture()}])
def test_growing_blur_is_continuous(device_info: DeviceInfo, options: dict) -> None:
    """Steps half as long change white noise half as much, also where it changes most: nothing jumps."""
    options = dict(options)
    aperture = options.pop("aperture", "disc")
    frame = plane_frame(np.random.default_rng(5).random((24, 48, 4)) * (1, 1, 1, 0) + (0, 0, 0, 1), 4.0)
    radii = np.linspace(0.0, 3.0, 301) / float(abs(Lens(1.0, 2.0).coc_radius_px(frame.camera, 4.0)))
    with Renderer("multiview", device=device_info.index, **options) as renderer:
        images = np.stack([renderer.render(frame, Lens(r, 2.0, aperture=aperture)).image for r in radii])
    fine, coarse = (np.abs(np.diff(images[::step], axis=0)).max() for step in (1, 2))
    assert fine <= 0.55 * coarse
    # Per 0.01 px of C; a ray of 64 that moved on as a whole would come to 1/64 of the contrast, several do at a time.
    assert fine <= 0.0125


def test_adaptive_rays_change_little(device: Device) -> None:
    """White noise is the worst that there is for few rays; at large blur nothing is cut."""
    frame = noise_frame(96, 96)
    for blur_px, largest in ((1.0, 0.03), (3.0, 0.02), (30.0, 0.0)):
        lens = Lens(blur_px / frame.camera.focal_px, 1.7)
        many, few = (render(device, frame, lens, rays=256, adaptive=adaptive) for adaptive in (False, True))
        assert np.sqrt(((many - few) ** 2).mean()) <= largest


def test_layers_reach_the_coc_range() -> None:
    frame = noise_frame(40, 30)
    lens = Lens(4.0 / frame.camera.focal_px, 1.7)
    plan = Multiview().plan(frame, lens)
    layers = Multiview().layering(frame, lens)
    assert 0.25 < layers.delta_px <= 0.5
    # What is nearest and what is farthest stand in the middle of their layers.
    assert layers.coc[0] == pytest.approx(-plan.summary["largest_near_coc_px"], abs=1e-5)
    assert layers.coc[-1] == pytest.approx(plan.summary["largest_far_coc_px"], abs=1e-5)
    seen = lens.coc_radius_px(frame.camera, frame.depth[np.isfinite(frame.depth)])
    assert layers.coc[0] == pytest.approx(seen.min(), abs=1e-4) and layers.limits[-1] >= seen.max()
    huge = Lens(5000.0 / frame.camera.focal_px, 1.7)
    assert Multiview().plan(frame, huge).structure.total <= MAX_LAYERS
    assert Multiview(layers=6).plan(frame, huge).structure.total <= 6


def test_an_enormous_aperture_is_rendered(device: Device) -> None:
    frame = noise_frame(50, 40)
    assert np.isfinite(render(device, frame, Lens(5000.0 / frame.camera.focal_px, 1.7))).all()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"rays": 0}, "rays is 0"),
        ({"rays": 1025}, "from 1 to 1024"),
        ({"rays": 2.5}, "rays is 2.5"),
        ({"layers": 4}, "from 5 to 32"),
        ({"delta_px": 0.0}, "delta_px"),
        ({"seed": -1}, "seed is -1"),
        ({"traversal": "texels"}, "choose one of layers, peels"),
        ({"refine_steps": 5, "traversal": "peels"}, "refine_steps is 5"),
        ({"refine_steps": 1}, "needs traversal='peels'"),
        ({"traversal": "peels", "cone": True}, "cone=True needs"),
        ({"traversal": "peels", "supersample": 2}, "supersample needs"),
        ({"supersample": 9}, "from 1 to 8"),
        ({"supersample": 2, "antialias": False}, "odd number"),
    ],
)
def test_bad_options_are_refused(options: dict, message: str) -> None:
    with pytest.raises(InputError, match=message):
        Multiview(**options)
