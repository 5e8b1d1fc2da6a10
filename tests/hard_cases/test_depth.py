"""Depth: infinities, contact, planes nearly in one place, edges of layers, grazing planes."""

from __future__ import annotations

import math

import numpy as np
import pytest

from cldof import Camera, LayeredFrame, Lens
from cldof.lens import lens_samples
from tests.oracles import plane as plane_oracle

from .conftest import Subject
from .promises import CAMERA, keep_promises, lens_at, one_plane, textured

H, W = CAMERA.height, CAMERA.width


def disc(radius: float, height: int = H, width: int = W) -> np.ndarray:
    """Where a round thing in the middle of the image is."""
    y, x = np.mgrid[:height, :width]
    return np.hypot(x - (width - 1) / 2, y - (height - 1) / 2) <= radius


def two_layers(near: np.ndarray, near_m: float, far: np.ndarray, far_m: float, where: np.ndarray) -> LayeredFrame:
    """A thing before a wall: both peels where it is, the wall alone beside it."""
    color = np.stack([far, far])
    depth = np.full(color.shape[:3], far_m, np.float32)
    color[0][where], depth[0][where] = near[where], near_m
    color[1][~where], depth[1][~where] = 0.0, np.inf
    return LayeredFrame(color, depth, CAMERA)


WHITE = np.ones((H, W, 4), np.float32)


@pytest.mark.parametrize("coc_px", [2.0, 9.0, 40.0])
def test_a_thing_before_an_infinite_sky(subject: Subject, coc_px: float) -> None:
    case = "a thing before an infinite sky"
    lens = lens_at(coc_px, math.inf, 2.0)
    frame = two_layers(textured(H, W), 1.1, textured(H, W, 1), math.inf, disc(12))
    keep_promises(subject, case, frame, subject.render(frame, lens))
    white = two_layers(WHITE, 1.1, WHITE, math.inf, disc(12))
    image = subject.render(white, lens)
    subject.check(case, "white stays white", np.abs(image - 1.0).max(), 1e-3)


@pytest.mark.parametrize("focus_m", [0.3, 2.0, 1e6, math.inf])
def test_all_is_infinitely_far(method: Subject, focus_m: float) -> None:
    case = f"all infinitely far, focus at {focus_m:g} m"
    lens = Lens(9.0 / CAMERA.focal_px, focus_m)
    frame = one_plane(math.inf)
    image = method.render(frame, lens)
    keep_promises(method, case, frame, image)
    if math.isinf(focus_m):
        method.check(case, "in focus, changed by", np.abs(image - frame.color[0]).max(), 1e-6)


@pytest.mark.parametrize("coc_px", [0.3, 8.0, 500.0])
def test_contact(subject: Subject, coc_px: float) -> None:
    """A plane one millimetre from the lens, alone and beside the horizon."""
    case = "a plane 1e-3 m away"
    lens = lens_at(coc_px, 1e-3, 2.0)
    frame = one_plane(1e-3)
    keep_promises(subject, case, frame, subject.render(frame, lens))
    frame = two_layers(textured(H, W), 1e-3, textured(H, W, 1), 1e6, disc(12))
    keep_promises(subject, case, frame, subject.render(frame, lens))
    white = two_layers(WHITE, 1e-3, WHITE, 1e6, disc(12))
    subject.check(case, "white stays white", np.abs(subject.render(white, lens) - 1.0).max(), 1e-3)


@pytest.mark.parametrize("focus_m", [2.0, 1e6])
def test_a_plane_a_thousand_kilometres_away(subject: Subject, focus_m: float) -> None:
    case = "a plane 1e6 m away"
    lens = Lens(9.0 * 2.0 / CAMERA.focal_px, focus_m)
    far, infinite = one_plane(1e6), one_plane(math.inf)
    image = subject.render(far, lens)
    keep_promises(subject, case, far, image)
    # Less than 2e-5 px of CoC apart; the light field moves slots by steps of 1/256 px, rays pass from pixel to pixel
    # on the twentieth of one, at the least.
    bound = {"lightfield": 1e-3, "multiview": 4e-5}.get(subject.method, 1e-5)
    subject.check(case, "against infinity", np.abs(image - subject.render(infinite, lens)).max(), bound)


@pytest.mark.parametrize("coc_px", [-9.0, 0.0, 5.0])
def test_two_surfaces_closer_than_rounding(subject: Subject, coc_px: float) -> None:
    """1e-5 apart in relative depth, one behind the other and side by side, look as if they were one."""
    case = "two surfaces 1e-5 apart"
    depth = 2.0
    lens = Lens(0.05, 2.0) if coc_px == 0.0 else lens_at(coc_px, depth, 1.2 if coc_px > 0 else 6.0)
    front = textured(H, W)
    alone = subject.render(one_plane(depth, front), lens)
    behind = np.float32(depth * (1.0 + 1e-5))
    hidden = LayeredFrame(
        np.stack([front, textured(H, W, 1)]),
        np.stack([np.full((H, W), depth, np.float32), np.full((H, W), behind, np.float32)]),
        CAMERA,
    )
    subject.check(case, "hidden one shows by", np.abs(subject.render(hidden, lens) - alone).max(), 1e-4)
    # Depth fighting: every other pixel of the surface is a hair farther.
    y, x = np.mgrid[:H, :W]
    fighting = one_plane(np.where((x + y) % 2, np.float32(depth), behind), front)
    subject.check(case, "interleaved against one", np.abs(subject.render(fighting, lens) - alone).max(), 1e-3)


