# Every target creates what it needs. `make help` lists them.
SHELL := /bin/bash
.DEFAULT_GOAL := help

SHARD  ?= 0
CONFIG ?= tiny
OUT    ?= data/$(basename $(notdir $(CONFIG)))
DATA   ?= data/tiny
CASES  ?= ../shared/cases
PYTHON ?= python3.11
ARGS   ?=

# Where licensed inputs lie (`datagen assets` lists them); a configuration may name the places instead.
GRASPXL   ?=
OBJAVERSE ?=
MANO_DIR  ?=
HTML_DIR  ?=
export GRASPXL OBJAVERSE MANO_DIR HTML_DIR

VENV    := .venv
SHARDS  := .venv-shards
# setuptools warns about every editable installation.
INSTALL := -m pip install --quiet --disable-pip-version-check --constraint requirements.lock
PIP     := PYTHONWARNINGS=ignore $(VENV)/bin/python $(INSTALL)
RUNTIME := $(VENV)/.runtime-installed
DEV     := $(VENV)/.dev-installed
TRAIN   := $(VENV)/.training-installed
PARITY  := $(VENV)/.parity-installed

# Two processes share the tests, file by file. Each keeps to one thread: more would wait for each other.
JOBS    ?= 2
PYTEST  := OMP_NUM_THREADS=1 $(VENV)/bin/python -m pytest -q
SPREAD  := --numprocesses $(JOBS) --dist loadfile

.PHONY: help setup render train demo test test-slow test-shards test-parity cases check bench clean

help: ## list the targets and their variables
	@grep -hE '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/^([a-z-]+):.*## /\1\t/' | expand -t 13
	@echo
	@echo "variables: SHARD=$(SHARD) CONFIG=$(CONFIG) OUT=$(OUT) DATA=$(DATA) CASES=$(CASES) ARGS=$(ARGS) JOBS=$(JOBS) PYTHON=$(PYTHON)"
	@echo "places of licensed inputs: GRASPXL=$(GRASPXL) OBJAVERSE=$(OBJAVERSE) MANO_DIR=$(MANO_DIR) HTML_DIR=$(HTML_DIR)"

# Blender's module exists for Python 3.11 alone. Debian's python3.11 makes no environments without python3.11-venv.
$(VENV)/bin/python $(SHARDS)/bin/python:
	@if $(PYTHON) -c 'import ensurepip, sys; sys.exit(sys.version_info[:2] != (3, 11))' 2>/dev/null; then \
		echo "creating $(@:/bin/python=) with $(PYTHON)"; \
		$(PYTHON) -m venv $(@:/bin/python=); \
	elif test "$(origin PYTHON)" = file && command -v uv >/dev/null; then \
		echo "creating $(@:/bin/python=) with uv, which finds or downloads Python 3.11"; \
		uv venv --quiet --python 3.11 --seed $(@:/bin/python=); \
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

# mosaicml-streaming asks for transformers < 5 and the clients of five clouds; what is measured here needs none of them.
$(PARITY): $(DEV)
	@echo "installing what is compared with"
	@$(PIP) --editable '.[datagen,model,dev,parity]'
	@$(PIP) --no-deps mosaicml-streaming
	@touch $@

$(SHARDS)/.installed: $(SHARDS)/bin/python pyproject.toml requirements.lock
	@echo "installing shards and its tests"
	@PYTHONWARNINGS=ignore $< $(INSTALL) --editable '.[shards-tests]'
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
	$(PYTEST) $(SPREAD) -m "not slow" $(ARGS)

test-slow: $(DEV) ## run the tests that take minutes, and property tests with new examples
	$(PYTEST) -m "slow or hypothesis" --hypothesis-profile explore $(ARGS)

test-shards: $(SHARDS)/.installed ## run the tests of shards alone, without Blender and PyTorch
	$(SHARDS)/bin/python -m pytest -q -m "not slow" tests/shards $(ARGS)

test-parity: $(PARITY) ## run the comparisons with public packages
	$(PYTEST) -m parity $(ARGS)

cases: $(DEV) ## read the files from the field in CASES, a line each: right, refused or wrong
	OMP_NUM_THREADS=1 $(VENV)/bin/python -m tests.cases $(CASES)

check: $(DEV) ## lint, types, import contracts, then the tests
	$(VENV)/bin/ruff check .
	$(VENV)/bin/ruff format --check .
	$(VENV)/bin/lint-imports
	$(VENV)/bin/mypy
	@$(MAKE) --no-print-directory test

bench: $(PARITY) ## measure the performance claims of README.md on this machine
	$(VENV)/bin/python -m pytest -q -s tests/benchmarks --override-ini "python_files=bench_*.py" --override-ini addopts=--import-mode=importlib $(ARGS)

clean: ## remove .venv and caches; rendered data stays
	rm -rf $(VENV) $(SHARDS) .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis .benchmarks *.egg-info
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
