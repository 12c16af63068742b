# For everybody: make demo, make test. All targets set up .venv first; Python and make suffice.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
# Modules are compiled when they are first imported: of all that is installed, a few are. Kept they
# are whatever the environment says, or every process would compile the same thousands again.
export PYTHONDONTWRITEBYTECODE :=
PIP_OPTIONS := --quiet --disable-pip-version-check --no-compile
# Long files first, each file in one process: its models are fitted once.
PYTEST := $(BIN)/python -m pytest -n auto --dist loadfile --no-loadscope-reorder

.PHONY: demo test studies notebooks lint style types contracts wheel docs bench clean

demo: $(VENV)/.installed
	$(BIN)/python examples/iea15/demo.py --output out
	$(BIN)/python examples/iea15/optimal_control.py --models out --output out

# Everything but the studies. Without XLA's fusion emitters, where they can be left out, and at its
# lowest level loops are compiled in half the time and take up to twice as long: tests compile more
# than they compute.
test: $(VENV)/.installed-dev
	XLA_FLAGS="$$XLA_FLAGS $$($(BIN)/python .ci/xla_flags.py)" $(PYTEST) -m "not slow and not notebook"

# What the documentation states, computed again. Only files that hold studies are collected.
studies: $(VENV)/.installed-dev
	$(PYTEST) -m slow $$(grep -l 'mark\.slow' tests/test_*.py)

# Notebooks and the start page, from top to bottom.
notebooks: $(VENV)/.installed-dev
	$(PYTEST) -m notebook tests/test_notebooks.py tests/test_pages.py

lint: style types contracts

style: $(VENV)/.installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(VENV)/.installed-dev
	$(BIN)/basedpyright --threads 2

contracts: $(VENV)/.installed-dev
	$(BIN)/lint-imports

# What would be published, looked at and used from an environment of its own.
wheel: $(VENV)/.installed-dev
	$(BIN)/python -m pip install $(PIP_OPTIONS) -e '.[dev,release]'
	rm -rf dist
	$(BIN)/python -m build --wheel
	$(BIN)/twine check --strict dist/*.whl
	$(BIN)/python .ci/check_wheel.py dist/*.whl

# The documentation as a site in out/site; any warning fails.
docs: $(VENV)/.installed-docs
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet
	@echo "open out/site/index.html"

bench: $(VENV)/.installed-dev
	$(BIN)/python -m benchmarks

clean:
	rm -rf $(VENV) out dist

$(VENV)/bin/python:
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "dfsm needs Python 3.11 or newer; set PYTHON=")'
	$(PYTHON) -m venv $(VENV)

$(VENV)/.installed: pyproject.toml | $(VENV)/bin/python
	$(BIN)/python -m pip install $(PIP_OPTIONS) -e '.[openfast]'
	touch $@

$(VENV)/.installed-dev: pyproject.toml | $(VENV)/bin/python
	$(BIN)/python -m pip install $(PIP_OPTIONS) -e '.[dev]'
	touch $@ $(VENV)/.installed

$(VENV)/.installed-docs: pyproject.toml | $(VENV)/bin/python
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e '.[docs]'
	touch $@
