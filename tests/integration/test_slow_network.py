"""A run over two machines whose cable is slow, is cut for a moment, and then for so long that a machine is given up."""

import dataclasses
import json
import secrets
import subprocess
import sys
from pathlib import Path

import pytest

from deploy.chaos.invariants import broken_invariants
from learner.checkpoints.checkpoint import finished_names
from learner.checkpoints.store import env_steps_of
from learner.run_folder import RunFolder
from learner.tracking.fault_log import read_faults
from tests.integration.conftest import PATIENCE_S, SMALL, clean_environment, flags
from tests.integration.jobs import kill, wait_for
from tests.integration.machines import SlowCable, at, machines
from tests.integration.ray_head import ROOT, ray_start, short_folder, with_token

pytestmark = [
    pytest.mark.ray,
    pytest.mark.slow,
    pytest.mark.filterwarnings("ignore:The ``noload`` loader strategy:DeprecationWarning"),  # MLflow's own query
]

HEAD, FAR = "10.78.1.1", "10.78.1.2"
DELAY_MS = 5.0
MOMENT_S, LONG_S = 3.0, 35.0
QUICK = {
    "health_check_initial_delay_ms": 1000,
    "health_check_period_ms": 1000,
    "health_check_timeout_ms": 4000,
    "health_check_failure_threshold": 4,
}
"""A machine is given up after about 20 s."""
CONFIG = dataclasses.replace(
    SMALL, engine="ray", workers=2, replay_shards=1, replay_placement="actors", total_env_steps=50_000
)


class Cluster:
    """A head and another machine at the far end of a slow cable, each with two CPU slots for four parts."""

    def __init__(self, head: str, far: str, folder: Path) -> None:
        self._machines, self._folder = (head, far), folder
        self.auth = with_token(secrets.token_hex(32))
        self.nodes = [self._start(0, "--head", "--include-dashboard=false", f"--system-config={json.dumps(QUICK)}")]
        self.join()

    def join(self) -> None:
        """Starts the far machine's node."""
        self.nodes.append(self._start(1, f"--address={HEAD}:6379"))

    def _start(self, i: int, *words: str) -> subprocess.Popen:
        place = self._folder / f"{i}-{secrets.token_hex(2)}"
        place.mkdir()
        words = (*words, f"--node-ip-address={(HEAD, FAR)[i]}", f"--temp-dir={place}", "--num-cpus=2")
        node = ray_start(place / "log", *words, auth=self.auth, before=at(self._machines[i]))
        assert node.poll() is None, (place / "log").read_text()
        return node

    def train(self, tmp_path: Path) -> subprocess.Popen:
        """`shoal train` on the head's machine."""
        words = ["train", "--name", "r", "--runs-dir", str(tmp_path), "--address", f"{HEAD}:6379", *flags(CONFIG)]
        words += ["--deadline-s", "30", "--start-deadline-s", "120"]
        with (tmp_path / "log").open("w") as log:
            return subprocess.Popen(
                [*at(self._machines[0]), sys.executable, "-m", "deploy", *words],
                env={**clean_environment(), **self.auth},
                cwd=ROOT,
                stdout=log,
                stderr=subprocess.STDOUT,
            )

    def close(self) -> None:
        for node in self.nodes:
            if node.poll() is None:
                kill(node)


@pytest.fixture
def wired():
    """(the cluster, its cable)."""
    with short_folder() as folder, machines("head", "far") as (head, far):
        cable = SlowCable(head, HEAD, far, FAR, DELAY_MS)
        cluster = Cluster(head, far, folder)
        yield cluster, cable
        cluster.close()
        cable.close()


def wait_for_steps(folder: RunFolder, env_steps: int, job: subprocess.Popen, log: Path) -> None:
    """Waits until the run's journal has come so far."""
    wait_for(lambda: folder.journal.is_file() and steps(folder) >= env_steps, log.read_text, job)


def steps(folder: RunFolder) -> int:
    """How far the run has come; a row of an evaluation tells of the moment when it began."""
    rows = folder.journal.read_text().split("\n")[:-1]
    return max((json.loads(row)[0] for row in rows), default=0)


def test_a_run_outlives_a_slow_and_a_cut_cable(wired, tmp_path):
    cluster, cable = wired
    job, folder, log = cluster.train(tmp_path), RunFolder(tmp_path / "r"), tmp_path / "log"
    try:
        wait_for_steps(folder, 4_000, job, log)
        cable.cut(MOMENT_S)
        assert not read_faults(folder.faults), "a moment is no fault"
        before = steps(folder)
        wait_for_steps(folder, before + 2_000, job, log)
        cable.cut(LONG_S)
        cluster.nodes[1].wait(PATIENCE_S)  # it was given up, hears so and ends
        cluster.join()
        assert job.wait(PATIENCE_S) == 0, log.read_text()
    finally:
        if job.poll() is None:
            kill(job)
    assert env_steps_of(finished_names(folder.checkpoint_location())[0]) >= CONFIG.total_env_steps
    assert {entry.event for entry in read_faults(folder.faults)} >= {"failed", "mended"}, log.read_text()
    assert broken_invariants(folder) == []
