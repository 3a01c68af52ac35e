"""A head node as `ray start --head` makes it, nodes that join it, and jobs that `shoal submit` gives it."""

import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import requests

from deploy.chaos.processes import free_port
from learner.config import RunConfig
from tests.integration.conftest import PATIENCE_S, clean_environment, flags
from tests.integration.jobs import kill, wait_for

ROOT = Path(__file__).parents[2]
FEW_STARTS = {
    "RAY_idle_worker_killing_time_threshold_ms": "600000",
    "RAY_prestart_worker_first_driver": "0",
}
"""Variables of nodes whose worker processes stay and start when needed, as in a Ray of our own: each takes seconds."""
HEAD_PORTS = ("port", "dashboard-port", "ray-client-server-port")
NODE_PORTS = (
    "dashboard-agent-listen-port",
    "dashboard-agent-grpc-port",
    "runtime-env-agent-port",
    "metrics-export-port",
)


class Head(NamedTuple):
    """A running head node: its dashboard, the address that nodes join, and the folder of its session."""

    address: str
    gcs: str
    session: Path


def answers(url: str) -> bool:
    try:
        return requests.get(url, timeout=10).status_code == 200
    except requests.RequestException:
        return False


@contextmanager
def short_folder() -> Iterator[Path]:
    """A folder for Ray's sockets, whose paths must be short."""
    folder = Path(tempfile.mkdtemp(prefix="sh", dir="/tmp"))
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


LOOPBACK = ("--node-ip-address=127.0.0.1",)
NO_TOKEN = {"RAY_AUTH_MODE": "disabled"}


def with_token(token: str) -> dict[str, str]:
    """The variables of a process that shows a token, or asks for it."""
    return {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": token}


def ray_start(log: Path, *words: str, auth: dict[str, str], before: Sequence[str] = ()) -> subprocess.Popen:
    """`ray start --block`, with the words `before` in front of it, once it has started or ended."""
    binaries = str(Path(sys.executable).parent)
    environment = {**clean_environment(), **FEW_STARTS, **auth}
    environment["PATH"] = f"{binaries}:{environment['PATH']}"
    environment.pop("PYTHONPATH", None)  # a job's code is what was uploaded
    command = [*before, f"{binaries}/ray", "start", "--block", "--disable-usage-stats", *words]
    with log.open("w") as file:
        process = subprocess.Popen(command, env=environment, stdout=file, stderr=subprocess.STDOUT)
    while process.poll() is None and "Ray runtime started" not in log.read_text():
        time.sleep(0.2)
    return process


def with_free_ports(*names: str) -> dict[str, int]:
    ports: set[int] = set()
    while len(ports) < len(names):
        ports.add(free_port())
    return dict(zip(names, ports, strict=True))


def as_flags(ports: dict[str, int]) -> list[str]:
    return [f"--{name}={port}" for name, port in ports.items()]


def start_head(folder: Path, log: Path, *words: str) -> tuple[subprocess.Popen, dict[str, int]]:
    """(`ray start --head`, as a user starts it on a laptop, and its ports)."""
    ports = with_free_ports(*HEAD_PORTS, *NODE_PORTS)
    words = ("--head", "--dashboard-host=127.0.0.1", *LOOPBACK, f"--temp-dir={folder}", *words)
    return ray_start(log, *words, *as_flags(ports), auth=NO_TOKEN), ports


@contextmanager
def running_head(log: Path, *words: str) -> Iterator[Head]:
    """A head node; it is started again where Ray's own 30 s for it were too short on a busy machine."""
    with short_folder() as folder:
        for _ in range(3):
            process, ports = start_head(folder, log, *words)
            if process.poll() is None or "timed out during startup" not in log.read_text():
                break
        assert process.poll() is None, log.read_text()
        address = f"http://127.0.0.1:{ports['dashboard-port']}"
        try:
            wait_for(lambda: answers(f"{address}/api/jobs/"), log.read_text, process)
            yield Head(address, f"127.0.0.1:{ports['port']}", folder / "session_latest")
        finally:
            kill(process)  # Ray's own end takes 20 s and more, and no test asks how it goes


@contextmanager
def joined_node(head: Head, log: Path, *words: str) -> Iterator[subprocess.Popen]:
    """Another node of the head's cluster, with a folder of its own: in a shared one, nodes delete each other's code."""
    with short_folder() as folder:
        ports = with_free_ports(*NODE_PORTS)
        words = (f"--address={head.gcs}", *LOOPBACK, f"--temp-dir={folder}", *words)
        node = ray_start(log, *words, *as_flags(ports), auth=NO_TOKEN)
        assert node.poll() is None, log.read_text()
        try:
            yield node
        finally:
            if node.poll() is None:
                kill(node)


def copy_of_the_code(folder: Path) -> Path:
    """A checkout with what must not be uploaded in it."""
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


def submit(
    head: Head, checkout: Path, config: RunConfig, runs: Path, log: Path, *options: str, cwd: Path | None = None
) -> subprocess.Popen:
    """`shoal submit train` in the background, from the folder `cwd`, the checkout by default."""
    place = ["--address", head.address, "--working-dir", str(checkout)]
    words = ["submit", *place, *options, "train", "--runs-dir", str(runs), *flags(config)]
    with log.open("w") as file:
        return subprocess.Popen(
            [sys.executable, "-W", "error::DeprecationWarning:__main__", "-m", "deploy", *words],
            cwd=cwd or checkout,
            env={**clean_environment(), **NO_TOKEN, "PYTHONPATH": str(checkout)},
            stdout=file,
            stderr=subprocess.STDOUT,
        )


def finish(process: subprocess.Popen, log: Path) -> tuple[int, str]:
    return process.wait(PATIENCE_S), log.read_text()
