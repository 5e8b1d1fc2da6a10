"""The table of workarounds, and PoCL's cache directory."""

from __future__ import annotations

import datetime
import os
import tempfile
from pathlib import Path

import pytest

from cldof.host.quirks import QUIRKS, Effect, Quirk, effects_of, prepare_environment


def test_rows_match_by_substring_in_any_case() -> None:
    row = Quirk("cuda", "force", Effect.LAST_RESORT, "why", "where", "2025-01-01")
    assert row.matches("NVIDIA CUDA", "GeForce")
    assert not row.matches("NVIDIA CUDA", "Tesla")
    assert effects_of("Portable Computing Language", "pthread") == {
        Effect.DRIVER_CACHES_BUILDS,
        Effect.NEEDS_LINKER,
    }
    assert effects_of("rusticl", "llvmpipe (LLVM 15)") == {Effect.LAST_RESORT}
    assert effects_of("Some Platform", "Some Device") == frozenset()


@pytest.mark.parametrize("row", QUIRKS, ids=lambda row: f"{row.platform}/{row.device}")
def test_rows_are_complete(row: Quirk) -> None:
    assert (row.platform or row.device) and row.reason and row.source
    assert (row.platform, row.device) == (row.platform.lower(), row.device.lower())
    assert datetime.date.fromisoformat(row.date) >= datetime.date(2025, 1, 1)


def test_a_cache_directory_that_works_is_left_alone(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("POCL_CACHE_DIR", str(tmp_path / "not yet" / "there"))
    prepare_environment()
    assert os.environ["POCL_CACHE_DIR"] == str(tmp_path / "not yet" / "there")


def test_programs_cut_short_are_removed_but_not_those_that_others_write(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("POCL_CACHE_DIR", str(tmp_path))
    for folder in ("own", "cldof-1/theirs"):
        (tmp_path / folder).mkdir(parents=True)
        (tmp_path / folder / "kernel.so").write_bytes(b"\x7fELF\x02")
    (tmp_path / "cldof-1" / "cldof.lock").touch()
    prepare_environment()
    assert [str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*.so")] == ["cldof-1/theirs/kernel.so"]


@pytest.mark.parametrize("variable", ["POCL_CACHE_DIR", "XDG_CACHE_HOME", "HOME"])
def test_a_cache_directory_that_cannot_work_is_replaced(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, variable: str
) -> None:
    (tmp_path / "file").touch()
    # Set first, so that monkeypatch puts all of it back.
    for name in ("POCL_CACHE_DIR", "XDG_CACHE_HOME"):
        monkeypatch.setenv(name, "")
        monkeypatch.delenv(name)
    monkeypatch.setenv(variable, str(tmp_path / "file" / "inside"))
    prepare_environment()
    assert Path(os.environ["POCL_CACHE_DIR"]).parent == Path(tempfile.gettempdir())
