"""What gpu_check says of parts that pass, fail, are cut or die, by outputs that are given; and a run that cuts."""

from __future__ import annotations

import json
import math
import os
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from cldof.errors import DeviceError
from cldof.host.device import DeviceInfo
from tests.tools import gpu_check
from tests.tools.gpu_check import Check, Part, Run, choose, judged_doctor, judged_forms, judged_tests, run_process, slug

CPU = DeviceInfo(0, "pthread-cpu", "Portable Computing Language", "3.0", "cpu", 2, 1 << 30)
GPU = DeviceInfo(1, "NVIDIA H200 (PCIe)", "NVIDIA CUDA", "550", "gpu", 132, 1 << 37)


def test_a_process_over_its_time_is_cut_with_all_its_children(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also one that does not notice an interrupt; what it printed is there."""
    code = (
        "import signal, subprocess, sys, time\n"
        "signal.signal(signal.SIGINT, signal.SIG_IGN)\n"
        "child = subprocess.Popen([sys.executable, '-c', 'import time; time.sleep(60)'])\n"
        "print('child', child.pid, flush=True)\n"
        "time.sleep(60)\n"
    )
    monkeypatch.setattr(gpu_check, "_GRACE_S", 0.5)
    begin = time.monotonic()
    done = run_process([sys.executable, "-I", "-S", "-c", code], 5.0, tmp_path / "log")
    assert done.cut
    assert time.monotonic() - begin < 40.0  # it would take 60
    child = int(done.text.split()[1])
    for _ in range(50):  # init reaps it
        state = Path(f"/proc/{child}/stat")
        if not state.exists() or state.read_text().rsplit(")", 1)[1].split()[0] == "Z":
            break
        time.sleep(0.1)
    else:
        os.kill(child, 9)
        pytest.fail("the child lives on")


def test_a_process_that_ends_is_not_cut(tmp_path: Path) -> None:
    done = run_process([sys.executable, "-c", "print('hello'); raise SystemExit(3)"], 30.0, tmp_path / "log")
    assert (done.code, done.cut, done.text) == (3, False, "hello\n")


def pytest_text(*outcomes: str, collected: int = 9) -> str:
    lines = [
        f"tests/kernels/test_a.py::test_x[opaque 5px - {n}] {outcome}  [ 10%]" for n, outcome in enumerate(outcomes)
    ]
    return "\n".join([f"collecting ... collected {collected} items / 2 deselected / 7 selected", *lines, ""])


def test_tests_are_counted_however_they_end() -> None:
    text = pytest_text("PASSED", "PASSED", "SKIPPED (no such thing)", "FAILED", "ERROR")
    text += "FAILED tests/kernels/test_a.py::test_x[opaque 5px - 3] - AssertionError\n"  # the summary counts none twice
    counts = gpu_check.test_counts(text)
    assert (counts["passed"], counts["failed"], counts["skipped"], counts["of"]) == (2, 2, 1, 7)
    assert counts["failures"][0] == "tests/kernels/test_a.py::test_x[opaque 5px - 3]"


@pytest.mark.parametrize(
    ("code", "outcomes", "state", "why"),
    [
        (0, ["PASSED", "SKIPPED (x)"], "passed", ""),
        (1, ["PASSED", "FAILED"], "failed", "1 tests failed, first tests/kernels"),
        (None, ["PASSED", "SKIPPED (x)"], "cut", "after 2 of 7 tests"),
        (None, ["FAILED"], "failed", "1 tests failed"),
        (None, [], "failed", "no test ran"),
        (-11, ["PASSED"], "failed", "ended with -11"),
        (5, [], "failed", "ended with 5"),
        (0, ["SKIPPED (x)"], "failed", "no test ran"),
    ],
)
def test_tests_are_judged(code: int | None, outcomes: list[str], state: str, why: str) -> None:
    part = judged_tests(Run(code, 1.0, pytest_text(*outcomes)))
    assert part.state == state
    assert why in part.why


@pytest.mark.parametrize(("state", "expected"), [("ok", "passed"), ("note", "failed"), ("bad", "failed")])
def test_doctor_is_asked_about_this_device(state: str, expected: str) -> None:
    """Whatever it says of others; with no source in what is kept."""
    methods = {"layered": {"db": math.inf}, "pyramid": {"error": f"a kernel did not compile\n--- source\n{'x' * 9000}"}}
    report = {
        "findings": [
            {"what": "Python", "state": "ok", "found": "3.11", "advice": ""},
            {"what": "device 0", "state": "bad" if state == "ok" else "ok", "found": "another", "advice": ""},
            {"what": "device 1", "state": state, "found": "pyramid: wrong", "advice": "x"},
        ],
        "devices": [{"index": 0, "methods": {}}, {"index": 1, "methods": methods}],
    }
    part = judged_doctor(report, 1)
    assert part.state == expected
    assert part.why == ("" if state == "ok" else "pyramid: wrong")
    assert part.facts["methods"] == {"layered": {"db": "inf"}, "pyramid": {"error": "a kernel did not compile"}}
    assert [finding["what"] for finding in part.facts["findings"]] == ["Python"]
    assert judged_doctor(report, 2).state == "failed"


def forms_facts(db: dict[str, Any], **device: Any) -> dict[str, Any]:
    good = {"rendered": 3, "cut": False, "died": "", "errors": {}, "lacking": {}}
    return {"forms": 3, "db": {"device": db}, "devices": {"CPU": good, "device": {**good, **device}}}


@pytest.mark.parametrize(
    ("facts", "state", "why"),
    [
        (forms_facts({"a": "inf", "b": 120.0, "c": 71.0}), "passed", ""),
        (forms_facts({"a": "inf", "b": 120.0}, lacking={"c": "no atomics"}), "passed", ""),
        (forms_facts({"a": "inf", "b": 120.0}, cut=True), "cut", "after 2 of 3 forms"),
        (forms_facts({"a": "inf", "b": 60.0, "c": 99.0}), "failed", "1 forms below 70 dB, worst b"),
        (forms_facts({"a": "-inf", "b": 99.0, "c": 99.0}), "failed", "worst a"),
        (forms_facts({"a": 99.0, "b": 99.0}, errors={"c": "no"}), "failed", "1 forms failed"),
        (forms_facts({"a": 99.0, "b": 99.0}, died="c: ended with -11"), "failed", "died: c: ended with -11"),
        (forms_facts({}), "failed", "nothing was compared"),
    ],
)
def test_forms_are_judged(facts: dict[str, Any], state: str, why: str) -> None:
    part = judged_forms(facts, "log")
    assert part.state == state
    assert why in part.why
    assert part.facts["compared"] == len(facts["db"]["device"])


def test_the_device_is_a_gpu_unless_told_otherwise() -> None:
    assert choose([CPU, GPU], "", told=False) == (GPU, CPU)
    assert choose([CPU, GPU], "h200", told=False) == (GPU, CPU)
    assert choose([CPU, GPU], "0", told=False) == (CPU, CPU)
    assert choose([GPU], "", told=False) == (GPU, None)
    assert choose([CPU], "", told=True) == (CPU, CPU)
    for infos, wanted in (([CPU], ""), ([CPU], "radeon"), ([], ""), ([GPU], "7")):
        with pytest.raises(DeviceError, match="CLDOF_TEST_LIMITS=64,32768,gpu"):
            choose(infos, wanted, told=False)
    assert (slug(GPU, False), slug(CPU, True)) == ("nvidia-h200-pcie", "pthread-cpu-told-gpu")


def test_without_a_cpu_nothing_is_compared(tmp_path: Path) -> None:
    assert gpu_check.forms(Check(GPU, None, tmp_path), 10.0).state == "failed"


def fake(monkeypatch: pytest.MonkeyPatch, states: dict[str, str]) -> dict[str, float]:
    """Parts that take 10 s each, by a clock that they move."""
    now, budgets = [0.0], {}

    def part(name: str) -> Any:
        def run(check: Check, seconds: float) -> Part:
            budgets[name] = seconds
            now[0] += 10.0
            return Part(states[name], "because" if states[name] != "passed" else "")

        return run

    monkeypatch.setattr(gpu_check, "PARTS", {name: (part(name), 100.0) for name in states})
    monkeypatch.setattr(gpu_check, "list_devices", lambda: [CPU, GPU])
    monkeypatch.setattr(gpu_check.time, "monotonic", lambda: now[0])
    return budgets


@pytest.mark.parametrize(
    ("states", "code", "passed", "complete"),
    [
        ({"forms": "passed", "tests": "passed"}, 0, True, True),
        ({"forms": "passed", "tests": "cut"}, 0, True, False),
        ({"doctor": "skipped", "forms": "passed"}, 0, True, False),
        ({"forms": "failed", "tests": "passed"}, 1, False, False),
    ],
)
def test_the_exit_code_says_whether_anything_failed(
    states: dict[str, str],
    code: int,
    passed: bool,
    complete: bool,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.delenv("CLDOF_TEST_LIMITS", raising=False)
    budgets = fake(monkeypatch, states)
    path = tmp_path / "result.json"
    assert gpu_check.main(["--output", str(path), "--parts", *states]) == code
    result = json.loads(path.read_text())
    assert (result["passed"], result["complete"], result["told_to_be_gpu"]) == (passed, complete, False)
    assert result["device"]["name"] == GPU.name
    assert {name: part["state"] for name, part in result["parts"].items()} == states
    # The first may take all but what the second needs; the second has what is left.
    assert list(budgets.values()) == [480.0 - 25.0 - 100.0, 480.0 - 25.0 - 10.0]
    last = capsys.readouterr().out.splitlines()[-2]
    assert last.startswith("PASS" if passed else "FAIL")
    assert ("not all of it ran" in last) == (not complete)


def test_time_that_went_before_the_start_counts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("CLDOF_TEST_LIMITS", raising=False)
    budgets = fake(monkeypatch, {"forms": "passed"})
    monkeypatch.setattr(gpu_check.time, "time", lambda: 1030.0)
    path = tmp_path / "result.json"
    assert gpu_check.main(["--output", str(path), "--started", "1000"]) == 0
    assert budgets["forms"] == 480.0 - 25.0 - 30.0
    assert json.loads(path.read_text())["seconds"] == 40.0


def test_a_cpu_told_to_be_a_gpu_is_no_gpu(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("CLDOF_TEST_LIMITS", "64,32768,gpu")
    fake(monkeypatch, {"forms": "passed"})
    assert gpu_check.main(["--output", str(tmp_path / "result.json")]) == 0
    result = json.loads((tmp_path / "result.json").read_text())
    assert result["told_to_be_gpu"]
    assert result["device"]["kind"] == "cpu"
    assert "NO GPU WAS MEASURED" in capsys.readouterr().out


def test_without_a_gpu_it_says_what_to_do(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.delenv("CLDOF_TEST_LIMITS", raising=False)
    monkeypatch.setattr(gpu_check, "list_devices", lambda: [CPU])
    assert gpu_check.main([]) == 2
    assert "Install its driver" in capsys.readouterr().err
