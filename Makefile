# make train   from a fresh clone: environment, the bunny end to end (arguments go in ARGS, as in make train ARGS="seed=1")
# make test    the default tests, warnings as errors, with coverage
# make check   format, lint, types, import contracts: what CI checks
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin

.PHONY: train test check environment

train: environment
	$(BIN)/python train.py $(ARGS)

test: environment
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n 2 --dist worksteal -m "not slow and not gpu" --cov --cov-report=term --cov-fail-under=90 $(ARGS)

check: environment
	$(BIN)/ruff format --check src tests datasets *.py
	$(BIN)/ruff check src tests datasets *.py
	$(BIN)/mypy
	$(BIN)/lint-imports

environment: $(VENV)/installed

$(VENV)/installed: constraints.txt pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt torch
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable ".[dev]"
	touch $@
