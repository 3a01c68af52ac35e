"""A local MLflow store: a sqlite database, and the artifacts in a folder beside it.

MLflow makes and upgrades the tables of a database when it opens it, and two processes that do so at once spoil each
other's work. It also stores artifacts' locations as absolute paths, which a folder of runs that is moved or copied
takes along. Both are mended here; other stores, such as a server's, look after themselves.
"""

from __future__ import annotations

import fcntl
import os
import re
import sqlite3
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from urllib.parse import quote

from learner.tracking.redaction import VARIABLE, public_uri
from sim_core.checks import ConfigError

DATABASE, ARTIFACTS = "mlflow.db", "mlartifacts"
"""Names of the database and of its artifacts' folder in a folder of runs."""
SQLITE_URI = re.compile(r"sqlite(?:\+\w+)?:///([^?]*)")
LOCATIONS = (
    ("experiments", "artifact_location"),
    ("runs", "artifact_uri"),
    ("logged_models", "artifact_location"),
    ("model_versions", "storage_location"),
)
"""Tables and columns in which MLflow stores locations of artifacts."""
LONGEST_WAIT_S, POLL_S = 120.0, 0.1
"""How long to wait for another process that opens the same database; it takes a few seconds."""


def sqlite_uri(database: Path) -> str:
    """The tracking URI of a database in a file."""
    return f"sqlite:///{database.absolute()}"


def database_of(uri: str) -> Path | None:
    """The file of a sqlite database, as SQLAlchemy reads its URI; None for other stores, and for one in memory."""
    found = SQLITE_URI.match(uri)
    return Path(found[1]).absolute() if found and found[1] not in ("", ":memory:") else None


@contextmanager
def opening(uri: str) -> Iterator[int]:
    """Lets one process at a time open a local store, whose artifacts are found first where its folder was moved.

    Yields:
      The number of locations that were mended (see `mend_locations`).

    Raises:
      ConfigError: another process does not get on with it.
      OSError, sqlite3.Error: the database cannot be opened.
    """
    database = database_of(uri)
    if database is None:
        yield 0
        return
    with database.with_name(f"{database.name}.lock").open("w") as lock:
        _wait_for(lock.fileno(), database)
        yield mend_locations(database)


def _wait_for(lock: int, database: Path) -> None:
    deadline_s = time.monotonic() + LONGEST_WAIT_S
    while True:
        try:
            return fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            if time.monotonic() > deadline_s:
                raise ConfigError(
                    f"another process has been opening {database} for {LONGEST_WAIT_S:.0f} s; end it, or wait for it"
                ) from error
            time.sleep(POLL_S)


def mend_locations(database: Path) -> int:
    """Lets MLflow find the artifacts beside a database that was moved or copied together with them.

    An experiment whose artifacts were in a folder `mlartifacts` elsewhere gets the one beside the database, if
    artifacts of its runs are there, or if the other one has gone.

    Returns:
      The number of locations that were changed.

    Raises:
      sqlite3.Error: the file is no database, or cannot be written to.
    """
    here = database.parent / ARTIFACTS
    if not database.is_file() or not here.is_dir():
        return 0
    with closing(sqlite3.connect(database)) as connection:
        tables = {name for (name,) in connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
        if not {table for table, _ in LOCATIONS} <= tables:
            return 0  # MLflow has yet to make them
        known = [place for (place,) in connection.execute("SELECT DISTINCT artifact_location FROM experiments")]
        moved = [place for place in known if place and _has_moved(connection, place, here)]
        changed = sum(_replace(connection, *column, place, str(here)) for place in moved for column in LOCATIONS)
        connection.commit()
        return changed


def _has_moved(connection: sqlite3.Connection, place: str, here: Path) -> bool:
    if Path(place).name != ARTIFACTS or not os.path.isabs(place) or Path(place) == here:
        return False
    pattern = (len(place) + 1, f"{place}/")
    runs = connection.execute("SELECT run_uuid FROM runs WHERE substr(artifact_uri, 1, ?) = ?", pattern)
    return not Path(place).exists() or any((here / run_id).is_dir() for (run_id,) in runs)


def _replace(connection: sqlite3.Connection, table: str, column: str, old: str, new: str) -> int:
    """Replaces the folder `old` at the beginning of a column by `new`; returns the number of changed rows."""
    statement = (
        f"UPDATE {table} SET {column} = ? || substr({column}, ?) WHERE {column} = ? OR substr({column}, 1, ?) = ?"
    )
    return connection.execute(statement, (new, len(old) + 1, old, len(old) + 1, f"{old}/")).rowcount


def find_store(uri: str, run_id: str, folder: Path) -> str:
    """The tracking URI of the store that a run is logged to, where its folder, with or without the store, was moved.

    A database of the same name in a folder above the run goes first if it knows the run, so that a copied folder of
    runs has a store of its own. Then come the place where it was, and MLFLOW_TRACKING_URI.

    Args:
      uri: where the store was.
      run_id: the run in MLflow.
      folder: the run's folder.

    Raises:
      ConfigError: the database has gone.
    """
    database = database_of(uri)
    if database is None:
        return uri
    for place in folder.absolute().parents:
        if _knows_run(place / database.name, run_id):
            return sqlite_uri(place / database.name)
    if database.is_file():
        return uri
    given = os.environ.get(VARIABLE)
    if given:
        return given
    raise ConfigError(
        f"the MLflow store of the run, {public_uri(uri)}, is not there, and in no folder above {folder} is one that "
        f"knows the run; put it back, or set {VARIABLE} to where it is"
    )


def _knows_run(database: Path, run_id: str) -> bool:
    if not database.is_file():
        return False
    try:
        with closing(sqlite3.connect(f"file:{quote(str(database))}?mode=ro", uri=True)) as connection:
            return connection.execute("SELECT 1 FROM runs WHERE run_uuid = ?", (run_id,)).fetchone() is not None
    except sqlite3.Error:  # no database of MLflow's
        return False
