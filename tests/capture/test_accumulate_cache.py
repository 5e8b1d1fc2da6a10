"""References kept on disk: what is asked for again is read, what changed or broke is drawn again."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from PIL import Image

from cldof import Lens
from cldof.capture.peel import DepthPeeler
from cldof.capture.reference_cache import ReferenceCache, scene_digest
from cldof.capture.scene import Ambient, DirectionalLight, Gradient, Material, Node, PointLight, Scene
from cldof.lens import ImageAperture, PolygonAperture
from tests.shaded import environment

from .conftest import camera_at, flat, quad


def picture(seed: int = 7) -> Image.Image:
    return Image.fromarray(np.random.default_rng(seed).integers(0, 256, (8, 8, 3), dtype=np.uint8))


def a_scene(**changes: Any) -> Scene:
    """Built anew, equal in all that shows."""
    nodes = (quad(2.0, 0.3, flat(base_color_texture=picture())), quad(3.0, 0.9, flat((0.2, 0.5, 0.1))))
    return dataclasses.replace(Scene("cards", nodes, lights=(DirectionalLight((0.0, -1.0, -1.0)),)), **changes)


@pytest.fixture
def cache(tmp_path: Path) -> ReferenceCache:
    return ReferenceCache(tmp_path / "references")


def files(cache: ReferenceCache) -> list[Path]:
    return sorted(cache.folder.iterdir())


def test_what_was_drawn_is_read(peeler: DepthPeeler, cache: ReferenceCache) -> None:
    camera, lens, calls = camera_at(32, 24), Lens(0.1, 2.5), []
    first = cache.accumulate(peeler, a_scene(), camera, lens, 8, progress=lambda *done: calls.append(done))
    assert not first.is_cached and len(calls) == 8
    again = ReferenceCache(cache.folder).accumulate(
        peeler, a_scene(name="other", focus_distance_m=1.0), camera, lens, 8, progress=lambda *done: calls.append(done)
    )
    assert again.is_cached and len(calls) == 8
    np.testing.assert_array_equal(again.image, first.image)
    assert (again.views, again.noise_rms, again.seconds) == (8, first.noise_rms, first.seconds)
    assert len(files(cache)) == 1
    assert cache.accumulate(peeler, a_scene(), camera, Lens(0.0, 2.5), 8).noise_floor_db == math.inf
    assert cache.accumulate(peeler, a_scene(), camera, Lens(0.0, 2.5), 4).is_cached  # one view, whatever is asked for
    assert cache.accumulate(peeler, a_scene(), camera, lens, 8, noise_floor=False).noise_rms is None
    assert cache.accumulate(peeler, a_scene(), camera, lens, 8, noise_floor=False).is_cached


def test_whatever_the_image_depends_on_asks_for_a_new_one(peeler: DepthPeeler, cache: ReferenceCache) -> None:
    base: dict[str, Any] = {"scene": a_scene(), "camera": camera_at(16, 12), "lens": Lens(0.1, 2.5), "views": 8}
    disc = np.hypot(*(np.indices((9, 9)) - 4.0)) < 4.0
    changes: list[dict[str, Any]] = [
        {},
        {"scene": a_scene(background=(0.1, 0.2, 0.3))},
        {"camera": camera_at(16, 12, yfov_deg=44.0)},
        {"camera": camera_at(16, 12, eye=(0.0, 0.0, 0.1))},
        {"lens": Lens(0.11, 2.5)},
        {"lens": Lens(0.1, 2.4)},
        {"lens": Lens(0.1, 2.5, aperture=PolygonAperture(5))},
        {"shape": "gaussian"},
        {"shape": ImageAperture(disc)},
        {"shape": ImageAperture(disc, ratio=2.0)},
        {"views": 9},
        {"seed": 1},
        {"jitter": True},
        {"noise_floor": False},
        {"view_dependent": False},
        {"scene": a_scene(environment=environment())},
        {"scene": a_scene(background=environment())},
    ]
    for count, change in enumerate(changes, 1):
        made = cache.accumulate(peeler, **(base | change))
        assert not made.is_cached, change
        assert len(files(cache)) == count, change


@pytest.mark.parametrize(
    "damage",
    [
        lambda data: b"",
        lambda data: b"no archive at all",
        lambda data: data[: len(data) // 2],
        lambda data: data[:1500] + bytes([data[1500] ^ 0x40]) + data[1501:],
        lambda data: data.replace(b"noise_rms", b"noise_sum"),
    ],
    ids=["empty", "text", "cut", "a flipped bit", "a changed header"],
)
def test_damaged_files_are_drawn_again(peeler: DepthPeeler, cache: ReferenceCache, damage: Any) -> None:
    arguments = (peeler, a_scene(), camera_at(32, 24), Lens(0.1, 2.5), 4)
    first = cache.accumulate(*arguments)
    (file,) = files(cache)
    whole = file.read_bytes()
    file.write_bytes(damage(whole))
    again = cache.accumulate(*arguments)
    assert not again.is_cached
    np.testing.assert_array_equal(again.image, first.image)
    assert cache.accumulate(*arguments).is_cached
    assert files(cache) == [file]


def test_a_file_of_another_key_is_not_believed(peeler: DepthPeeler, cache: ReferenceCache) -> None:
    scene, camera = a_scene(), camera_at(32, 24)
    cache.accumulate(peeler, scene, camera, Lens(0.1, 2.5), 4)
    (file,) = files(cache)
    cache.accumulate(peeler, scene, camera, Lens(0.3, 2.5), 4)
    (other,) = set(files(cache)) - {file}
    other.write_bytes(file.read_bytes())
    assert not cache.accumulate(peeler, scene, camera, Lens(0.3, 2.5), 4).is_cached


def test_a_folder_that_cannot_be_written_is_warned_of(peeler: DepthPeeler, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    cache = ReferenceCache(tmp_path / "file")
    with pytest.warns(UserWarning, match="could not be kept"):
        made = cache.accumulate(peeler, a_scene(), camera_at(8, 8), Lens(0.1, 2.5), 2)
    assert made.image.shape == (8, 8, 4)


def changed_nodes(**changes: Any) -> tuple[Node, ...]:
    first, second = a_scene().nodes
    return first, dataclasses.replace(second, **changes)


def colored(kind: str, color: int) -> trimesh.Trimesh:
    mesh = quad(3.0, 0.9).mesh
    colors = np.full((4 if kind == "vertex" else 2, 4), color, np.uint8)
    mesh.visual = trimesh.visual.ColorVisuals(mesh, **{f"{kind}_colors": colors})
    return mesh


def with_uv(scale: float) -> trimesh.Trimesh:
    mesh = quad(3.0, 0.9).mesh
    mesh.visual = trimesh.visual.TextureVisuals(uv=mesh.visual.uv * scale)
    return mesh


def test_the_digest_sees_all_that_shows_and_nothing_else() -> None:
    base = scene_digest(a_scene())
    assert scene_digest(a_scene()) == base
    unseen = a_scene(
        name="x", camera=camera_at(), focus_distance_m=3.0, aperture_radius_m=0.1, view_from_deg=(1.0, 2.0)
    )
    assert scene_digest(unseen) == base
    changed = [
        a_scene(unlit=True),
        a_scene(background=(0.0, 0.0, 0.0)),
        a_scene(background=Gradient((0.0, 0.0, 1.0), (1.0, 1.0, 1.0))),
        a_scene(ambient=Ambient((0.3, 0.3, 0.3))),
        a_scene(lights=()),
        a_scene(lights=(DirectionalLight((0.0, -1.0, -1.1)),)),
        a_scene(lights=(PointLight((0.0, 1.0, 1.0)),)),
        a_scene(lights=(PointLight((0.0, 1.0, 1.0), direction=(0.0, -1.0, 0.0)),)),
        a_scene(nodes=a_scene().nodes[::-1]),
        a_scene(nodes=a_scene().nodes[:1]),
        a_scene(nodes=changed_nodes(transform=np.diag([1.0, 1.0, 1.01, 1.0]))),
        a_scene(nodes=changed_nodes(material=flat((0.2, 0.5, 0.2)))),
        a_scene(nodes=changed_nodes(material=Material((0.2, 0.5, 0.1, 1.0)))),
        a_scene(nodes=changed_nodes(material=flat((0.2, 0.5, 0.1), base_color_texture=picture()))),
        a_scene(nodes=changed_nodes(material=flat((0.2, 0.5, 0.1), base_color_texture=picture(8)))),
        a_scene(nodes=changed_nodes(mesh=quad(3.0, 0.8).mesh)),
        a_scene(nodes=changed_nodes(mesh=with_uv(0.5))),
        *(a_scene(nodes=changed_nodes(mesh=colored(kind, color))) for kind in ("vertex", "face") for color in (9, 90)),
    ]
    assert len({base, *(scene_digest(scene) for scene in changed)}) == len(changed) + 1


def test_shared_objects_and_equal_ones_have_one_digest() -> None:
    card = quad(2.0, 0.3)
    shared = Scene("two", (card, Node(card.mesh, card.transform, card.material)))
    assert scene_digest(shared) == scene_digest(Scene("two", (quad(2.0, 0.3), quad(2.0, 0.3))))
