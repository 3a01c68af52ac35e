# `make train` and `make test` do all the set-up on a fresh machine; the rest builds on them.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready
RLLIB := $(VENV)/rllib
INSTALL := -m pip install --quiet --disable-pip-version-check --editable

.PHONY: train test bench bench-peers bench-exactness reproduce fuzz soak lint setup clean

setup: $(READY)

# The environment counts as made only once everything is in it.
$(READY): pyproject.toml
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "shoal needs Python 3.11 or newer: make PYTHON=python3.11 ...")'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python $(INSTALL) '.[dev]'
	touch $(READY)

# The main job: M_sensor, 10 robots x 2 groups, on a Ray of its own. ARGS adds flags, as in ARGS="--seed 1".
train: $(READY)
	$(BIN)/shoal train $(ARGS)

lint: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports --no-cache

# Lint, types, import rules, then all tests. ARGS goes to pytest.
test: lint
	$(BIN)/python -m pytest $(ARGS)

bench: $(READY)
	$(BIN)/python -m tests.benchmarks $(ARGS)

# The same trainings by Stable-Baselines3, TorchRL and RLlib, which pins another Gymnasium and so lives in a folder of its
# own. ARGS="cartpole --rounds 1" for a short one.
bench-peers: $(VENV)/.peers $(RLLIB)/.ready
	$(BIN)/python -m tests.benchmarks.peers --rllib $(RLLIB)/bin/python $(ARGS)

$(VENV)/.peers: $(READY)
	$(BIN)/python $(INSTALL) '.[dev,peers]'
	touch $@

$(RLLIB)/.ready: $(READY)
	$(PYTHON) -m venv $(RLLIB)
	$(RLLIB)/bin/python $(INSTALL) . 'ray[rllib]'
	touch $@

# How exact the simulator is: RVO2, float64, FL-ORCA's episodes. ARGS="--episodes 20 --scenes 800" for a short one.
bench-exactness: $(READY)
	$(BIN)/python -m tests.benchmarks.exactness $(ARGS)

# Three cells of the committed results, trained anew: do they land where those are? ARGS="--cells 10 --seed 1" for others.
reproduce: $(READY)
	$(BIN)/python -m tests.benchmarks.reproduce $(ARGS)

# Over ten thousand random command lines and config files. ARGS="--share 0.1" for some, ARGS="--seed 1" for others.
fuzz: $(READY)
	$(BIN)/python -m tests.benchmarks.fuzz $(ARGS)

# Two hours of training at full speed: is memory flat, does anything leak? ARGS="--hours 0.1" for a short one.
soak: $(READY)
	$(BIN)/python -m tests.benchmarks.soak $(ARGS)

clean:
	rm -rf $(VENV) build *.egg-info .pytest_cache .ruff_cache .mypy_cache .hypothesis
