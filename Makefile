# `make demo`, `make test` and `make docs` need Python >= 3.11 and make; everything else they set up themselves.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
INSTALL = $(BIN)/python -m pip install --quiet --disable-pip-version-check

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

# The site: warnings are errors, what was built is looked at as a reader without a network would, and prose is measured.
docs: $(VENV)/.docs
	JAX_PLATFORMS=cpu NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --quiet --strict
	$(BIN)/python docs/tools/check.py site
	$(BIN)/python docs/tools/prose.py

lint: $(VENV)/.ready
	$(BIN)/ruff check src tests benchmarks docs/tools
	$(BIN)/lint-imports
	$(BIN)/basedpyright --level error

clean:
	rm -rf $(VENV) demo site
