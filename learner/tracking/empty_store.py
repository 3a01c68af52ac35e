"""An empty MLflow database in no time: a copy of one that was made before.

MLflow makes the tables of a new database by all migrations of its history, each with its own writes to the disk. That
takes seconds. The tables depend on MLflow's migrations alone. So they are made once for each user and version of
MLflow, in the user's cache folder, and copied from there. A cache is no reason to fail: without it, or where it cannot
be filled, MLflow makes the tables in their place.
"""

from __future__ import annotations

import hashlib
import importlib.metadata
import importlib.util
import shutil
import sqlite3
import tempfile
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path

from sqlalchemy import event
from sqlalchemy.engine import Engine

from actors.storage.atomic_write import replacing_file, sync
from learner.tracking.local_store import database_of, sqlite_uri
from sim_core.user_cache import user_cache

MIGRATIONS = "mlflow.store.db_migrations"
"""The package whose folder `versions` has a file for each migration."""
OpenStore = Callable[[str], object]
"""Opens the MLflow store at a URI, which has MLflow make its tables."""


def copy_empty_store(uri: str, open_store: OpenStore) -> None:
    """Makes the database at `uri`, if it is a file that is not there; the caller lets one process at a time do so.

    Raises:
      OSError: the database cannot be written.
    """
    database, template = database_of(uri), _template()
    if database is None or database.exists() or template is None:
        return
    if not _is_sound(template):
        try:
            _make(template, open_store)
        except Exception:  # of the disk, of sqlite on a network's disk, of MLflow: it tells when it opens the database
            return
    with replacing_file(database, sync_first=True) as copy:
        shutil.copyfile(template, copy)


def _template() -> Path | None:
    """Where the empty database of the present MLflow is kept; None for a user without a home."""
    folder = user_cache()
    return folder / f"mlflow-{_migrations_digest()}.db" if folder else None


def _migrations_digest() -> str:
    """Hash of MLflow's version and of the names of its migrations; 16 hex digits."""
    digest = hashlib.sha256(importlib.metadata.version("mlflow").encode())
    spec = importlib.util.find_spec(MIGRATIONS)
    for folder in (spec and spec.submodule_search_locations) or ():
        for each in sorted(Path(folder).glob("versions/*.py")):
            digest.update(b"\0" + each.name.encode())
    return digest.hexdigest()[:16]


def _is_sound(template: Path) -> bool:
    """Whether the template is there and whole; one that is damaged is made again."""
    with suppress(sqlite3.Error), closing(sqlite3.connect(f"{template.as_uri()}?mode=ro", uri=True)) as connection:
        connection.execute("SELECT experiment_id FROM experiments")  # an empty file is a database without tables
        return list(connection.execute("PRAGMA quick_check")) == [("ok",)]
    return False


def _make(template: Path, open_store: OpenStore) -> None:
    """Makes the template."""
    template.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=template.parent) as folder:
        made = Path(folder) / template.name
        with _unsynced():
            open_store(sqlite_uri(made))
        with closing(sqlite3.connect(made)) as connection:
            connection.execute("DELETE FROM experiments")  # MLflow's own, whose artifacts would lie beside the template
            connection.commit()
        sync(made)
        made.replace(template)


@contextmanager
def _unsynced() -> Iterator[None]:
    """Has databases that are opened in the `with` block leave it to the system when it writes to the disk."""

    def leave(connection: sqlite3.Connection, record: object) -> None:
        connection.execute("PRAGMA synchronous=OFF")

    event.listen(Engine, "connect", leave)
    try:
        yield
    finally:
        event.remove(Engine, "connect", leave)
