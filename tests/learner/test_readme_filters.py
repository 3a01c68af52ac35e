"""The filters that dashboards/README.md suggests for MLflow's search box find what it says."""

import re
from pathlib import Path

import mlflow
import pytest

from learner.config import RunConfig
from learner.tracking.mlflow_run import Tracker
from sim_core.config import WorldConfig

pytestmark = pytest.mark.filterwarnings("ignore:The ``noload`` loader strategy is deprecated")

RUNS = {
    "solved": ({"method": "sensor", "robots": 10, "groups": 2}, {"policy": "learned"}, 0.95, 0.0, "FINISHED"),
    "failed": ({"method": "out", "robots": 25, "groups": 8}, {"policy": "learned"}, 0.60, 0.2, "FAILED"),
    "greedy": ({"method": "in", "robots": 5, "groups": 8}, {"policy": "greedy"}, 0.70, 0.01, "FINISHED"),
}
"""World, tags, success rate, captured rate and end of three runs."""
FOUND = {
    "tags.policy = 'learned'": {"solved", "failed"},
    "tags.method = 'out' and params.robots = '25'": {"failed"},
    "tags.policy = 'learned' and metrics.`final/success_rate` < 0.8": {"failed"},
    "metrics.`final/captured_rate` > 0.05 and params.groups = '8'": {"failed"},
    "attributes.run_name LIKE 'sensor 10r%'": {"solved"},
    "attributes.status != 'FINISHED'": {"failed"},
    "params.n_step = '3'": {"solved", "failed", "greedy"},
}


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    return f"sqlite:///{tmp_path_factory.mktemp('mlflow') / 'mlflow.db'}"


@pytest.fixture(scope="module")
def names(store, tmp_path_factory):
    """Name by id of the runs of the store."""
    ids = {}
    for name, (world, tags, success, captured, status) in RUNS.items():
        tracker = Tracker(store, "filters", str(tmp_path_factory.mktemp("artifacts")))
        tracker.start(RunConfig(world=WorldConfig(**world), n_step=3), tags)
        tracker.log_results({"success_rate": success, "captured_rate": captured}, 1_700_000_000_000)
        tracker.end(status)
        ids[tracker.run_id] = name
    return ids


def readme_filters():
    text = (Path(__file__).parents[2] / "dashboards" / "README.md").read_text()
    table = text.split("## Comparing runs in MLflow")[1].split("## ")[0]
    return [code.strip("`") for code in re.findall(r"^\| (`+.*?`+) \|", table, re.MULTILINE)]


def test_the_readme_names_these_filters():
    assert set(readme_filters()) == set(FOUND)


@pytest.mark.parametrize("text", FOUND)
def test_a_filter_finds_what_the_readme_says(store, names, text):
    client = mlflow.MlflowClient(store)
    experiment = client.get_experiment_by_name("filters").experiment_id
    assert {names[run.info.run_id] for run in client.search_runs([experiment], text)} == FOUND[text]
