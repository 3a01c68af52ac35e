"""Client of Ray's job server: submits a command, follows its log, and stops it."""

from __future__ import annotations

import asyncio
import logging
import os
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import aiohttp
import requests
from ray.exceptions import AuthenticationError
from ray.job_submission import JobStatus, JobSubmissionClient

from learner.ray_backend.auth import TOKEN_HELP
from sim_core.checks import ConfigError

ADDRESS = "RAY_API_SERVER_ADDRESS"
DEFAULT_ADDRESS = "http://127.0.0.1:8265"
STOP_WAIT = "RAY_JOB_STOP_WAIT_TIME_S"
"""An environment variable: seconds that Ray waits between SIGTERM and SIGKILL when a job is stopped."""
NOISY_LOGGERS = (
    "ray.dashboard.modules.dashboard_sdk",
    "ray.dashboard.modules.job.sdk",
    "ray._private.runtime_env.packaging",
    "ray._private.runtime_env.working_dir",
)
"""Ray's loggers that report uploads and closed connections; only their errors are shown."""
POLL_S = 0.2
RETRY_S = 1.0


class Job(NamedTuple):
    """A submitted job: its id, and whether it has ended."""

    id: str
    has_ended: bool


class JobResult(NamedTuple):
    """Ray's status of an ended job (SUCCEEDED, FAILED or STOPPED), and its command's exit code if Ray knows it."""

    status: str
    exit_code: int | None


class JobServer:
    """The job server of a Ray cluster.

    Args:
      address: the cluster's dashboard; RAY_API_SERVER_ADDRESS by default, else this machine's.

    Raises:
      ConfigError: nothing answers there, or it asks for a token.
    """

    def __init__(self, address: str | None) -> None:
        self.address = _url(address)
        for name in NOISY_LOGGERS:
            logging.getLogger(name).setLevel(logging.ERROR)
        os.environ[ADDRESS] = self.address  # in Ray's client the environment overrides the argument
        with self._clear_errors():
            self._client = JobSubmissionClient(self.address)

    @contextmanager
    def _clear_errors(self) -> Iterator[None]:
        """Turns errors of the connection and of the server into a ConfigError of one sentence."""
        try:
            yield
        except AuthenticationError as error:
            raise ConfigError(
                f"the Ray cluster at {self.address} asks for a token that it knows: {TOKEN_HELP}"
            ) from error
        except (ConnectionError, requests.RequestException) as error:
            raise ConfigError(
                f"no Ray job server answers at {self.address} ({_cause(error)}); start one with `ray start --head`, "
                "or name the cluster's dashboard with --address"
            ) from error
        except RuntimeError as error:  # any answer but OK
            raise ConfigError(f"the Ray job server at {self.address} refused: {_cause(error)}") from error

    def attempts(self, name: str) -> list[Job]:
        """The jobs that were submitted as `name`, in the order of their attempts."""
        with self._clear_errors():
            found = {str(job.submission_id): job.status for job in self._client.list_jobs()}
        numbers = [int(end) for end in (key.removeprefix(f"{name}-") for key in found) if end.isdecimal()]
        ids = [f"{name}-{number}" for number in sorted(numbers) if f"{name}-{number}" in found]
        return [Job(key, found[key].is_terminal()) for key in ids]

    def submit(self, name: str, entrypoint: str, working_dir: Path, env: dict[str, str], stop_wait_s: int) -> Job:
        """Submits a command as the next attempt of `name`.

        Args:
          name: the job's id without the attempt number.
          entrypoint: the command, as a shell line.
          working_dir: folder that Ray uploads, without the files that its .gitignore names.
          env: environment variables of the command.
          stop_wait_s: seconds that a stopped job has before it is killed.

        Raises:
          ConfigError: the server refuses it.
        """
        number = 1 + max((int(job.id.rpartition("-")[2]) for job in self.attempts(name)), default=0)
        runtime_env: dict[str, Any] = {
            "working_dir": str(working_dir),
            "env_vars": {**env, STOP_WAIT: str(stop_wait_s)},
        }
        with self._clear_errors():
            job = self._client.submit_job(
                entrypoint=entrypoint, submission_id=f"{name}-{number}", runtime_env=runtime_env
            )
        return Job(job, False)

    def result(self, job: str) -> JobResult:
        """A job's status and exit code."""
        with self._clear_errors():
            info = self._client.get_job_info(job)
        return JobResult(info.status.value, info.driver_exit_code)

    def follow(self, job: str, stop: Callable[[], bool], write: Callable[[str], None], stopping: str) -> JobResult:
        """Writes a job's log until the job has ended.

        Args:
          job: its id.
          stop: polled; once true, the job is told to stop. Its log is still followed until it ends or Ray kills it.
          write: called with pieces of the log.
          stopping: written when the job is told to stop.

        Raises:
          ConfigError: the server no longer answers.
        """

        async def tail_and_watch() -> None:
            watcher = asyncio.create_task(self._stop_when_asked(job, stop, write, stopping))
            try:
                await self._tail(job, write)
            finally:
                watcher.cancel()

        with warnings.catch_warnings():
            # Ray itself passes ssl=None to aiohttp.
            warnings.filterwarnings("ignore", "ssl=None is deprecated", DeprecationWarning)
            asyncio.run(tail_and_watch())
        return self.result(job)

    async def _stop_when_asked(
        self, job: str, stop: Callable[[], bool], write: Callable[[str], None], stopping: str
    ) -> None:
        while not stop():
            await asyncio.sleep(POLL_S)
        write(f"{stopping}\n")
        with self._clear_errors():
            await asyncio.to_thread(self._client.stop_job, job)

    async def _tail(self, job: str, write: Callable[[str], None]) -> None:
        """Writes the log from its beginning; after a broken connection, continues where it stopped."""
        written = 0
        while True:
            seen = 0
            try:
                async for text in self._client.tail_job_logs(job):
                    write(text[max(0, written - seen) :])
                    seen += len(text)
                    written = max(written, seen)
            except (RuntimeError, aiohttp.ClientError):
                pass
            if JobStatus(self.result(job).status).is_terminal():
                return
            await asyncio.sleep(RETRY_S)


def _url(address: str | None) -> str:
    """The dashboard's URL; `http://` is added if no scheme is given.

    Raises:
      ConfigError: its scheme is neither http nor https.
    """
    given = address or os.environ.get(ADDRESS) or DEFAULT_ADDRESS
    scheme, separator, _ = given.partition("://")
    if separator and scheme not in ("http", "https"):
        raise ConfigError(f"--address must be a dashboard such as {DEFAULT_ADDRESS}, not {given!r}")
    return (given if separator else f"http://{given}").rstrip("/")


def _cause(error: Exception) -> str:
    """The last line of an error's text, which states the cause."""
    lines = [line for line in str(error).splitlines() if line.strip()]
    return lines[-1].strip() if lines else type(error).__name__
