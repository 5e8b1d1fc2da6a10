"""Alpha: frames with nothing in them, nearly nothing, glass, and hairs."""

from __future__ import annotations

import numpy as np
import pytest

from cldof import LayeredFrame, Lens

from .conftest import Subject
from .promises import CAMERA, checkered, keep_promises, lens_at, textured

H, W = CAMERA.height, CAMERA.width


def panes(*slots: tuple[np.ndarray, float]) -> LayeredFrame:
    """Fronto-parallel peels of premultiplied images at depths."""
    color = np.stack([image for image, _ in slots]).astype(np.float32)
    depth = np.stack([np.full((H, W), depth_m, np.float32) for _, depth_m in slots])
    return LayeredFrame(color, depth, CAMERA)


def flat(*rgba: float) -> np.ndarray:
    """A premultiplied image of one colour."""
    return np.broadcast_to(np.float32(rgba), (H, W, 4))


@pytest.mark.parametrize("coc_px", [0.0, 5.0, 200.0])
def test_a_fully_transparent_frame(method: Subject, coc_px: float) -> None:
    case = "fully transparent"
    clear = np.zeros((H, W, 4), np.float32)
    lens = lens_at(coc_px, 1.0, 2.0)
    for frame in (panes((clear, 1.0), (clear, 3.0)), panes((clear, np.inf)), panes((clear, 1.0), (clear, np.inf))):
        method.check(case, "anything", np.abs(method.render(frame, lens)).max(), 0.0)


@pytest.mark.parametrize("depth_m", [1.0, 2.0, 4.0])
@pytest.mark.parametrize("coc_px", [0.5, 4.0, 15.0])
def test_alphas_of_a_255th(subject: Subject, depth_m: float, coc_px: float) -> None:
    """One step of 8 bits, of bright paint: neither lost nor rounded up."""
    case = "alpha 1/255"
    alpha = 1.0 / 255.0
    lens = lens_at(coc_px, 4.0, 2.0)
    frame = panes((flat(alpha, 0.5 * alpha, 30.0 * alpha, alpha), depth_m))
    image = subject.render(frame, lens)
    keep_promises(subject, case, frame, image)
    off = np.abs(image / frame.color[0] - 1.0)
    # Of the largest CoC in either direction, that of the void.
    inner = (slice(16, -16), slice(16, -16))
    if coc_px <= 4.0:
        subject.check(case, "off by, share", off[inner].max(), 1e-5)
    # Rays of which only a part is known count as if that were all.
    subject.check(case, "off at the frame's edges by, share", off.max(), 1.0 if subject.method == "multiview" else 1e-5)
    noise = textured(H, W) * (np.random.default_rng(2).random((H, W, 1)) < 0.5) * np.float32(alpha)
    frame = panes((noise, depth_m))
    image = subject.render(frame, lens)
    keep_promises(subject, case, frame, image)
    # Pixels beside nothing are thin things (below).
    bound = {"gather": 0.4, "lightfield": 0.45, "pyramid": 0.5}.get(subject.method, 0.25)
    off = abs(image[inner].mean() / frame.color[0][inner].mean() - 1.0)
    subject.check(case, "mean of noise off by, share", off, bound)


@pytest.mark.parametrize("alpha", [1.0 / 255.0, 0.5, 254.0 / 255.0])
@pytest.mark.parametrize("glass_m, wall_m", [(2.0, 50.0), (0.9, 50.0), (2.0, np.inf), (3.0, 3.1)])
def test_thin_glass_over_a_far_wall(subject: Subject, alpha: float, glass_m: float, wall_m: float) -> None:
    """Both of one colour each: what comes through is exact, however both are blurred."""
    case = "glass before a far wall"
    lens = Lens(14.0 / CAMERA.focal_px, 2.0)
    frame = panes((flat(0.2 * alpha, alpha, 0.0, alpha), glass_m), (flat(5.0, 0.1, 0.7, 1.0), wall_m))
    image = subject.render(frame, lens)
    keep_promises(subject, case, frame, image)
    off = np.abs(image - frame.pinhole_image())
    # The published matting repeats glass in two layers.
    # Multiview sums up to 256 rays of a light of 5 in float32.
    bound = 1.2 if subject.name == "layered paper" else 2e-5
    subject.check(case, "off by", off[16:-16, 16:-16].max(), bound)
    # Rays of which only a part is known count as if that were all.
    if subject.method in ("lightfield", "multiview"):
        subject.check(case, "off at the frame's edges by", off.max(), 3.0)
    else:
        subject.check(case, "off at the frame's edges by", off.max(), bound)