@pytest.mark.parametrize("focus_m", [1e-3, 0.1, 1.0 / 3.0, 2.0, 7.7, 1e3, 1e6, math.inf])
@pytest.mark.parametrize("aperture_px", [1.0, 300.0])
def test_in_focus_nothing_changes(method: Subject, focus_m: float, aperture_px: float) -> None:
    """The plane in focus stays; a float32 depth is off by 6e-8, which enormous lenses turn into a CoC."""
    case = "exactly at focus"
    focus_m = float(np.float32(focus_m))
    frame = one_plane(focus_m)
    radius_m = aperture_px / CAMERA.focal_px * (min(focus_m, 1e6))  # CoC of aperture_px at twice the inverse depth
    image = method.render(frame, Lens(radius_m, focus_m))
    method.check(case, "changed by", np.abs(image - frame.color[0]).max(), 1e-6)


def boundaries(subject: Subject, frame: LayeredFrame, lens: Lens) -> list[float]:
    """Depths at which the method's layers begin, and a few of the others'."""
    plan = subject.renderer.method.plan(frame, lens)
    structure = plan.structure
    if subject.method == "layered":
        from cldof.methods.layered import layer_coc

        coc = list(layer_coc(structure))
    elif subject.method == "pyramid":
        coc = [2.0 * subject.renderer.method._radius(i) for i in structure.indices]
    elif subject.method == "multiview":
        layers = subject.renderer.method.layering(frame, lens)
        coc = [*layers.limits[1:-1], *layers.coc]
    else:
        coc = list(np.linspace(-9.0, 9.0, 10))
    depths = [lens.depth_of_coc_m(frame.camera, float(c)) for c in coc]
    return [z for z in depths if 0.3 < z < 30.0]


