# Two commands on a fresh machine: `make demo` and `make test`. Both set up .venv first.
PYTHON ?= python3
BIN := .venv/bin

.PHONY: demo test test-all test-arithmetic lint setup clean

setup: .venv/.ready

# Not compiled: of all that is installed a small part is ever imported, and is compiled then. Where the environment
# forbids to keep that, each process would compile it anew: seconds for every one that a test or a sweep starts.
unexport PYTHONDONTWRITEBYTECODE
PIP := $(BIN)/python -m pip install --quiet --no-compile --constraint constraints.txt

.venv/.ready: setup.cfg pyproject.toml constraints.txt
	$(PYTHON) -m venv .venv
	$(PIP) torch
	$(PIP) --editable ".[dev]"
	touch $@

demo: setup
	$(BIN)/python examples/close_the_loop.py

lint: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

PYTEST := OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n 2 --dist loadfile

test: setup lint
	$(PYTEST) -m "not slow"

# The slow ones too: whole traces and runs beside quicker tests of the same code, more than half of the time of all tests.
test-all: setup lint
	$(PYTEST)

# What BLAS, MKL, torch, oneDNN and numpy compute on a processor without wide vectors, with other last digits for each
# shape (tests/rounding.py): a test that takes last digits for granted fails here, as it would on another processor.
ARITHMETIC := OPENBLAS_CORETYPE=Prescott MKL_CBWR=COMPATIBLE ATEN_CPU_CAPABILITY=default ONEDNN_MAX_CPU_ISA=SSE41 \
	NPY_DISABLE_CPU_FEATURES="X86_V3 X86_V4 AVX512_ICL AVX512_SPR"

test-arithmetic: setup
	$(ARITHMETIC) $(PYTEST) --rounding -m "not slow"

clean:
	rm -rf .venv runs
