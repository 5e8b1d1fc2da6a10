"""Property-based: random frames and lenses keep what DESIGN section 4 promises, for every method.

What hypothesis finds is shrunk, kept in its database (tests/conftest.py says where) and tried first the next time; it
belongs here as an ``@example``.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

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
# Devices take denormals for 0: test_radiance.py has those.
LIGHT = st.one_of(st.sampled_from([0.0, 1e-8, 0.5, 1.0, 1e6]), st.floats(0.0, 2.0**20, width=32, allow_subnormal=False))
ALPHA = st.sampled_from([0.0, 1.0 / 255.0, 0.5, 254.0 / 255.0, 1.0])


class Scene(NamedTuple):
    """A few kinds of surface, (depth, red, green, alpha) each, scattered over pixels and peels by a small pattern.

    All that a frame is made of, so that what hypothesis prints of a failure can be written down as an ``@example``.
    """

    width: int
    height: int
    peels: int
    guard_px: int
    kinds: list[tuple[float, float, float, float]]
    side: int
    seed: int

    def frame(self, opaque: bool) -> LayeredFrame:
        """Peels by increasing depth, the last without holes if it has to be opaque."""
        rng = np.random.default_rng(self.seed)
        shape = (self.peels, self.height + 2 * self.guard_px, self.width + 2 * self.guard_px)
        coarse = rng.integers(0, len(self.kinds), (self.peels, shape[1] // self.side + 1, shape[2] // self.side + 1))
        kind = coarse.repeat(self.side, 1).repeat(self.side, 2)[:, : shape[1], : shape[2]]
        table = np.array(self.kinds, np.float32)[kind]
        order = np.argsort(table[..., 0], axis=0, kind="stable")
        table = np.take_along_axis(table, order[..., None], 0)
        alpha = table[..., 3].copy()
        if opaque:
            alpha[-1] = 1.0
        color = np.stack([table[..., 1], table[..., 2], np.zeros(shape, np.float32), np.ones(shape, np.float32)], -1)
        camera = Camera(self.width, self.height, 40.0)
        depth = np.ascontiguousarray(table[..., 0])
        return LayeredFrame(color * alpha[..., None], depth, camera, guard_px=self.guard_px)


SCENES = st.builds(
    Scene,
    width=st.integers(1, 40),
    height=st.integers(1, 30),
    peels=st.integers(1, 4),
    guard_px=st.sampled_from([0, 0, 2]),
    kinds=st.lists(st.tuples(DEPTHS, LIGHT, LIGHT, ALPHA), min_size=1, max_size=5),
    side=st.integers(1, 8),
    seed=st.integers(0, 99),
)
# From pinholes to apertures wider than the scene: CoC one metre in inverse depth from focus, px, and the focus.
COC = st.one_of(st.sampled_from([0.0, 1e-6, 0.25, 0.5, 1.0]), st.floats(0.0, 60.0))
FOCUS = st.one_of(st.sampled_from([1e-3, 1.0, 1e6, math.inf]), st.floats(1e-3, 1e3))

# Found: slots without light or coverage at finite depths, in front of a wall and of void.
CLEAR_SLOTS = Scene(24, 16, 2, 0, [(0.5, 0.0, 0.0, 0.0), (4.0, 1.0, 0.5, 1.0)], 3, 0)
# A lamp of 1e6 in one pixel of glass among void at infinity, in an image of a few pixels.
LAMP = Scene(5, 3, 3, 2, [(1e-3, 1e6, 0.0, 1.0 / 255.0), (math.inf, 1e-8, 0.0, 0.0), (1.0, 0.0, 1e6, 1.0)], 1, 7)
# Two surfaces a rounding apart, at focus and not.
FIGHTING = Scene(31, 17, 2, 0, [(1.0, 1.0, 0.0, 1.0), (1.0000001, 0.0, 1.0, 1.0), (1e6, 0.5, 0.5, 1.0)], 1, 3)

# Found: coverage of 1 and a rounding before faint light, of which "over" left less than nothing.
FAINT = Scene(
    4, 1, 2, 0, [(1e-3, 0.0, 0.0, 0.0), (0.5, 0.0, 1e-8, 0.0), (1e-3, 0.0, 0.0, 1.0), (1e-3, 0.0, 0.0, 0.0)], 1, 0
)

# Found: four panes before one another, of which the light field keeps two apart.
FOUR_PANES = Scene(1, 1, 4, 0, [(1e-3, 0.0, 0.0, 1.0 / 255.0), (math.inf, 0.0, 0.5, 1.0 / 255.0)], 1, 0)

# Found: glass at infinity before an opaque slot at infinity, which the light field took for void.
PANES_AT_INFINITY = Scene(1, 2, 3, 0, [(1e-3, 0.0, 0.0, 1.0 / 255.0), (math.inf, 0.0, 0.5, 1.0 / 255.0)], 1, 0)


def lens_of(frame: LayeredFrame, coc_px: float, focus_m: float) -> Lens:
    return Lens(coc_px / frame.camera.focal_px, focus_m)


@pytest.mark.parametrize("opaque", [True, False], ids=["opaque", "void"])
@hard
@given(scene=SCENES, coc_px=COC, focus_m=FOCUS)
@example(scene=CLEAR_SLOTS, coc_px=9.0, focus_m=2.0)
@example(scene=LAMP, coc_px=60.0, focus_m=math.inf)
@example(scene=FIGHTING, coc_px=0.5, focus_m=1.0)
@example(scene=FOUR_PANES, coc_px=0.0, focus_m=1e-3)
@example(scene=PANES_AT_INFINITY, coc_px=0.0, focus_m=1e-3)
@example(scene=FAINT, coc_px=0.25, focus_m=1.0)
def test_promises(method: Subject, opaque: bool, scene: Scene, coc_px: float, focus_m: float) -> None:
    frame = scene.frame(opaque)
    keep_promises(method, "random frames", frame, method.render(frame, lens_of(frame, coc_px, focus_m)))


@hard
@given(scene=SCENES, coc_px=COC, focus_m=FOCUS, light=LIGHT)
@example(scene=CLEAR_SLOTS, coc_px=9.0, focus_m=2.0, light=1.0)
@example(scene=FIGHTING, coc_px=60.0, focus_m=1e6, light=1e6)
def test_one_colour_stays(method: Subject, scene: Scene, coc_px: float, focus_m: float, light: float) -> None:
    """Whatever the depths, an opaque scene of one colour shows that colour."""
    frame = scene.frame(True)
    color = np.where(frame.color[..., 3:] > 0, np.float32((light, light, light, 1.0)), 0).astype(np.float32)
    frame = LayeredFrame(color, frame.depth, frame.camera, guard_px=frame.guard_px)
    image = method.render(frame, lens_of(frame, coc_px, focus_m))
    off = np.abs(image[..., :3] - np.float32(light)).max() / (light or 1.0)
    method.check("random frames", "one colour off by, share", off, 1e-3)


@hard
@given(scene=SCENES, focus_m=st.sampled_from([1e-3, 0.3, 1.0, 2.0, 1e3, math.inf]), coc_px=st.floats(0.0, 100.0))
@example(scene=LAMP, focus_m=math.inf, coc_px=100.0)
def test_in_focus_nothing_changes(method: Subject, scene: Scene, focus_m: float, coc_px: float) -> None:
    """One opaque plane in focus, whatever the lens."""
    frame = scene.frame(True)
    focus_m = float(np.float32(focus_m))
    depth = np.full(frame.depth.shape[1:], focus_m, np.float32)
    alone = LayeredFrame(frame.color[-1], depth, frame.camera, guard_px=frame.guard_px)
    image = method.render(alone, lens_of(frame, coc_px, focus_m))
    pinhole = alone.pinhole_image()
    off = (np.abs(image - pinhole) / np.maximum(1.0, pinhole.max())).max()
    method.check("random frames", "in focus, changed by", off, 2e-6)


@hard
@given(scene=SCENES, opaque=st.booleans(), focus_m=st.sampled_from([1e-3, 1.0, math.inf]))
@example(scene=CLEAR_SLOTS, opaque=False, focus_m=1.0)
@example(scene=LAMP, opaque=False, focus_m=1.0)
def test_a_pinhole_is_the_pinhole_image(method: Subject, scene: Scene, opaque: bool, focus_m: float) -> None:
    frame = scene.frame(opaque)
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
@given(scene=SCENES, coc_px=COC, focus_m=FOCUS, opaque=st.booleans())
@example(scene=LAMP, coc_px=7.0, focus_m=2.0, opaque=False)
def test_mirror_symmetry(
    subjects: Callable[[str], Subject], name: str, scene: Scene, coc_px: float, focus_m: float, opaque: bool
) -> None:
    method = subjects(name)
    frame = scene.frame(opaque)
    lens = lens_of(frame, coc_px, focus_m)
    mirrored = LayeredFrame(
        np.ascontiguousarray(frame.color[:, ::-1, ::-1]),
        np.ascontiguousarray(frame.depth[:, ::-1, ::-1]),
        frame.camera,
        guard_px=frame.guard_px,
    )
    one, other = method.render(frame, lens), method.render(mirrored, lens)[::-1, ::-1]
    off = np.abs(one - other).max() / max(1.0, float(frame.color.max()))
    method.check("random frames", "mirrored image differs by", off, 1e-4)
