"""Three Ray nodes on this machine with token authentication, in a process of their own.

As a program it starts them in the folder that it is given, writes down where they are, answers each line on its input
with the table of Ray actors, and ends the nodes with its input.
"""

import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from tests.integration.conftest import PATIENCE_S, clean_environment
from tests.integration.ray_head import FEW_STARTS

NODES = 3
CPUS = 2
TOKEN = "simulated-cluster-" + "0123456789abcdef" * 2
PLACE = "cluster.json"


class SimulatedCluster:
    """The nodes, from outside their process; `environment` is what a driver needs, `folder` holds their files."""

    def __init__(self) -> None:
        self.folder = Path(tempfile.mkdtemp(prefix="shoal-", dir="/tmp"))  # Ray's sockets want a short path
        self.environment = {
            **clean_environment(),
            "RAY_AUTH_MODE": "token",
            "RAY_AUTH_TOKEN": TOKEN,
            "RAY_TMPDIR": str(self.folder),
            "RAY_metrics_report_interval_ms": "1000",
            "RAY_USAGE_STATS_ENABLED": "0",
            **FEW_STARTS,
        }
        self._log = self.folder / "cluster.log"
        with self._log.open("w") as log:
            self._process = subprocess.Popen(
                [sys.executable, "-m", __name__, str(self.folder)],
                env=self.environment,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=log,
                text=True,
            )
        self.address = self._wait()["address"]

    def _wait(self):
        deadline_s = time.monotonic() + PATIENCE_S
        while not (self.folder / PLACE).is_file():
            assert self._process.poll() is None, self._log.read_text()
            assert time.monotonic() < deadline_s, self._log.read_text()
            time.sleep(0.2)
        return json.loads((self.folder / PLACE).read_text())

    def actors(self) -> list[tuple[str, str]]:
        """(class, node) of every Ray actor so far, dead ones too."""
        self._process.stdin.write("\n")
        self._process.stdin.flush()
        return [tuple(pair) for pair in json.loads(self._process.stdout.readline())]

    def close(self) -> None:
        """Ends all nodes."""
        self._process.stdin.close()
        self._process.wait(PATIENCE_S)
        self._process.stdout.close()


def main(folder: Path) -> None:
    """Runs the nodes until the input ends."""
    from ray.cluster_utils import Cluster

    cluster = Cluster()
    cluster.add_node(num_cpus=CPUS, include_dashboard=True, dashboard_port=0)
    for _ in range(NODES - 1):
        cluster.add_node(num_cpus=CPUS)
    part = folder / f"{PLACE}.part"
    part.write_text(json.dumps({"address": cluster.address}))
    part.rename(folder / PLACE)
    for _ in sys.stdin:
        table = cluster.global_state.actor_table(None)
        print(json.dumps([(a["ActorClassName"], a["Address"]["NodeID"]) for a in table.values()]), flush=True)
    cluster.shutdown()


if __name__ == "__main__":
    main(Path(sys.argv[1]))
