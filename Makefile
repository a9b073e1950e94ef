# Everything a user does, from Python 3.11 and make alone. `make` lists the targets.
PYTHON ?= python3.11
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready
LIBRARIES := libegl1 libgl1 libx11-6 libusb-1.0-0
# One registration, one scan, one kernel: one thread. Runs are what is parallel.
export OMP_NUM_THREADS = 1
export OPENBLAS_NUM_THREADS = 1
export OPEN3D_DISABLE_WEB_VISUALIZER = true

.PHONY: help setup reproduce study smoke test lint check gallery lab lock clean
.DEFAULT_GOAL := help

help:  ## list the targets
	@grep -hE '^[a-z]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/:.*## /|/' | awk -F'|' '{printf "  make %-10s %s\n", $$1, $$2}'

setup: $(READY)  ## virtual environment from environment.lock (the other targets do this by themselves)

$(READY): environment.lock pyproject.toml
	@command -v $(PYTHON) >/dev/null || { echo "$(PYTHON) not found: install Python 3.11, or name it: make PYTHON=/path/to/python3.11"; exit 1; }
	@scripts/system-libraries $(LIBRARIES)
	@test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes -r environment.lock
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation -e .
	@mkdir -p $(VENV)/etc/jupyter/labconfig $(VENV)/share/jupyter/lab/settings
	@cp scripts/jupyterlab/page_config.json $(VENV)/etc/jupyter/labconfig/
	@cp scripts/jupyterlab/overrides.json $(VENV)/share/jupyter/lab/settings/
	@touch $@

reproduce: $(READY)  ## run every notebook that is not up to date and regenerate results/
	@$(BIN)/steelnb reproduce

study: $(READY)  ## run what is missing of notebooks/study.toml into results/study/ (half an hour on two cores)
	@$(BIN)/steelnb study

smoke: $(READY)  ## the same with short flights, into results-smoke/
	@$(BIN)/steelnb reproduce --budget smoke

test: $(READY) lint  ## lint, types, import contracts, tests, notebooks at their smoke budget
	@$(BIN)/python -m pytest

lint: $(READY)
	@$(BIN)/ruff check .
	@$(BIN)/ruff format --check .
	@$(BIN)/mypy
	@$(BIN)/lint-imports

check: $(READY)  ## run everything again in a scratch folder and compare with the committed results
	@$(BIN)/steelnb check

gallery: $(READY)  ## every notebook as executed, as pages to read offline: gallery/index.html
	@$(BIN)/steelnb gallery

lab: $(READY)  ## open JupyterLab on the notebook to explore
	@$(BIN)/jupyter lab --notebook-dir=. notebooks/00_explore.ipynb

lock:  ## write environment.lock anew from pyproject.toml (needs uv)
	uv lock --quiet --upgrade --python $(PYTHON)
	uv export --quiet --format requirements-txt --no-emit-project --no-header --no-annotate > environment.lock
	rm uv.lock

clean:  ## remove the environment and every cache; results stay
	rm -rf $(VENV) .cache results-smoke gallery .pytest_cache .mypy_cache .ruff_cache .hypothesis .import_linter_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
