# Everything a newcomer types. The environment is made once and again whenever pyproject.toml changes.
PYTHON ?= python3
VENV   ?= .venv
BIN    := $(VENV)/bin
READY  := $(VENV)/.ready

.PHONY: demo test unit lint types bench bench-design campaign clean

demo: $(READY)
	$(BIN)/ident simulate

test: lint types
	$(BIN)/pytest -m "not campaign"

unit: $(READY)
	$(BIN)/pytest -n 2 -m "not campaign and not slow"

lint: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(READY)
	$(BIN)/mypy

bench: $(READY)
	$(BIN)/python -m benchmarks

bench-design: $(READY)
	$(BIN)/python -m benchmarks.design

campaign: $(READY)
	$(BIN)/pytest -m campaign --timeout 7200

# pip 25.1 is the first to read dependency groups.
$(READY): pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade "pip>=25.1"
	$(BIN)/python -m pip install --quiet --editable . --group dev
	touch $@

clean:
	rm -rf $(VENV) .mypy_cache .ruff_cache .pytest_cache .hypothesis build dist
