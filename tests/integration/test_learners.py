"""A swarm that learns, from the command line: trained in one process and over Ray, evaluated, exported."""

import dataclasses
import json

import mlflow
import numpy as np
import pytest

from actors.evaluation.evaluation_store import load_evaluation
from actors.evaluation.trajectory import load_episodes
from learner.checkpoints.checkpoint import newest_valid
from tests.integration.conftest import SMALL, flags, run_here

pytestmark = pytest.mark.filterwarnings(
    "ignore:The ``noload`` loader strategy:DeprecationWarning"
)  # MLflow's own query
IN_PROCESS = pytest.mark.parametrize("trained", ["process"], indirect=True)
"""For what does not depend on where the run was trained."""
SWARM = dataclasses.replace(
    SMALL, world=dataclasses.replace(SMALL.world, learners="1.0"), envs_per_worker=12, total_env_steps=4_000
)


@pytest.fixture(scope="module", params=["process", pytest.param("ray", marks=pytest.mark.ray)])
def trained(request, tmp_path_factory):
    """(folder, what the command printed) of a run in which all robots learn."""
    folder = tmp_path_factory.mktemp(request.param)
    config = dataclasses.replace(SWARM, engine=request.param)
    return folder, run_here("train", *location(folder), "--name", "r", *flags(config))


def location(folder):
    return ["--runs-dir", f"{folder}/runs", "--tracking-uri", f"sqlite:///{folder}/runs/mlflow.db"]


def test_a_run_tells_of_the_robots_and_of_the_team(trained):
    folder, printed = trained
    assert "sensor 3r×2g, learners 1.0 s0" in printed
    for words in ("success rate", "all arrive", "segregated along the way", "collision of two learners", "worlds"):
        assert words in printed
    client = mlflow.MlflowClient(f"sqlite:///{folder}/runs/mlflow.db")
    (run,) = client.search_runs([client.get_experiment_by_name("shoal").experiment_id])
    assert run.data.tags["learners"] == run.data.params["learners"] == "1.0"
    assert {"final/all_arrive_rate", "final/segregation", "final/learner_collision_rate"} <= run.data.metrics.keys()
    assert len(run.data.metrics) < 35
    state = newest_valid(folder / "runs/r/checkpoints")[0].state
    ledger = state["ledger"]
    assert state["env_steps"] >= SWARM.total_env_steps and not any(ledger["dropped"].values())
    assert 0 < state["env_steps"] - ledger["produced"] <= 12 * SWARM.n_step and ledger["produced"] == ledger["stored"]
    (episode,), world = load_episodes(folder / "runs/r/artifacts/episode.zarr")
    assert world.learners == "1.0" and 0 <= episode.learner < 6
    assert (folder / "runs/r/artifacts/episode.html").exists()


@pytest.mark.ray
@IN_PROCESS
def test_a_policy_is_evaluated_at_another_share(trained, tmp_path):
    folder, _ = trained
    for learners, count in (("one", 1), ("0.5", 4)):
        out = tmp_path / f"{learners}.zarr"
        played = ["--learners", learners, "--episodes", "5", "--out", str(out)]
        run_here("evaluate", "r", "--runs-dir", f"{folder}/runs", *played)
        stored = load_evaluation(out)
        assert stored.spec.world.learners == learners and len(stored.stats.outcome) == 5 * count
        assert len(stored.stats.team) == (5 * count if count > 1 else 0)
        np.testing.assert_array_equal(stored.seed, np.repeat(stored.seed[::count], count))


@IN_PROCESS
def test_the_policy_is_exported_for_one_robot(trained):
    folder, _ = trained
    run_here("export", "r", "--runs-dir", f"{folder}/runs")
    described = json.loads((folder / "runs/r/artifacts/export/policy.json").read_text())
    assert described["method"] == "sensor"
