"""Where to focus, and how a lens moves: against scenes whose answers are known."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import erf

from cldof import Camera, FrameError, InputError, LayeredFrame, Lens, Renderer, SceneError
from cldof.capture.scene import Node, Scene
from cldof.focus import LensKey, LensTrack, autofocus, find_node, focus_at, focus_on, render_track
from cldof.host.device import DeviceInfo
from tests.frames import noise_frame, plane_frame
from tests.opengl import require_opengl


def frame_of(depth: np.ndarray, alpha: np.ndarray | None = None, guard_px: int = 0) -> LayeredFrame:
    """Grey surfaces; layers (M, H, W)."""
    depth = np.atleast_3d(depth) if depth.ndim == 3 else depth[None]
    alpha = np.ones_like(depth) if alpha is None else alpha
    color = np.repeat(alpha[..., None], 4, axis=-1)
    height, width = (n - 2 * guard_px for n in depth.shape[1:])
    return LayeredFrame(color.astype(np.float32), depth.astype(np.float32), Camera(width, height), guard_px=guard_px)


# Pixels


def test_focus_at_is_the_depth_of_the_pixel_without_the_guard_band() -> None:
    depth = np.arange(1.0, 1.0 + 8 * 10).reshape(8, 10)
    frame = frame_of(depth, guard_px=2)
    assert focus_at(frame, 0, 0) == depth[2, 2]
    assert focus_at(frame, 5.9, 3.2) == depth[5, 7]


def test_focus_at_looks_through_glass_and_not_through_what_is_more_opaque() -> None:
    depth = np.stack([np.full((4, 4), 1.0), np.full((4, 4), 3.0)])
    for pane, expected in ((0.3, 3.0), (0.6, 1.0)):
        alpha = np.stack([np.full((4, 4), pane), np.ones((4, 4))])
        assert focus_at(frame_of(depth, alpha), 1, 1) == expected


def test_focus_at_hits_a_wire_beside_the_pixel_and_sky_is_infinity() -> None:
    depth = np.full((9, 20), np.inf)
    depth[:, 4], depth[:, 5] = 2.0, 3.0
    frame = frame_of(depth)
    assert focus_at(frame, 6, 4) == 2.0  # the nearer of both in reach
    assert focus_at(frame, 7, 4) == 3.0
    assert focus_at(frame, 8, 4) == math.inf
    assert focus_at(frame, 6, 4, reach_px=0) == math.inf
    assert focus_at(frame, 5, 4) == 3.0  # a pixel with a surface needs no search


def test_focus_at_refuses_the_void_and_pixels_outside() -> None:
    alpha = np.ones((1, 9, 20))
    alpha[..., 8:] = 0.0
    depth = np.where(alpha[0] > 0, 2.0, np.inf)
    frame = frame_of(depth, alpha)
    assert focus_at(frame, 9, 3) == 2.0
    with pytest.raises(FrameError, match=r"Nothing is seen at pixel \(15, 3\)"):
        focus_at(frame, 15, 3)
    for x, y in ((-0.1, 0), (20, 0), (0, 9)):
        with pytest.raises(FrameError, match="outside the image of 20x9"):
            focus_at(frame, x, y)
    with pytest.raises(InputError, match="reach_px is -1"):
        focus_at(frame, 3, 3, reach_px=-1)


# Autofocus


def scene_depth() -> np.ndarray:
    """A wall at 10 m, a subject at 2 m in the middle, something large and nearer in a corner."""
    depth = np.full((60, 80), 10.0)
    depth[22:40, 30:50] = 2.0
    depth[40:, :20] = 0.7
    return depth


def test_autofocus_takes_the_nearest_surface_in_the_middle() -> None:
    assert autofocus(frame_of(scene_depth())) == 2.0


def test_autofocus_passes_over_specks_and_wires() -> None:
    depth = scene_depth()
    rng = np.random.default_rng(1)
    depth[rng.random(depth.shape) < 0.02] = 0.5
    depth[:, 41] = 1.0
    assert autofocus(frame_of(depth)) == 2.0


def test_autofocus_on_a_slope_lands_within_its_range() -> None:
    depth = 1.0 / np.linspace(0.2, 1.0, 60)[:, None] * np.ones((1, 80))
    found = autofocus(frame_of(depth))
    middle = depth[18:42]
    assert middle.min() <= found <= middle.max()


def test_autofocus_falls_back_to_the_whole_image_then_to_the_sky() -> None:
    depth = np.full((60, 80), np.inf)
    assert autofocus(frame_of(depth)) == math.inf
    depth[:, :14] = 3.0
    assert autofocus(frame_of(depth)) == 3.0
    depth[:, 2:] = np.inf
    assert autofocus(frame_of(depth)) == 3.0
    with pytest.raises(FrameError, match="Nothing is in sight"):
        autofocus(frame_of(depth, np.zeros((1, 60, 80))))


@pytest.mark.parametrize("size", [(1, 1), (1, 7), (3, 2)])
def test_autofocus_of_tiny_images(size: tuple[int, int]) -> None:
    assert autofocus(frame_of(np.full(size, 4.0))) == 4.0


@given(st.integers(0, 10_000))
def test_autofocus_is_the_depth_of_some_pixel(seed: int) -> None:
    frame = noise_frame(23, 17, seed=seed)
    found = autofocus(frame)
    assert np.isclose(frame.depth, found, rtol=1e-6).any() or found == math.inf


# Nodes


def boxes() -> Scene:
    """Boxes of 0.4 m at 2, 3 and 5 m; the one at 5 m hides behind the one at 3 m."""
    box = trimesh.creation.box((0.4, 0.4, 0.4))

    def at(x: float, z: float, name: str | None) -> Node:
        place = np.eye(4)
        place[:3, 3] = x, 0.0, z
        return Node(box, place, name=name)

    nodes = (
        at(0.5, -2.0, "left"),
        at(0.0, -3.0, "front"),
        at(0.0, -5.0, "hidden"),
        at(0.0, 4.0, "behind"),
        at(1, -3, None),
    )
    return Scene("boxes", nodes, camera=Camera(96, 96, 40.0), background=(0.5, 0.5, 0.5))


def test_nodes_are_found_by_name_number_and_themselves() -> None:
    scene = boxes()
    assert find_node(scene, "front") is scene.nodes[1]
    assert find_node(scene, 1) is find_node(scene, "1") is find_node(scene, scene.nodes[1]) is scene.nodes[1]
    with pytest.raises(
        SceneError, match=r"no node 'nobody'; named are behind, front, hidden, left, numbers go from 0 to 4"
    ):
        find_node(scene, "nobody")
    with pytest.raises(SceneError, match="nodes 0 to 4; there is no node 5"):
        find_node(scene, 5)
    with pytest.raises(SceneError, match="not one of scene"):
        find_node(scene, boxes().nodes[0])
    twins = replace(scene, nodes=(scene.nodes[0], scene.nodes[0]))
    with pytest.raises(SceneError, match="2 nodes named 'left'; say which: 0, 1"):
        find_node(twins, "left")


def test_focus_on_without_a_frame_is_the_middle_of_the_box() -> None:
    scene = boxes()
    assert focus_on(scene, "left") == pytest.approx(2.0)
    assert focus_on(scene, "hidden") == pytest.approx(5.0)
    with pytest.raises(SceneError, match="behind the camera"):
        focus_on(scene, "behind")
    turned = np.eye(4)
    turned[:3, 3] = 0.0, 0.0, 1.0
    assert focus_on(scene, "left", camera=Camera(8, 8, 40.0, pose=turned)) == pytest.approx(3.0)


def test_focus_on_with_a_frame_is_what_is_seen_of_the_node() -> None:
    require_opengl()
    from cldof.capture.peel import DepthPeeler

    scene = boxes()
    with DepthPeeler(96, 96) as peeler:
        frame = peeler.peel(scene, layers=1, guard_px=4)
    # Of the front box the face at 2.8 m is seen; of the one at the side that and a flank.
    assert focus_on(scene, "front", frame) == pytest.approx(2.8, abs=1e-3)
    assert 1.8 - 1e-6 <= focus_on(scene, "left", frame) < 2.0
    # Hidden behind another: the middle of the box all the same.
    assert focus_on(scene, "hidden", frame) == pytest.approx(5.0)


# Tracks


def test_rack_focus_changes_every_blur_evenly() -> None:
    camera, lens = Camera(64, 48, 40.0), Lens(0.02, 1.2)
    lenses = LensTrack.rack(lens, math.inf, 25).lenses(25)
    assert lenses[0] == lens and lenses[-1].focus_distance_m == math.inf
    for depth in (0.8, 3.0, math.inf):
        coc = np.array([float(each.coc_radius_px(camera, depth)) for each in lenses])
        assert np.diff(coc) == pytest.approx(np.diff(coc)[0], rel=1e-9)


def test_f_number_moves_evenly_in_stops() -> None:
    keys = [LensKey.photographic(0, 50.0, 2.0, 3.0), LensKey.photographic(8, 50.0, 16.0)]
    numbers = [lens.f_number for lens in LensTrack(keys, focal_length_mm=50.0).lenses(9)]
    assert numbers == pytest.approx([2.0 * 2.0 ** (3.0 * i / 8.0) for i in range(9)])
    assert numbers[0] == 2.0 and numbers[-1] == 16.0


def test_an_aperture_closes_to_exactly_nothing() -> None:
    track = LensTrack([LensKey(0, 2.0, 0.04), LensKey(10, aperture_radius_m=0.0)])
    radii = [lens.aperture_radius_m for lens in track.lenses(12)]
    assert radii == pytest.approx([*np.linspace(0.04, 0.0, 11), 0.0]) and radii[10] == 0.0


@given(
    st.lists(st.tuples(st.integers(0, 50), st.floats(0.1, 1e3), st.floats(0.0, 0.1)), min_size=1, max_size=5,
             unique_by=lambda key: key[0]),
    st.sampled_from(["linear", "smooth"]),
    st.floats(-5.0, 60.0),
)  # fmt: skip
def test_a_track_meets_its_keys_and_stays_between_them(
    values: list[tuple[int, float, float]], ease: str, at: float
) -> None:
    track = LensTrack([LensKey(*value) for value in values], ease=ease)
    for frame, focus, radius in values:
        assert track.lens(frame) == Lens(radius, focus)
    lens = track.lens(at)
    frames = sorted(values)
    before = [value for value in frames if value[0] <= at][-1:] or frames[:1]
    after = [value for value in frames if value[0] >= at][:1] or frames[-1:]
    for got, index in ((lens.focus_distance_m, 1), (lens.aperture_radius_m, 2)):
        low, high = sorted((before[0][index], after[0][index]))
        assert low * (1 - 1e-9) <= got <= high * (1 + 1e-9)


@pytest.mark.parametrize(
    "keys, says",
    [
        ([LensKey(0, 1.0)], "No key gives aperture_radius_m"),
        ([LensKey(0, aperture_radius_m=0.1)], "No key gives focus_distance_m"),
        ([LensKey(0, 1.0, 0.1), LensKey(0, 2.0)], "Frame 0 has two keys that give focus_distance_m"),
    ],
)
def test_incomplete_tracks_are_refused(keys: list[LensKey], says: str) -> None:
    with pytest.raises(InputError, match=says):
        LensTrack(keys)


def test_impossible_keys_are_refused() -> None:
    for make in (
        lambda: LensKey(math.nan, 1.0),
        lambda: LensKey(0, -1.0),
        lambda: LensKey(0, 1.0, -0.1),
        lambda: LensTrack([LensKey(0, 1.0, 0.1)], ease="bouncy"),
        lambda: LensTrack.rack(Lens(0.1, 1.0), 2.0, 1),
    ):
        with pytest.raises(InputError):
            make()


# Sequences


@pytest.mark.parametrize("method", ["gather", "layered", "lightfield", "multiview", "pyramid"])
def test_closing_the_aperture_ends_in_the_pinhole_image_bit_for_bit(method: str, device_info: DeviceInfo) -> None:
    frame = noise_frame(48, 40, seed=3, guard_px=4)
    track = LensTrack([LensKey(0, 2.0, 0.02), LensKey(5, aperture_radius_m=0.0)])
    with Renderer(method, device=device_info.index) as renderer:
        images = [result.image for result in render_track(renderer, frame, track.lenses(6))]
        pinhole = renderer.render(frame, Lens(0.0, 7.0)).image
    assert np.array_equal(images[-1], pinhole)
    assert images[-1] == pytest.approx(frame.pinhole_image(), abs=1e-6)
    steps = [float(np.abs(image - pinhole).mean()) for image in images]
    assert steps[0] > 0.001 and steps[-1] == 0.0
    # Means of equal pixels may differ from the pixel by rounding.
    assert all(later <= earlier + 1e-6 for earlier, later in pairwise(steps))


@pytest.mark.parametrize("in_flight", [1, 2, 3])
def test_a_sequence_is_what_single_frames_are(in_flight: int, device_info: DeviceInfo) -> None:
    frame = plane_frame(np.random.default_rng(0).random((24, 32, 4)) * (1, 1, 1, 0) + (0, 0, 0, 1), 2.0)
    lenses = LensTrack.rack(Lens(0.05, 1.0), 4.0, 7).lenses(7)
    with Renderer("layered", device=device_info.index, frames_in_flight=in_flight) as renderer:
        sequence = [result.image for result in render_track(renderer, frame, lenses, in_flight)]
        singles = [renderer.render(frame, lens).image for lens in lenses]
    assert all(np.array_equal(one, other) for one, other in zip(sequence, singles, strict=True))


def cosine_sweep(camera: Camera, lenses: list[Lens], depth_m: float, period_px: float) -> np.ndarray:
    """What a Gaussian lens makes of a cosine on a plane: its amplitude falls by exp(-2 (pi sigma / p)^2)."""
    wave = np.cos(2.0 * np.pi * (np.arange(camera.width) + 0.5) / period_px)
    sigma = 0.5 * np.array([float(lens.coc_radius_px(camera, depth_m)) for lens in lenses])
    return 0.5 + 0.4 * np.exp(-2.0 * (np.pi * sigma / period_px) ** 2)[:, None] * wave


@pytest.mark.parametrize("method", ["gather", "layered", "pyramid", "lightfield", "multiview"])
def test_a_sweep_of_focus_does_not_jump(method: str, device_info: DeviceInfo) -> None:
    """120 frames: no step is larger than 1.5 times the largest of the theory, as RMS and at any pixel."""
    size, depth, period = 64, 2.0, 16.0
    wave = 0.5 + 0.4 * np.cos(2.0 * np.pi * (np.arange(size) + 0.5) / period)
    image = np.repeat(np.broadcast_to(wave, (size, size))[..., None], 4, axis=-1).copy()
    image[..., 3] = 1.0
    frame = plane_frame(image, depth)
    track = LensTrack.rack(Lens(0.03, 1.2, aperture="gaussian"), 5.0, 120)
    lenses = track.lenses(120)
    options = {"kernel": "gaussian"} if method == "gather" else {}
    with Renderer(method, device=device_info.index, **options) as renderer:
        rendered = np.stack([result.image[..., 0] for result in render_track(renderer, frame, lenses)])
    expected = cosine_sweep(frame.camera, lenses, depth, period)
    inner = slice(16, -16)  # edges repeat on the device and go on in theory
    steps = np.abs(np.diff(rendered[:, inner, inner].astype(np.float64), axis=0))
    theory = np.abs(np.diff(expected[:, inner], axis=0))
    rms, largest = np.sqrt((steps**2).mean(axis=(1, 2))), np.sqrt((theory**2).mean(axis=1))
    assert rms.max() <= 1.5 * largest.max()
    assert steps.max() <= 1.5 * theory.max()
    # The sweep crosses the plane: a method that showed no blur at all would not jump either.
    assert rms.max() >= 0.5 * largest.max()


def picket_sweep(camera: Camera, lenses: list[Lens], depth_m: float, edges: list[tuple[int, int]]) -> np.ndarray:
    """Share of each column that white pickets cover through a Gaussian lens, (frames, width)."""
    x = np.arange(camera.width) + 0.5
    sigma = 0.5 * np.abs([float(lens.coc_radius_px(camera, depth_m)) for lens in lenses])[:, None]
    cover = np.zeros((len(lenses), camera.width))
    for start, end in edges:
        cover += 0.5 * (erf((x - start) / (math.sqrt(2.0) * sigma)) - erf((x - end) / (math.sqrt(2.0) * sigma)))
    return cover


PICKETS = {"layered": 1.5, "multiview": 1.2, "pyramid": 1.0}


@pytest.mark.parametrize(
    "method, tilt, wall_m",
    [
        ("layered", 0.0, 4.0),
        ("layered", 0.004, 4.0),
        ("multiview", 0.0, 4.0),
        ("multiview", 0.0, 1.15),
        ("pyramid", 0.0, 4.0),
        ("pyramid", 0.004, 4.0),
        ("layered", 0.0, 1.15),  # both within one interval between two blurs
        ("pyramid", 0.0, 1.15),
    ],
)
def test_pickets_do_not_jump_from_layer_to_layer(
    method: str, tilt: float, wall_m: float, device_info: DeviceInfo
) -> None:
    """White pickets before a dark wall, focus from near them to 4 m: as they pass from one depth layer to the next
    they must neither show twice nor vanish for a frame. A grey wall's blur does not show, so theory is exact."""
    width, height, depth = 96, 48, 1.0
    edges = [(12, 19), (30, 34), (45, 48), (60, 72)]
    camera = Camera(width, height, 40.0)
    color = np.empty((2, height, width, 4), np.float32)
    color[:] = (0.2, 0.2, 0.2, 1.0)
    depths = np.full((2, height, width), wall_m, np.float32)
    for start, end in edges:
        color[0, :, start:end] = 1.0
        # Not all of a picket passes at once.
        depths[0, :, start:end] = depth * (1.0 + tilt * np.arange(height)[:, None] / height)
    frame = LayeredFrame(color, depths, camera)
    lenses = LensTrack.rack(Lens(0.12, 1.1, aperture="gaussian"), 4.0, 120).lenses(120)
    with Renderer(method, device=device_info.index) as renderer:
        rendered = np.stack([result.image[..., 0] for result in render_track(renderer, frame, lenses)])
    expected = 0.2 + 0.8 * picket_sweep(camera, lenses, depth, edges)
    steps = np.diff(rendered[:, 12:-12, 8:-8].astype(np.float64), axis=0)
    theory = np.diff(expected[:, 8:-8], axis=0)
    rms, largest = np.sqrt((steps**2).mean(axis=(1, 2))), np.sqrt((theory**2).mean(axis=1))
    assert rms.max() <= PICKETS[method] * largest.max()
    assert rms.sum() >= 0.7 * largest.sum()
