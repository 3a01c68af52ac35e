"""`shoal submit` on a real Ray of one node: Ctrl-C saves a checkpoint, the same command goes on from it."""

import dataclasses
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import mlflow
import psutil
import pytest
import requests

from learner.checkpoint import newest_valid
from tests.integration.conftest import SMALL, clean_environment, flags

pytestmark = [
    pytest.mark.ray,
    pytest.mark.slow,
    pytest.mark.timeout(900),
    pytest.mark.filterwarnings("ignore:The ``noload`` loader strategy:DeprecationWarning"),  # MLflow's own query
]
ROOT = Path(__file__).parents[2]
PORTS = (
    "port dashboard-port ray-client-server-port dashboard-agent-listen-port dashboard-agent-grpc-port "
    "runtime-env-agent-port metrics-export-port"
).split()
LONG = dataclasses.replace(
    SMALL, env_id="CartPole-v1", engine="ray", total_env_steps=150_000, checkpoint_every_env_steps=5_000
)


def free_ports(count: int) -> list[int]:
    sockets = [socket.socket() for _ in range(count)]
    for each in sockets:
        each.bind(("127.0.0.1", 0))
    ports = [each.getsockname()[1] for each in sockets]
    for each in sockets:
        each.close()
    return ports


class Head(NamedTuple):
    """A running head node: its dashboard, and the folder of its session."""

    address: str
    session: Path


def answers(url: str) -> bool:
    try:
        return requests.get(url, timeout=10).status_code == 200
    except requests.RequestException:
        return False


def wait_for(condition, log, process: subprocess.Popen) -> None:
    deadline_s = time.monotonic() + 240
    while not condition():
        assert process.poll() is None, log()
        assert time.monotonic() < deadline_s, log()
        time.sleep(0.2)


def start_head(folder: Path, log: Path) -> tuple[subprocess.Popen, str]:
    """(`ray start --head` on this machine alone, as a user starts it on a laptop, and its dashboard's address)."""
    ports = dict(zip(PORTS, free_ports(len(PORTS)), strict=True))
    binaries = str(Path(sys.executable).parent)
    environment = {**clean_environment(), "RAY_AUTH_MODE": "disabled"}
    environment["PATH"] = f"{binaries}:{environment['PATH']}"
    environment.pop("PYTHONPATH", None)  # a job's code is what was uploaded
    flags = [f"--{name}={port}" for name, port in ports.items()]
    command = [f"{binaries}/ray", "start", "--head", "--block", "--num-cpus=3", "--disable-usage-stats", *flags]
    command += ["--node-ip-address=127.0.0.1", "--dashboard-host=127.0.0.1", f"--temp-dir={folder}"]
    with log.open("w") as file:
        process = subprocess.Popen(command, env=environment, stdout=file, stderr=subprocess.STDOUT)
    while process.poll() is None and "Ray runtime started" not in log.read_text():
        time.sleep(0.2)
    return process, f"http://127.0.0.1:{ports['dashboard-port']}"


@pytest.fixture(scope="module")
def head(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Head]:
    """A running head node; it is started again where Ray's own 30 s for it were too short on a busy machine."""
    log = tmp_path_factory.mktemp("head") / "log"
    folder = Path(tempfile.mkdtemp(prefix="sh", dir="/tmp"))  # short: Ray's sockets lie in it
    for _ in range(3):
        process, address = start_head(folder, log)
        if process.poll() is None or "timed out during startup" not in log.read_text():
            break
    assert process.poll() is None, log.read_text()
    family = [psutil.Process(process.pid), *psutil.Process(process.pid).children(recursive=True)]
    try:
        wait_for(lambda: answers(f"{address}/api/jobs/"), log.read_text, process)
        yield Head(address, folder / "session_latest")
    finally:
        process.terminate()
        process.wait(60)
        for left in psutil.wait_procs(family, timeout=20)[1]:
            left.kill()
        shutil.rmtree(folder, ignore_errors=True)


