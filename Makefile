# Uses .venv where there is one (make setup creates it), else the environment that is active.
VENV ?= .venv
BIN = $(if $(wildcard $(VENV)/bin/python),$(VENV)/bin/,)

.PHONY: setup check format test

setup:  ## create .venv with everything a contributor needs
	python3 -m venv $(VENV)
	$(VENV)/bin/pip install -c constraints.txt -e '.[dev]'

check:  ## formatting, lint and types; changes nothing
	$(BIN)ruff format --check .
	$(BIN)ruff check .
	$(BIN)mypy torchrl_priors recipes

format:  ## apply the formatting and the safe lint fixes
	$(BIN)ruff format .
	$(BIN)ruff check --fix .

test:  ## doctests and tests
	$(BIN)python -m pytest -n auto
