"""A local MLflow store: opened by several processes at once, moved, copied, and found again."""

import fcntl
import multiprocessing
import shutil
import sqlite3
from pathlib import Path

import mlflow
import pytest

from learner.tracking import local_store
from learner.tracking.local_store import database_of, find_store, mend_locations, sqlite_uri
from learner.tracking.mlflow_run import Tracker, tracking_at
from learner.tracking.redaction import VARIABLE
from sim_core.checks import ConfigError

# MLflow's own tables use an option that SQLAlchemy 2.1 is going to drop.
pytestmark = pytest.mark.filterwarnings("ignore:The ``noload`` loader strategy is deprecated")


@pytest.mark.parametrize(
    ("uri", "file"),
    [
        ("sqlite:////a/mlflow.db", "/a/mlflow.db"),
        ("sqlite:///a/mlflow.db", f"{Path.cwd()}/a/mlflow.db"),
        ("sqlite+pysqlite:////a/x.db?timeout=5", "/a/x.db"),
        ("sqlite://", None),
        ("sqlite:///:memory:", None),
        ("http://host/sqlite:///x", None),
        ("postgresql://me@host/x", None),
        ("/a/mlruns", None),
    ],
)
def test_the_file_of_a_database(uri, file):
    assert database_of(uri) == (None if file is None else Path(file))


def start_run(uri, root, run, results):
    tracker = Tracker(uri, "shoal", root)
    tracker.start(run)
    tracker.push([])
    tracker.end("FINISHED")
    results.put(tracker.run_id)


@pytest.mark.filterwarnings("ignore:.*multi-threaded, use of fork:DeprecationWarning")
def test_several_processes_make_one_store_at_once(tmp_path, small_run):
    """Each would make the tables, of which one succeeds; and each the experiment."""
    context = multiprocessing.get_context("fork")  # they have MLflow loaded already
    results, uri = context.Queue(), sqlite_uri(tmp_path / "mlflow.db")
    arguments = (uri, str(tmp_path / "mlartifacts"), small_run, results)
    processes = [context.Process(target=start_run, args=arguments) for _ in range(4)]
    for process in processes:
        process.start()
    for process in processes:
        process.join()
    assert [process.exitcode for process in processes] == [0] * 4
    client = mlflow.MlflowClient(uri)
    experiment = client.get_experiment_by_name("shoal")
    runs = client.search_runs([experiment.experiment_id])
    assert {run.info.run_id for run in runs} == {results.get() for _ in processes}
    assert {run.info.status for run in runs} == {"FINISHED"}


def test_a_process_that_never_lets_go_is_named(tmp_path, monkeypatch):
    monkeypatch.setattr(local_store, "LONGEST_WAIT_S", 0.0)
    with (tmp_path / "mlflow.db.lock").open("w") as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        with pytest.raises(ConfigError, match="another process has been opening .*mlflow.db"):
            Tracker(sqlite_uri(tmp_path / "mlflow.db"), "shoal", None)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A folder of runs `old` with a store and its artifacts, and the id of its run, which is a folder, too."""
    old = tmp_path_factory.mktemp("moves") / "old"
    old.mkdir()
    tracker = Tracker(sqlite_uri(old / "mlflow.db"), "shoal", str(old / "mlartifacts"))
    run_id = tracker._client.create_run(tracker._experiment_id).info.run_id
    tracker._client.log_text(run_id, "hello", "greeting.txt")
    model = tracker._client.create_logged_model(tracker._experiment_id, "policy", run_id)
    (Path(model.artifact_location)).mkdir(parents=True)
    (Path(model.artifact_location) / "MLmodel").write_text("flavors: {}")
    with tracking_at(tracker.uri):
        tracker._client.create_registered_model("m")
        tracker._client.create_model_version("m", f"models:/{model.model_id}", run_id, model_id=model.model_id)
    (old / "r").mkdir()
    return old, run_id


def locations(database):
    connection = sqlite3.connect(database)
    found = [
        row[0] for table, column in local_store.LOCATIONS for row in connection.execute(f"SELECT {column} FROM {table}")
    ]
    connection.close()
    return [place for place in found if place]


def read_greeting(folder, run_id):
    """The artifact, as MLflow's users load it."""
    uri = sqlite_uri(folder / "mlflow.db")
    place = mlflow.artifacts.download_artifacts(run_id=run_id, artifact_path="greeting.txt", tracking_uri=uri)
    return Path(place).read_text()


