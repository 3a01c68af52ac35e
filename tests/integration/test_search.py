"""A search over Ray Tune: killed twice and run again, it has every trial once, as if nothing had happened."""

import csv
import fcntl
import functools

import mlflow
import pytest

from deploy.cli import main
from deploy.runs.objectives import find_objectives
from deploy.runs.search_driver import SearchDriver, SearchPlace, work
from learner.search.config import SearchConfig
from learner.search.study import SearchStudy
from learner.sweep.tune import run_trials
from learner.tracking.mlflow_run import Tracker
from tests.integration.conftest import run_here
from tests.integration.jobs import Job

pytestmark = [
    pytest.mark.ray,
    pytest.mark.slow,
    pytest.mark.filterwarnings("ignore:The ``noload`` loader strategy:DeprecationWarning"),  # MLflow's own query
]

TRIALS = 6
SPACE = ["arena_radius_m=3.0..8.0", "time_step_s=0.02..0.05"]
PLAYED = ["--policy", "greedy", "--robots", "5", "10", "--episodes", "400", "--objective", "success", "worst"]
COMMAND = ["search", "--space", *SPACE, *PLAYED, "--budget", str(TRIALS), "--name", "s", "--at-once", "2"]
"""Trials that train nothing and take a second or two."""


def table_of(folder):
    with (folder / "runs/searches/s/trials.csv").open(newline="") as file:
        return [{name: value for name, value in row.items() if name != "seconds"} for row in csv.DictReader(file)]


def test_a_search_that_is_killed_twice_has_every_trial_once(shoal, tmp_path):
    tables = "runs/searches/s/trials/*/cells/*/results.csv"
    for done in (3, 6):
        before = len(list(tmp_path.glob(tables)))
        job = Job(tmp_path, *COMMAND)
        job.wait_for_files(tables, max(done, before + 1))
        job.kill_all()
    assert len(list(tmp_path.glob(tables))) < 2 * TRIALS, "killed before its end"
    done = shoal(*COMMAND)
    assert done.returncode == 0, done.stdout + done.stderr
    rows = table_of(tmp_path)
    assert [(int(row["number"]), row["state"]) for row in rows] == [(n, "complete") for n in range(TRIALS)]
    assert len({tuple(row[name.split("=")[0]] for name in SPACE) for row in rows}) == TRIALS

    client = mlflow.MlflowClient(f"sqlite:///{tmp_path}/runs/mlflow.db")
    runs = client.search_runs([client.get_experiment_by_name("search s").experiment_id])
    logged = {int(run.data.tags["trial"]): run for run in runs}
    assert len(runs) == TRIALS and sorted(logged) == list(range(TRIALS))
    assert {run.info.status for run in runs} == {"FINISHED"}
    for row in rows:
        run = logged[int(row["number"])]
        assert run.data.metrics == {f"final/{name}": float(row[name]) for name in ("success", "worst")}
        assert run.data.params == {name: row[name] for name in ("arena_radius_m", "time_step_s")}
    cells = client.search_runs([client.get_experiment_by_name("search s cells").experiment_id])
    assert len(cells) == 2 * TRIALS and {run.info.status for run in cells} == {"FINISHED"}
    assert {path.name for path in (tmp_path / "runs/searches/s").iterdir()} >= {"search.png", "dashboard.html"}

    location = ["--runs-dir", f"{tmp_path}/runs", "--tracking-uri", f"sqlite:///{tmp_path}/runs/mlflow.db"]
    assert "search.png" in run_here(*COMMAND, *location)
    assert table_of(tmp_path) == rows, "the same command again runs nothing"


class Told:
    """Remembers what it is told; implements `deploy.runs.search_driver.TrialListener`."""

    def __init__(self):
        self.events = []

    def started(self, number):
        self.events.append(("started", number))

    def ended(self, number):
        self.events.append(("ended", number))

    def message(self, text):
        self.events.append(("message", text))


