# Everything a fresh machine needs is Python >= 3.11 and make; `make help` lists the targets.

PYTHON ?= python3
VENV ?= .venv
OUT ?= out/demo
NEBULA_DATA ?= $(abspath $(if $(wildcard ../shared/data),../shared/data,data))
export NEBULA_DATA

UV := $(shell command -v uv 2>/dev/null)
ifdef UV
MAKE_VENV = "$(UV)" venv --quiet --allow-existing --python "$(PYTHON)" "$(VENV)"
INSTALL = "$(UV)" pip install --python "$(VENV)/bin/python"
else
MAKE_VENV = "$(PYTHON)" -m venv "$(VENV)"
INSTALL = "$(VENV)/bin/python" -m pip install --disable-pip-version-check
endif

RUN = "$(VENV)/bin/python" -m
# Stamps: an environment is installed anew only when pyproject.toml changed.
HAS_QUALITY = $(VENV)/.installed-quality
HAS_DEV = $(VENV)/.installed-dev

.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.PHONY: help demo test test-slow check clean

help:
	@echo "make demo       set up $(VENV), simulate the default city, print where the report is"
	@echo "make test       set up $(VENV), run every test that is not marked slow"
	@echo "make test-slow  run the slow tests; SLOW='-k NAME' picks some of them"
	@echo "make check      format, lint, import contract, types, quick tests"
	@echo "make clean      remove .venv, caches and built packages; keeps out/ and data/"
	@echo "variables       PYTHON=$(PYTHON)  VENV=$(VENV)  OUT=$(OUT)"
	@echo "                NEBULA_DATA=$(NEBULA_DATA)"

demo: $(HAS_QUALITY)
	$(RUN) nebula simulate --out "$(OUT)"
	@echo "report: $(abspath $(OUT))/report.html"

test: $(HAS_DEV)
	$(RUN) pytest -m "not slow"

test-slow: $(HAS_DEV)
	$(RUN) pytest -m slow $(SLOW)

check: $(HAS_DEV)
	$(RUN) ruff format --check .
	$(RUN) ruff check .
	"$(VENV)/bin/lint-imports"
	$(RUN) mypy
	$(RUN) pytest -m "not slow"

clean:
	rm -rf .venv dist .pytest_cache .mypy_cache .ruff_cache .hypothesis .import_linter_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

$(VENV)/bin/python:
	@"$(PYTHON)" -c 'import sys; sys.exit(sys.version_info < (3, 11) and "NEBULA needs Python >= 3.11, not %d.%d; name another one with PYTHON=" % sys.version_info[:2])'
	@echo "creating $(VENV)"
	$(MAKE_VENV)

$(HAS_QUALITY): pyproject.toml | $(VENV)/bin/python
	$(INSTALL) -e ".[quality]"
	@touch $@

$(HAS_DEV): pyproject.toml | $(VENV)/bin/python
	$(INSTALL) -e ".[dev]"
	@touch $@ $(HAS_QUALITY)