def test_at_every_boundary_of_layers(subject: Subject) -> None:
    """A plane at each boundary and one ULP to either side: stays opaque and white, and does not flicker."""
    case = "at layer boundaries, +-1 ULP"
    lens = Lens(12.0 / CAMERA.focal_px, 1.5)
    white, noise = np.ones((H, W, 4), np.float32), textured(H, W)

    def framed(z: np.float32, image: np.ndarray) -> LayeredFrame:
        depth = np.full((H, W), z, np.float32)
        depth[0, 0], depth[-1, -1] = 0.3, np.inf  # the same layers for all
        return LayeredFrame(image, depth, CAMERA)

    found = boundaries(subject, framed(np.float32(1.5), noise), lens)
    assert found
    for z in found[:: max(1, len(found) // 12)]:
        middle = np.float32(z)
        depths = (np.nextafter(middle, np.float32(0)), middle, np.nextafter(middle, np.float32(np.inf)))
        for one in depths:
            image = subject.render(framed(one, white), lens)
            subject.check(case, "white stays white", np.abs(image - 1.0).max(), 1e-3)
            keep_promises(subject, case, framed(one, white), image)
        below, at, above = (subject.render(framed(one, noise), lens)[5:-5, 5:-5] for one in depths)
        jump = max(np.abs(at - below).max(), np.abs(above - at).max())
        # Rays meet each layer at one CoC, half a pixel from the next.
        subject.check(case, "noise jumps within 1 ULP by", jump, 0.8 if subject.method == "multiview" else 1e-2)


def grazing(degrees: float, camera: Camera) -> tuple[np.ndarray, float]:
    """Inverse depths of a plane that recedes upwards through focus at 2 m, and their change per row."""
    y = (np.arange(camera.height) - (camera.height - 1) / 2) / camera.focal_px
    slope = math.tan(math.radians(degrees)) / 2.0
    return np.broadcast_to((0.5 + slope * y)[:, None], (camera.height, camera.width)), slope / camera.focal_px


def waves(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return 0.5 + 0.5 * np.sin(x * (2 * math.pi / 11)) * np.sin(y * (2 * math.pi / 13) + 0.3)


# RMS error on smooth waves against exact rays: a method's own error, from its steps in blur.
GRAZING = {"gather": 0.03, "layered": 0.015, "lightfield": 0.015, "multiview": 0.015, "pyramid": 0.025}


@pytest.mark.parametrize("coc_per_inverse_m", [2.0, 6.0])
def test_a_plane_at_85_degrees_through_focus(subject: Subject, coc_per_inverse_m: float) -> None:
    case = "a plane at 85 degrees through focus"
    camera = Camera(96, 80, 40.0)
    inverse, step = grazing(85.0, camera)
    depth = 1.0 / np.clip(inverse, 0.02, None)
    lens = Lens(coc_per_inverse_m / camera.focal_px, 2.0)
    white = LayeredFrame(np.ones((80, 96, 4), np.float32), depth.astype(np.float32), camera)
    image = subject.render(white, lens)
    keep_promises(subject, case, white, image)
    subject.check(case, "white stays white", np.abs(image - 1.0).max(), 1e-3)
    # A black wall far behind must not show through the plane where it is steep.
    before_black = LayeredFrame(
        np.stack([white.color[0], np.broadcast_to(np.float32((0, 0, 0, 1)), (80, 96, 4))]),
        np.stack([white.depth[0], np.full((80, 96), 1e4, np.float32)]),
        camera,
    )
    image = subject.render(before_black, lens)
    subject.check(case, "black behind shows by", 1.0 - image[12:-12, 16:-16, :3].min(), 0.06)
    # Where the plane has moved off the frame's edge nobody knows what is there, but not the wall.
    bound = {"lightfield": 0.0, "gather": 0.0}.get(subject.method, 0.15)
    subject.check(case, "black behind shows at the frame's edges by", 1.0 - image[..., :3].min(), bound)
    y, x = np.mgrid[:80, :96].astype(np.float64)
    shown = np.ones((80, 96, 4), np.float32)
    shown[..., :3] = waves(x, y)[..., None]
    image = subject.render(LayeredFrame(shown, white.depth, camera), lens)
    shape = "gaussian" if subject.is_gaussian else "disc"
    expected, reach = plane_oracle.tilted(waves, (80, 96), 0.0, -coc_per_inverse_m * step, lens_samples(512, shape))
    seen = (reach[:, 0] >= np.flatnonzero(inverse[:, 0] > 0.02)[0]) & (reach[:, 1] <= 79)
    assert seen.sum() > 20
    error = (image[..., 0] - expected)[seen][:, 24:-24]
    bound = 0.04 if " " in subject.name else GRAZING[subject.method]
    subject.check(case, "RMS against exact rays", np.sqrt((error**2).mean()), bound)


# A lone pixel's coverage is 1: what share of it a method loses or makes up. Gathering spreads nothing over what is in
# focus. The others take neighbours up to a pixel or two of CoC apart for one surface, which a lone pixel is not part
# of, and count it more than once; the published mattings do so everywhere.
LONE = {"gather": 1.01, "layered": 0.75, "lightfield": 1.6, "multiview": 0.01, "pyramid": 1.1, "layered paper": 1.1}


@pytest.mark.parametrize("coc_px", [0.4, 1.0, 3.0, 8.0])
@pytest.mark.parametrize("side", ["before", "behind"])
def test_a_single_pixel_of_depth(subject: Subject, coc_px: float, side: str) -> None:
    """One white pixel before a black wall in focus, or before a black wall as far as itself behind focus."""
    case = f"a single pixel {side} focus"
    where = np.zeros((H, W), bool)
    where[H // 2, W // 2] = True
    black = np.broadcast_to(np.float32((0, 0, 0, 1)), (H, W, 4))
    near_m, far_m, focus_m = (1.0, 2.0, 2.0) if side == "before" else (2.0, 2.5, 1.0)
    frame = two_layers(WHITE, near_m, black, far_m, where)
    image = subject.render(frame, lens_at(coc_px, near_m, focus_m))
    keep_promises(subject, case, frame, image)
    bound = LONE.get(subject.name, LONE[subject.method])
    subject.check(case, "energy off by, share", abs(image[..., 0].sum() - 1.0), bound)


def test_nothing_between_two_surfaces(subject: Subject) -> None:
    """Many depth layers and one peel with nothing in them, between full ones, add nothing."""
    case = "an empty layer between full ones"
    lens = Lens(18.0 / CAMERA.focal_px, 1.5)
    near, far = textured(H, W), textured(H, W, 1)
    frame = two_layers(near, 0.9, far, 30.0, disc(14))
    image = subject.render(frame, lens)
    keep_promises(subject, case, frame, image)
    color = np.stack([frame.color[0], np.zeros_like(far), frame.color[1]])
    depth = np.stack([frame.depth[0], frame.depth[0], frame.depth[1]])
    with_empty = subject.render(LayeredFrame(color, depth, CAMERA), lens)
    subject.check(case, "transparent peel changes", np.abs(with_empty - image).max(), 1e-6)
    after = LayeredFrame(
        np.concatenate([frame.color, np.zeros_like(frame.color[:1])]),
        np.concatenate([frame.depth, np.full((1, H, W), np.inf, np.float32)]),
        CAMERA,
    )
    subject.check(case, "empty last peel changes", np.abs(subject.render(after, lens) - image).max(), 1e-6)


@pytest.mark.parametrize("coc_px", [0.0, 7.0])
@pytest.mark.parametrize("peels", [2, 5, 16])
def test_all_peels_are_the_same(method: Subject, peels: int, coc_px: float) -> None:
    case = "all peels equal"
    lens = lens_at(coc_px, 3.0, 2.0)
    one = one_plane(3.0)
    frame = LayeredFrame(np.repeat(one.color, peels, 0), np.repeat(one.depth, peels, 0), CAMERA)
    image = method.render(frame, lens)
    keep_promises(method, case, frame, image)
    method.check(case, "changes one peel's image by", np.abs(image - method.render(one, lens)).max(), 1e-6)
