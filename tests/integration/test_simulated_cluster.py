"""`shoal train --address` on three nodes with token authentication, and a real Prometheus that scrapes them."""

import dataclasses
import json
import shutil
import signal
import subprocess
import sys
import time
import urllib.parse
import urllib.request
from collections import Counter
from pathlib import Path

import mlflow
import promql_parser
import pytest
import yaml

from deploy.chaos.processes import free_port
from learner.checkpoints.checkpoint import newest_valid
from learner.tracking.metric_names import ENV_STEPS, METRICS
from tests.dashboards.promql import alert_queries, dashboard, dashboard_queries
from tests.deploy.manifests import PROMETHEUS
from tests.integration.conftest import PATIENCE_S, SMALL, flags
from tests.integration.simulated_cluster import CPUS, NODES, SimulatedCluster

pytestmark = [
    pytest.mark.ray,
    pytest.mark.slow,
    pytest.mark.filterwarnings("ignore:The ``noload`` loader strategy:DeprecationWarning"),  # MLflow's own query
]

FULL = dataclasses.replace(SMALL, engine="ray", workers=3, replay_shards=2, replay_placement="actors")
"""A run that takes every CPU slot of the cluster, and so all of its nodes."""


@pytest.fixture(scope="module")
def nodes():
    cluster = SimulatedCluster()
    yield cluster
    cluster.close()
    shutil.rmtree(cluster.folder, ignore_errors=True)


def command(nodes, *arguments):
    return [sys.executable, "-m", "deploy", *arguments, "--address", nodes.address]