def test_artifacts_are_found_beside_a_store_that_was_moved(made, tmp_path):
    old, run_id = made
    new = tmp_path / "new [x]'; --"
    shutil.copytree(old, new)
    hidden = old.rename(old.with_name("gone"))
    try:
        assert mend_locations(new / "mlflow.db") == 4  # of the experiment, run, model and version
        assert mend_locations(new / "mlflow.db") == 0
        assert all(
            place.startswith(f"{new}/mlartifacts") for place in locations(new / "mlflow.db") if str(old) in place
        )
        assert read_greeting(new, run_id) == "hello"
    finally:
        hidden.rename(old)


def test_a_copy_has_artifacts_of_its_own(made, tmp_path):
    old, run_id = made
    before = locations(old / "mlflow.db")
    copy = Path(shutil.copytree(old, tmp_path / "copy"))
    Tracker(sqlite_uri(copy / "mlflow.db"), "shoal", str(copy / "mlartifacts"))
    (copy / "mlartifacts" / run_id / "artifacts" / "greeting.txt").write_text("my own")
    assert (read_greeting(copy, run_id), read_greeting(old, run_id)) == ("my own", "hello")
    assert mend_locations(old / "mlflow.db") == 0 and locations(old / "mlflow.db") == before


def test_artifacts_that_lie_elsewhere_on_purpose_stay_there(made, tmp_path):
    """The database alone was copied to where another folder of artifacts is, of other runs."""
    old, _ = made
    shutil.copy(old / "mlflow.db", tmp_path / "mlflow.db")
    (tmp_path / "mlartifacts" / "another run").mkdir(parents=True)
    assert mend_locations(tmp_path / "mlflow.db") == 0
    assert locations(tmp_path / "mlflow.db") == locations(old / "mlflow.db")


@pytest.mark.parametrize("content", [None, b"", b"no database"])
def test_what_is_no_store_is_left_alone(tmp_path, content):
    (tmp_path / "mlartifacts").mkdir()
    if content is not None:
        (tmp_path / "mlflow.db").write_bytes(content)
    if content == b"no database":
        with pytest.raises(ConfigError, match="cannot be opened"):
            Tracker(sqlite_uri(tmp_path / "mlflow.db"), "shoal", None)
    else:
        assert mend_locations(tmp_path / "mlflow.db") == 0


def test_a_store_is_found_where_its_folder_is_now(made, tmp_path, monkeypatch):
    old, run_id = made
    monkeypatch.delenv(VARIABLE, raising=False)
    uri = sqlite_uri(old / "mlflow.db")
    assert find_store(uri, run_id, old / "r") == uri
    assert find_store(uri, run_id, tmp_path / "r") == uri, "the run alone was moved"
    copy = Path(shutil.copytree(old, tmp_path / "copy"))
    (copy / "sweeps" / "s" / "cells" / "c").mkdir(parents=True)
    for folder in (copy / "r", copy / "sweeps" / "s" / "cells" / "c"):
        assert find_store(uri, run_id, folder) == sqlite_uri(copy / "mlflow.db")
    other = tmp_path / "other"
    other.mkdir()
    (other / "mlflow.db").write_text("not MLflow's")
    assert find_store(uri, run_id, other / "r") == uri
    assert find_store("http://host", run_id, copy / "r") == "http://host"


def test_a_store_that_has_gone_is_refused_or_taken_from_the_environment(tmp_path, monkeypatch):
    monkeypatch.delenv(VARIABLE, raising=False)
    uri = sqlite_uri(tmp_path / "gone" / "mlflow.db")
    with pytest.raises(ConfigError, match=f"{uri}, is not there.* set {VARIABLE}"):
        find_store(uri, "0123", tmp_path / "r")
    assert not (tmp_path / "gone").exists(), "no database is made where it was"
    monkeypatch.setenv(VARIABLE, "http://host")
    assert find_store(uri, "0123", tmp_path / "r") == "http://host"
