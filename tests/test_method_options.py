"""Options of methods from text: listed from the dataclass, converted by its types, refused with the list."""

from __future__ import annotations

import dataclasses
from typing import Any

import pytest

from cldof import InputError
from cldof.method_options import about, options_of, parse_options, simulated_aperture
from cldof.methods import METHODS


@dataclasses.dataclass(frozen=True)
class Imagined:
    """A method.

    Parameters
    ----------
    rays, steps : int, optional
        Both are
        counts.
    width : float
        In px.
    early : bool
    ends : (int, int), optional
        First, last.
    name_of : {"this", "that"}
        Which.

    Notes
    -----
    rays : not a parameter
        Here.
    """

    rays: int | None = None
    steps: int | None = 3
    width: float = 1.5
    early: bool = True
    ends: tuple[int, int] | None = None
    name_of: str = "this"
    derived: int = dataclasses.field(init=False, default=0)

    simulated_aperture = None


@pytest.fixture
def imagined(monkeypatch: pytest.MonkeyPatch) -> str:
    """A method of our own in the registry."""
    monkeypatch.setitem(METHODS, "imagined", Imagined)
    return "imagined"


@pytest.mark.parametrize("method", METHODS)
def test_every_method_documents_every_option(method: str) -> None:
    assert about(method)
    for option in options_of(method).values():
        assert option.text and option.kind, f"{method}: {option.name} is not in the docstring's Parameters"
        # The default, written out, is read back: what is listed can be typed.
        assert parse_options(method, [(option.name, str(option.default))]) == {option.name: option.default}
    METHODS[method](**{option.name: option.default for option in options_of(method).values()})


def test_options_of_a_class(imagined: str) -> None:
    options = options_of(imagined)
    assert list(options) == ["rays", "steps", "width", "early", "ends", "name_of"]
    assert options["rays"] == ("rays", "int", None, "Both are counts.")
    assert options["steps"].text == "Both are counts." and options["steps"].default == 3
    assert options["name_of"].kind == '{"this", "that"}'
    assert about(imagined).startswith("Options of methods from text")
    assert simulated_aperture(imagined) is None and simulated_aperture("layered") == "gaussian"


@pytest.mark.parametrize(
    "name, text, value",
    [
        ("rays", "8", 8),
        ("rays", "none", None),
        ("width", "2", 2.0),
        ("width", "1e-3", 0.001),
        ("early", "no", False),
        ("early", "True", True),
        ("ends", "-3,5", (-3, 5)),
        ("ends", "(-3, 5)", (-3, 5)),
        ("ends", "None", None),
        ("name-of", " that ", "that"),
    ],
)
def test_reads_values(imagined: str, name: str, text: str, value: Any) -> None:
    read = parse_options(imagined, [(name, text)])[name.replace("-", "_")]
    assert read == value and type(read) is type(value)


@pytest.mark.parametrize(
    "pairs, says",
    [
        ([("rayz", "8")], "no option 'rayz'; its options are: rays, steps, width, early, ends, name_of"),
        ([("derived", "8")], "no option 'derived'"),
        ([("rays", "eight")], "'rays' of method 'imagined' is 'eight'; it must be: int"),
        ([("rays", "8.5")], "it must be: int"),
        ([("ends", "3")], r"it must be: \(int, int\)"),
        ([("ends", "3,4,5")], r"it must be: \(int, int\)"),
        ([("early", "2")], "it must be: bool"),
        ([("rays", "8"), ("rays", "9")], "given twice"),
    ],
)
def test_refuses(imagined: str, pairs: list[tuple[str, str]], says: str) -> None:
    with pytest.raises(InputError, match=says):
        parse_options(imagined, pairs)


def test_refuses_unknown_methods() -> None:
    with pytest.raises(InputError, match="'magic' is unknown; choose one of"):
        options_of("magic")
