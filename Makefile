# Two commands for a fresh machine: `make demo` and `make test`. Each makes its own .venv.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
# Two processes. A file's tests run in one process and share its fixtures; a process without tests takes some of the other's.
PYTEST := python -m pytest -n 2 --dist worksteal

.PHONY: demo test test-slow test-all test-lowest docs clean

demo: $(VENV)/installed
	$(BIN)/retrieve demo

test: $(VENV)/installed
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/$(PYTEST) -m "not slow"

# Long tests: trainings, notebooks, killed processes, the commands of the documentation.
test-slow: $(VENV)/installed
	$(BIN)/$(PYTEST) -m slow

test-all: test test-slow

# The oldest versions that pyproject.toml admits.
test-lowest:
	$(MAKE) VENV=.venv-lowest CONSTRAINTS=.ci/lowest.txt .venv-lowest/installed
	.venv-lowest/bin/$(PYTEST)

# Open site/index.html. The site's search needs a server: `python3 -m http.server -d site`.
docs: $(VENV)/installed
	$(BIN)/python -m benchmarks.reference
	$(BIN)/zensical build --clean --strict

clean:
	rm -rf .venv .venv-lowest .cache demo site .pytest_cache .mypy_cache .ruff_cache

CONSTRAINTS ?= .ci/constraints.txt

$(VENV)/installed: pyproject.toml $(CONSTRAINTS)
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo "Python 3.11 or newer is needed; $(PYTHON) is $$($(PYTHON) --version 2>&1). Try: make PYTHON=python3.12"; exit 1; }
	@$(PYTHON) -c 'import venv, ensurepip' 2>/dev/null || \
		{ echo "Python's venv module is needed. On Debian or Ubuntu: apt-get install python3-venv"; exit 1; }
	$(PYTHON) -m venv --clear $(VENV)
# PyTorch first, pinned: other versions may install gigabytes of CUDA libraries, which the tests do not use.
	$(BIN)/python -m pip install --quiet -c $(CONSTRAINTS) torch
	$(BIN)/python -m pip install --quiet -c $(CONSTRAINTS) -e '.[test,docs,sim,mesh,heif,calibration,evaluation,onnx,sawyer,realsense,importers,serve,hub,cluster,transformers]'
	@touch $@
