"""A run's folder: paths of its files, and reading and writing the small ones."""

from __future__ import annotations

import fcntl
import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from actors.rollout.foreign_env import EnvError
from actors.storage.atomic_write import replacing_file
from actors.storage.permissions import may_not_read, may_not_write
from actors.storage.uri import Location, parse_location
from learner import file_names
from learner.config import RunConfig, from_dict, to_dict, user_files
from sim_core.checks import ConfigError, require

REFUSED = {file_names.LOCK, file_names.ENV_TRACE}
"""Files of a run that was refused at its start."""


class RunIdentity(NamedTuple):
    """The run in MLflow: run name, tracking URI without its password, experiment and run id."""

    name: str
    tracking_uri: str
    experiment: str
    mlflow_run_id: str


class Storage(NamedTuple):
    """Storage of the run's checkpoints: URL or folder (None: in the run's folder), and how many of the best to keep."""

    checkpoint_url: str | None = None
    keep_best: int = 0


class RunFolder:
    """The folder of one run; `learner.file_names` describes its files.

    Args:
      path: the folder; it need not exist.
    """

    def __init__(self, path: Path) -> None:
        self.path = path.absolute()
        self.checkpoints = self.path / file_names.CHECKPOINTS
        self.journal = self.path / file_names.JOURNAL
        self.pushed = self.path / file_names.PUSHED
        self.faults = self.path / file_names.FAULTS
        self.artifacts = self.path / file_names.ARTIFACTS
        self.end = self.path / file_names.END
        self.policy = self.path / file_names.POLICY
        self.results = self.path / file_names.RESULTS
        self._identity = self.path / file_names.IDENTITY

    def has_begun(self) -> bool:
        """Whether a run has been started here that can be resumed."""
        return self._identity.is_file()

    def is_taken(self) -> bool:
        """Whether there is anything here, beside what a start leaves that was refused."""
        here = self.path
        return here.exists() and not (here.is_dir() and {each.name for each in here.iterdir()} <= REFUSED)

    @contextmanager
    def traceback_kept(self) -> Iterator[None]:
        """Within the `with` block, keeps the traceback of what a foreign environment raises, and names its file.

        Raises:
          EnvError: as the block raised it, with the file.
        """
        path = self.path / file_names.ENV_TRACE
        path.unlink(missing_ok=True)
        try:
            yield
        except EnvError as error:
            if not error.trace:
                raise
            self.path.mkdir(parents=True, exist_ok=True)
            with replacing_file(path) as partial:
                partial.write_text(error.trace, "utf-8", "backslashreplace")
            raise EnvError(f"{error}; its traceback is in {path}") from error

    @contextmanager
    def lock(self) -> Iterator[None]:
        """Locks the run against training by other processes; the lock ends with the `with` block or the process.

        Raises:
          ConfigError: another process has locked it, or the folder may not be written to.
        """
        self.path.mkdir(parents=True, exist_ok=True)
        try:
            lock = (self.path / file_names.LOCK).open("w")
        except PermissionError as error:
            raise ConfigError(may_not_write(self.path)) from error
        with lock as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError as error:
                raise ConfigError(f"another process is training {self.path}; wait for it or end it") from error
            yield

    def save_config(self, config: RunConfig) -> None:
        """Writes `config.json`, and beside it copies of a user's own files."""
        write_json(self.path / file_names.CONFIG, to_dict(config))
        for name, text in user_files(config).items():
            path = self.path / file_names.USER_FILES / name
            path.parent.mkdir(parents=True, exist_ok=True)
            with replacing_file(path) as partial:
                partial.write_text(text, "utf-8")

    def config(self) -> RunConfig:
        """Reads `config.json`.

        Raises:
          ConfigError: the file is missing, not JSON, or from another version.
        """
        return from_dict(_read(self.path / file_names.CONFIG))

    def save_storage(self, storage: Storage) -> None:
        """Writes `storage.json`; a folder beside the run is named relative to it, so that both can be moved."""
        url, runs = storage.checkpoint_url, self.path.parent
        if url is not None and os.path.isabs(url) and runs in Path(url).parents:
            storage = storage._replace(checkpoint_url=os.path.relpath(url, self.path))
        write_json(self.path / file_names.STORAGE, storage._asdict())

    def storage(self) -> Storage:
        """Reads `storage.json`; without that file, the checkpoints are in the run's folder.

        Raises:
          ConfigError: the file is damaged.
        """
        path = self.path / file_names.STORAGE
        if not path.exists():
            return Storage()
        try:
            storage = Storage(**_read(path))
        except TypeError as error:
            raise ConfigError(f"{path} does not describe a storage; name another run or start a new one") from error
        url, best = storage
        require(url is None or isinstance(url, str), f"{path}: checkpoint_url must be a string, not {url!r}")
        require(type(best) is int and best >= 0, f"{path}: keep_best must be a whole number >= 0, not {best!r}")
        return storage

    def checkpoint_location(self) -> Location:
        """Location of the run's checkpoints (see `storage` for errors)."""
        url = self.storage().checkpoint_url
        if url is None:
            return self.checkpoints
        is_beside = "://" not in url and not os.path.isabs(url)
        return parse_location(os.path.normpath(self.path / url) if is_beside else url)

    def save_identity(self, identity: RunIdentity) -> None:
        """Writes `run.json`."""
        write_json(self._identity, identity._asdict())

    def identity(self) -> RunIdentity:
        """Reads `run.json`.

        Raises:
          ConfigError: the file is missing or does not name a run.
        """
        values = _read(self._identity)
        try:
            return RunIdentity(**values)
        except TypeError as error:
            raise ConfigError(f"{self._identity} does not name a run; start a new run") from error


def find_run(name: str, runs_dir: Path) -> RunFolder:
    """The run that a user names by its path or by the name of its folder in `runs_dir`.

    Raises:
      ConfigError: there is none.
    """
    for path in (Path(name), runs_dir / name):
        if (path / file_names.CONFIG).is_file():
            return RunFolder(path)
    known = sorted(path.parent.name for path in runs_dir.glob(f"*/{file_names.CONFIG}"))
    hint = f"runs there: {', '.join(known[-5:])}" if known else f"there are no runs in {runs_dir}"
    raise ConfigError(f"there is no run {name!r}; {hint}")


def write_json(path: Path, values: dict[str, Any]) -> None:
    """Writes a JSON file atomically (see `replacing_file`)."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing_file(path, sync_first=True) as partial:
        partial.write_text(json.dumps(values, indent=2))


def _read(path: Path) -> dict[str, Any]:
    try:
        values = json.loads(path.read_text("utf-8-sig"))
    except PermissionError as error:
        raise ConfigError(may_not_read(path)) from error
    except (OSError, ValueError, RecursionError) as error:
        raise ConfigError(f"{path} cannot be read ({error}); name another run or start a new one") from error
    if not isinstance(values, dict):
        raise ConfigError(f"{path} is not a JSON object; name another run or start a new one")
    return values
