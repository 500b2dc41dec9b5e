# Two commands on a fresh machine: `make demo` and `make test`. Both set up .venv first.
PYTHON ?= python3
BIN := .venv/bin

.PHONY: demo test test-all lint setup clean

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

clean:
	rm -rf .venv runs
