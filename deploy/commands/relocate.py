"""`shoal relocate`: lets MLflow find its artifacts again after a folder of runs was moved or copied."""

from __future__ import annotations

import sqlite3

from deploy.console.terminal import plain_console
from deploy.options.results import Relocate
from learner.tracking.local_store import DATABASE, opening, sqlite_uri
from sim_core.checks import ConfigError, require


def run(command: Relocate) -> int:
    """Mends the locations of artifacts in the folder's MLflow database; returns the exit code.

    Raises:
      ConfigError: there is no database, or it cannot be read or written.
    """
    database = command.runs_dir.absolute() / DATABASE
    require(database.is_file(), f"there is no {database}; name the folder of runs with --runs-dir")
    try:
        with opening(sqlite_uri(database)) as changed:
            text = (
                f"{changed} locations of artifacts mended" if changed else "every artifact is where MLflow looks for it"
            )
    except (OSError, sqlite3.Error) as error:
        raise ConfigError(f"{database} cannot be mended ({error}); it must be MLflow's, and yours to write") from error
    plain_console().print(f"{text}: {database}", soft_wrap=True)
    return 0
