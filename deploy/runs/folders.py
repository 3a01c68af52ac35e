"""Names, folders and files that the command line writes."""

from __future__ import annotations

import datetime
import fcntl
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from actors.storage.atomic_write import replacing_file
from actors.storage.uri import Location, check_writable, join_location, parse_location
from learner.checkpoints.store import open_store
from learner.config import RunConfig
from learner.file_names import LOCK
from learner.run_folder import Storage
from learner.sweep.grid import SweepConfig
from sim_core.checks import ConfigError, require

JOB = "RAY_JOB_CONFIG_JSON_ENV_VAR"
"""An environment variable that Ray sets for the command of a submitted job."""


def default_name(config: RunConfig) -> str:
    """How names of runs with `config` begin, unless the user gives one."""
    return re.sub(r"[^\w.+=-]+", "-", config.name.replace("×", ""))


def stamped_name(config: RunConfig) -> str:
    """The name of a new run with `config` that the user has not named."""
    return f"{default_name(config)}-{datetime.datetime.now().strftime('%Y%m%d-%H%M%S')}"


def default_sweep_name(grid: SweepConfig) -> str:
    """Name of a sweep's folder, unless the user gives one: its preset and the settings that differ from it."""
    return re.sub(r"[^\w.+=-]+", "-", grid.label)


def check_outlasts_job(runs_dir: Path) -> None:
    """Raises ConfigError if `--runs-dir` would be lost with the temporary folder that a Ray job runs in."""
    require(
        runs_dir.is_absolute() or JOB not in os.environ,
        f"a Ray job runs in a copy of its folder, where --runs-dir {runs_dir} would be lost; name an absolute path",
    )


def make_folder(path: Path, flag: str) -> None:
    """Makes the folder that a flag names, if it is missing.

    Raises:
      ConfigError: it cannot be made or written to.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"{flag} {path} cannot be made ({error}); name a folder that you may write to") from error
    may_write = os.access(path, os.W_OK, effective_ids=True)
    require(may_write, f"{flag} {path} cannot be written to; name a folder that you may write to")


@contextmanager
def locked(folder: Path, command: str) -> Iterator[None]:
    """Locks the folder of a sweep or a search, so that no two commands run what is missing there at once.

    Raises:
      ConfigError: another command holds it.
    """
    with (folder / LOCK).open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise ConfigError(f"another `shoal {command}` is at work in {folder}; wait for it or end it") from error
        yield


def run_location(checkpoint_url: str, name: str) -> Location:
    """Where the checkpoints of the run `name` are stored under `--checkpoint-url` (see `parse_location` for errors)."""
    return join_location(parse_location(checkpoint_url), name)


def new_storage(checkpoint_url: str | None, name: str, keep_best: int) -> Storage:
    """The checkpoint storage of a new run `name`: a folder of its own under `--checkpoint-url`, or the run's folder.

    Raises:
      ConfigError: nothing can be written there, or a run of that name has checkpoints there.
    """
    if checkpoint_url is None:
        return Storage(None, keep_best)
    root, location = parse_location(checkpoint_url), run_location(checkpoint_url, name)
    if isinstance(root, Path):
        make_folder(root, "--checkpoint-url")
    else:
        check_writable(root)
    try:
        taken = open_store(location).names()
    except OSError as error:
        raise ConfigError(f"--checkpoint-url {location} cannot be listed ({error}); name another one") from error
    require(
        not taken, f"--checkpoint-url {location} holds the checkpoints of another run; choose another --name or URL"
    )
    return Storage(str(location), keep_best)


def check_plain_name(name: str) -> None:
    """Raises ConfigError unless `--name` is a single folder name, which cannot lead to another folder."""
    plain = name == Path(name).name and name not in ("", ".", "..")
    require(plain, f"--name must be a plain folder name, not {name!r}")


def write_text(path: Path, text: str) -> None:
    """Writes a UTF-8 file atomically and durably: an older file stays until the new one is complete on disk."""
    with replacing_file(path, sync_first=True) as partial:
        partial.write_text(text, encoding="utf-8", newline="\n")
