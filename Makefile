# `make demo`, `make test` and `make docs` need Python >= 3.11 and make; everything else they set up themselves.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
INSTALL = $(BIN)/python -m pip install --quiet --disable-pip-version-check

# Pages whose prose is held to the limits of docs/tools/prose.py.
PLAIN = README index start choose commands errors data data-sets arrays import-tables import-tracks import-bags import-hdf5 import-public \
	record extending export security ope replay replay-results gpu limits upgrade guard guard-results method drivers-results attribution \
	evaluation options crossing crossing-results benchmark tables ablations frontiers performance code

.PHONY: demo test versions docs lint clean

$(BIN)/python:
	$(PYTHON) -c 'import sys; sys.exit("Ringfence needs Python 3.11 or newer, found " + sys.version.split()[0] + "; run make PYTHON=python3.12") if sys.version_info < (3, 11) else None'
	$(PYTHON) -m venv $(VENV)

$(VENV)/.ready: pyproject.toml | $(BIN)/python
	$(INSTALL) -e '.[test]'
	touch $@

$(VENV)/.docs: pyproject.toml | $(BIN)/python
	$(INSTALL) -e '.[docs]'
	touch $@

demo: $(VENV)/.ready
	$(BIN)/ringfence demo --out demo

test: $(VENV)/.ready
	$(BIN)/python -m pytest -n 2 --dist loadfile

# The suite on every Python that is here, with the newest packages and with the oldest JAX that the bounds allow.
versions:
	.ci/versions

# The site: warnings are errors, and what was built is looked at as a reader without a network would.
docs: $(VENV)/.docs
	JAX_PLATFORMS=cpu NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --quiet --strict
	$(BIN)/python docs/tools/check.py site
	$(BIN)/python docs/tools/prose.py --pages $(PLAIN)

lint: $(VENV)/.ready
	$(BIN)/ruff check src tests benchmarks docs/tools
	$(BIN)/lint-imports
	$(BIN)/basedpyright --level error

clean:
	rm -rf $(VENV) demo site
