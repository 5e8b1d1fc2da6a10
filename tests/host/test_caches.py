"""Folders of built programs: which one PoCL gets, and what of it is believed."""

from __future__ import annotations

import os
import sys
import tempfile
from pathlib import Path

import pytest

from cldof.host.caches import adopt_programs, lent_programs, own_programs, prepare_environment

PROGRAM = "AB/CDEF"
KERNEL = f"{PROGRAM}/blur/1-1-1/blur.so"

claims = pytest.mark.skipif(sys.platform == "win32", reason="no folder is claimed there")


def write_program(
    folder: Path, kernel: bytes | None = b"not of Linux, but 64 bytes long at the least".ljust(64)
) -> None:
    (folder / PROGRAM).mkdir(parents=True)
    (folder / PROGRAM / "program.bc").write_bytes(b"BC")
    if kernel is not None:
        (folder / KERNEL).parent.mkdir(parents=True)
        (folder / KERNEL).write_bytes(kernel)


def test_a_process_has_a_folder_of_its_own(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("POCL_CACHE_DIR", str(tmp_path / "not yet" / "there"))
    prepare_environment()
    assert own_programs() == tmp_path / "not yet" / "there" / "cldof"
    prepare_environment()
    assert own_programs() == tmp_path / "not yet" / "there" / "cldof", "asked again"


@claims
def test_what_cannot_be_believed_is_removed(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """A program without a kernel, as a process leaves that dies in the compiler, and one whose kernel is cut short."""
    monkeypatch.setenv("POCL_CACHE_DIR", str(tmp_path))
    folders = {name: tmp_path / "cldof" / name for name in ("AA/dead", "BB/cut", "CC/whole")}
    for name, folder in folders.items():
        (folder / "blur").mkdir(parents=True)
        (folder / "program.bc").write_bytes(b"BC")
        if name != "AA/dead":
            (folder / "blur" / "blur.so").write_bytes(b"\x7fELF\x02" if name == "BB/cut" else bytes(64))
    (tmp_path / "cldof" / "trial-killed").mkdir()
    other = tmp_path / "AA" / "another's"
    other.mkdir(parents=True)
    (other / "program.bc").touch()
    prepare_environment()
    assert [name for name, folder in folders.items() if folder.exists()] == ["CC/whole"]
    assert not (tmp_path / "cldof" / "trial-killed").exists()
    assert (other / "program.bc").exists(), "other programs' folders are theirs"


@claims
def test_programs_come_from_another_process(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("POCL_CACHE_DIR", str(tmp_path))
    prepare_environment()
    write_program(own_programs())
    with lent_programs() as lent:
        assert not list(lent.iterdir())
        write_program(lent / "cldof")
        (lent / "cldof" / KERNEL).write_bytes(b"changed")
        new = lent / "cldof" / PROGRAM / "blur" / "2-1-1"
        new.mkdir()
        (new / "blur.so").write_bytes(b"new")
        adopt_programs(lent)
    assert not lent.exists()
    assert (own_programs() / PROGRAM / "blur" / "2-1-1" / "blur.so").read_bytes() == b"new"
    assert (own_programs() / KERNEL).read_bytes() != b"changed", "what is there stays"
    assert not list(own_programs().glob("trial-*"))


@pytest.mark.parametrize("variable", ["POCL_CACHE_DIR", "XDG_CACHE_HOME", "HOME"])
def test_a_folder_that_cannot_work_is_replaced(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, variable: str) -> None:
    (tmp_path / "file").touch()
    # Set first, so that monkeypatch puts all of it back.
    for name in ("POCL_CACHE_DIR", "XDG_CACHE_HOME"):
        monkeypatch.setenv(name, "")
        monkeypatch.delenv(name)
    monkeypatch.setenv(variable, str(tmp_path / "file" / "inside"))
    prepare_environment()
    assert Path(os.environ["POCL_CACHE_DIR"]).is_relative_to(tempfile.gettempdir())
