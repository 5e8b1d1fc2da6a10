# Each target is the only step: what it needs is installed into .venv first (scripts/setup.sh).
# PYTHON=python3.12 picks the interpreter, DEVICE=... the OpenCL device, ARGS=... goes to pytest or bench.

VENV := .venv/bin
DEVICE ?=
ARGS ?=

export PYTHON

.PHONY: help demo test test-install test-devices test-cpus gpu-check gpu-registers test-oclgrind stability mutants bench lint clean

help:
	@echo "make demo   render a built-in scene to out/demo.png (and out/demo-pinhole.png beside it)"
	@echo "make test   run all tests          (ARGS='-k lens' picks some, ARGS='-n 0' has one process run them)"
	@echo "make stability  hard cases on every device, measured into docs/stability.md"
	@echo "make test-install   wheel and sdist in clean environments, and what they require on four systems (3 minutes)"
	@echo "make test-devices   the kernel and method tests on every OpenCL driver that can be installed, and how they agree"
	@echo "make test-cpus      every kernel as other x86-64 processors and Debian's PoCL have it (under 15 minutes)"
	@echo "make gpu-check      a GPU in eight minutes: pictures, speed, kernel tests, one JSON (DEVICE= picks)"
	@echo "make gpu-registers  what NVIDIA's assembler makes of the kernels: registers, stack, spills, occupancy; needs no GPU"
	@echo "make test-oclgrind  every kernel under a simulator that checks each access to memory (minutes)"
	@echo "make mutants        faults put into the kernels: how many the tests notice (an hour)"
	@echo "make bench  speed of each pass, then accuracy and time of every method, quickly (4 minutes)"
	@echo "            ARGS=speed or ARGS=--quick: one of them; ARGS='--scenes row': any 'cldof bench' options"
	@echo "make lint   ruff check, ruff format --check, mypy"
	@echo "make clean  remove .venv, out/ and caches"

demo:
	@scripts/setup.sh core
	@mkdir -p out
	@$(VENV)/cldof render foliage -o out/demo.png --pinhole out/demo-pinhole.png --size 1024x768 --supersample 2 \
		$(if $(DEVICE),--device "$(DEVICE)")

# A process for each core, as builds and references keep one core busy each; few, as each of them builds and kernels run
# on all cores anyway (tests/workers.py).
test:
	@scripts/setup.sh test
	$(VENV)/python -m pytest -n auto --maxprocesses 4 $(ARGS)

# What hard cases measure on every device of this machine, and the page of it.
stability:
	@scripts/setup.sh test
	CLDOF_STABILITY=bench/results/stability.json $(VENV)/python -m pytest tests/hard_cases $(ARGS)
	$(VENV)/python -m bench.stability

test-install:
	@scripts/setup.sh test
	$(VENV)/python -m tests.tools.install $(ARGS)

test-devices:
	@scripts/setup.sh test
	@scripts/devices.sh $(ARGS)

# Processors that this machine is not: compiled by the system's clang, then by PoCL, which is told that it runs there.
test-cpus:
	@scripts/setup.sh test
	$(VENV)/python -m tests.tools.compiled
	$(VENV)/python -m tests.tools.processors $(ARGS)

gpu-check:
	@scripts/setup.sh test
	@scripts/gpu_check.sh $(if $(DEVICE),"$(DEVICE)") $(ARGS)

gpu-registers:
	@scripts/setup.sh registers
	$(VENV)/python -m tests.tools.registers $(ARGS)

test-oclgrind:
	@scripts/setup.sh test
	$(VENV)/python -m tests.tools.checked --private
	@scripts/setup.sh oclgrind
	@if command -v oclgrind >/dev/null; then $(VENV)/python -m tests.tools.checked $(ARGS); \
	else echo "SKIPPED: oclgrind is not here and cannot be installed; no kernel was checked" >&2; fi

mutants:
	@scripts/setup.sh test
	$(VENV)/python -m tests.tools.mutate $(ARGS)

bench:
	@scripts/setup.sh bench
ifeq ($(ARGS),)
	$(VENV)/python -m bench speed $(if $(DEVICE),--device "$(DEVICE)")
	$(VENV)/python -m bench --quick $(if $(DEVICE),--devices "$(DEVICE)")
else
	$(VENV)/python -m bench $(ARGS) $(if $(DEVICE),$(if $(filter speed,$(ARGS)),--device,--devices) "$(DEVICE)")
endif

lint:
	@scripts/setup.sh dev
	$(VENV)/ruff check .
	$(VENV)/ruff format --check .
	$(VENV)/mypy

clean:
	rm -rf .venv out build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
