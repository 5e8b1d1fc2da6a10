"""PoCL believes in the processor that it is told of, in child processes too, and fails as it does on the real one."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from tests.tools import feigned

ROOT = Path(__file__).parents[2]

_BUILD = """
import os, sys
import pyopencl as cl

(platform,) = [platform for platform in cl.get_platforms() if platform.name == "Portable Computing Language"]
(device,) = platform.get_devices()
print(device.version, flush=True)
program = cl._cl._Program(cl.Context([device]), sys.argv[1])
try:
    program._build(options=b"", devices=[device])
except cl.Error:
    sys.exit(program.get_build_info(device, cl.program_build_info.LOG))
program.get_info(cl.program_info.BINARIES)  # compiles every kernel
"""
_PLAIN = "__kernel void plain(__global float *o) { o[get_global_id(0)] += 1.0f; }"
_WIDE = "__kernel void wide(__global uint16 *o, __global float16 *v) { *o = convert_uint16(*v); }"


def _built(processor: str, source: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """A child whose only hint is the environment."""
    if reason := feigned.why_not_here():
        pytest.skip(reason)
    environment = feigned.environment(processor, folder, {**os.environ, "OCL_ICD_VENDORS": str(folder)})
    Path(environment["POCL_CACHE_DIR"]).mkdir(parents=True)
    command = [sys.executable, "-c", _BUILD, source]
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=120)


@pytest.mark.parametrize("processor", ["nehalem", "haswell", "skylake-avx512"])
def test_another_processor_is_compiled_for(processor: str, tmp_path: Path) -> None:
    done = _built(processor, _PLAIN, tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stdout.rstrip().endswith(f"-{processor}")


def test_the_library_of_builtins_is_the_one_that_is_named(tmp_path: Path) -> None:
    """What ended processes on Zen 4: code for AVX2 calls a function that AVX-512's library returns 64 bytes from."""
    done = _built("znver3:avx512", _WIDE, tmp_path)
    assert done.returncode in (-signal.SIGSEGV, -signal.SIGABRT), done.stderr
    assert _built("znver3:avx2", _WIDE, tmp_path / "other").returncode == 0


def test_a_processor_that_llvm_does_not_know_builds_nothing(tmp_path: Path) -> None:
    done = _built("generic", _PLAIN, tmp_path)
    assert done.returncode == 1
    assert "unknown target CPU 'generic'" in done.stderr


def test_a_misspelt_processor_is_no_silent_native_one(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="'pentium' is none of x86-64"):
        feigned.environment("pentium", tmp_path)
    with pytest.raises(ValueError, match="the library is none of"):
        feigned.Processor.parse("znver3:avx1024")
    environment = {**feigned.environment("haswell", tmp_path), feigned.VARIABLE: "pentium"}
    done = subprocess.run([sys.executable, "-c", "import pyopencl"], env=environment, capture_output=True, text=True)
    assert done.returncode == 1
    assert "'pentium' is none of" in done.stderr


def test_children_keep_what_is_on_their_path_and_a_sitecustomize_of_the_system(tmp_path: Path) -> None:
    (tmp_path / "sitecustomize.py").write_text("import os; os.environ['SEEN'] = 'other'\n")
    environment = feigned.environment("haswell", tmp_path, {**os.environ, "PYTHONPATH": str(tmp_path)})
    code = "import os, sys; print(os.environ['SEEN'], 'pyopencl' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True)
    assert done.stdout.split() == ["other", "False"], done.stderr
    again = feigned.environment("nehalem", tmp_path, environment)
    assert again["PYTHONPATH"] == environment["PYTHONPATH"]
