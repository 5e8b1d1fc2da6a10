"""Captured colours against the float64 twin of the shaders, with surface buffers and lighting as captured."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cldof import Lens
from cldof.capture.accumulate import accumulate
from cldof.capture.draw import View
from cldof.capture.peel import DepthPeeler
from cldof.capture.scene import Environment, Material, Node, Scene
from cldof.capture.shapes import ball, moved
from tests.oracles import shading as oracle
from tests.shaded import LIGHTS, environment

from .conftest import camera_at, quad


def glossy_scene(lit_by: Environment | None = None) -> Scene:
    """Balls of metal and plastic before a board, under a sun, a lamp and a spot."""
    amber = (0.8, 0.5, 0.2, 1.0)
    balls = [
        Node(moved(ball(0.3, 48), (x, 0.0, -1.4)), material=Material(amber, metallic=metal, roughness=rough))
        for x, metal, rough in ((-0.4, 1.0, 0.3), (0.4, 0.0, 0.15))
    ]  # fmt: skip
    board = quad(2.0, material=Material((0.6, 0.6, 0.7, 1.0), roughness=0.5))
    return Scene(
        "glossy", (*balls, board), lights=LIGHTS.lights, ambient=LIGHTS.ambient, background=(0.1, 0.2, 0.3),
        environment=lit_by,
    )  # fmt: skip


@pytest.mark.parametrize("lit_by", [None, environment()], ids=["hemisphere", "environment"])
def test_colours_are_those_of_the_twin(peeler: DepthPeeler, lit_by: Environment | None) -> None:
    """All but the pixels at silhouettes, where a vertex normal at a pixel's centre may lie outside of its triangle."""
    scene = glossy_scene(lit_by)
    frame = peeler.peel(scene, camera_at(96, 96, eye=(0.05, 0.2, 0.1)), layers=2, guard_px=4, surface=True)
    buffers = {name: array.astype(np.float64) for name, array in frame.surface.items()}
    with np.errstate(divide="ignore"):
        where = oracle.positions(1.0 / frame.depth.astype(np.float64), frame.inputs["lighting"])
    expected = oracle.shade(
        where, buffers["normal"], buffers["albedo"], buffers["specular"], oracle.roughness(buffers["shininess"]),
        frame.camera.pose[:3, 3], scene.lighting,
    )  # fmt: skip
    is_surface = frame.depth < np.inf
    error = np.abs(frame.color[..., :3] - expected)[is_surface] / (0.02 + expected[is_surface])
    assert np.quantile(error, 0.999) < 2e-3
    assert is_surface.mean() > 0.5 and frame.is_glossy


def test_what_is_unlit_or_far_mirrors_nothing(peeler: DepthPeeler) -> None:
    scene = glossy_scene()
    unlit = replace(scene, unlit=True)
    frame = peeler.peel(unlit, camera_at(), surface=True)
    assert not frame.is_glossy
    np.testing.assert_array_equal(frame.surface["specular"], 0.0)
    sky = peeler.peel(replace(scene, nodes=scene.nodes[:1]), camera_at(), surface=True)
    assert (sky.surface["specular"][sky.depth == np.inf] == 0.0).all()


def test_the_sky_may_be_the_environment(peeler: DepthPeeler) -> None:
    around = environment()
    camera = camera_at(32, 32, 90.0)
    frame = peeler.peel(Scene("sky", (quad(50.0, 0.01),), background=around), camera)
    y, x = np.mgrid[:32, :32] + 0.5
    towards = np.stack([(x - 16) / 16, (16 - y) / 16, -np.ones_like(x)], axis=-1)
    expected = oracle.octahedral(around.levels[0], towards)
    is_sky = frame.depth[0] == np.inf
    np.testing.assert_allclose(frame.color[0, ..., :3][is_sky], expected[is_sky], atol=2e-5)


def test_views_are_shaded_from_their_own_points(peeler: DepthPeeler) -> None:
    """One view of a lens against the twin, and against a capture through a camera that stands where it stands."""
    scene, camera = glossy_scene(), camera_at(96, 96)
    point = (0.11, -0.07)
    # Focused at infinity the view from a lens point is a plain picture of a moved camera.
    pose = np.eye(4)
    pose[:3, 3] = *point, 0.0
    moved_camera = replace(camera, pose=pose)
    images = {}
    with peeler.current():
        from cldof.capture.draw import PassOptions

        for shaded in (False, True):
            view = View(camera, point, np.inf, shade_from_lens_point=shaded)
            for target in peeler.passes(scene, view, 1, PassOptions()):
                images[shaded] = target.read(0, np.empty((96, 96, 4), np.float32))
    expected = peeler.peel(scene, moved_camera, layers=1).color[0]
    difference = np.abs(images[True] - expected)[..., :3]
    assert np.quantile(difference, 0.99) < 2e-3
    assert np.abs(images[False] - expected)[..., :3].max() > 0.1


def test_accumulation_may_shade_from_the_centre(peeler: DepthPeeler) -> None:
    scene, camera = glossy_scene(), camera_at(96, 96)
    lens = Lens(0.05, 1.4)
    own = accumulate(peeler, scene, camera, lens, 16).image
    centre = accumulate(peeler, scene, camera, lens, 16, view_dependent=False).image
    assert np.abs(own - centre).max() > 0.02
    matte = replace(scene, unlit=True)
    np.testing.assert_array_equal(
        accumulate(peeler, matte, camera, lens, 16).image,
        accumulate(peeler, matte, camera, lens, 16, view_dependent=False).image,
    )
