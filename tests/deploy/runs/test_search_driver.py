"""The driver of a search, with trials that are played in this process: none is lost or doubled, or stops the others."""

import mlflow
import pytest

from deploy.runs.objectives import find_objectives
from deploy.runs.search_driver import SearchDriver, SearchPlace, work
from deploy.runs.search_results import summary_of, write_trials
from learner.search.config import SearchConfig
from learner.search.study import SearchStudy
from learner.tracking.mlflow_run import Tracker
from learner.tracking.tracked_run import TrackingError

pytestmark = pytest.mark.filterwarnings("ignore:The ``noload`` loader strategy is deprecated")


class Told:
    """Remembers what it is told; implements `TrialListener`."""

    def __init__(self):
        self.ended_trials, self.messages = [], []

    def started(self, number):
        pass

    def ended(self, number):
        self.ended_trials.append(number)

    def message(self, text):
        self.messages.append(text)


@pytest.fixture
def place(tmp_path):
    uri = f"sqlite:///{tmp_path / 'mlflow.db'}"
    found = SearchPlace(tmp_path / "s", uri, "search s")
    found.folder.mkdir()
    for experiment in (found.experiment, found.cells_experiment):
        Tracker(uri, experiment, str(tmp_path / "artifacts"))
    return found


def search_of(*space, budget="4", **settings):
    return SearchConfig(space=space, policy="greedy", robots=(3,), groups=(1,), episodes=10, budget=budget, **settings)


def open_driver(search, place):
    objectives = find_objectives(search)
    study = SearchStudy(place.folder, search, [each.minimised for each in objectives], [e.source for e in objectives])
    return SearchDriver(search, objectives, study, place, told := Told()), study, told


def play(driver, search, place, number, settings):
    work(search, place, number, settings, lambda progress: None)
    driver.finished(number)


def runs_of(place):
    client = mlflow.MlflowClient(place.tracking_uri)
    experiment = client.get_experiment_by_name(place.experiment).experiment_id
    return {int(run.data.tags["trial"]): run for run in client.search_runs([experiment])}


def test_a_run_that_a_kill_left_without_its_settings_gets_them(place):
    search = search_of("arena_radius_m=3.0..6.0", budget="1")
    client = mlflow.MlflowClient(place.tracking_uri)
    experiment = client.get_experiment_by_name(place.experiment).experiment_id
    client.create_run(experiment, tags={"search": place.folder.name, "trial": "0"})
    driver, _, _ = open_driver(search, place)
    number, settings = driver.next()
    play(driver, search, place, number, settings)
    (run,) = runs_of(place).values()
    assert run.data.params == {name: str(value) for name, value in settings.items()} and run.info.status == "FINISHED"


def test_a_trial_that_was_run_but_not_told_is_told_by_the_next_session(place):
    search = search_of("arena_radius_m=3.0..6.0", budget="2")
    driver, _, _ = open_driver(search, place)
    number, settings = driver.next()
    work(search, place, number, settings, lambda progress: None)  # and the session dies before it is told
    driver, study, told = open_driver(search, place)
    assert driver.next() == (number, settings)
    play(driver, search, place, number, settings)
    play(driver, search, place, *driver.next())
    assert driver.next() is None and told.ended_trials == [0, 1] and not told.messages
    runs = runs_of(place)
    assert sorted(runs) == [0, 1] and {run.info.status for run in runs.values()} == {"FINISHED"}
    for record in study.records():
        assert runs[record.number].data.metrics == {"final/success": record.values[0]}
        assert runs[record.number].data.params == {"arena_radius_m": str(record.settings["arena_radius_m"])}


def test_settings_that_a_trial_has_had_are_not_run_again(place):
    search = search_of("captured_is=among,surrounded", budget="7")
    driver, study, _ = open_driver(search, place)
    started = [driver.next(), driver.next()]
    assert len({each[1]["captured_is"] for each in started}) == 2, "two run at once, with settings of their own"
    for number, settings in started:
        play(driver, search, place, number, settings)
    assert driver.next() is None
    records = study.records()
    assert [each.state for each in records] == ["complete"] * 7
    values = {
        each.settings["captured_is"]: {r.values for r in records if r.settings == each.settings} for each in records
    }
    assert all(len(found) == 1 for found in values.values())
    assert len(list(place.folder.glob("trials/*/cells/*"))) == 2 and len(runs_of(place)) == 7


def test_settings_that_contradict_each_other_fail_and_the_search_goes_on(place):
    search = search_of("robot_radius_m=0.05..0.15", "orca_radius_m=0.1,0.2", budget="12")
    driver, study, _ = open_driver(search, place)
    while (asked := driver.next()) is not None:
        play(driver, search, place, *asked)
    states = {each.state for each in study.records()}
    assert states == {"complete", "failed"} and len(study.records()) == 12
    for each in study.records():
        impossible = float(each.settings["orca_radius_m"]) < each.settings["robot_radius_m"]
        assert ("orca_radius_m" in each.reason) == impossible == (each.state == "failed")


def test_an_objective_that_raises_or_gives_nan_fails_its_trials_alone(place, tmp_path):
    file = tmp_path / "mine.py"
    file.write_text(
        "def mine(result):\n"
        "    if result.number == 0:\n"
        "        raise KeyError('no')\n"
        "    return float('nan') if result.number == 1 else 1.0\n"
    )
    search = search_of("arena_radius_m=3.0..6.0", objective=(f"{file}:mine",), budget="3")
    driver, study, _ = open_driver(search, place)
    while (asked := driver.next()) is not None:
        play(driver, search, place, *asked)
    reasons = [each.reason for each in study.records()]
    assert "raised KeyError ('no') in mine.py, line 3" in reasons[0] and "gave nan" in reasons[1] and reasons[2] == ""
    assert [run.info.status for _, run in sorted(runs_of(place).items())] == ["FAILED", "FAILED", "FINISHED"]
    write_trials(place.folder, study)
    lines = (place.folder / "trials.csv").read_text().splitlines()
    assert len(lines) == 4 and lines[1].startswith("0,failed,,")
    found = summary_of(study)
    assert found.front == [2] and [trial.number for trial in found.complete] == [2]


def test_a_crash_is_stored_with_its_trace(place):
    search = search_of("arena_radius_m=3.0..6.0", budget="1")
    driver, study, _ = open_driver(search, place)
    number, _ = driver.next()
    driver.failed(number, "Traceback\n  in some line\nRuntimeError: it broke\n")
    (record,) = study.records()
    assert record.state == "failed" and record.reason.startswith("RuntimeError: it broke (trace in ")
    assert "in some line" in (place.folder / "trials/s-0000/error.txt").read_text()
    assert driver.next() is None


def test_without_mlflow_the_search_goes_on(place, monkeypatch):
    search = search_of("arena_radius_m=3.0..6.0", budget="1")
    driver, study, told = open_driver(search, place)
    number, settings = driver.next()
    work(search, place, number, settings, lambda progress: None)
    monkeypatch.setattr(Tracker, "log_results", lambda *given: (_ for _ in ()).throw(TrackingError("gone")))
    driver.finished(number)
    assert study.records()[0].state == "complete" and told.messages == ["MLflow lacks a trial's result: gone"]