@pytest.fixture(scope="module")
def checkout(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A checkout with what must not be uploaded in it."""
    folder = tmp_path_factory.mktemp("checkout") / "shoal"
    folder.mkdir()
    ignored = shutil.ignore_patterns("__pycache__", "results", "images")
    for package in ("sim_core", "actors", "learner", "deploy", "dashboards"):
        shutil.copytree(ROOT / package, folder / package, ignore=ignored)
    shutil.copy(ROOT / ".gitignore", folder)
    for planted in (
        ".venv/bin/python",
        "runs/old/config.json",
        ".git/HEAD",
        ".hypothesis/x",
        "deploy/__pycache__/a.pyc",
    ):
        (folder / planted).parent.mkdir(parents=True, exist_ok=True)
        (folder / planted).write_text("not for the cluster")
    return folder


def submit(head: Head, checkout: Path, runs: Path, log: Path, *options: str) -> subprocess.Popen:
    """`shoal submit train` of the long run, in the background."""
    words = ["submit", "--address", head.address, *options, "train", "--runs-dir", str(runs), *flags(LONG)]
    with log.open("w") as file:
        return subprocess.Popen(
            [sys.executable, "-W", "error::DeprecationWarning:__main__", "-m", "deploy", *words],
            cwd=checkout,
            env={**clean_environment(), "RAY_AUTH_MODE": "disabled", "PYTHONPATH": str(checkout)},
            stdout=file,
            stderr=subprocess.STDOUT,
        )


def finish(process: subprocess.Popen, log: Path) -> tuple[int, str]:
    return process.wait(400), log.read_text()


def the_run(runs: Path):
    client = mlflow.MlflowClient(f"sqlite:///{runs}/mlflow.db")
    (run,) = client.search_runs([client.get_experiment_by_name("shoal").experiment_id])
    return run


def test_stop_saves_a_checkpoint_and_the_same_command_goes_on(head, checkout, tmp_path):
    runs, log = tmp_path / "runs", tmp_path / "log"
    first = submit(head, checkout, runs, log)
    wait_for(lambda: len(list(runs.glob("*/checkpoints/step-*[0-9]"))) >= 2, log.read_text, first)

    watching = submit(head, checkout, runs, tmp_path / "other", "--follow", "False")
    code, text = finish(watching, tmp_path / "other")
    assert code == 0 and re.search(r"following job shoal-train-CartPole-v1-s0-\w+-1, which is under way", text), text

    first.send_signal(signal.SIGINT)
    code, text = finish(first, log)
    assert code == 128 + signal.SIGINT, text
    assert "stopping the job" in text and "goes on with it" in text
    found = re.search(r"stopped by SIGTERM at ([\d,]+) env steps; checkpoint saved", text)
    assert found, text
    (run,) = (path.parent for path in runs.glob("*/config.json"))
    checkpoint, _ = newest_valid(run / "checkpoints")
    stopped_at = checkpoint.state["env_steps"]
    assert stopped_at == int(found[1].replace(",", "")) < LONG.total_env_steps
    assert the_run(runs).info.status == "KILLED"

    code, text = finish(submit(head, checkout, runs, log), log)
    assert code == 0, text
    assert f"going on from {checkpoint.folder}" in text
    assert re.search(r"job shoal-train-CartPole-v1-s0-\w+-2 on", text)
    assert newest_valid(run / "checkpoints")[0].state["env_steps"] >= LONG.total_env_steps
    assert (the_run(runs).info.status, the_run(runs).data.tags["attempts"]) == ("FINISHED", "2")

    code, text = finish(submit(head, checkout, runs, log), log)
    assert code == 0 and "has finished before" in text, text
    assert the_run(runs).data.tags["attempts"] == "2"


def test_what_git_ignores_is_not_uploaded(head, checkout, tmp_path):
    log = tmp_path / "log"
    code, text = finish(submit(head, checkout, Path("/proc/nothing"), log), log)
    assert code == 2, text
    assert "--runs-dir /proc/nothing" in text and "Traceback" not in text
    (copy,) = (path.parent.parent for path in head.session.glob("runtime_resources/working_dir_files/*/deploy/cli.py"))
    there = {str(path.relative_to(copy)) for path in copy.rglob("*")}
    assert {"learner/loop.py", "deploy/configs/cartpole.toml"} <= there
    for planted in (".venv", "runs", ".git", ".hypothesis"):
        assert not [path for path in there if path == planted or path.startswith(f"{planted}/")]


def test_ray_job_submit_runs_a_sweep(head, checkout, tmp_path):
    """The other way in, without `shoal submit`: a sweep of one training and one baseline."""
    words = "sweep --robots 3 --groups 2 --methods sensor --baselines greedy --baseline-episodes 4 --episodes 4".split()
    words += ["--extrapolation", "none", "--env-steps", "21000", "--seeds", "0", "--runs-dir", str(tmp_path / "runs")]
    words += ["--set", "hidden_sizes=[8]"]
    done = subprocess.run(
        [f"{Path(sys.executable).parent}/ray", "job", "submit", "--address", head.address, "--working-dir", "."]
        + ["--", "shoal", *words],
        cwd=checkout,
        env={**os.environ, "RAY_AUTH_MODE": "disabled"},
        capture_output=True,
        text=True,
        timeout=800,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    (table,) = tmp_path.glob("runs/sweeps/*/results.csv")
    assert len(table.read_text().splitlines()) == 3
