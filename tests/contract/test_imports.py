"""Which modules a process may not import: what it does not use costs it start-up time and memory."""

import json
import subprocess
import sys

import pytest

MEASURED = {"numba", "torch", "torch._dynamo", "ray", "mlflow", "matplotlib", "zarr", "pandas", "scipy.stats", "optuna"}
"""Modules that take more than a tenth of a second to import."""
KERNELS, TORCH = {"numba"}, {"torch", "torch._dynamo"}
HELP = "from deploy.cli import main\ntry:\n    main({arguments})\nexcept SystemExit:\n    pass"
START = """
import sys
sys.argv[1:] = ["--help"]
from deploy.__main__ import main
try:
    main()
except SystemExit:
    pass
"""
WORKER = """
from actors.rollout.worker import RolloutWorker
from learner.config import RunConfig
from learner.ray_backend.spares import SpareWorker
from learner.training.cluster import rollout_settings
config = RunConfig(envs_per_worker=2, steps_per_block=2)
RolloutWorker(rollout_settings(config), 0, 0)
"""
LEARNER = """
import ray
from actors.rollout.vector_env import env_shape
from actors.service.rpc import LocalCalls
from learner.config import RunConfig
from learner.ray_backend.cluster import LearnerActor
config = RunConfig(envs_per_worker=2, steps_per_block=2, min_replay=2, replay_capacity=1000)
LearnerActor(config, env_shape(config.env), [], LocalCalls()).weights()
"""
ENVIRONMENT = """
import gymnasium
import sim_core
env = gymnasium.make(sim_core.ENV_ID)
env.reset(seed=0)
"""
PROCESSES = {
    "shoal --help": (HELP.format(arguments="['--help']"), MEASURED),
    "shoal resume --help": (HELP.format(arguments="['resume', '--help']"), MEASURED),
    "shoal train --help": (HELP.format(arguments="['train', '--help']"), MEASURED - KERNELS),
    "a refused option": (HELP.format(arguments="['train', '--robots', '1']"), MEASURED - KERNELS),
    "import sim_core": ("import sim_core", MEASURED),
    "an environment": (ENVIRONMENT, MEASURED - KERNELS),
    "a rollout worker": (WORKER, MEASURED - KERNELS - {"ray", "zarr"}),
    "the learner": (LEARNER, MEASURED - KERNELS - {"torch", "ray", "zarr"}),
    "an evaluation of a rule": ("import deploy.commands.evaluate", MEASURED - KERNELS - {"ray", "zarr"}),
    "the pictures at the end of a run": (
        "import deploy.runs.artifacts",
        MEASURED - KERNELS - {"zarr", "matplotlib"},
    ),
    "the driver": ("import deploy.commands.train, deploy.training", MEASURED - KERNELS - {"zarr"}),
    "the process that writes to MLflow": (
        "import sim_core, learner.tracking.mlflow_run, mlflow.store.tracking.sqlalchemy_store",
        MEASURED - {"mlflow", "pandas"},
    ),
}
"""A program for each kind of process, and what it may not import."""


def value_after(code, expression):
    """The value of an expression in a fresh process that has run `code`."""
    program = f"{code}\nimport gc, json, sys\nsys.__stderr__.write('\\n' + json.dumps({expression}))"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, timeout=300)
    return json.loads(done.stderr.splitlines()[-1])


def modules_after(code):
    """Names of the modules that a fresh process has imported once it has run `code`."""
    return set(value_after(code, "sorted(sys.modules)"))


@pytest.mark.parametrize("process", PROCESSES)
def test_a_process_imports_nothing_that_it_does_not_use(process):
    code, forbidden = PROCESSES[process]
    imported = modules_after(code)
    assert {"numpy", "sim_core"} <= imported
    assert not forbidden & imported


def test_what_is_forbidden_is_found_where_it_is_used():
    assert MEASURED <= modules_after("\n".join(f"import {name}" for name in sorted(MEASURED)))


def test_only_the_start_of_shoal_has_python_look_for_cycles_rarely():
    """A process that imports shoal keeps its own garbage collector, and frees what its trainings leave."""
    of_python, imported, started = (
        value_after(code, "gc.get_threshold()") for code in ("", "import deploy.cli, deploy.commands.train", START)
    )
    assert of_python == imported != started
