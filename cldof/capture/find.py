"""A scene by what people call it: a built-in name, a file, or a model put into a scene around it."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

from ..errors import SceneError
from .load import load_scene
from .model_scenes import bunnies
from .scene import Scene
from .scenes import builtin_scenes

__all__ = ["find_scene"]

_AROUND_MODEL = {"bunnies": bunnies}


def find_scene(name: str, *, unlit: bool = False, **view: Any) -> Scene:
    """Build or load a scene.

    Parameters
    ----------
    name : str
        A name of :func:`cldof.capture.scenes.builtin_scenes`, a file, or ``bunnies:FILE`` for nine of a model.
    unlit : bool
        Show base colours without any light.
    **view
        For files: as :func:`cldof.capture.load.load_scene` takes it.

    Raises
    ------
    SceneError
        None of these, or a file that cannot be read.
    """
    builtin = builtin_scenes()
    around, _, model = name.partition(":")
    if name in builtin:
        scene = builtin[name].make()
    elif around in _AROUND_MODEL and model:
        scene = _AROUND_MODEL[around](model)
    elif Path(name).exists():
        return load_scene(name, unlit=unlit, **view)
    else:
        raise SceneError(f"{name!r} is neither a file nor a built-in scene; built in are {', '.join(builtin)}.")
    return dataclasses.replace(scene, unlit=True) if unlit else scene
