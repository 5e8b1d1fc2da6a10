#!/usr/bin/env bash
# Does cldof work on this machine's GPU, and how fast is it? In under 8 minutes: gpu_check.sh [DEVICE] [--parts NAME ...]
#
# DEVICE is an index or part of a name of `cldof devices`; the first GPU by default. Needs the GPU's OpenCL driver, and a
# CPU driver for the pictures to compare with (PoCL, which pip brings). Parts, each in a process of its own that is ended
# when its time is up; what a part leaves of its seconds goes to those after it, and what is left out gives its own (so
# `--parts forms` compares as many as 7 minutes allow):
#   doctor  60 s   `cldof doctor --json`
#   forms  115 s   the 90 forms of tests/every_kernel.py against the CPU's pictures, at least 70 dB
#   speed  110 s   `bench speed` of every method at 1080p and 4K, as ratios to OpenCV's Gaussian blur of sigma 16
#   tests  170 s   tests/kernels and tests/test_every_kernel.py on the device: oracles, canaries, garbage in memory
#
# A CPU device told to be a GPU runs the forms that GPUs get, and measures no GPU:
#   CLDOF_TEST_LIMITS=64,32768,gpu scripts/gpu_check.sh
#
# Exit code: 0 nothing failed (parts that were cut or skipped are named), 1 something failed, 2 there is no such device.
# Output of the parts: out/gpu-check/*.log. Result, written again after each part:
# bench/results/gpu-check-<device>.json (--output FILE puts it elsewhere), with -told-gpu in its name where that is so:
#   schema            1
#   cldof, commit, date, system, python
#   device            index, name, platform, driver_version, kind, compute_units, global_mem_bytes
#   told_to_be_gpu    true: a CPU that took a GPU's forms; limits: CLDOF_TEST_LIMITS or null
#   reference         the CPU device whose pictures are right, as device; null if there is none
#   load_before, load_after   load averages of 1, 5, 15 minutes
#   passed, complete  whether nothing failed; whether every part ran to its end and passed
#   seconds           all of it
#   parts             by name: state ("passed", "failed", "cut": its time was up and what ran passed, "skipped"),
#                     why, seconds, budget_s, log (the last lines, where it did not pass), and
#     doctor          findings (what, state, found, advice), methods of this device (db or error, seconds)
#     forms           forms, compared, same_bits, least_db, worst, below_70_db, db (by form; "inf": the same bits),
#                     devices: of "CPU" and "device" rendered, cut, died, errors, lacking (what it has not, by form)
#     speed           rows, not_timed: as `bench speed --output` writes them; of a row: title, method, options, width,
#                     height, peels, unit (blur, copy, threads, opencv), frame, kernels (min, median, iqr, ms), blurs
#                     (what it is judged by), by_processor_time, passes_ms, device_bytes
#     tests           passed, failed, skipped, of (collected), failures
set -euo pipefail
cd "$(dirname "$0")/.."

python=${PYTHON_OF_TESTS:-$PWD/.venv/bin/python}
if [ ! -x "$python" ]; then
    scripts/setup.sh test
fi

started=$(date +%s)

# Containers get a GPU's driver mounted without the file by which OpenCL finds it.
nvidia=libnvidia-opencl.so.1
vendors=${OCL_ICD_VENDORS:-/etc/OpenCL/vendors}
if ldconfig -p 2>/dev/null | grep -q "$nvidia" && ! grep -qs nvidia-opencl "$vendors"/*.icd; then
    icd=$(mktemp -d)
    trap 'rm -rf "$icd"' EXIT
    cp "$vendors"/*.icd "$icd" 2>/dev/null || true
    echo "$nvidia" >"$icd/nvidia.icd"
    export OCL_ICD_VENDORS=$icd
    echo "gpu_check: $nvidia is here and not in $vendors; registered for this run" >&2
fi

# Where the tests keep what PoCL has built.
export POCL_CACHE_DIR=${POCL_CACHE_DIR:-${XDG_CACHE_HOME:-$HOME/.cache}/cldof-tests}
PYTHONPATH=$PWD "$python" -m tests.tools.gpu_check --started "$started" "$@"
