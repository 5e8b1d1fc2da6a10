"""Depth-of-field methods: each declares passes and owns no OpenCL object."""

from __future__ import annotations

from typing import Any

from ..errors import InputError
from .base import FrameShape, Method, Plan
from .gather import Gather
from .layered import Layered
from .lightfield import LightField
from .multiview import Multiview
from .pyramid import Pyramid

__all__ = ["METHODS", "FrameShape", "Method", "Plan", "make_method"]

# A new method is one line here.
METHODS: dict[str, type[Any]] = {
    "gather": Gather,
    "layered": Layered,
    "lightfield": LightField,
    "multiview": Multiview,
    "pyramid": Pyramid,
}


def make_method(name: str, **options: Any) -> Method:
    """A method by name with its options.

    Raises
    ------
    InputError
        Unknown name or option.
    """
    if name not in METHODS:
        raise InputError(f"Method {name!r} is unknown; choose one of {', '.join(sorted(METHODS))}.")
    try:
        method: Method = METHODS[name](**options)
    except TypeError as error:
        raise InputError(f"Method {name!r}: {str(error).split('() ', 1)[-1]}.") from None
    return method
