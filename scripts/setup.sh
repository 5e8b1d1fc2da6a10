#!/usr/bin/env bash
# Make .venv ready, from nothing: setup.sh core|test|dev|bench|oclgrind|rusticl|registers
#
# Installs what is missing and no more; a second run is instant. Uses apt-get (with sudo when not root) for what pip
# cannot bring: Python's own venv module, what PoCL links its kernels with, a PoCL where pip has none that works here, an
# EGL/OpenGL driver, and for `test` a clang, through which kernels are compiled for other processors.
# Where apt-get or the right to use it is missing it says what to install and goes on if it can.
set -euo pipefail
cd "$(dirname "$0")/.."

extra=${1:-core}
venv=.venv
stamp=$venv/.cldof-$extra
cl_stamp=$venv/.cldof-cl
gl_stamp=$venv/.cldof-gl
system_pocl_stamp=$venv/.cldof-system-pocl
clang_stamp=$venv/.cldof-clang

say() { printf '%s\n' "cldof setup: $*" >&2; }
fail() { say "$*"; exit 1; }

as_root() {
    if [ "$(id -u)" = 0 ]; then "$@"
    elif ! command -v sudo >/dev/null; then return 1
    elif [ -t 0 ]; then sudo "$@"
    else sudo -n "$@"
    fi
}

apt_updated=
apt_install() {
    command -v apt-get >/dev/null || return 1
    as_root true 2>/dev/null || return 1
    if [ -z "$apt_updated" ]; then
        as_root apt-get update -qq >&2 || say "apt-get update failed; trying with the package lists at hand"
        apt_updated=1
    fi
    say "installing $*"
    as_root env DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends "$@" </dev/null >&2
}

new_enough() { "$1" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; }

find_python() {
    if [ -n "${PYTHON:-}" ]; then
        command -v "$PYTHON" >/dev/null || fail "PYTHON=$PYTHON is not a command"
        new_enough "$PYTHON" || fail "PYTHON=$PYTHON is $("$PYTHON" --version 2>&1); cldof needs Python 3.11 or newer"
        printf '%s\n' "$PYTHON"
        return
    fi
    local candidate
    for candidate in python3 python3.13 python3.12 python3.11; do
        if command -v "$candidate" >/dev/null && new_enough "$candidate"; then
            printf '%s\n' "$candidate"
            return
        fi
    done
    fail "no Python 3.11 or newer found (python3 is $(python3 --version 2>&1 || true));" \
        "install one, or name it: make PYTHON=/path/to/python3.11 ..."
}

make_venv() {
    local python package
    python=$(find_python)
    say "creating $venv with $("$python" --version 2>&1)"
    if ! "$python" -c 'import ensurepip, venv' 2>/dev/null; then
        package=python$("$python" -c 'import sys; print("%d.%d" % sys.version_info[:2])')-venv
        apt_install "$package" || fail "$python has no venv module; install the package $package and try again"
    fi
    rm -rf "$venv"
    "$python" -m venv "$venv" || { rm -rf "$venv"; fail "$python could not create $venv"; }
}

# Tools of the system alone, for checks: nothing of Python's.
case $extra in
oclgrind) command -v oclgrind >/dev/null || apt_install oclgrind || say "oclgrind cannot be installed"; exit 0 ;;
rusticl) apt_install mesa-opencl-icd || say "mesa-opencl-icd cannot be installed"; exit 0 ;;
esac

drop_pip_pocl() { "$venv/bin/python" -m pip uninstall -qq -y --disable-pip-version-check pocl-binary-distribution; }

# An existing .venv whose interpreter is gone (an upgrade of the system, a moved folder) is made anew.
"$venv/bin/python" -c 'import pip' 2>/dev/null || make_venv

# What `registers` needs of Python is what `test` needs.
tools=
if [ "$extra" = registers ]; then extra=test stamp=$venv/.cldof-test tools=registers; fi

if [ ! -e "$stamp" ] || [ setup.cfg -nt "$stamp" ] || [ pyproject.toml -nt "$stamp" ]; then
    target=.
    [ "$extra" = core ] || target=".[$extra]"
    say "installing cldof and what it needs into $venv (once, a few minutes on a slow line)"
    "$venv/bin/python" -m pip install -qq --disable-pip-version-check -e "$target"
    [ ! -e "$system_pocl_stamp" ] || drop_pip_pocl
    touch "$stamp"
fi

# Proved by use, not by looking for files: a vendor's driver counts as well. Drivers may be talkative while they fail.
prove() { { "$venv/bin/python" -c "$1" >"$venv/$2.log" 2>&1; } 2>/dev/null; }
have_cl() { prove 'from cldof.host.device import Device; Device.open().traits' cl; }
have_gl() { prove 'from cldof.capture.peel import DepthPeeler; DepthPeeler(8, 8).close()' gl; }
why() { tail -n 1 "$venv/$1.log"; }

# The distribution's PoCL in place of pip's. The first probe sees that driver alone: pip's is removed only for one that
# works, since with both present the one that fails may be the one that is chosen.
use_system_pocl() {
    local icd=/etc/OpenCL/vendors/pocl.icd
    [ -e "$icd" ] || apt_install pocl-opencl-icd || return 1
    OCL_ICD_VENDORS=$icd have_cl || return 1
    say "the system's PoCL works here, and pip's does not or is not there: $venv is left to the system's"
    drop_pip_pocl
    touch "$system_pocl_stamp"
    have_cl
}

# PoCL links each kernel against libgcc and libc with the system's ld, and aborts the process where one of them is missing.
# pip has no PoCL for Arm, and its LLVM 14 cannot compile for processors that it cannot name ("unknown target CPU").
if [ ! -e "$cl_stamp" ]; then
    if have_cl || { apt_install gcc libc6-dev && have_cl; } || use_system_pocl; then
        touch "$cl_stamp"
    else
        say "no OpenCL device works here ($(why cl)): nothing can be rendered;" \
            "for PoCL on the CPU install gcc and libc6-dev, and pocl-opencl-icd where pip's PoCL does not work;" \
            "for a GPU its driver."
    fi
fi

if [ ! -e "$gl_stamp" ]; then
    if have_gl || { apt_install libegl1 libgl1 libgl1-mesa-dri && have_gl; }; then
        touch "$gl_stamp"
    else
        say "no offscreen OpenGL here: scenes cannot be captured; frames of your own (.npz, arrays) still render." \
            "The probe ended with: $(why gl)"
    fi
fi

have_clang() { "$venv/bin/python" -c 'from tests.tools.compiled import find_clang; raise SystemExit(not find_clang())'; }

if [ "$extra" = test ] && [ ! -e "$clang_stamp" ]; then
    have_clang || { apt_install clang && have_clang; } ||
        say "no clang that knows OpenCL C: kernels are not checked for other processors; install clang."
    touch "$clang_stamp" # asked once; tests find a clang that comes later by themselves
fi

# NVIDIA's assembler, from CUDA or from PyPI, and the builtins that go with clang's version.
if [ -n "$tools" ]; then
    command -v ptxas >/dev/null || [ -x /usr/local/cuda/bin/ptxas ] ||
        "$venv/bin/python" -m pip install -qq --disable-pip-version-check nvidia-cuda-nvcc-cu12 ||
        say "nvidia-cuda-nvcc-cu12, which has ptxas, cannot be installed"
    missing=$("$venv/bin/python" -c 'from tests.tools.registers import missing_package; print(missing_package())')
    [ -z "$missing" ] || apt_install "$missing" || say "$missing cannot be installed"
fi
