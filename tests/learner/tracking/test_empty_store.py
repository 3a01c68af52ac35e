"""An empty MLflow database that is copied: the same as MLflow's own, and made again where its origin is damaged."""

import sqlite3
from contextlib import closing

import mlflow
import pytest

from learner.tracking.empty_store import copy_empty_store
from learner.tracking.local_store import sqlite_uri
from learner.tracking.mlflow_run import mlflow_client

# MLflow's own tables use an option that SQLAlchemy 2.1 is going to drop.
pytestmark = pytest.mark.filterwarnings("ignore:The ``noload`` loader strategy is deprecated")


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """An empty cache folder."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache" / "shoal"


@pytest.fixture
def opened():
    """The URIs of the stores that MLflow was asked to open, and the call that asks it."""
    uris = []

    def open_store(uri):
        uris.append(uri)
        mlflow_client(uri)

    return uris, open_store


def content(database):
    """The lines that make the tables, whose constraints have no order in MLflow; all rows but the experiments'."""
    with closing(sqlite3.connect(database)) as connection:
        made = connection.execute("SELECT name, sql FROM sqlite_master")
        tables = {name: sorted(line.rstrip(", ") for line in (sql or "").splitlines()) for name, sql in made}
        names = [name for (name,) in connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'")]
        rows = {name: list(connection.execute(f"SELECT * FROM {name}")) for name in names if name != "experiments"}
    return tables, rows


def test_a_copy_is_what_mlflow_makes(cache, opened, tmp_path):
    uris, open_store = opened
    for name in ("first.db", "second.db"):
        copy_empty_store(sqlite_uri(tmp_path / name), open_store)
    assert len(uris) == 1, "the second is copied from the same file"
    mlflow_client(sqlite_uri(tmp_path / "own.db"))
    assert content(tmp_path / "first.db") == content(tmp_path / "second.db") == content(tmp_path / "own.db")
    assert len(list(cache.iterdir())) == 1, "nothing else is left in the cache folder"
    experiment = mlflow.MlflowClient(sqlite_uri(tmp_path / "second.db")).get_experiment("0")
    assert str(cache) not in experiment.artifact_location


def test_a_database_that_is_there_stays(cache, opened, tmp_path):
    (tmp_path / "mine.db").write_bytes(b"mine")
    copy_empty_store(sqlite_uri(tmp_path / "mine.db"), opened[1])
    assert (tmp_path / "mine.db").read_bytes() == b"mine" and not opened[0]


@pytest.mark.parametrize("damaged", [b"", b"no database", None])
def test_a_damaged_origin_is_made_again(damaged, cache, opened, tmp_path):
    uris, open_store = opened
    copy_empty_store(sqlite_uri(tmp_path / "first.db"), open_store)
    (template,) = cache.iterdir()
    template.write_bytes(template.read_bytes()[:50_000] if damaged is None else damaged)
    copy_empty_store(sqlite_uri(tmp_path / "second.db"), open_store)
    assert len(uris) == 2 and content(tmp_path / "second.db") == content(tmp_path / "first.db")


def test_a_new_mlflow_has_a_new_origin(cache, opened, tmp_path, monkeypatch):
    copy_empty_store(sqlite_uri(tmp_path / "first.db"), opened[1])
    monkeypatch.setattr("importlib.metadata.version", lambda name: "99.0")
    copy_empty_store(sqlite_uri(tmp_path / "second.db"), opened[1])
    assert len(opened[0]) == len(list(cache.iterdir())) == 2


@pytest.mark.parametrize("place", ["file", "~"])
def test_without_a_cache_folder_mlflow_makes_the_database(place, opened, tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_CACHE_HOME", place if place == "~" else str(tmp_path / place))  # "~": no home
    copy_empty_store(sqlite_uri(tmp_path / "mine.db"), opened[1])
    assert not opened[0] and not (tmp_path / "mine.db").exists()


def test_an_error_leaves_the_database_to_mlflow_and_nothing_in_the_cache(cache, tmp_path):
    def refuse(uri):
        raise mlflow.MlflowException("no locks on this disk")

    copy_empty_store(sqlite_uri(tmp_path / "mine.db"), refuse)
    assert not (tmp_path / "mine.db").exists() and not list(cache.iterdir())
