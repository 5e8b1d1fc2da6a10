"""Ladders name options that the methods have, and rows can be told apart."""

from __future__ import annotations

import pytest

from cldof.benchmark import ladders
from cldof.benchmark.harness import Settings, estimate_s, list_jobs
from cldof.benchmark.peers import PEERS
from cldof.errors import InputError
from cldof.host.device import DeviceInfo
from cldof.methods import METHODS, make_method

DEVICE = DeviceInfo(0, "a device", "a platform", "1", "cpu", 2, 1 << 30)


@pytest.mark.parametrize("method", sorted(METHODS))
def test_every_rung_makes_a_method(method: str) -> None:
    rungs = ladders.rungs(method)
    assert len({rung.name for rung in rungs}) == len(rungs)
    assert any(rung.shown for rung in ladders.rungs(method, quick=True))
    for rung in rungs:
        make_method(method, **rung.options)


def test_unknown_methods_are_refused() -> None:
    with pytest.raises(KeyError):
        ladders.rungs("guesswork")
    with pytest.raises(InputError, match="guesswork"):
        list_jobs(Settings(("row",), ((8, 8),), ("guesswork",)), [DEVICE])


def test_jobs_are_unique_and_peers_draw_base_colours_only() -> None:
    methods = ("accumulate", *METHODS, *PEERS)
    settings = Settings(("row", "fence"), ((8, 8), (16, 8)), methods, peer_scenes=("row",))
    jobs = list_jobs(settings, [DEVICE])
    assert len({job.key for job in jobs}) == len(jobs)
    assert all(job.case.unlit for job in jobs if job.method in PEERS)
    assert {job.method for job in jobs} == set(methods)
    assert 0.0 < estimate_s(jobs[:1], settings) < estimate_s(jobs, settings)


def test_without_peers_there_are_no_cases_for_them() -> None:
    jobs = list_jobs(Settings(("row",), ((8, 8),), ("layered",), peer_scenes=("row",)), [DEVICE])
    assert not any(job.case.unlit for job in jobs)
