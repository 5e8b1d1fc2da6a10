"""Sizes: a pixel, lines, primes, ribbons, 4K, and as many or as few layers as there may be."""

from __future__ import annotations

import numpy as np
import pytest

from cldof import Camera, LayeredFrame, Lens, Renderer
from tests.frames import noise_frame

from .conftest import Subject
from .promises import keep_promises, one_plane

SIZES = [(1, 1), (2, 1), (1, 2), (1, 97), (97, 1), (2, 211), (3, 3), (17, 31), (127, 7), (61, 67), (257, 16)]


@pytest.mark.parametrize("size", SIZES, ids=lambda size: f"{size[0]}x{size[1]}")
@pytest.mark.parametrize("opaque", [True, False], ids=["opaque", "void"])
def test_awkward_sizes(method: Subject, size: tuple[int, int], opaque: bool) -> None:
    """1x1, lines and primes, blurred a little and by far more than they are wide, with and without a guard band."""
    width, height = size
    for guard_px, coc_px in ((0, 1.3), (0, 40.0), (3, 40.0)):
        frame = noise_frame(width, height, opaque=opaque, seed=width, guard_px=guard_px)
        white = LayeredFrame(np.where(frame.color[..., 3:] > 0, np.float32(1), 0) * np.ones(4, np.float32), frame.depth,
                             frame.camera, guard_px=guard_px)  # fmt: skip
        lens = Lens(coc_px / frame.camera.focal_px, 1.7)
        image = method.render(frame, lens)
        assert image.shape == (height, width, 4)
        keep_promises(method, "awkward sizes", frame, image)
        if opaque and guard_px == 0:
            off = np.abs(method.render(white, lens) - 1.0).max()
            method.check("awkward sizes", "white stays white", off, 1e-3)


def wide_frame(width: int, height: int, far_only: bool) -> LayeredFrame:
    """Half a wall in focus, half a little behind it: few layers."""
    camera = Camera(width, height, 40.0)
    image = np.empty((height, width, 4), np.float32)
    image[..., :3] = np.random.default_rng(0).random((height, width, 1), np.float32)
    image[..., 3] = 1.0
    depth = np.full((height, width), 2.0, np.float32)
    depth[:, width // 2 :] = 2.5 if far_only else 1.6
    return LayeredFrame(image, depth, camera)


def check_wide(subject: Subject, case: str, frame: LayeredFrame, coc_px: float) -> None:
    """In focus untouched, the mean kept, the promises kept."""
    width = frame.width
    lens = Lens(coc_px / frame.camera.focal_px / abs(1 / 2.0 - 1 / float(frame.depth[0, 0, -1])), 2.0)
    image = subject.renderer.render(frame, lens).image
    assert np.isfinite(image).all()
    keep_promises(subject, case, frame, image)
    reach = int(3 * coc_px) + 2
    focus = np.abs(image[:, : width // 2 - reach] - frame.color[0, :, : width // 2 - reach]).max()
    subject.check(case, "in focus, changed by", focus, 1e-6)
    blurred = (
        slice(reach, -reach or None) if frame.height > 4 * reach else slice(None),
        slice(width // 2 + reach, -reach),
    )
    off = abs(image[blurred][..., 0].mean(dtype=np.float64) - frame.color[0][blurred][..., 0].mean(dtype=np.float64))
    subject.check(case, "mean of the blurred half off by", off, 5e-3)


def test_a_ribbon(method: Subject) -> None:
    frame = wide_frame(4096, 16, far_only=True)
    check_wide(method, "4096x16", frame, 3.0)


def test_uhd(subject: Subject) -> None:
    """3840x2160. Little blur, so few layers: minutes on llvmpipe, where it is left out."""
    if subject.is_slow:
        pytest.skip("8 million pixels take llvmpipe minutes")
    # Few rays and views: the size is the point.
    few = {"multiview": {"rays": 4, "layers": 5}, "lightfield": {"views": 4}, "gather": {"samples": 8}}
    frame = wide_frame(3840, 2160, far_only=True)
    case = "3840x2160"
    with Renderer(
        subject.method, device=subject.info.index, **subject.options, **few.get(subject.method, {})
    ) as renderer:
        lens = Lens(1.0 / frame.camera.focal_px / 0.1, 2.0)
        image = renderer.render(frame, lens).image
    assert np.isfinite(image).all()
    sharp = np.abs(image[:, :1900] - frame.color[0, :, :1900]).max()
    subject.check(case, "in focus, changed by", sharp, 1e-6)
    bound = 0.1 if subject.name == "pyramid paper" else 1e-3
    subject.check(case, "opaque: 1 - alpha", np.abs(image[..., 3] - 1.0).max(), bound)
    # The far corner and the last rows are computed like any others.
    crop = LayeredFrame(
        np.ascontiguousarray(frame.color[:, -64:, -96:]), np.full((64, 96), 2.5, np.float32), Camera(96, 64, 40.0)
    )
    alone = subject.renderer.render(crop, Lens(1.0 / crop.camera.focal_px / 0.1, 2.0)).image
    corner = np.abs(alone[16:, 16:, 0].mean() - image[-48:, -80:, 0].mean())
    subject.check(case, "last corner's mean off by", corner, 5e-3)


LAYER_OPTIONS = [
    ("layered", {"layers": 3}),
    ("layered", {"layers": 32, "sigma_step": 0.1}),
    ("multiview", {"layers": 5}),
    ("multiview", {"layers": 32, "delta_px": 0.1}),
    ("multiview", {"rays": 1}),
    ("multiview", {"rays": 1024}),
    ("lightfield", {"views": 1}),
    ("lightfield", {"views": 1024}),
    ("lightfield", {"peels": 16}),
    ("pyramid", {"sub_images": (0, 0)}),
    ("pyramid", {"sub_images": (-9, 9)}),
    ("gather", {"samples": 1}),
    ("gather", {"samples": 4096}),
]


@pytest.mark.parametrize("name, options", LAYER_OPTIONS, ids=lambda value: str(value))
def test_least_and_greatest(subjects, device_info, name: str, options: dict) -> None:  # type: ignore[no-untyped-def]
    """K, rays, views and samples at their ends; more layers than the scene has depths."""
    subject = subjects(name)
    if subject.is_slow and max((v for v in options.values() if isinstance(v, int)), default=0) > 100:
        pytest.skip("a thousand samples take llvmpipe minutes")
    frame = noise_frame(53, 37, seed=9)
    two = one_plane(np.where(np.arange(53) < 20, 1.0, 4.0), np.ones((37, 53, 4), np.float32), Camera(53, 37, 40.0))
    with Renderer(name, device=device_info.index, **options) as renderer:
        for coc_px in (0.5, 12.0):
            lens = Lens(coc_px / frame.camera.focal_px, 1.7)
            image = renderer.render(frame, lens).image
            keep_promises(subject, "least and greatest options", frame, image)
            off = np.abs(renderer.render(two, lens).image - 1.0).max()
            subject.check("least and greatest options", "white stays white", off, 1e-3)


@pytest.mark.parametrize("peels", [1, 16, 24])
def test_many_peels(method: Subject, peels: int) -> None:
    frame = noise_frame(31, 23, peels, seed=peels)
    image = method.render(frame, Lens(6.0 / frame.camera.focal_px, 1.7))
    keep_promises(method, "1 to 24 peels", frame, image)
