# Everything from a clean checkout: each target makes its own .venv when it has to. Needs make and Python 3.10 or newer.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready
DOCS_READY := $(VENV)/.docs-ready
# Tracing keeps one core busy, and so two processes keep two; a file stays in one of them, with what its tests share.
PYTEST := -q --numprocesses 2 --dist loadfile --no-loadscope-reorder

# Environments for other versions of dependencies, one for each Python. The tests use every dependency of the package.
VERSION_ENV := $(notdir $(PYTHON))/.ready
VERSION_TESTS := tests/project/test_cli.py tests/inverse/config tests/inverse/dataset/test_picture_files.py \
  tests/inverse/test_line_search.py tests/jobs/test_memory.py tests/jobs/test_session.py tests/runs/test_run_folder.py \
  tests/report/test_pages.py tests/report/test_progress.py tests/output/test_examples.py tests/scenes/test_scene_files.py \
  tests/transport/test_step.py tests/adjoint/test_lights.py

.DEFAULT_GOAL := help
.PHONY: help demo test test-all test-hours test-lowest test-newest always coverage lint bench docs release clean

help:
	@echo "make demo      recover a texture, two wall colours and a light from rendered pictures, write a report"
	@echo "make test      lint and the quick tests, with kernels that LLVM does not optimise"
	@echo "make test-all  lint and every test but those that take hours, with kernels as users have them"
	@echo "make test-hours  those: tails of all cells in 256 passes each, 300 random scenes in one process"
	@echo "make test-lowest  a selection of the tests, with the lowest supported version of each dependency"
	@echo "make test-newest  the same, with the newest versions"
	@echo "make coverage  lines of the package that the quick tests run"
	@echo "make lint      ruff and mypy"
	@echo "make bench     time, memory and variance next to Mitsuba's own integrators"
	@echo "make docs      build the documentation site, build/site; NOTEBOOKS=off leaves out what notebooks print"
	@echo "make release   build wheel and source archive, and run the demo from the wheel in an empty environment"
	@echo "make clean     remove .venv and caches, keep runs/"
	@echo "Another Python: make demo PYTHON=python3.12"

# The stamp depends on what decides the versions, so that nothing is installed twice. An interrupted set-up has no stamp and
# is gone on with; a .venv whose Python has vanished is made anew.
$(READY): pyproject.toml constraints.txt
	@command -v $(PYTHON) >/dev/null || { \
	  echo "make: error: there is no $(PYTHON): install Python 3.10 or newer, or name it: make PYTHON=python3.12 ..." >&2; \
	  exit 2; }
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 10))' || { \
	  echo "make: error: $(PYTHON) is $$($(PYTHON) --version 2>&1), Python 3.10 or newer is needed:" \
	    "make PYTHON=python3.12 ..." >&2; \
	  exit 2; }
	@$(PYTHON) -c 'import ensurepip, venv' 2>/dev/null || { \
	  echo "make: error: $(PYTHON) cannot make virtual environments: install its venv package" \
	    "(Debian: apt install python3-venv)" >&2; \
	  exit 2; }
	@echo "make: setting up $(VENV) (once; about a minute)"
	@$(BIN)/python -m pip --version >/dev/null 2>&1 || $(PYTHON) -m venv --clear $(VENV)
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[dev]'
	@touch $@

$(DOCS_READY): $(READY)
	@$(BIN)/python -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
	  echo "make: error: the documentation needs Python 3.11 or newer: make clean, then" \
	    "make docs PYTHON=python3.12" >&2; \
	  exit 2; }
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[dev,docs]'
	@touch $@

demo: $(READY)
	$(BIN)/pathreplay optimize examples/cornell-photo/config.toml

lint: $(READY)
	$(BIN)/ruff check
	$(BIN)/ruff format --check --quiet
	$(BIN)/mypy

# Most kernels of these run for less time than LLVM takes to optimise them; test-all runs them as users have them.
test: lint
	PATHREPLAY_TEST_KERNELS=unoptimised $(BIN)/python -m pytest $(PYTEST) -m "not slow and not hours"

test-all: lint
	$(BIN)/python -m pytest $(PYTEST) -m "not hours"

test-hours: lint
	$(BIN)/python -m pytest $(PYTEST) -m hours

build/lowest-$(VERSION_ENV): CONSTRAINT := --constraint constraints-lowest.txt
build/lowest-$(VERSION_ENV): constraints-lowest.txt
build/newest-$(VERSION_ENV): always
build/lowest-$(VERSION_ENV) build/newest-$(VERSION_ENV): pyproject.toml
	$(PYTHON) -m venv --clear $(@D)
	$(@D)/bin/python -m pip install --quiet $(CONSTRAINT) --editable . pytest
	@touch $@

# Old versions warn about the Pythons and libraries that came after them, and new ones about what they will drop: their
# warnings are no errors here.
test-lowest test-newest: test-%: build/%-$(VERSION_ENV)
	PATHREPLAY_TEST_KERNELS=unoptimised $(<D)/bin/python -m pytest -q -W ignore::DeprecationWarning \
	  -m "not slow and not hours" $(VERSION_TESTS)

coverage: $(READY)
	PATHREPLAY_TEST_KERNELS=unoptimised $(BIN)/python -m pytest $(PYTEST) -m "not slow and not hours" --cov

# TASKS='surface --quick' and the like: see benchmarks/__main__.py; without it all of them, in full.
bench: $(READY)
	$(BIN)/python -m benchmarks $(TASKS)

# Sphinx writes the site, and warnings are errors. Notebooks run if they have changed, or not at all with NOTEBOOKS=off.
NOTEBOOKS ?= cache
docs: $(DOCS_READY)
	PATHREPLAY_DOCS_NOTEBOOKS=$(NOTEBOOKS) $(BIN)/python -m sphinx -q -W --keep-going -c docs -d build/doctrees . build/site
	@echo "build/site/index.html is the site"

# Builds and tries the wheel in environments of its own.
release: $(READY)
	$(BIN)/python .ci/release.py

clean:
	rm -rf $(VENV) .coverage .pytest_cache .ruff_cache .mypy_cache build src/*.egg-info
