.PHONY: help setup setup-dev test test-faults lint format demo docs clean

VENV ?= .venv
PY := $(VENV)/bin/python

help:
	@echo "make setup   build the environment in $(VENV) (again: a second)"
	@echo "make test    set up if needed, then run every test"
	@echo "make test-faults  the tests of signals, kills, workers and ranks alone"
	@echo "make demo    set up if needed, then a trained GSMap drawn on MiniCity, and one of your own that starts from MapTR"
	@echo "make lint    ruff, ruff format, codespell, mypy"
	@echo "make format  let ruff fix what it can"
	@echo "make docs    the documentation as a site, in site/ (python -m http.server -d site shows it with search)"

setup:
	@tools/setup_env.sh $(VENV)

setup-dev:
	@GSMAP_DEV=1 tools/setup_env.sh $(VENV)

# One process of one thread per core: threads that wait for each other cost more than they give. A file stays in one process,
# in the order of the folders: by numbers of tests, as pytest-xdist has it, files of one long test would come last.
test: setup-dev
	OMP_NUM_THREADS=$${OMP_NUM_THREADS:-1} $(PY) -m pytest -n auto --dist loadfile --no-loadscope-reorder $(ARGS)

FAULTS = tests/fuzz/test_kills.py tests/fuzz/test_signals.py tests/utils/test_cli.py tests/utils/test_interrupt.py \
	tests/utils/test_parallel.py tests/utils/test_faults.py tests/utils/test_files.py tests/tools/test_run_ends.py \
	tests/tools/test_compare_runs.py tests/tools/test_train_and_test.py tests/engine/test_torchrun.py \
	tests/engine/test_checkpoint_hook.py tests/map_data/test_command_line.py tests/mini_city/test_generate.py
test-faults:
	$(MAKE) test ARGS="$(FAULTS) $(ARGS)"

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
