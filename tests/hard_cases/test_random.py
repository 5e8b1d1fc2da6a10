"""Property-based: random frames and lenses keep what DESIGN section 4 promises, for every method.

What hypothesis finds is shrunk and belongs here as an ``@example``; its own database lies in ``.hypothesis``.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, assume, example, given, settings
from hypothesis import strategies as st

from cldof import Camera, LayeredFrame, Lens
from tests.frames import noise_frame

from .conftest import Subject
from .promises import keep_promises

_EXAMPLES = 20
hard = settings(max_examples=_EXAMPLES, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])

# Depths of all sizes, among them ones that are the same, infinite or a rounding apart.
DEPTHS = st.one_of(
    st.sampled_from([1e-3, 0.5, 1.0, 1.0000001, 2.0, 1e6, math.inf]), st.floats(2.0**-10, 2.0**20, width=32)
)
LIGHT = st.one_of(st.sampled_from([0.0, 1e-8, 0.5, 1.0, 1e6]), st.floats(0.0, 2.0**20, width=32))
ALPHA = st.sampled_from([0.0, 1.0 / 255.0, 0.5, 254.0 / 255.0, 1.0])


@st.composite
def frames(draw: Callable[..., Any], opaque: bool) -> LayeredFrame:
    """A few slots of a few surfaces, scattered over pixels by a small pattern."""
    width, height, peels = draw(st.integers(1, 40)), draw(st.integers(1, 30)), draw(st.integers(1, 4))
    guard_px = draw(st.sampled_from([0, 0, 2]))
    kinds = draw(st.lists(st.tuples(DEPTHS, LIGHT, LIGHT, ALPHA), min_size=1, max_size=5))
    side, seed = draw(st.integers(1, 8)), draw(st.integers(0, 99))
    rng = np.random.default_rng(seed)
    shape = (peels, height + 2 * guard_px, width + 2 * guard_px)
    coarse = rng.integers(0, len(kinds), (peels, shape[1] // side + 1, shape[2] // side + 1))
    kind = coarse.repeat(side, 1).repeat(side, 2)[:, : shape[1], : shape[2]]
    table = np.array(kinds, np.float32)[kind]
    order = np.argsort(table[..., 0], axis=0, kind="stable")
    table = np.take_along_axis(table, order[..., None], 0)
    alpha = table[..., 3].copy()
    if opaque:
        alpha[-1] = 1.0
    color = np.stack([table[..., 1], table[..., 2], np.zeros(shape, np.float32), np.ones(shape, np.float32)], -1)
    return LayeredFrame(
        color * alpha[..., None], np.ascontiguousarray(table[..., 0]), Camera(width, height, 40.0), guard_px=guard_px
    )


@st.composite
def lenses(draw: Callable[..., Any], camera: Camera) -> Lens:
    """From pinholes to apertures wider than the scene; CoC of ``coc_px`` one metre in inverse depth from focus."""
    coc_px = draw(st.one_of(st.sampled_from([0.0, 1e-6, 0.25, 0.5, 1.0]), st.floats(0.0, 60.0)))
    focus_m = draw(st.one_of(st.sampled_from([1e-3, 1.0, 1e6, math.inf]), st.floats(1e-3, 1e3)))
    return Lens(coc_px / camera.focal_px, focus_m)


@pytest.mark.parametrize("opaque", [True, False], ids=["opaque", "void"])
@hard
@given(data=st.data())
def test_promises(method: Subject, opaque: bool, data: st.DataObject) -> None:
    frame = data.draw(frames(opaque))
    lens = data.draw(lenses(frame.camera))
    keep_promises(method, "random frames", frame, method.render(frame, lens))


@hard
@given(data=st.data(), light=LIGHT)
def test_one_colour_stays(method: Subject, data: st.DataObject, light: float) -> None:
    """Whatever the depths, an opaque scene of one colour shows that colour."""
    frame = data.draw(frames(True))
    color = np.where(frame.color[..., 3:] > 0, np.float32((light, light, light, 1.0)), 0).astype(np.float32)
    frame = LayeredFrame(color, frame.depth, frame.camera, guard_px=frame.guard_px)
    image = method.render(frame, data.draw(lenses(frame.camera)))
    off = np.abs(image[..., :3] - np.float32(light)).max() / (light or 1.0)
    method.check("random frames", "one colour off by, share", off, 1e-3)


@hard
@given(data=st.data(), focus_m=st.sampled_from([1e-3, 0.3, 1.0, 2.0, 1e3, math.inf]), coc_px=st.floats(0.0, 100.0))
def test_in_focus_nothing_changes(method: Subject, data: st.DataObject, focus_m: float, coc_px: float) -> None:
    """One opaque plane in focus, whatever the lens."""
    frame = data.draw(frames(True))
    focus_m = float(np.float32(focus_m))
    depth = np.full(frame.depth.shape[1:], focus_m, np.float32)
    alone = LayeredFrame(frame.color[-1], depth, frame.camera, guard_px=frame.guard_px)
    image = method.render(alone, Lens(coc_px / frame.camera.focal_px, focus_m))
    pinhole = alone.pinhole_image()
    off = (np.abs(image - pinhole) / np.maximum(1.0, pinhole.max())).max()
    method.check("random frames", "in focus, changed by", off, 2e-6)


@hard
@given(data=st.data(), opaque=st.booleans(), focus_m=st.sampled_from([1e-3, 1.0, math.inf]))
def test_a_pinhole_is_the_pinhole_image(method: Subject, data: st.DataObject, opaque: bool, focus_m: float) -> None:
    frame = data.draw(frames(opaque))
    panes = ((frame.color[..., 3] > 0) & (frame.color[..., 3] < 0.999)).sum(axis=0).max()
    assume(panes <= 2 or method.method != "lightfield")
    pinhole = frame.pinhole_image()
    off = np.abs(method.render(frame, Lens(0.0, focus_m)) - pinhole).max() / max(1.0, float(pinhole.max()))
    method.check("random frames", "aperture 0, off the pinhole image by", off, 2e-6)


@settings(max_examples=5, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    size=st.tuples(st.integers(1, 40), st.integers(1, 30)),
    seed=st.integers(0, 10**6),
    coc_px=st.floats(0.0, 30.0),
    opaque=st.booleans(),
)
@example(size=(1, 1), seed=0, coc_px=5.0, opaque=True)
def test_the_same_bits_on_a_new_renderer(
    method: Subject, size: tuple[int, int], seed: int, coc_px: float, opaque: bool
) -> None:
    """Nothing is left over from the frames before."""
    from cldof import Renderer

    frame = noise_frame(*size, seed=seed, opaque=opaque)
    lens = Lens(coc_px / frame.camera.focal_px, 1.7)
    used = method.render(frame, lens)
    with Renderer(method.method, device=method.info.index) as fresh:
        changed = np.count_nonzero(fresh.render(frame, lens).image != used)
    method.check("random frames", "values that differ on a new renderer", changed, 0)


# Mirrored lenses: samples of the others are not symmetric themselves.
@pytest.mark.parametrize("name", ["layered"])
@hard
@given(data=st.data(), opaque=st.booleans())
def test_mirror_symmetry(subjects: Callable[[str], Subject], name: str, data: st.DataObject, opaque: bool) -> None:
    method = subjects(name)
    frame = data.draw(frames(opaque))
    lens = data.draw(lenses(frame.camera))
    mirrored = LayeredFrame(
        np.ascontiguousarray(frame.color[:, ::-1, ::-1]),
        np.ascontiguousarray(frame.depth[:, ::-1, ::-1]),
        frame.camera,
        guard_px=frame.guard_px,
    )
    one, other = method.render(frame, lens), method.render(mirrored, lens)[::-1, ::-1]
    off = np.abs(one - other).max() / max(1.0, float(frame.color.max()))
    method.check("random frames", "mirrored image differs by", off, 1e-4)
