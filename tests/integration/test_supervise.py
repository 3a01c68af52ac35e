"""`shoal train --supervise`: the run goes on by itself when its driver is killed."""

import dataclasses

import psutil
import pytest

from deploy.chaos.invariants import broken_invariants
from learner.run_folder import RunFolder
from learner.tracking.fault_log import read_faults
from tests.integration.conftest import PATIENCE_S, SMALL, flags
from tests.integration.jobs import Job

pytestmark = [
    pytest.mark.ray,
    pytest.mark.filterwarnings("ignore:The ``noload`` loader strategy:DeprecationWarning"),  # MLflow's own query
]

LONG = dataclasses.replace(
    SMALL,
    engine="ray",
    workers=2,
    replay_shards=2,
    replay_placement="actors",
    total_env_steps=60_000,
    checkpoint_every_env_steps=4_000,
    eval_every_env_steps=100_000,
)


def test_a_run_whose_driver_is_killed_ends_with_all_accounts(tmp_path):
    job, folder = Job(tmp_path, "train", "--supervise", "--name", "r", *flags(LONG)), RunFolder(tmp_path / "runs" / "r")
    try:
        job.wait_for_checkpoints("r", 1)
        (driver,) = psutil.Process(job.process.pid).children()
        others = driver.children(recursive=True)
        assert len(others) > 3, "Ray runs in processes of its own"
        driver.kill()
        job.wait_for(lambda: "going on with the run" in job.log.read_text())
        assert not any(process.is_running() for process in others), "nothing of it may write any more"
        assert job.process.wait(PATIENCE_S) == 0, job.log.read_text()
    finally:
        if job.process.poll() is None:
            job.kill_all()
    assert sum(entry.event == "resumed" for entry in read_faults(folder.faults)) == 1
    assert broken_invariants(folder) == []
    assert job.log.read_text().count("the driver was killed by SIGKILL at") == 1
