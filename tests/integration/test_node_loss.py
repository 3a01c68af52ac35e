"""A node of a Ray cluster is removed while a run trains: what it held is placed anew and the accounts balance."""

import dataclasses

import pytest
import ray
from ray.cluster_utils import Cluster

from deploy.chaos.invariants import broken_invariants
from learner.cluster_options import ClusterOptions
from learner.run import RunSession
from learner.run_folder import RunFolder, RunIdentity
from learner.tracking.fault_log import read_faults
from learner.tracking.mlflow_run import Tracker
from tests.integration.conftest import SMALL

pytestmark = [
    pytest.mark.ray,
    pytest.mark.slow,
    pytest.mark.filterwarnings("ignore"),  # of Ray's own cluster of nodes on one machine
]

QUICK = {"health_check_initial_delay_ms": 1000, "health_check_period_ms": 1000, "health_check_failure_threshold": 3}


class NodeRemover:
    """A display that removes a node at the first checkpointed row after `env_steps`."""

    def __init__(self, remove, env_steps):
        self.messages, self._remove, self._env_steps = [], remove, env_steps

    def row(self, row):
        if self._remove is not None and row.env_steps >= self._env_steps:
            remove, self._remove = self._remove, None
            remove()

    def message(self, text):
        self.messages.append(text)


@pytest.fixture
def cluster():
    made = Cluster(initialize_head=True, head_node_args={"num_cpus": 2, "_system_config": QUICK})
    yield made
    ray.shutdown()
    made.shutdown()


def test_a_removed_node_costs_no_run(cluster, tmp_path):
    config = dataclasses.replace(
        SMALL, engine="ray", workers=2, replay_shards=1, replay_placement="actors", total_env_steps=30_000
    )
    second = cluster.add_node(num_cpus=2)  # 4 CPUs for 4 parts: some of them are on either node
    cluster.wait_for_nodes()

    def remove():
        cluster.add_node(num_cpus=4)
        cluster.remove_node(second, allow_graceful=False)

    tracker = Tracker(f"sqlite:///{tmp_path / 'mlflow.db'}", "faults", str(tmp_path / "artifacts"))
    tracker.start(config)
    folder = RunFolder(tmp_path / "r")
    folder.save_config(config)
    folder.save_identity(RunIdentity("r", tracker.uri, "faults", tracker.run_id))
    display = NodeRemover(remove, 5_000)
    options = ClusterOptions(cluster.address, 30.0, 200.0)
    result = RunSession(folder, config, tracker, display, options).execute(None, lambda result, rows: [])
    assert result.env_steps >= 30_000 and result.evaluation is not None, display.messages
    log = read_faults(folder.faults)
    assert {entry.event for entry in log} >= {"failed", "mended"}, display.messages
    assert broken_invariants(folder) == []
