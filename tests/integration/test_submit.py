"""`shoal submit` on a real Ray of one node: Ctrl-C saves a checkpoint, the same command goes on from it."""

import dataclasses
import functools
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import mlflow
import pytest

import deploy
from learner.checkpoints.checkpoint import newest_valid
from sim_core import ENV_ID
from sim_core.config import WorldConfig
from tests.integration.conftest import SMALL, clean_environment
from tests.integration.jobs import wait_for
from tests.integration.ray_head import NO_TOKEN, Head, copy_of_the_code, finish, running_head, submit

pytestmark = [
    pytest.mark.ray,
    pytest.mark.slow,
    pytest.mark.filterwarnings("ignore:The ``noload`` loader strategy:DeprecationWarning"),  # MLflow's own query
]
LONG = dataclasses.replace(
    SMALL,
    env_id="CartPole-v1",
    engine="ray",
    total_env_steps=150_000,
    checkpoint_every_env_steps=5_000,
    eval_every_env_steps=50_000,
)


@pytest.fixture(scope="module")
def head(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Head]:
    with running_head(tmp_path_factory.mktemp("head") / "log", "--num-cpus=3") as running:
        yield running


@pytest.fixture(scope="module")
def checkout(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return copy_of_the_code(tmp_path_factory.mktemp("checkout") / "shoal")


def the_run(runs: Path):
    client = mlflow.MlflowClient(f"sqlite:///{runs}/mlflow.db")
    (run,) = client.search_runs([client.get_experiment_by_name("shoal").experiment_id])
    return run


@pytest.fixture
def own_method(tmp_path, monkeypatch):
    """(run with a user's own method, the folder of its file): no job runs in that folder, and the name is relative."""
    folder = tmp_path / "elsewhere"
    folder.mkdir()
    shutil.copy(Path(deploy.__file__).parent / "examples" / "compass.py", folder / "mine.py")
    monkeypatch.chdir(folder)
    world = WorldConfig(method="mine.py:Compass", robots=3, groups=2, horizon_steps=60)
    return dataclasses.replace(LONG, env_id=ENV_ID, world=world), folder


def test_stop_saves_a_checkpoint_and_the_same_command_goes_on(head, checkout, tmp_path, own_method):
    """The run's method lies in a user's file outside the checkout, which travels with the job."""
    long, elsewhere = own_method
    runs, log = tmp_path / "runs", tmp_path / "log"
    submitted = functools.partial(submit, head, checkout, long, runs, cwd=elsewhere)
    first = submitted(log)
    wait_for(lambda: len(list(runs.glob("*/checkpoints/step-*[0-9]"))) >= 2, log.read_text, first)

    watching = submitted(tmp_path / "other", "--follow", "False")
    code, text = finish(watching, tmp_path / "other")
    assert code == 0 and re.search(r"following job shoal-train-Compass-3r2g-s0-\w+-1, which is under way", text), text

    first.send_signal(signal.SIGINT)
    code, text = finish(first, log)
    assert code == 128 + signal.SIGINT, text
    assert "stopping the job" in text and "goes on with it" in text
    found = re.search(r"stopped by SIGTERM at ([\d,]+) env steps; checkpoint saved", text)
    assert found, text
    (run,) = (path.parent for path in runs.glob("*/config.json"))
    checkpoint, _ = newest_valid(run / "checkpoints")
    stopped_at = checkpoint.state["env_steps"]
    assert stopped_at == int(found[1].replace(",", "")) < long.total_env_steps
    assert the_run(runs).info.status == "KILLED"

    code, text = finish(submitted(log), log)
    assert code == 0, text
    assert f"going on from {checkpoint.folder}" in text
    assert re.search(r"job shoal-train-Compass-3r2g-s0-\w+-2 on", text)
    assert newest_valid(run / "checkpoints")[0].state["env_steps"] >= long.total_env_steps
    assert (run / "user_files" / "method" / "mine.py").read_text() == (elsewhere / "mine.py").read_text()
    assert (the_run(runs).info.status, the_run(runs).data.tags["attempts"]) == ("FINISHED", "2")

    code, text = finish(submitted(log), log)
    assert code == 0 and "has finished before" in text, text
    assert the_run(runs).data.tags["attempts"] == "2"


def test_what_git_ignores_is_not_uploaded(head, checkout, tmp_path):
    log = tmp_path / "log"
    code, text = finish(submit(head, checkout, LONG, Path("/proc/nothing"), log), log)
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
        env={**clean_environment(), **NO_TOKEN},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    (table,) = tmp_path.glob("runs/sweeps/*/results.csv")
    assert len(table.read_text().splitlines()) == 3
