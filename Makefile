# Two commands matter: `make demo` and `make test`. Both set up .venv themselves; a second run starts at once.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
# Many tests start Python anew. Where images turn its bytecode off, each start compiles all of torch and MuJoCo again.
export PYTHONDONTWRITEBYTECODE :=

# One worker per core; a file stays in one worker, which computes its shared fixtures once; long files come first.
PARALLEL := -n logical --maxprocesses 8 --dist loadfile --no-loadscope-reorder
TIMED := tests/system/test_time.py
QUICK := $(PARALLEL) -q -m "not slow" tests/unit tests/conformance

.PHONY: help demo check test lint format docs clean

help:
	@echo "make demo   learn a contact model and push the cube with it (runs/demo)"
	@echo "make check  while you work: ruff and the fast tests of the parts, in a minute"
	@echo "make test   run all tests, in parallel"
	@echo "make lint   ruff and pyright"
	@echo "make format let ruff put the code in order"
	@echo "make docs   build the documentation (build/docs/index.html)"
	@echo "make coverage, make mutants   how much of the library the quick tests run, and notice"
	@echo "make clean  remove .venv and build products"

# The torch of PyPI for Linux has gigabytes for NVIDIA's GPUs. Where there is none, uv finds the build for processors; else
# pip takes what it finds.
CPU_TORCH := [ "$$(uname)" != Linux ] || command -v nvidia-smi >/dev/null || { \
  $(BIN)/python -m pip install --quiet --disable-pip-version-check uv && UV_HTTP_TIMEOUT=10 \
  $(BIN)/uv pip install --quiet --python $(BIN)/python --torch-backend cpu -c constraints.txt torch; } 2>/dev/null || true

# .ready: everything that developers need, with the kernels for every CPU. .demo: what the demo needs, a quarter of the
# packages, with the kernels for the CPU that is here, which compile in half the time.
SOURCES := pyproject.toml constraints.txt CMakeLists.txt cmake/kernels.cmake \
  $(wildcard $(addsuffix /_native/*.[ch]*,difflcs difflcs/physics/mujoco envs/difflcs_envs))
$(VENV)/.ready: EXTRAS := all
$(VENV)/.ready: ISAS := all
$(VENV)/.demo: EXTRAS := rl,envs,viz
$(VENV)/.demo: ISAS := here
$(VENV)/.ready $(VENV)/.demo: $(SOURCES)
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "difflcs needs Python 3.11 or newer, got $$($(PYTHON) --version); try make PYTHON=python3.11"; exit 1; }
	$(PYTHON) -m venv $(VENV)
	@$(CPU_TORCH)
	SKBUILD_CMAKE_DEFINE=DIFFLCS_ISAS=$(ISAS) \
	  $(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile -c constraints.txt -e ".[$(EXTRAS)]"
	@touch $@

demo: $(or $(wildcard $(VENV)/.ready),$(VENV)/.demo)
	$(BIN)/difflcs demo

check: $(VENV)/.ready
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/python -m pytest $(QUICK)

# What measures time comes last, when nothing else runs.
test: $(VENV)/.ready
	$(BIN)/python -m pytest $(PARALLEL) --ignore $(TIMED)
	$(BIN)/python -m pytest $(TIMED)

lint: $(VENV)/.ready
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright

format: $(VENV)/.ready
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

docs: $(VENV)/.ready
	$(BIN)/python -m sphinx -W --keep-going -q -b html -d build/doctrees docs build/docs
	@echo "written: build/docs/index.html"

clean:
	rm -rf $(VENV) build dist .pytest_cache .ruff_cache

# The kernels under address, undefined-behaviour and thread sanitizers, on every instruction set of this CPU.
.PHONY: sanitize
sanitize: $(VENV)/.ready
	tests/native/sanitize.sh address,undefined
	tests/native/sanitize.sh thread

# The lines that the quick tests do not run (build/coverage/index.html); and whether a test notices when a line is wrong:
# MUTANTS small faults below FROM, drawn with SEED, put into the working tree one after the other. Minutes for each.
MUTANTS := 60
SEED := 43
FROM := difflcs envs/difflcs_envs
TESTS := $(QUICK)
SESSION := build/mutants.sqlite
.PHONY: coverage mutants
coverage: $(VENV)/.ready
	$(BIN)/python -m pip install --quiet -c constraints.txt pytest-cov==7.1.0
	$(BIN)/python -m pytest $(QUICK) --cov=difflcs --cov=difflcs_envs --cov-report=html:build/coverage

mutants: $(VENV)/.ready
	$(BIN)/python -m pip install --quiet -c constraints.txt cosmic-ray==8.7.0
	@mkdir -p build
	sed 's|^module-path.*|module-path = [$(FROM:%="%",)]|' tests/mutants.toml > build/mutants.toml
	$(BIN)/cosmic-ray init --force build/mutants.toml $(SESSION)
	$(BIN)/python tests/draw_mutants.py $(SESSION) $(MUTANTS) $(SEED)
	PATH="$(CURDIR)/$(BIN):$$PATH" TESTS='$(TESTS)' $(BIN)/cosmic-ray exec build/mutants.toml $(SESSION)
	$(BIN)/cr-report --surviving-only --show-diff $(SESSION)
