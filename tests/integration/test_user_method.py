"""A fourth method and a scene, from files of their own, through every command; and what happens if they are broken."""

import dataclasses
import json
import shutil
from pathlib import Path
from typing import Any

import mlflow
import pytest

from actors.evaluation.result_table import read_table
from deploy.cli import main
from deploy.report_data.sources import find_report_source
from learner.config import RunConfig
from learner.run_folder import RunFolder
from sim_core.plugins import METHODS
from tests.integration.conftest import SMALL, flags

pytestmark = [
    pytest.mark.slow,
    pytest.mark.filterwarnings("ignore:The ``noload`` loader strategy:DeprecationWarning"),  # MLflow's own query
]
EXAMPLES = Path(__file__).parents[2] / "deploy" / "examples"


def user_run(**world: Any) -> RunConfig:
    """A run of a few seconds in such a world."""
    return dataclasses.replace(SMALL, world=dataclasses.replace(SMALL.world, **world))


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a user's own method and scene."""
    folder = tmp_path_factory.mktemp("user")
    for name in ("compass.py", "corridor.py"):
        shutil.copy(EXAMPLES / name, folder)
    return folder


@pytest.fixture(scope="module")
def trained(files: Path) -> RunFolder:
    """A finished run of both."""
    method, scene = f"{files}/compass.py:Compass", f"{files}/corridor.py:Corridor"
    settings = user_run(method=method, scene=scene, robots=6)
    assert main(["train", "--runs-dir", str(files / "runs"), "--name", "r", *flags(settings)]) == 0
    return RunFolder(files / "runs" / "r")


def test_the_run_holds_the_files_and_so_does_mlflow(trained, files):
    text = (files / "compass.py").read_text()
    assert (trained.path / "user_files" / "method" / "compass.py").read_text() == text
    config = trained.config()
    assert config.world.source(METHODS) == text and config.name.startswith("Compass Corridor 6+3r")
    client = mlflow.MlflowClient(trained.identity().tracking_uri)
    run = client.get_run(trained.identity().mlflow_run_id)
    assert run.data.tags["method"] == "Compass" and run.data.params["sources"].startswith("sha256:")
    names = {file.path for file in client.list_artifacts(run.info.run_id, "user_files/scene")}
    assert names == {"user_files/scene/corridor.py"}


def test_its_policy_and_its_rule_are_evaluated_and_watched(trained, files, tmp_path, capsys):
    assert main(["evaluate", str(trained.path), "--episodes", "6"]) == 0
    assert "Compass" in capsys.readouterr().out
    method = ["--method", f"{files}/compass.py:Compass"]
    assert main(["evaluate", "greedy", *method, "--robots", "4", "--episodes", "6"]) == 0
    assert main(["watch", str(trained.path), "--out", str(tmp_path / "e.html")]) == 0
    assert "Corridor 6+3r" in (tmp_path / "e.html").read_text()
    assert main(["watch", str(trained.path), "--format", "png", "--out", str(tmp_path / "e.png")]) == 0
    assert main(["dashboard", str(trained.path), "--out", str(tmp_path / "d.html")]) == 0
    assert (tmp_path / "d.html").stat().st_size > 100_000
    contents = find_report_source(str(trained.path), tmp_path).contents()
    assert "Compass" in contents.subtitle and {group.method for group in contents.groups} == {"Compass"}


def test_its_policy_is_exported_from_the_observation_on(trained, tmp_path, capsys):
    assert main(["export", str(trained.path), "--out", str(tmp_path / "e"), "--states", "50"]) == 2
    assert "what a robot senses is not known for method Compass" in capsys.readouterr().err
    assert main(["export", str(trained.path), "--bare", "True", "--out", str(tmp_path / "e"), "--states", "50"]) == 0
    assert "x of the group, y of the group" in json.dumps(json.loads((tmp_path / "e" / "policy.json").read_text()))


def test_a_changed_file_is_refused_on_resume_and_a_lost_one_is_not_needed(trained, files, capsys):
    further = ["resume", str(trained.path), "--total-env-steps", str(trained.config().total_env_steps + 2048)]
    path, text = files / "compass.py", (files / "compass.py").read_text()
    try:
        path.write_text(text + "# another\n")
        assert main(further) == 2
        message = capsys.readouterr().err
        assert "compass.py has changed since the run began" in message and "Traceback" not in message
        path.unlink()
        assert main(further) == 0
    finally:
        path.write_text(text)


@pytest.mark.ray
def test_a_sweep_and_its_report_have_it_beside_the_dissertations_methods(files, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    grid = ["--methods", f"{files}/compass.py:Compass", "in", "--robots", "5", "--groups", "1", "2", "--seeds", "0"]
    episodes = ["--episodes", "6", "--extrapolation-episodes", "3", "--baseline-episodes", "3", "--baselines", "greedy"]
    assert main(["sweep", *grid, *episodes, "--env-steps", "30000", "--name", "s"]) == 0
    assert "8 of 8 cells" in capsys.readouterr().out
    table = Path("runs/sweeps/s/results.csv")
    rows = read_table(table)
    assert {row.method for row in rows} == {"Compass", "in"}
    transferred = {(row.trained_groups, row.groups) for row in rows if row.method == "Compass" and not row.is_fixed}
    assert transferred == {(1, 2), (2, 1)}, "its state fits any number of groups"
    assert main(["report", str(table), "--out", "report"]) == 0
    assert main(["dashboard", "s", "--out", "s.html"]) == 0
    assert "Compass" in Path("s.html").read_text() and "Compass" in Path("report/report.md").read_text()


LATE = """
import numpy as np
from deploy.examples.compass import Compass


class Late(Compass):
    calls = 0

    def observe(self, state):
        type(self).calls += 1
        if type(self).calls > 100:
            raise RuntimeError("the gripper is stuck")
        return super().observe(state)
"""


@pytest.mark.ray
@pytest.mark.parametrize("engine", ["process", "ray"])
def test_a_method_that_breaks_in_the_middle_ends_the_run_with_its_file_and_line(tmp_path, capsys, engine):
    (tmp_path / "late.py").write_text((EXAMPLES / "compass.py").read_text() + LATE.partition("Compass\n")[2])
    settings = dataclasses.replace(user_run(method=f"{tmp_path}/late.py:Late"), engine=engine)
    assert main(["train", "--runs-dir", str(tmp_path / "runs"), "--name", "r", *flags(settings)]) == 2
    error = capsys.readouterr().err
    assert "late.py, line 4" in error and "observe of Late raised RuntimeError: the gripper is stuck" in error
    assert "Traceback" not in error and len(error.strip().splitlines()) == 1