# Blurred coverage of a hair: what of its light is lost or made up. Gathering keeps nearer things as thin as they were.
HAIRS = {"gather": 1.0, "layered": 0.55, "lightfield": 0.45, "multiview": 1.4, "pyramid": 1.0}


@pytest.mark.parametrize("coc_px", [1.5, 4.0, 10.0])
@pytest.mark.parametrize("side", ["before", "behind"])
def test_hair_thin_strips(subject: Subject, coc_px: float, side: str) -> None:
    """Opaque strips a pixel wide, 12 px apart, before a black wall or nothing: a twelfth of white."""
    case = f"strips a pixel wide, {side} focus"
    x = np.arange(W)
    where = np.broadcast_to(x % 12 == 6, (H, W))
    near_m, far_m, focus_m = (1.0, 2.0, 2.0) if side == "before" else (2.0, 4.0, 1.0)
    white = flat(1.0, 1.0, 1.0, 1.0) * where[..., None]
    depth = np.where(where, np.float32(near_m), np.float32(far_m))
    lens = lens_at(coc_px, near_m, focus_m)
    color = np.stack([np.where(where[..., None], 1.0, flat(0, 0, 0, 1)), flat(0, 0, 0, 1)]).astype(np.float32)
    frame = LayeredFrame(color, np.stack([depth, np.full((H, W), far_m, np.float32)]), CAMERA)
    image = subject.render(frame, lens)
    keep_promises(subject, case, frame, image)
    inner = image[8:-8, 18:42]  # two periods
    bound = HAIRS[subject.method] if "paper" not in subject.name else 1.0
    subject.check(case, "light off by, share", abs(inner[..., 0].mean() * 12.0 - 1.0), bound)
    alone = LayeredFrame(
        white[None].astype(np.float32), np.where(where, np.float32(near_m), np.inf)[None].astype(np.float32), CAMERA
    )
    image = subject.render(alone, lens)
    keep_promises(subject, case, alone, image)
    inner = image[8:-8, 18:42]
    subject.check(case, "alpha off by, share", abs(inner[..., 3].mean() * 12.0 - 1.0), bound)


def test_a_checkered_stencil(method: Subject) -> None:
    """Holes and paint in turn, half and half: premultiplied light never exceeds what the alpha allows."""
    case = "a stencil of holes"
    stencil = checkered(H, W, 1)
    stencil[..., 3] = stencil[..., 0]
    for depth_m in (0.8, 2.0, 7.0):
        frame = panes((stencil, depth_m))
        image = method.render(frame, Lens(12.0 / CAMERA.focal_px, 2.0))
        keep_promises(method, case, frame, image)
        method.check(case, "light above alpha", max(0.0, (image[..., :3] - image[..., 3:]).max()), 1e-4)


@pytest.mark.parametrize("opaque", [True, False], ids=["opaque", "void"])
def test_clear_slots_hide_nothing(method: Subject, opaque: bool) -> None:
    """Found by hypothesis: slots without light or coverage at finite depths, in front of a wall, change nothing."""
    case = "clear slots at finite depths"
    wall = textured(H, W)
    if not opaque:
        wall[:, 40:] = 0.0
    far = np.where(wall[..., 3] > 0, np.float32(4.0), np.inf)
    y, x = np.mgrid[:H, :W]
    near = np.where((x // 3 + y // 5) % 2, np.float32(0.5), np.float32(1.7))
    lens = Lens(9.0 / CAMERA.focal_px, 2.0)
    alone = LayeredFrame(wall, far, CAMERA)
    behind = LayeredFrame(np.stack([np.zeros_like(wall), wall]), np.stack([near, far]), CAMERA)
    image = method.render(behind, lens)
    keep_promises(method, case, behind, image)
    # The range of depths, and with it the layers, takes in the clear slots.
    bound = {"pyramid": 0.05, "layered": 0.05, "multiview": 0.3}.get(method.method, 1e-5)
    method.check(case, "changes the wall behind by", np.abs(image - method.render(alone, lens)).max(), bound)
