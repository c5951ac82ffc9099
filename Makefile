.PHONY: help setup setup-dev test test-faults lint format demo docs clean

VENV ?= .venv
PY := $(VENV)/bin/python

help:
	@echo "make setup   build the environment in $(VENV) (again: a second)"
	@echo "make test    set up if needed, then run every test but those of faults; ARGS=tests/FOLDER: some"
	@echo "make test-faults  the tests of signals, kills, workers, ranks and damaged files, one after another"
	@echo "make demo    set up if needed, then a trained GSMap drawn on MiniCity, and one of your own that starts from MapTR"
	@echo "make lint    ruff, ruff format, codespell, mypy"
	@echo "make format  let ruff fix what it can"
	@echo "make docs    the documentation as a site, in site/ (python -m http.server -d site shows it with search)"

setup:
	@tools/setup_env.sh $(VENV)

setup-dev:
	@GSMAP_DEV=1 tools/setup_env.sh $(VENV)

# Python and the kernels for the CPU leave compiled files behind for the next run. One thread per process: threads that
# wait for each other cost more than they give.
PYTEST = env -u PYTHONDONTWRITEBYTECODE OMP_NUM_THREADS=$${OMP_NUM_THREADS:-1} $(PY) -m pytest

# One process per core; one that is done takes tests from the end of another's list.
test: setup-dev
	$(PYTEST) -n auto --dist worksteal $(ARGS)

# One process, so that no test disturbs another: ARGS=--count=30 runs each thirty times.
test-faults: setup-dev
	$(PYTEST) -m faults $(ARGS)

lint: setup-dev
	$(PY) -m ruff check .
	$(PY) -m ruff format --check .
	$(PY) -m codespell_lib
	$(PY) -m mypy

format: setup-dev
	$(PY) -m ruff check --fix .
	$(PY) -m ruff format .

demo: setup
	$(PY) tools/demo.py $(ARGS)

docs: setup-dev
	NO_MKDOCS_2_WARNING=1 $(PY) -m mkdocs build --strict
	@echo "Open site/index.html, or for the search: $(PY) -m http.server -d site"

clean:
	rm -rf demo site work_dirs .pytest_cache .mypy_cache .ruff_cache
