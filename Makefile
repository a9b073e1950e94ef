# Everything a user does, from Python 3.11 and make alone. `make` lists the targets.
PYTHON ?= python3.11
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready
LIBRARIES := libegl1 libgl1 libx11-6 libusb-1.0-0
export OPEN3D_DISABLE_WEB_VISUALIZER = true
# The same bits on every x86-64 processor with AVX2; steelnb/pins.py says why, and sets the same in a user's own script.
include steelnb/pins.env
export $(shell sed 's/=.*//' steelnb/pins.env)
# NumPy refuses to start with both of its variables, and where the processor lacks what the first names.
ifneq ($(NPY_DISABLE_CPU_FEATURES)$(shell grep -q avx2 /proc/cpuinfo || echo old),)
unexport NPY_ENABLE_CPU_FEATURES
endif
# The libraries' bytecode is kept, even where a container says otherwise: every kernel imports them, in 2 s instead of 5.
export PYTHONDONTWRITEBYTECODE =
# `workflow` lies beside the package, not in it.
export PYTHONPATH = .

.PHONY: help setup reproduce study smoke test bits lint check docs train lab lock clean
.DEFAULT_GOAL := help

help:  ## list the targets
	@grep -hE '^[a-z]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/:.*## /|/' | awk -F'|' '{printf "  make %-10s %s\n", $$1, $$2}'

setup: $(READY)  ## virtual environment from environment.lock (the other targets do this by themselves)

$(READY): environment.lock pyproject.toml
	@command -v $(PYTHON) >/dev/null || { echo "$(PYTHON) not found: install Python 3.11, or name it: make PYTHON=/path/to/python3.11"; exit 1; }
	@scripts/system-libraries $(LIBRARIES)
	@test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile --require-hashes -r environment.lock
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation -e .
	@touch $@

# ONLY="id ...", BUDGET=smoke, OUT=folder, P="seed=3 tof.rate_hz=10": some notebooks, short, elsewhere, with parameters.
reproduce: $(READY)  ## run every notebook that is not up to date and regenerate results/ (ONLY= BUDGET= OUT= P=)
	@$(BIN)/python -m workflow reproduce $(ONLY) $(if $(BUDGET),--budget "$(BUDGET)") $(if $(OUT),--output "$(OUT)") $(if $(P),-p "$$P")

smoke: $(READY)  ## the same with short flights, into results-smoke/
	@$(BIN)/python -m workflow reproduce $(ONLY) --budget smoke

check: $(READY)  ## run every notebook again, from nothing, and compare metrics and tables with the last commit (ONLY=)
	@$(BIN)/python -m workflow check $(ONLY)

study: $(READY)  ## run what is missing of notebooks/study.toml and write results/study/ (all of it: 7 hours on two cores)
	@$(BIN)/python -m steelnb.runs notebooks/study.toml -o results/study

test: $(READY) lint  ## lint, types, import contracts, tests, notebooks at their smoke budget, on two workers
	@$(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder
	@NUMBA_DISABLE_JIT=1 $(BIN)/python -m pytest tests/hough tests/points tests/registration -m kernels -W ignore::RuntimeWarning

# 25 minutes on two cores; needs Debian's package qemu-user.
bits: $(READY)  ## compute digests of short flights as other processors would, and say whether they are the same bits
	@$(BIN)/python -m workflow bits

lint: $(READY)
	@$(BIN)/ruff check .
	@$(BIN)/ruff format --check .
	@$(BIN)/mypy
	@$(BIN)/lint-imports

docs: $(READY)  ## pages to read offline, with every notebook as executed: docs/_build/html/index.html (BUDGET=full: as published)
	@$(BIN)/python -m workflow pages --budget "$(or $(BUDGET),smoke)"
	@$(BIN)/python -m sphinx -W --keep-going -q -j 2 docs docs/_build/html

train: $(READY)  ## train the network of `deepvo` from nothing (half an hour on two cores; installs PyTorch)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check "torch>=2.4"
	$(BIN)/python scripts/train-deepvo

lab: $(READY)  ## open JupyterLab on the notebook to explore
	@JUPYTER_CONFIG_PATH="$(CURDIR)/scripts/jupyterlab" $(BIN)/jupyter lab --notebook-dir=. notebooks/00_explore.ipynb

GROUPS := workflow docs dev build
# With extras named, since pip takes `package[extra]` for another requirement, which wants a version of its own: without,
# set-up fails as soon as a newer version of such a package is released.
lock:  ## write environment.lock anew from pyproject.toml, versions kept where they fit (needs uv)
	@mkdir -p .cache
	sed -nE 's/^([A-Za-z0-9_.-]+)(\[.*\])?(==[^ ;]+).*/\1\3/p' environment.lock > .cache/constraints.txt
	uv pip compile pyproject.toml $(addprefix --group ,$(GROUPS)) --python-version 3.11 --generate-hashes \
	    --no-header --no-annotate --no-strip-extras --no-emit-package steelnb --quiet -c .cache/constraints.txt -o environment.lock

clean:  ## remove the environment and every cache; results stay
	rm -rf $(VENV) .cache results-smoke docs/_build docs/notebooks docs/_static/plotly.min.js .pytest_cache .mypy_cache .ruff_cache .hypothesis .import_linter_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