def test_a_training_by_address_takes_all_nodes_and_comes_to_its_end(nodes, tmp_path):
    assert FULL.workers + FULL.replay_shards + 1 == NODES * CPUS
    before = Counter(nodes.actors())
    done = subprocess.run(
        command(nodes, "train", "--name", "r", *flags(FULL)),
        cwd=tmp_path,
        env=nodes.environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "success rate" in done.stdout
    placed = Counter(nodes.actors()) - before
    kinds = Counter(kind for kind, _ in placed.elements())
    assert kinds == {"RolloutNode": FULL.workers, "ShardNode": FULL.replay_shards, "LearnerActor": 1}
    assert Counter(node for _, node in placed.elements()) == dict.fromkeys({node for _, node in placed}, CPUS)
    assert len({node for _, node in placed}) == NODES
    state = newest_valid(tmp_path / "runs/r/checkpoints")[0].state
    assert state["env_steps"] >= FULL.total_env_steps
    assert sum(shard["inserted"] for shard in state["learner"]["shards"]) == state["pacing"]["inserted"]
    client = mlflow.MlflowClient(f"sqlite:///{tmp_path}/runs/mlflow.db")
    (run,) = client.search_runs([client.get_experiment_by_name("shoal").experiment_id])
    assert run.info.status == "FINISHED" and "final/success_rate" in run.data.metrics


@pytest.mark.parametrize("token", ["", "another-token-of-the-same-form-0123456789"])
def test_who_has_not_the_token_is_told_so(nodes, tmp_path, token):
    environment = {**nodes.environment, "RAY_AUTH_TOKEN": token, "HOME": str(tmp_path)}
    if not token:
        del environment["RAY_AUTH_TOKEN"]
    done = subprocess.run(
        command(nodes, "evaluate", "random", "--robots", "2", "--episodes", "2"),
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 2, done.stderr
    assert "Traceback" not in done.stderr
    last = done.stderr.splitlines()[-1]
    assert last.startswith("shoal: ") and nodes.address in last and "RAY_AUTH_TOKEN" in last


class Prometheus:
    """A real Prometheus with our configuration, at the cluster's list of nodes and faster."""

    def __init__(self, nodes, folder: Path) -> None:
        config = yaml.safe_load((PROMETHEUS / "prometheus.yml").read_text())
        (job,) = config["scrape_configs"]
        (places,) = job["file_sd_configs"]
        assert places["files"] == ["/tmp/ray/prom_metrics_service_discovery.json"], "where Ray's head writes by default"
        written = nodes.folder / "ray" / "prom_metrics_service_discovery.json"
        places |= {"files": [str(written)], "refresh_interval": "1s"}
        config["global"] = {"scrape_interval": "1s", "evaluation_interval": "1s"}
        (folder / "prometheus.yml").write_text(yaml.safe_dump(config))
        shutil.copy(PROMETHEUS / "alerts.yml", folder)
        port = free_port()
        self._url = f"http://127.0.0.1:{port}/api/v1"
        self._process = subprocess.Popen(
            [
                shutil.which("prometheus"),
                f"--config.file={folder / 'prometheus.yml'}",
                f"--storage.tsdb.path={folder / 'data'}",
                f"--web.listen-address=127.0.0.1:{port}",
                "--log.level=error",
            ]
        )

    def ask(self, query: str):
        """The series that answer a query; none while Prometheus starts."""
        try:
            with urllib.request.urlopen(f"{self._url}/query?query={urllib.parse.quote(query)}", timeout=30) as answer:
                found = json.load(answer)
        except urllib.error.HTTPError as error:
            with error:
                assert error.code == 503, error.read().decode()
            return []
        except urllib.error.URLError:
            assert self._process.poll() is None
            return []
        return found["data"]["result"]

    def close(self) -> None:
        self._process.terminate()
        self._process.wait(PATIENCE_S)


@pytest.fixture
def prometheus(nodes, tmp_path):
    if not shutil.which("prometheus"):
        pytest.skip("prometheus is not on PATH (apt-get install prometheus)")
    folder = tmp_path / "prometheus"
    folder.mkdir()
    server = Prometheus(nodes, folder)
    yield server
    server.close()


def selectors(expression: str) -> set[str]:
    """The series that an expression is made of."""
    found: set[str] = set()

    def visit(node):
        if isinstance(node, promql_parser.VectorSelector):
            found.add(str(node))

    promql_parser.walk(promql_parser.parse(expression), visit)
    return found


def questions() -> set[str]:
    """Every query of the dashboard, and every series that an alert looks at."""
    shown = {text for texts in dashboard_queries(dashboard(), "10s", "scraped").values() for text in texts}
    return shown | {series for text in alert_queries().values() for series in selectors(text)}


def assert_samples_are_the_journals(prometheus, rows) -> None:
    """Every sample that Prometheus has of the run stands in its journal."""
    for known in METRICS:
        values = {float(row[0]) if known.journal == ENV_STEPS else row[2].get(known.journal) for row in rows}
        found = prometheus.ask(f'{known.series}{{run="scraped"}}[1h]')
        samples = {float(value) for series in found for _, value in series["values"]}
        assert samples <= values, known
        assert samples or known.journal.startswith("eval/return_"), f"{known.series}: only where there are no outcomes"


def test_a_real_prometheus_answers_every_query_with_the_runs_own_numbers(nodes, prometheus, tmp_path):
    config = dataclasses.replace(FULL, total_env_steps=50_000_000, checkpoint_every_env_steps=50_000_000)
    with (tmp_path / "job.log").open("w") as log:
        job = subprocess.Popen(
            command(nodes, "train", "--name", "scraped", *flags(config)),
            cwd=tmp_path,
            env=nodes.environment,
            stdout=log,
            stderr=subprocess.STDOUT,
        )
    try:
        open_questions = questions()
        assert len(open_questions) > 35
        deadline_s = time.monotonic() + PATIENCE_S
        while open_questions:
            assert job.poll() is None, (tmp_path / "job.log").read_text()
            assert time.monotonic() < deadline_s, f"no answer to {sorted(open_questions)}"
            time.sleep(1)
            open_questions = {query for query in open_questions if not prometheus.ask(query)}
        assert not prometheus.ask("ray_shoal_no_such_metric"), "an unknown metric has no answer"
        while {series["value"][1] for series in prometheus.ask('up{job="ray"}')} != {
            "1"
        }:  # a busy node may answer late
            assert time.monotonic() < deadline_s, "a node is never up"
            time.sleep(1)
        job.send_signal(signal.SIGINT)
        assert job.wait(PATIENCE_S) == 128 + signal.SIGINT, (tmp_path / "job.log").read_text()
    finally:
        if job.poll() is None:
            job.kill()
            job.wait(PATIENCE_S)
    rows = [json.loads(line) for line in (tmp_path / "runs/scraped/metrics.jsonl").read_text().splitlines()]
    assert_samples_are_the_journals(prometheus, rows)
