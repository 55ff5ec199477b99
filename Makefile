# Two commands do everything on a fresh machine: `make demo` and `make test`. Both set up .venv themselves.
PYTHON ?= python3
VENV   := .venv
BIN    := $(VENV)/bin
BASE   := $(VENV)/.base
DOCS   := $(VENV)/.docs
STAMP  := $(VENV)/.ready
EXTRAS ?= dev,notebooks
# Bytecode of everything installed is 0.2 GB, most of it never loaded; Python writes what it does load. Without any, each
# process compiles its imports anew: 4 of the 6 s that a command takes to start. Hence also where it is told not to.
export PYTHONDONTWRITEBYTECODE :=
PIP    := $(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile
# Processes that run tests, or quick benchmarks, at one time; the tests of a file stay together.
WORKERS ?= 2

# Kernels are small and many; two threads that spin cost more than they give (see docs/how-to.md).
export NUMBA_THREADING_LAYER ?= workqueue
export OMP_WAIT_POLICY ?= passive

.PHONY: setup demo test test-all docs lint types bench bench-peers clean
.DEFAULT_GOAL := demo

setup: $(STAMP)

# What runs, draws and simulates: the demo needs no more.
$(BASE): pyproject.toml
	@test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	@echo "installing graphslam into $(VENV) (0.6 GB, half a minute or more the first time)"
	@$(PIP) --upgrade pip
	@$(PIP) --editable .
	@touch $(BASE)

# What the tests compare with, the notebooks, and the studies.
$(STAMP): $(BASE) notebooks/studies/pyproject.toml
	@echo "installing what the tests and the notebooks need into $(VENV) (another 2 GB: Open3D, Rerun, JupyterLab)"
	@$(PIP) --editable '.[$(EXTRAS)]' --editable notebooks/studies
	@touch $(STAMP)

demo: $(BASE)
	$(BIN)/graphslam demo --out demo-run $(DEMO)
	@echo "look at demo-run/figures/fused_level0.png and fused_level1.png"

test: $(STAMP)
	$(BIN)/python -m pytest -n $(WORKERS) --dist loadfile --no-loadscope-reorder $(TESTS)

# Also the rest of the tables of faults, of which `make test` runs each fault with one front end.
test-all:
	@$(MAKE) --no-print-directory test TESTS=--all

# The documentation site, build/site/index.html; a warning is an error. The notebooks are executed first, and again after
# a change of them or of the code; EXECUTE=0 builds the site without that: pages of notebooks show what the cache has.
$(DOCS): $(BASE)
	@$(PIP) --editable '.[docs]'
	@touch $(DOCS)

EXECUTE ?= 1
docs: $(DOCS) $(if $(filter 0,$(EXECUTE)),,$(STAMP))
ifneq ($(EXECUTE),0)
	$(BIN)/python docs/notebook_outputs.py
endif
	NO_MKDOCS_2_WARNING=1 PYTHONPATH=. $(BIN)/mkdocs build --quiet --strict
	@echo "look at build/site/index.html"

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(STAMP)
	$(BIN)/mypy

bench: $(STAMP)
	$(BIN)/python -m tests.benchmarks.quick $(WORKERS)

# Beside other programs, each installed into an environment of its own below build/peers. Hours; ROWS="isam2 evo" for some.
bench-peers: $(STAMP)
	$(BIN)/python -m tests.benchmarks.bench_peers $(ROWS)

clean:
	rm -rf $(VENV) build demo-run .pytest_cache .mypy_cache .ruff_cache
