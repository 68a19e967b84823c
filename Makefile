# `make help` lists the targets. Everything runs in .venv, which the first target that needs it makes.
PYTHON ?= python3
VENV   := .venv
RUN    := $(VENV)/bin/python
# Tests that share compiled programs sit in one file, so each file stays with one worker.
TEST   := $(RUN) -m pytest --numprocesses auto --maxprocesses 4 --dist loadfile --no-loadscope-reorder
READY  := $(VENV)/.ready

.DEFAULT_GOAL := help
.PHONY: help install evolve test test-all test-quick fuzz check format docs bench dist environments numbers lock clean

help:  ## list the targets
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | awk -F ':.*## ' '{printf "  make %-12s %s\n", $$1, $$2}'

$(READY): requirements.lock pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "error: expected Python 3.11 or newer; found $$($(PYTHON) --version) (set PYTHON=...)"; exit 2; }
	@echo "setting up $(VENV) from requirements.lock: one to three minutes, 2 GB"
	@$(PYTHON) -m venv $(VENV)
	@echo "downloading and installing packages"
	@$(VENV)/bin/pip install --disable-pip-version-check -r requirements.lock
	@echo "installing mjx_revolve itself"
	@$(VENV)/bin/pip install --quiet --disable-pip-version-check --no-deps --editable .
	@touch $(READY)

install: $(READY)  ## set up .venv

evolve: $(READY)  ## evolve a swimmer in the lake (into runs/)
	$(RUN) -m mjx_revolve.evolve configs/lake_swim.yaml

test: $(READY)  ## the tests, but for some long ones
	$(TEST) -m "not long"

test-all: $(READY)  ## all tests: notebooks, the tutorial and more cases, too; three times as long
	$(TEST)

fuzz: $(READY)  ## malformed files of all kinds, drawn anew; N of each (default: 2000)
	MJX_REVOLVE_FUZZ=$(or $(N),2000) $(RUN) -m pytest tests/inputs/test_fuzz.py

test-quick: $(READY)  ## the quick tests, some two minutes
	$(TEST) -m "not slow and not long"

check: $(READY)  ## lint, format and types
	$(RUN) -m ruff check .
	$(RUN) -m ruff format --check .
	$(RUN) -m mypy

format: $(READY)  ## let ruff mend what it can
	$(RUN) -m ruff check --fix .
	$(RUN) -m ruff format .

docs: $(READY)  ## the site in build/docs: pages, reference, gallery; minutes
	$(RUN) docs/settings.py
	$(RUN) docs/figures.py
	rm -rf build/docs
	$(RUN) docs/gallery.py build/docs
	$(RUN) docs/reference.py build/docs

numbers: $(READY)  ## the figures of README and docs from docs/results
	$(RUN) docs/figures.py

bench: $(READY)  ## work and precision, then throughput, beside MuJoCo C and plain MJX
	$(RUN) -m experiments.precision
	$(RUN) -m experiments.bench

dist: $(READY)  ## wheel and sdist in dist/, tried in a fresh environment from an empty folder
	rm -rf dist build/dist
	$(RUN) -m pip install --quiet --disable-pip-version-check build
	$(RUN) -m build --outdir dist .
	$(PYTHON) -m venv build/dist/venv
	build/dist/venv/bin/pip install --quiet --disable-pip-version-check dist/*.whl
	build/dist/venv/bin/pip check
	mkdir -p build/dist/empty && cd build/dist/empty && ../venv/bin/mjx-revolve evolve smoke --out run

environments: $(READY)  ## lowest and newest versions, and neighbours: installed and tried, minutes and GB each
	$(RUN) -m experiments.installations --tests

lock:  ## write requirements.lock anew from pyproject.toml
	$(PYTHON) -m venv $(VENV)-lock
	$(VENV)-lock/bin/pip install --quiet pip-tools
	$(VENV)-lock/bin/pip-compile --quiet --strip-extras --no-emit-index-url --no-emit-find-links \
	  --no-emit-trusted-host --extra dev --output-file requirements.lock pyproject.toml
	rm -rf $(VENV)-lock

clean:  ## remove .venv and caches; runs/ stays
	rm -rf $(VENV) .pytest_cache .ruff_cache .mypy_cache build *.egg-info
