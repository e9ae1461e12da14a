# make setup | demo | test | benchmark | lint | format | clean          (PYTHON=python3.12 make setup takes another interpreter)
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready
KERNELS := $(VENV)/.kernels

.PHONY: setup demo test benchmark lint format clean

setup: $(READY)

$(READY): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo "skyfix needs Python 3.11 or newer, $(PYTHON) is $$($(PYTHON) --version 2>&1); try PYTHON=python3.11 make setup" >&2; exit 1; }
	@test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/pip install -q -c constraints.txt setuptools
	$(BIN)/pip install -q -c constraints.txt --no-build-isolation -e '.[dev]'
	@touch $@

# numba keeps compiled kernels by file and does not see a change in a file that they call into.
$(KERNELS): $(READY) $(shell find fusion -name '*.py')
	@find fusion -name '*.nb[ic]' -delete
	@touch $@

demo: setup $(KERNELS)
	OMP_NUM_THREADS=1 $(BIN)/skyfix demo

test: setup $(KERNELS)
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -q -n 2 --dist loadfile

benchmark: setup $(KERNELS)
	OMP_NUM_THREADS=1 $(BIN)/skyfix benchmark

lint: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

format: setup
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

clean:
	rm -rf build dist runs *.egg-info .pytest_cache .ruff_cache .mypy_cache .hypothesis
	find benchmarks fusion learned sequences tests -name __pycache__ -type d -prune -exec rm -rf {} +
