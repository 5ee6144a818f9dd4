# Two commands matter: `make tune` (gains for the paper's spacecraft) and `make test`.
PYTHON ?= $(shell command -v python3.11 || command -v python3)
VENV := .venv
BIN := $(VENV)/bin
SCENARIO := scenarios/first_flight.toml
OUT := out/tune-first_flight
TYPED := ptsmc_jax tuning tests docs benchmarks

.PHONY: tune test types suite test-long setup table docs notebooks notebooks-kept clean

tune: $(VENV)/.installed
	$(BIN)/ptsmc tune $(SCENARIO) --out $(OUT)
	@echo "Tuned gains: $(OUT)/tuned.toml; figures: $(OUT)/figures; all numbers: $(OUT)/summary.json"

test: $(VENV)/.installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports --no-logo --no-cache
	$(MAKE) --jobs 2 types suite

types: $(VENV)/.types

# Pyright runs again if a source file has changed. The folders are listed because deleting a file changes them, too.
$(VENV)/.types: $(VENV)/.installed-dev $(shell find $(TYPED) -mindepth 1 -name '*.py' -o -type d ! -name __pycache__)
	$(BIN)/pyright
	@touch $@

suite:
	$(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder

# the tests that `make test` leaves out: more cases of each kind, and tests that take minutes
test-long: $(VENV)/.installed-dev
	$(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder -m long

table: $(VENV)/.installed
	$(BIN)/python benchmarks/observer_table.py

notebooks: $(VENV)/.installed-notebooks
	$(BIN)/jupyter lab notebooks

# generates the reference pages from the code, then builds all pages
docs: $(VENV)/.installed-dev
	$(BIN)/python docs/generate.py
	$(BIN)/python -m sphinx -W --keep-going -q -b html docs out/docs
	@echo "Documentation: out/docs/index.html"

# executes the notebooks and writes them with their outputs next to their sources
notebooks-kept: $(VENV)/.installed-dev
	$(BIN)/python notebooks/execute.py

setup: $(VENV)/.installed-dev

$(VENV)/.installed: pyproject.toml constraints.txt
	$(PYTHON) -c 'import sys; sys.exit("ptsmc-jax needs Python 3.11 or newer; name one with make PYTHON=...") if sys.version_info < (3, 11) else None'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --no-compile --constraint constraints.txt --editable '.[report]'
	@touch $@

$(VENV)/.installed-dev: $(VENV)/.installed
	$(BIN)/python -m pip install --quiet --no-compile --constraint constraints.txt --editable '.[dev]'
	@touch $@

$(VENV)/.installed-notebooks: $(VENV)/.installed
	$(BIN)/python -m pip install --quiet --no-compile --constraint constraints.txt --editable '.[notebooks]'
	@touch $@

clean:
	rm -rf $(VENV) out build dist .pytest_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
