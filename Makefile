# Uses .venv where there is one (make setup creates it), else the environment that is active.
VENV ?= .venv
BIN = $(if $(wildcard $(VENV)/bin/python),$(VENV)/bin/,)

.PHONY: setup check format docs inventories test test-min test-pythons test-next

setup:  ## create .venv with everything a contributor needs
	python3 -m venv $(VENV)
	$(VENV)/bin/pip install -c constraints.txt -e '.[dev]'

check:  ## formatting, lint and types; changes nothing
	$(BIN)ruff format --check .
	$(BIN)ruff check .
	$(BIN)mypy torchrl_priors recipes hydra_plugins

format:  ## apply the formatting and the safe lint fixes
	$(BIN)ruff format .
	$(BIN)ruff check --fix .

docs:  ## the documentation, into site/; a warning is an error
	$(BIN)python -m sphinx -W --keep-going -b html docs site

inventories:  ## where other projects document what docs/ refers to; needs the network
	$(BIN)python docs/inventories.py

test:  ## doctests and tests
	$(BIN)python -m pytest -n auto

test-min:  ## the same with the oldest supported versions, in an environment of their own
	python3 -m venv $(VENV)-min
	$(VENV)-min/bin/pip install -c constraints-min.txt -e '.[test]'
	$(VENV)-min/bin/python -m pytest -n auto

test-pythons:  ## the same on the other Pythons, where they are installed
	for version in 3.10 3.12; do .ci/python $$version || [ $$? -eq 77 ] || exit 1; done

test-next:  ## the same with the newest releases of all, whatever pyproject.toml allows; may fail
	python3 -m venv $(VENV)-next
	$(VENV)-next/bin/pip install -e '.[test]'
	$(VENV)-next/bin/pip install --upgrade --pre torch tensordict torchrl
	$(VENV)-next/bin/python -m pytest -n auto
