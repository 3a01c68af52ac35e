"""A sweep over Ray Tune: killed twice and run again, it has every cell once, as if nothing had happened."""

import fcntl

import mlflow
import pytest

from actors.evaluation.result_table import read_table, write_table
from deploy.cli import main
from learner.sweep.cell import SweepLocation, run_cell
from learner.sweep.grid import SweepConfig, make_cells
from learner.sweep.tune import run_cells
from learner.tracking.mlflow_run import Tracker
from tests.integration.conftest import run_here
from tests.integration.jobs import Job

pytestmark = [
    pytest.mark.ray,
    pytest.mark.slow,
    pytest.mark.filterwarnings("ignore:The ``noload`` loader strategy:DeprecationWarning"),  # MLflow's own query
]

SWEEP = SweepConfig(
    methods=("sensor", "in"),
    robots=(5,),
    groups=(1, 2),
    seeds=(0,),
    env_steps=24_000,
    episodes=20,
    extrapolation_episodes=5,
    baselines=("greedy",),
    baseline_episodes=10,
)
GRID = "--methods sensor in --robots 5 --groups 1 2 --seeds 0 --episodes 20 --extrapolation-episodes 5".split()
GRID += "--baselines greedy --baseline-episodes 10".split()
COMMAND = ["sweep", *GRID, "--env-steps", "24000", "--name", "s"]


@pytest.fixture(scope="module")
def rows(tmp_path_factory):
    """What the cells give when each is run in this process."""
    folder = tmp_path_factory.mktemp("alone")
    uri = f"sqlite:///{folder / 'mlflow.db'}"
    Tracker(uri, "cells", str(folder / "artifacts"))
    place = SweepLocation(folder / "cells", uri, "cells")
    tables = [run_cell(SWEEP, cell, place, lambda row: None) for cell in make_cells(SWEEP)]
    return sorted(row for table in tables for row in read_table(table))


def test_a_sweep_that_is_killed_twice_has_every_cell_once(shoal, rows, tmp_path):
    tables = "runs/sweeps/s/cells/*/results.csv"
    for cells_done in (3, 5):
        before = len(list(tmp_path.glob(tables)))
        job = Job(tmp_path, *COMMAND)
        job.wait_for_files(tables, max(cells_done, before + 1))  # always one of its own: Ray runs when it is killed
        job.kill_all()
    assert len(list(tmp_path.glob(tables))) < 8, "killed before its end"
    done = shoal(*COMMAND)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "8 of 8 cells" in done.stdout
    assert read_table(tmp_path / "runs/sweeps/s/results.csv") == rows

    client = mlflow.MlflowClient(f"sqlite:///{tmp_path}/runs/mlflow.db")
    experiment = client.get_experiment_by_name("sweep s")
    runs = client.search_runs([experiment.experiment_id])
    assert sorted(run.data.tags["cell"] for run in runs) == sorted(cell.key for cell in make_cells(SWEEP))
    assert {run.info.status for run in runs} == {"FINISHED"}
    assert sum(name.startswith("mlflow.sharedViewState.") for name in experiment.tags) >= 4

    location = ["--runs-dir", f"{tmp_path}/runs", "--tracking-uri", f"sqlite:///{tmp_path}/runs/mlflow.db"]
    assert "8 of 8 cells" in run_here(*COMMAND, *location)
    assert len(client.search_runs([experiment.experiment_id])) == 8


def test_cells_of_an_earlier_sitting_are_not_run_again(rows, capsys, tmp_path, monkeypatch):
    known = tmp_path / "known.csv"
    write_table(known, rows)
    monkeypatch.chdir(tmp_path)
    assert main([*COMMAND, "--known", str(known)]) == 0
    assert "8 of 8 cells" in capsys.readouterr().out
    assert read_table(tmp_path / "runs/sweeps/s/results.csv") == rows
    assert not (tmp_path / "runs/sweeps/s/cells").exists()


def results_of(folder, *arguments):
    """The table after a sweep whose cells are all known; nothing may run."""
    assert main(["sweep", "--runs-dir", str(folder / "runs"), *arguments]) == 0
    return read_table(folder / "runs/sweeps/s/results.csv")


def test_a_smaller_grid_of_the_same_name_leaves_the_others_results(rows, capsys, tmp_path):
    write_table(tmp_path / "known.csv", rows)
    assert results_of(tmp_path, *COMMAND[1:], "--known", str(tmp_path / "known.csv")) == rows
    assert results_of(tmp_path, *COMMAND[1:]) == rows, "the folder's own table is known"
    fewer = [*COMMAND[1:], "--methods", "in"]
    assert results_of(tmp_path, *fewer) == rows
    assert "4 of 4 cells" in capsys.readouterr().out


def test_results_of_former_settings_are_left_out(rows, tmp_path):
    former = [row._replace(config="0" * 12) for row in rows]
    write_table(tmp_path / "known.csv", [*former, *rows])
    assert results_of(tmp_path, *COMMAND[1:], "--known", str(tmp_path / "known.csv")) == rows


def test_two_sweeps_in_one_folder_are_refused(capsys, tmp_path):
    folder = tmp_path / "runs" / "sweeps" / "s"
    folder.mkdir(parents=True)
    with (folder / "lock").open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        assert main([*COMMAND, "--runs-dir", str(tmp_path / "runs")]) == 2
    assert "another `shoal sweep` is at work" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--robots", "400"], "does not fit"),
        (["--episodes", "0"], "episodes must be at least 1"),
        (["--env-steps", "100"], "min_replay"),
        (["--known", "missing.csv"], "missing.csv cannot be read"),
        (["--name", "../up"], "--name must be a plain folder name"),
        (["--at-once", "0"], "--at-once must be at least 1"),
    ],
)
def test_what_cannot_be_is_refused_before_anything_runs(capsys, tmp_path, monkeypatch, arguments, words):
    monkeypatch.chdir(tmp_path)
    assert main(["sweep", *arguments]) == 2
    assert words in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


class Told:
    """Remembers what it is told; implements `learner.sweep.tune.CellListener`."""

    def __init__(self):
        self.events = []

    def started(self, key):
        self.events.append(("started", key))

    def progressed(self, key, env_steps):
        self.events.append(("progressed", key))

    def finished(self, key):
        self.events.append(("finished", key))

    def failed(self, key, reason):
        self.events.append(("failed", key, reason))


def test_a_cell_that_crashes_fails_with_its_reason_and_the_others_go_on(capsys, tmp_path):
    uri = f"sqlite:///{tmp_path / 'mlflow.db'}"
    Tracker(uri, "cells", str(tmp_path / "artifacts"))
    good, bad = make_cells(SWEEP)[:2]
    told = Told()
    (tmp_path / "cells" / bad.key / "artifacts" / "results.csv.part").mkdir(parents=True)  # where a file is written
    run_cells(SWEEP, [bad, good], SweepLocation(tmp_path / "cells", uri, "cells"), None, 1, told)
    last = {event[1]: event for event in told.events}
    assert last[good.key] == ("finished", good.key)
    assert last[bad.key][0] == "failed" and "IsADirectoryError" in last[bad.key][2]
    assert [event[0] for event in told.events].count("failed") == 1
    trace = (tmp_path / "cells" / bad.key / "error.txt").read_text()
    assert "in run_cell" in trace and "IsADirectoryError" in trace
    assert "Trial" not in capsys.readouterr().out
