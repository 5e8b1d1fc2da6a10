"""The options of methods as a command line sees them: listed from their dataclasses, read from text.

A method is a dataclass whose docstring has a numpydoc ``Parameters`` section (:mod:`cldof.methods`). Nothing of it is
repeated here, so a method's options are those of its class.
"""

from __future__ import annotations

import dataclasses
import inspect
import sys
import types
import typing
from collections.abc import Iterable
from typing import Any, NamedTuple

from .errors import InputError
from .methods import METHODS

__all__ = ["Option", "about", "options_of", "parse_options", "shades_surfaces", "simulated_aperture"]

_TRUE, _FALSE = ("true", "yes", "on", "1"), ("false", "no", "off", "0")


class Option(NamedTuple):
    """One option of a method."""

    name: str
    kind: str
    """As the docstring has it, for instance ``int``."""
    default: Any
    text: str


def options_of(method: str) -> dict[str, Option]:
    """A method's options by name.

    Raises
    ------
    InputError
        Unknown method.
    """
    cls = _method(method)
    documented = _documented(inspect.getdoc(cls) or "")
    options = {}
    for field in dataclasses.fields(cls):
        if not field.init:
            continue
        default = field.default
        if field.default_factory is not dataclasses.MISSING:
            default = field.default_factory()
        kind, text = documented.get(field.name, (str(field.type), ""))
        options[field.name] = Option(field.name, kind, default, text)
    return options


def about(method: str) -> str:
    """What a method is: the first sentence of its module."""
    text = inspect.getdoc(sys.modules[_method(method).__module__]) or inspect.getdoc(_method(method)) or ""
    return " ".join(text.split("\n\n", 1)[0].split()).rstrip(".")


def simulated_aperture(method: str) -> str | None:
    """The one aperture that a method simulates; None for a method that takes the lens's own."""
    shape: str | None = _method(method).simulated_aperture
    return shape


def shades_surfaces(method: str, options: dict[str, Any]) -> bool:
    """Whether a method with these options makes use of a frame's surface buffers."""
    option = options_of(method).get("view_dependent")
    return option is not None and bool(options.get("view_dependent", option.default))


def parse_options(method: str, pairs: Iterable[tuple[str, str]]) -> dict[str, Any]:
    """Read ``(name, value)`` pairs of text as a method's options; names may have dashes, tuples are ``1,2``.

    Raises
    ------
    InputError
        Unknown method or option, an option given twice, or a value of another type.
    """
    options = options_of(method)
    hints = typing.get_type_hints(_method(method))
    values: dict[str, Any] = {}
    for given, text in pairs:
        name = given.strip().replace("-", "_")
        if name not in options:
            listed = ", ".join(options) or "none"
            raise InputError(f"Method {method!r} has no option {given!r}; its options are: {listed}.")
        if name in values:
            raise InputError(f"Option {name!r} of method {method!r} is given twice.")
        values[name] = _read(text.strip(), hints[name], method, options[name])
    return values


def _method(name: str) -> type[Any]:
    if name not in METHODS:
        raise InputError(f"Method {name!r} is unknown; choose one of {', '.join(sorted(METHODS))}.")
    return METHODS[name]


def _read(text: str, hint: Any, method: str, option: Option) -> Any:
    kinds = typing.get_args(hint) if typing.get_origin(hint) in (types.UnionType, typing.Union) else (hint,)
    for kind in sorted(kinds, key=_rank):
        try:
            if typing.get_origin(kind) is tuple:
                parts = text.strip("()").split(",")
                return tuple(_READERS[k](v.strip()) for k, v in zip(typing.get_args(kind), parts, strict=True))
            return _READERS[kind](text)
        except (KeyError, ValueError):
            continue
    raise InputError(f"Option {option.name!r} of method {method!r} is {text!r}; it must be: {option.kind}.")


def _none(text: str) -> None:
    if text.lower() not in ("none", ""):
        raise ValueError(text)


def _bool(text: str) -> bool:
    if text.lower() in _TRUE:
        return True
    if text.lower() in _FALSE:
        return False
    raise ValueError(text)


_READERS: dict[Any, Any] = {type(None): _none, bool: _bool, int: int, float: float, str: str}


def _rank(kind: Any) -> int:
    """Of several types, the narrowest that fits is meant."""
    return list(_READERS).index(kind) if kind in _READERS else -1


def _documented(doc: str) -> dict[str, tuple[str, str]]:
    """(type, description) by name, from the ``Parameters`` section of a numpydoc docstring."""
    lines = doc.splitlines()
    found: dict[str, tuple[str, str]] = {}
    start = next((i for i, line in enumerate(lines) if line.strip() == "Parameters"), len(lines))
    names: list[str] = []
    for number, line in enumerate(lines[start + 2 :], start + 2):
        if number + 1 < len(lines) and set(lines[number + 1].strip()) == {"-"}:
            break  # the next section's title
        if line and not line.startswith(" "):
            title, _, kind = line.partition(" : ")
            names = [name.strip() for name in title.split(",")]
            found |= dict.fromkeys(names, (kind.strip().removesuffix(", optional"), ""))
        else:
            for name in names:
                found[name] = (found[name][0], f"{found[name][1]} {line.strip()}".strip())
    return found
