#!/usr/bin/env bash
# Run the tests of kernels and methods on every OpenCL driver that can be installed: devices.sh [small|intel|rusticl|...]
#
# What is tested, by name (all of them unless named):
#   two      two PoCL devices of one platform at once
#   small    PoCL, told to be a device with work-groups of 64 and 32 KiB of local memory
#   gpu      the same, told to be no CPU as well: the forms that GPUs get
#   intel    Intel's CPU runtime, from PyPI
#   rusticl  Mesa's rusticl on llvmpipe; slow to build, so a few tiny frames
#   agree    Intel's runtime and rusticl against PoCL: the same pictures within 70 dB
# and only when named:
#   quick    PoCL against Intel's runtime, methods without options; what .ci/run runs
#   figures  the hard cases on Intel's runtime and rusticl, measured into bench/results/stability.json beside PoCL's
# Installs into .venv and with apt-get; what cannot be had is skipped in so many words.
set -uo pipefail
cd "$(dirname "$0")/.."

venv=$PWD/.venv
[ -x "$venv/bin/python" ] || { echo "run 'make test-devices'" >&2; exit 1; }
python=${PYTHON_OF_TESTS:-$venv/bin/python}
prefix=$("$python" -c 'import sys; print(sys.prefix)')
icd=$(mktemp -d)
trap 'rm -rf "$icd"' EXIT
# Every kernel, and whole frames of all methods; the hard cases are run on every driver by `make stability`.
fast=(tests/test_every_kernel.py tests/kernels tests/methods/test_gather.py tests/methods/test_layered.py
    tests/methods/test_pyramid.py -k "not reference and not full_hd and not dense and not variables_are_set")
failed=() skipped=()

skip() { echo "SKIPPED $1: $2" >&2; skipped+=("$1"); }
intel=(OCL_ICD_VENDORS="$icd" LD_LIBRARY_PATH="$prefix/lib" CLDOF_TEST_DEVICE="intel(r) opencl")
rusticl=(OCL_ICD_VENDORS="$icd" RUSTICL_ENABLE=llvmpipe CLDOF_TEST_DEVICE=llvmpipe)
test_on() { # name, then variables, then -- and what to run
    local name=$1; shift
    local variables=()
    while [ "$1" != -- ]; do variables+=("$1"); shift; done
    shift
    echo "== $name" >&2
    env "${variables[@]}" CLDOF_REQUIRE_DEVICE=1 "$python" -m pytest -q -p no:cacheprovider "$@" || failed+=("$name")
}

plain='^\w+ (opaque|void) 5px$' # the forms of each method without options
agrees() { # forms, then what to compare PoCL with
    echo "== $name: ${2%%=*}" >&2
    # Where the tests keep what PoCL has built.
    POCL_CACHE_DIR=${POCL_CACHE_DIR:-${XDG_CACHE_HOME:-$HOME/.cache}/cldof-tests} OCL_ICD_VENDORS="$icd" \
        LD_LIBRARY_PATH="$prefix/lib" RUSTICL_ENABLE=llvmpipe "$python" -m tests.tools.agreement \
        --only "$1" PoCL=portable "$2" || failed+=("$name ${2%%=*}")
}

have_intel() {
    local library=$prefix/lib/libintelocl.so
    [ -e "$library" ] || timeout 180 "$python" -m pip install -qq --retries 1 --timeout 20 intel-opencl-rt \
        intel-cmplr-lib-rt >&2 || true
    [ -e "$library" ] || return 1
    echo "$library" >"$icd/intel.icd"
    shows "${intel[@]}"
}
have_rusticl() {
    local found=/etc/OpenCL/vendors/rusticl.icd
    [ -e "$found" ] || scripts/setup.sh rusticl || true
    [ -e "$found" ] || return 1
    cp "$found" "$icd/rusticl.icd"
    shows "${rusticl[@]}"
}
shows() { # whether the driver, once installed, has a device on this machine
    env "$@" "$python" -c 'import os
from cldof.host.device import list_devices
part = os.environ["CLDOF_TEST_DEVICE"]
raise SystemExit(not any(part in f"{info.platform} {info.name}".lower() for info in list_devices()))'
}

for name in ${*:-two small gpu intel rusticl agree}; do
    rm -f "$icd"/*
    case $name in
    two) test_on two POCL_DEVICES="pthread pthread" CLDOF_TEST_DEVICE=portable -- tests/host tests/test_every_kernel.py ;;
    small) test_on small CLDOF_TEST_LIMITS=64,32768 -- "${fast[@]}" ;;
    gpu) test_on gpu CLDOF_TEST_LIMITS=64,32768,gpu -- "${fast[@]}" ;;
    intel)
        have_intel || { skip intel "no intel-opencl-rt to be had"; continue; }
        test_on intel "${intel[@]}" -- "${fast[@]}"
        ;;
    rusticl)
        have_rusticl || { skip rusticl "no mesa-opencl-icd to be had"; continue; }
        test_on rusticl "${rusticl[@]}" -- \
            tests/test_every_kernel.py -k "pixel or gather or (40px and not cascade and not lookup) or (multiview and sharp)"
        ;;
    agree)
        if have_intel; then agrees "" "Intel=intel(r) opencl"; else skip agree "no intel-opencl-rt to be had"; fi
        rm -f "$icd"/*
        if have_rusticl; then agrees "$plain" rusticl=llvmpipe; else skip agree "no mesa-opencl-icd to be had"; fi
        ;;
    quick)
        if have_intel; then agrees "$plain" "Intel=intel(r) opencl"; else skip quick "no intel-opencl-rt to be had"; fi
        ;;
    figures)
        record=(CLDOF_STABILITY="$PWD/bench/results/stability.json")
        if have_intel; then test_on figures-intel "${intel[@]}" "${record[@]}" -- tests/hard_cases
        else skip figures "no intel-opencl-rt to be had"; fi
        rm -f "$icd"/*
        if have_rusticl; then test_on figures-rusticl "${rusticl[@]}" "${record[@]}" -- tests/hard_cases \
            -k "not random and not time" # an hour, most of it Mesa's compiler
        else skip figures "no mesa-opencl-icd to be had"; fi
        "$python" -m bench.stability
        ;;
    *) echo "no such device: $name" >&2; exit 2 ;;
    esac
done
echo "failed: ${failed[*]:-none}; skipped: ${skipped[*]:-none}" >&2
[ ${#failed[@]} = 0 ]