def test_bad_trials_end_at_a_rung_and_the_search_goes_on(tmp_path):
    """Learning rates that learn nothing are ended early; MLflow calls their trainings killed."""
    search = SearchConfig(
        space=("learning_rate=1e-9,1e-8,3e-3",),
        robots=(5,),
        groups=(1,),
        env_steps=40_000,
        episodes=20,
        budget="6",
        prune=True,
        set=("eval_episodes=40", "min_replay=2000", "epsilon_decay_env_steps=5000"),
    )
    place = SearchPlace(tmp_path, f"sqlite:///{tmp_path / 'mlflow.db'}", "s")
    for experiment in (place.experiment, place.cells_experiment):
        Tracker(place.tracking_uri, experiment, str(tmp_path / "artifacts"))
    study, told = SearchStudy(tmp_path, search, [False], []), Told()
    driver = SearchDriver(search, find_objectives(search), study, place, told)
    run_trials(functools.partial(work, search, place), driver, None, 1)
    records = {each.number: each for each in study.records()}
    assert len(records) == 6 and {each.state for each in records.values()} == {"complete", "pruned"}
    assert not [event for event in told.events if event[0] == "message"]
    client = mlflow.MlflowClient(place.tracking_uri)
    runs = client.search_runs([client.get_experiment_by_name("s").experiment_id])
    status = {"complete": "FINISHED", "pruned": "KILLED"}
    assert {int(run.data.tags["trial"]): run.info.status for run in runs} == {
        number: status[each.state] for number, each in records.items()
    }
    cells = client.search_runs([client.get_experiment_by_name("s cells").experiment_id])
    assert {run.info.status for run in cells} == {"FINISHED", "KILLED"}


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], "name what to vary, as in --space NAME=LOW..HIGH"),
        (["--space", "learning_rat=1..2"], "space cannot vary 'learning_rat'"),
        (["--space", "n_step=5..1"], "'n_step=5..1' is empty"),
        (["--space", "discount=0.5..1.5"], "space discount=1.5: discount must be in (0, 1]"),
        (["--space", "n_step=1..5", "--budget", "soon"], "budget must be trials or hours"),
        (["--space", "n_step=1..5", "--objective", "luck"], "objective must be among success, worst"),
        (["--space", "n_step=1..5", "--objective", "steps_to=2"], "its success must be in (0, 1]"),
        (["--space", "n_step=1..5", "--objective", "missing.py:f"], "missing.py cannot be read"),
        (
            ["--space", "n_step=1..5", "--objective", "claims", "--prune", "True"],
            "prune needs one objective of success",
        ),
        (["--space", "n_step=1..5", "--name", "../up"], "--name must be a plain folder name"),
        (["--space", "n_step=1..5", "--at-once", "0"], "--at-once must be at least 1"),
        (["--space", "n_step=1..5", "--env-steps", "100"], "min_replay"),
    ],
)
def test_what_cannot_be_is_refused_before_anything_runs(capsys, tmp_path, monkeypatch, arguments, words):
    monkeypatch.chdir(tmp_path)
    assert main(["search", *arguments]) == 2
    assert words in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_two_searches_in_one_folder_are_refused(capsys, tmp_path):
    folder = tmp_path / "runs" / "searches" / "s"
    folder.mkdir(parents=True)
    with (folder / "lock").open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        assert main([*COMMAND, "--runs-dir", str(tmp_path / "runs")]) == 2
    assert "another `shoal search` is at work" in capsys.readouterr().err


def test_a_dry_run_says_how_long_it_takes_and_leaves_nothing(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    small = ["--set", "min_replay=2000", "--robots", "5", "--groups", "1", "--env-steps", "40000", "--episodes", "20"]
    dry = ["search", "--space", "n_step=1..2", *small, "--at-once", "2", "--dry-run"]
    assert main([*dry, "--budget", "10"]) == 0
    assert main([*dry, "--budget", "1h"]) == 0
    printed = capsys.readouterr().out
    assert "in a process of its own, 2 at once" in printed and "10 trials take about" in printed
    assert "1 hours suffice for about" in printed
    assert not list(tmp_path.iterdir())
