# `make train` and `make test` do all the set-up on a fresh machine; the rest builds on them.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
RUNTIME := $(VENV)/.runtime-ready
READY := $(VENV)/.dev-ready
RLLIB := $(VENV)/rllib
PIP := -m pip install --quiet --disable-pip-version-check --no-compile
ROBOT_PEERS := $(VENV)/robot-peers
VMAS := vmas==1.5.2 gym==0.26.2 gym-notices==0.0.8 six==1.17.0 pyglet==1.5.27
INSTALL := $(PIP) --constraint .ci/constraints.txt --editable
# Python compiles the modules that it imports, once. pip would compile all, which takes longer than a first training saves.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: train test lint style types kernels constraints bench bench-peers bench-robots bench-exactness reproduce generalist league shares robustness overestimation fuzz soak setup clean

setup: $(READY)

$(BIN)/python:
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "shoal needs Python 3.11 or newer: make PYTHON=python3.11 ...")'
	$(PYTHON) -m venv $(VENV)

# An environment counts as made only once everything is in it.
$(RUNTIME): pyproject.toml .ci/constraints.txt | $(BIN)/python
	$(BIN)/python $(INSTALL) .
	touch $@

$(READY): pyproject.toml .ci/constraints.txt | $(BIN)/python
	$(BIN)/python $(INSTALL) '.[dev]'
	touch $(RUNTIME) $@

# The main job: our best settings for M_sensor, 10 robots x 2 groups, on a Ray of its own. ARGS adds flags: ARGS="--seed 1".
train: $(RUNTIME)
	$(BIN)/shoal train --preset best $(ARGS)

# Style, types and import rules.
lint: style types

style: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(READY)
	$(BIN)/mypy
	$(BIN)/lint-imports --no-cache

# While the packages that tests add are being installed.
kernels: $(RUNTIME)
	$(BIN)/python -m tests.precompile

# Style, types, import rules, then all tests. ARGS goes to pytest, which runs WORKERS processes: two with a Ray, which
# wait more than they compute, and one that computes. Four on two cores are too many: a machine that is that busy misses
# deadlines.
WORKERS ?= 3
test: $(RUNTIME)
	$(MAKE) --no-print-directory --jobs 2 kernels lint
	$(BIN)/python -m pytest --numprocesses $(WORKERS) --dist loadscope --no-loadscope-reorder $(ARGS)

# Renews .ci/constraints.txt: the newest releases that pyproject.toml admits. ARGS="torch==2.13.0" holds one back.
constraints: $(BIN)/python
	$(BIN)/python .ci/constraints.py $(ARGS)

bench: $(READY)
	$(BIN)/python -m tests.benchmarks $(ARGS)

# The same trainings by Stable-Baselines3, TorchRL and RLlib, which pins another Gymnasium and so lives in a folder of its
# own. ARGS="cartpole --rounds 1" for a short one.
bench-peers: $(VENV)/.peers $(RLLIB)/.ready
	$(BIN)/python -m tests.benchmarks.peers --rllib $(RLLIB)/bin/python $(ARGS)

# Steps of learning robots beside VMAS, which lives in a folder of its own, since it needs Gymnasium's predecessor, and
# beside CAMAR, JaxNav and IR-SIM, which have an interpreter of their own with JAX. ARGS="--robots 10 --rounds 2" for some.
bench-robots: $(VENV)/vmas/.ready $(ROBOT_PEERS)/.ready
	$(BIN)/python -m tests.benchmarks.robot_peers --vmas $(VENV)/vmas --peers $(ROBOT_PEERS)/bin/python $(ARGS)

$(ROBOT_PEERS)/.ready: $(READY)
	$(PYTHON) -m venv $(ROBOT_PEERS)
	$(ROBOT_PEERS)/bin/python $(PIP) camar==0.4.0 jaxmarl==0.2.0 ir-sim==2.12.0 jax==0.10.2
	touch $@

$(VENV)/vmas/.ready: $(READY)
	$(BIN)/python $(PIP) --no-deps --target $(VENV)/vmas $(VMAS)
	touch $@

$(VENV)/.peers: $(READY)
	$(BIN)/python $(INSTALL) '.[dev,peers]'
	touch $@

$(RLLIB)/.ready: $(READY)
	$(PYTHON) -m venv $(RLLIB)
	$(RLLIB)/bin/python $(PIP) --editable . 'ray[rllib]'
	touch $@

# How exact the simulator is: RVO2, float64, FL-ORCA's episodes. ARGS="--episodes 20 --scenes 800" for a short one.
bench-exactness: $(READY)
	$(BIN)/python -m tests.benchmarks.exactness $(ARGS)

# Three cells of the committed results, trained anew: do they land where those are? ARGS="--cells 10 --seed 1" for others.
reproduce: $(READY)
	$(BIN)/python -m tests.benchmarks.reproduce $(ARGS)

# One policy for all setups beside the rules, on the same start scenes: trainings of minutes, three seeds a method.
# ARGS="--methods sensor --seeds 0" for one.
generalist: $(READY)
	$(BIN)/python -m tests.benchmarks.generalist $(ARGS)

# Our policies, the rules, FL-ORCA and the published GA3C-CADRL, whose package is there for its weights alone.
# ARGS="--setups 10x2 --episodes 200" for some.
league: $(VENV)/cadrl/.ready
	$(BIN)/python -m tests.benchmarks.league --cadrl $(VENV)/cadrl $(ARGS)

$(VENV)/cadrl/.ready: $(READY)
	$(BIN)/python $(PIP) --no-deps --target $(VENV)/cadrl gym-collision-avoidance==0.0.3
	touch $@

# One robot, a quarter, half or all of a swarm learn, and each policy plays at every share; half a minute a training.
# ARGS="--methods sensor --setups 10x2 --seeds 0" for some.
shares: $(READY)
	$(BIN)/python -m tests.benchmarks.shares $(ARGS)

# Policies trained for bad senses beside ones trained without, and the rules: 36 trainings of a minute or two, then 16
# conditions in three setups. ARGS="--methods sensor --seeds 0" for some.
robustness: $(READY)
	$(BIN)/python -m tests.benchmarks.robustness $(ARGS)

# What DQN and Double DQN expect beside what they get: six trainings, a table for `shoal report`. ARGS="--seeds 0" for two.
overestimation: $(READY)
	$(BIN)/python -m tests.benchmarks.overestimation $(ARGS)

# Over ten thousand random command lines and config files, and 2,000 environments. ARGS="--share 0.1" for some,
# ARGS="--seed 1" for others, ARGS="--kinds environments" for one kind.
fuzz: $(READY)
	$(BIN)/python -m tests.benchmarks.fuzz $(ARGS)

# Two hours of training at full speed: is memory flat, does anything leak? ARGS="--hours 0.1" for a short one.
soak: $(READY)
	$(BIN)/python -m tests.benchmarks.soak $(ARGS)

clean:
	rm -rf $(VENV) build *.egg-info .pytest_cache .ruff_cache .mypy_cache .hypothesis
