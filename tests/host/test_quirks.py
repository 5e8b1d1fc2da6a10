"""The table of workarounds."""

from __future__ import annotations

import datetime

import pytest

from cldof.host.quirks import QUIRKS, Effect, Quirk, effects_of


def test_rows_match_by_substring_in_any_case() -> None:
    row = Quirk("cuda", "force", Effect.LAST_RESORT, "why", "where", "2025-01-01")
    assert row.matches("NVIDIA CUDA", "GeForce")
    assert not row.matches("NVIDIA CUDA", "Tesla")
    assert effects_of("Portable Computing Language", "pthread") == {
        Effect.DRIVER_CACHES_BUILDS,
        Effect.NEEDS_LINKER,
        Effect.TRUSTS_CACHE,
    }
    assert effects_of("rusticl", "llvmpipe (LLVM 15)") == {Effect.LAST_RESORT}
    assert effects_of("Some Platform", "Some Device") == frozenset()


@pytest.mark.parametrize("row", QUIRKS, ids=lambda row: f"{row.platform}/{row.device}")
def test_rows_are_complete(row: Quirk) -> None:
    assert (row.platform or row.device) and row.reason and row.source
    assert (row.platform, row.device) == (row.platform.lower(), row.device.lower())
    assert datetime.date.fromisoformat(row.date) >= datetime.date(2025, 1, 1)
