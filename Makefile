# Every target creates what it needs. `make help` lists them.
SHELL := /bin/bash
.DEFAULT_GOAL := help

SHARD  ?= 0
CONFIG ?= tiny
OUT    ?= data/$(basename $(notdir $(CONFIG)))
DATA   ?= data/tiny
PYTHON ?= python3.11
ARGS   ?=

# Where licensed inputs lie (`datagen assets` lists them); a configuration may name the places instead.
GRASPXL   ?=
OBJAVERSE ?=
MANO_DIR  ?=
HTML_DIR  ?=
export GRASPXL OBJAVERSE MANO_DIR HTML_DIR

VENV    := .venv
# setuptools warns about every editable installation.
PIP     := PYTHONWARNINGS=ignore $(VENV)/bin/python -m pip install --quiet --disable-pip-version-check --constraint requirements.lock
RUNTIME := $(VENV)/.runtime-installed
DEV     := $(VENV)/.dev-installed
TRAIN   := $(VENV)/.training-installed
SHARDS  := .venv-shards/.installed

.PHONY: help setup render train demo test test-shards test-parity test-slow check bench clean

help: ## list the targets and their variables
	@grep -hE '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/^([a-z-]+):.*## /\1\t/' | expand -t 14
	@echo
	@echo "variables: SHARD=$(SHARD) CONFIG=$(CONFIG) OUT=$(OUT) DATA=$(DATA) ARGS=$(ARGS) PYTHON=$(PYTHON)"
	@echo "places of licensed inputs: GRASPXL=$(GRASPXL) OBJAVERSE=$(OBJAVERSE) MANO_DIR=$(MANO_DIR) HTML_DIR=$(HTML_DIR)"

# Blender's module exists for Python 3.11 alone. Debian's python3.11 makes no environments without python3.11-venv.
$(VENV)/bin/python:
	@if $(PYTHON) -c 'import ensurepip, sys; sys.exit(sys.version_info[:2] != (3, 11))' 2>/dev/null; then \
		echo "creating $(VENV) with $(PYTHON)"; \
		$(PYTHON) -m venv $(VENV); \
	elif test "$(origin PYTHON)" = file && command -v uv >/dev/null; then \
		echo "creating $(VENV) with uv, which finds or downloads Python 3.11"; \
		uv venv --quiet --python 3.11 --seed $(VENV); \
	else \
		echo "make: $(PYTHON) is no Python 3.11 that can make environments, and Blender's module needs 3.11." \
			"Install uv, which brings one (pipx install uv), or on Debian 12: apt-get install python3.11-venv," \
			"or name one: make $(MAKECMDGOALS) PYTHON=/path/to/python3.11" >&2; \
		exit 2; \
	fi

$(RUNTIME): $(VENV)/bin/python pyproject.toml requirements.lock
	@echo "installing the generator (about a minute)"
	@$(PIP) --editable '.[datagen]'
	@$(VENV)/bin/python blender_scripts/check_blender.py
	@touch $@

$(DEV): $(RUNTIME)
	@echo "installing the development tools"
	@$(PIP) --editable '.[datagen,model,dev]'
	@touch $@

$(TRAIN): $(RUNTIME)
	@echo "installing PyTorch and what training needs"
	@$(PIP) --editable '.[datagen,model]'
	@touch $@

setup: $(RUNTIME) ## create .venv and install the generator

render: $(RUNTIME) ## plan CONFIG into OUT if needed, then render shard SHARD
	$(VENV)/bin/datagen render --config $(CONFIG) --out $(OUT) --shard $(SHARD) $(ARGS)

train: $(TRAIN) ## train the preset tiny on shard 0 of DATA, rendering it if absent
	@test -f $(DATA)/shards/shard-00000/shard.json || $(MAKE) --no-print-directory render SHARD=0 OUT=$(DATA)
	$(VENV)/bin/forehoi train tiny $(ARGS)

# metrics.json of a component is written when its training is finished; a stopped one is resumed.
demo: $(TRAIN) ## train both stages of tiny unless that is done, then reconstruct a held-out clip into runs/demo
	@test -f $(DATA)/shards/shard-00000/shard.json -a -f runs/tiny/stage_one/metrics.json || \
		$(MAKE) --no-print-directory train ARGS=
	@test -f runs/tiny_slat/slat_flow/metrics.json || { set -x; $(VENV)/bin/forehoi train tiny_slat; }
	$(VENV)/bin/forehoi reconstruct --held-out --out runs/demo --overwrite $(ARGS)

test: $(DEV) ## run the tests, without those marked slow
	$(VENV)/bin/python -m pytest -q -m "not slow" $(ARGS)

$(SHARDS): pyproject.toml
	@echo "creating .venv-shards: the format and its tests, without Blender and PyTorch"
	@$(PYTHON) -m venv .venv-shards
	@.venv-shards/bin/python -m pip install --quiet --disable-pip-version-check --constraint requirements.lock --editable '.[shards-tests]'
	@touch $@

test-shards: $(SHARDS) ## run the tests of the format alone, without Blender and PyTorch
	.venv-shards/bin/python -m pytest -q -m "not slow" tests/shards $(ARGS)

test-parity: $(DEV) ## install the public packages that results are compared with, then compare
	@$(PIP) --editable '.[datagen,model,dev,parity]'
	$(VENV)/bin/python -m pytest -q -m parity $(ARGS)

test-slow: $(DEV) ## run the tests that take minutes
	$(VENV)/bin/python -m pytest -q -m slow $(ARGS)

check: $(DEV) ## lint, types, import contracts, then the tests
	$(VENV)/bin/ruff check .
	$(VENV)/bin/ruff format --check .
	$(VENV)/bin/lint-imports
	$(VENV)/bin/mypy
	@$(MAKE) --no-print-directory test

bench: $(DEV) ## measure the performance claims of README.md on this machine
	$(VENV)/bin/python -m pytest -q -s tests/benchmarks --override-ini "python_files=bench_*.py" --override-ini addopts=--import-mode=importlib $(ARGS)

clean: ## remove .venv and caches; rendered data stays
	rm -rf $(VENV) .venv-shards .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis .benchmarks *.egg-info
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
