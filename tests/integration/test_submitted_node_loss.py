"""A submitted job on a head and two nodes that joined it: a node is lost, the job trains on and comes to its end."""

import dataclasses
import json
import re

import pytest

from deploy.chaos.invariants import broken_invariants
from learner.run_folder import RunFolder
from learner.tracking.fault_log import read_faults
from tests.integration.conftest import SMALL
from tests.integration.jobs import kill, wait_for
from tests.integration.ray_head import copy_of_the_code, finish, joined_node, running_head, submit

pytestmark = [
    pytest.mark.ray,
    pytest.mark.slow,
    pytest.mark.filterwarnings("ignore:The ``noload`` loader strategy:DeprecationWarning"),  # MLflow's own query
]

QUICK = {"health_check_initial_delay_ms": 1000, "health_check_period_ms": 1000, "health_check_failure_threshold": 5}
WIDE = dataclasses.replace(
    SMALL,
    env_id="CartPole-v1",
    engine="ray",
    workers=3,
    replay_shards=2,
    replay_placement="actors",
    total_env_steps=60_000,
    checkpoint_every_env_steps=5_000,
    eval_every_env_steps=20_000,
)
"""Six parts on three nodes of two CPUs."""


def test_a_submitted_job_outlives_a_node(tmp_path):
    checkout = copy_of_the_code(tmp_path / "checkout")
    runs, log = tmp_path / "runs", tmp_path / "log"
    quick = f"--system-config={json.dumps(QUICK)}"
    with (
        running_head(tmp_path / "head", "--num-cpus=2", quick) as head,
        joined_node(head, tmp_path / "second", "--num-cpus=2"),
        joined_node(head, tmp_path / "third", "--num-cpus=2") as third,
    ):
        job = submit(head, checkout, WIDE, runs, log)
        wait_for(lambda: len(list(runs.glob("*/checkpoints/step-*[0-9]"))) >= 2, log.read_text, job)
        with joined_node(head, tmp_path / "fourth", "--num-cpus=2"):  # as an autoscaler brings one
            kill(third)
            code, text = finish(job, log)
    assert code == 0, text
    (run,) = (path.parent for path in runs.glob("*/config.json"))
    folder = RunFolder(run)
    faults = read_faults(folder.faults)
    assert {entry.event for entry in faults} >= {"failed", "mended"}, text
    assert re.search(r"works again after|going on from", text), text
    assert broken_invariants(folder) == []
