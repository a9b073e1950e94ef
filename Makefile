# All a user's tasks; they need only Python 3.11 and make. `make` lists the targets.
PYTHON ?= python3.11
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready
LIBRARIES := libegl1 libgl1 libx11-6 libusb-1.0-0
export OPEN3D_DISABLE_WEB_VISUALIZER = true
# Bit-identical results on every x86-64 processor with AVX2. steelnb/core/determinism.py explains why, and sets the same variables in a user's script.
include steelnb/core/pins.env
export $(shell sed 's/=.*//' steelnb/core/pins.env)
# NumPy refuses to start if both of its variables are set, or if the processor lacks a feature that the first names.
ifneq ($(NPY_DISABLE_CPU_FEATURES)$(shell grep -q avx2 /proc/cpuinfo || echo old),)
unexport NPY_ENABLE_CPU_FEATURES
endif
# Keep the libraries' bytecode, even in a container that disables it: every kernel then imports them in 2 s instead of 5.
export PYTHONDONTWRITEBYTECODE =
# `workflow` is beside the package, not in it.
export PYTHONPATH = .

.PHONY: help setup reproduce study rows smoke test plain bits lint check docs train lab lock clean
.DEFAULT_GOAL := help

help:  ## list the targets
	@grep -hE '^[a-z]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/:.*## /|/' | awk -F'|' '{printf "  make %-10s %s\n", $$1, $$2}'

setup: $(READY)  ## create the virtual environment from environment.lock (the other targets do so if needed)

$(READY): environment.lock pyproject.toml Makefile
	@command -v $(PYTHON) >/dev/null || { echo "$(PYTHON) not found: install Python 3.11, or name it: make PYTHON=/path/to/python3.11"; exit 1; }
	@scripts/system-libraries $(LIBRARIES)
	@test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	@awk '/^[^ #]/ {half = !half} {print > ("$(VENV)/half-" half ".lock")}' environment.lock # two processes unpack twice as fast
	printf '%s\n' 0 1 | xargs -P 2 -I @ $(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile --no-deps --require-hashes -r $(VENV)/half-@.lock
	@$(BIN)/python -m pip uninstall --quiet --yes rfc3987-syntax # if it is there, papermill compiles a grammar of IRIs for 2 s at each start
	@$(BIN)/python -m compileall -q -j 0 -x '/tests?/' $(VENV)/lib >/dev/null 2>&1 || true # pip would use one core; a few files of libraries are no Python 3
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation -e .
	@$(BIN)/python -m workflow kernels
	@touch $@

# ONLY="id ..." selects notebooks, BUDGET=smoke shortens them, OUT=folder redirects the results, P="seed=3 tof.rate_hz=10" sets parameters.
reproduce: $(READY)  ## run every notebook that is not up to date and regenerate results/ (ONLY= BUDGET= OUT= P=)
	@$(BIN)/python -m workflow reproduce $(ONLY) $(if $(BUDGET),--budget "$(BUDGET)") $(if $(OUT),--output "$(OUT)") $(if $(P),-p "$$P")

smoke: $(READY)  ## the same with short flights, written to results-smoke/
	@$(BIN)/python -m workflow reproduce $(ONLY) --budget smoke

check: $(READY)  ## run every notebook from scratch and compare metrics and tables with the last commit (ONLY=)
	@$(BIN)/python -m workflow check $(ONLY)

study: $(READY)  ## run what is missing of notebooks/study.toml and write results/study/ (from scratch: 7 hours on two cores)
	@$(BIN)/steelnb study notebooks/study.toml -o results/study

# Each step skips what is up to date, or cached.
rows: study  ## fly every row of README's table: the study, twenty draws of the report's plots, and ours on its flights (8 hours)
	@$(BIN)/python -m workflow reproduce segmentation-odometry-draws cloud-odometry-draws accuracy honest-sensors
	@STEELNB_CACHE=.cache/rows $(BIN)/python benchmarks/report.py --parts ours

test: $(READY)  ## run linters, type checks, import contracts and all tests, with the notebooks that are not up to date at the smoke budget, on two workers
	@$(MAKE) --no-print-directory --jobs=2 --output-sync lint plain
	@$(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder

# The kernels' tests in plain Python, where indices beyond an array raise.
plain: $(READY)
	@NUMBA_DISABLE_JIT=1 $(BIN)/python -m pytest tests/hough tests/points tests/registration tests/fusion/test_kernels.py -m kernels -W ignore::RuntimeWarning

# 25 minutes on two cores; needs Debian's package qemu-user.
bits: $(READY)  ## compute digests of short flights as other processors would, and report whether they agree
	@$(BIN)/python -m workflow bits

lint: $(READY)
	@$(BIN)/ruff check .
	@$(BIN)/ruff format --check .
	@$(BIN)/mypy
	@$(BIN)/lint-imports
	@$(BIN)/python scripts/duplicate-names

docs: $(READY)  ## build the offline pages with every executed notebook: docs/_build/html/index.html (BUDGET=full: all as published)
	@$(BIN)/python -m workflow pages $(if $(BUDGET),--budget "$(BUDGET)")
	@$(BIN)/python -m sphinx -W --keep-going -q -j 2 docs docs/_build/html

train: $(READY)  ## train the network of `deepvo` from scratch (half an hour on two cores; installs PyTorch)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check "torch>=2.4"
	$(BIN)/python scripts/train-deepvo

# Copies, so that edited parameters leave the tracked notebooks clean; an existing copy stays. Jupyter refuses root without a
# word. LAB="--ip=0.0.0.0 --no-browser" opens it from outside a container.
lab: $(READY)  ## open JupyterLab with a copy of the notebook 00_explore (LAB= further options)
	@mkdir -p my-notebooks && for file in notebooks/*.ipynb; do test -e "my-notebooks/$${file##*/}" || cp "$$file" my-notebooks/; done
	@echo "my-notebooks/ holds your copies of the notebooks: edit them, and delete one to get the current version."
	@JUPYTER_CONFIG_PATH="$(CURDIR)/scripts/jupyterlab" $(BIN)/jupyter lab --notebook-dir=. \
	    $(if $(filter 0,$(shell id -u)),--allow-root) $(LAB) my-notebooks/00_explore.ipynb

GROUPS := workflow docs dev build
# The lock names extras, since pip treats `package[extra]` as a separate requirement that needs its own pin. Without them,
# set-up fails as soon as a newer version of such a package is released.
lock:  ## update environment.lock from pyproject.toml, keeping the versions that fit (needs uv)
	@mkdir -p .cache
	sed -nE 's/^([A-Za-z0-9_.-]+)(\[.*\])?(==[^ ;]+).*/\1\3/p' environment.lock > .cache/constraints.txt
	uv pip compile pyproject.toml $(addprefix --group ,$(GROUPS)) --python-version 3.11 --generate-hashes \
	    --no-header --no-annotate --no-strip-extras --no-emit-package steelnb --quiet -c .cache/constraints.txt -o environment.lock

clean:  ## remove the environment and all caches, but not the results
	rm -rf $(VENV) .cache results-smoke docs/_build docs/notebooks docs/_static/plotly.min.js .pytest_cache .mypy_cache .ruff_cache .hypothesis .import_linter_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
