"""Kernels for processors that this machine is not: no calls that crash drivers there, and no warnings.

Through the system's clang, see :mod:`tests.tools.compiled`; skipped where there is none.
"""

from __future__ import annotations

import pytest

from cldof.host.lanes import LANES
from tests.tools.compiled import TARGETS, X86_64_V4, Target, all_traits, failures, find_clang, sources, summary

_BODY = "__kernel void one(__global float *o, __global uint *u) {{ const size_t i = get_global_id(0); {} }}\n"
_WIDE = "__global float16 *p = (__global float16 *)o; __global uint16 *q = (__global uint16 *)u; "


@pytest.fixture(scope="module")
def clang() -> str:
    found = find_clang()
    if not found:
        pytest.skip("no clang that knows OpenCL C (Debian and Ubuntu: apt-get install clang): kernels were not checked")
    return found


def test_no_library_function_is_called_with_wide_vectors(clang: str) -> None:
    """A driver whose compiler knows no AVX-512 crashes over a call that passes or returns 64 bytes."""
    programs = sources(all_traits(LANES))
    assert len(programs) > 100
    found = failures(clang, programs, X86_64_V4)
    assert not found, "\n" + summary(found)


@pytest.mark.parametrize("target", TARGETS, ids=lambda target: target.name)
def test_kernels_compile_without_warnings(clang: str, target: Target) -> None:
    """With vectors of the processor's width. Unoptimised, which takes a tenth of the time and warns of the same."""
    found = failures(clang, sources(all_traits((target.lanes,))), target, optimisation=0)
    assert not found, "\n" + summary(found)


@pytest.mark.parametrize(
    ("body", "said"),
    [
        (_WIDE + "q[i] = convert_uint16(p[i]);", "calls convert_uint16 with vectors wider than 32 bytes"),
        (_WIDE + "p[i] = exp(p[i]);", "calls exp with"),
        (_WIDE + "vstore16(p[i], i, o);", "calls vstore16 with"),
        (_WIDE + "vstore_half16(p[i], i, (__global half *)u); ", "calls vstore_half16 with"),
        (_WIDE + "p[i] = (float16)(exp(p[i].lo), exp(p[i].hi));", ""),
        (_WIDE + "p[i] = p[i] < 0.0f ? -p[i] : (p[i] + 1.0f) * 3.0f; q[i] = as_uint16(p[i]) >> 3u;", ""),
        ("o[i] = exp(o[i]) + dot((float4)(o[i]), (float4)(1.0f));", ""),
        ("o[i] = nothing_of_that_name;", "undeclared identifier"),
    ],
)
def test_calls_with_wide_vectors_are_found(clang: str, body: str, said: str) -> None:
    found = failures(clang, {"one": _BODY.format(body)}, X86_64_V4)
    assert said in found.get("one", "")
    assert bool(said) == bool(found)


_HELPER = "static float{0} doubled(float{0} v) {{ return v + v; }}\n"
_USE = "__global float{0} *p = (__global float{0} *)o; p[i] = doubled(p[i]);"


@pytest.mark.parametrize("target", TARGETS[:2], ids=lambda target: target.name)
def test_helpers_that_take_more_than_a_register_are_found(clang: str, target: Target) -> None:
    def said(width: int) -> str:
        program = _HELPER.format(width) + _BODY.format(_USE.format(width))
        return failures(clang, {"one": program}, target, optimisation=0).get("one", "")

    assert "[-Werror,-Wpsabi]" in said(2 * target.lanes)
    assert said(target.lanes) == ""
