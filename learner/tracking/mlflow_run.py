"""A run in MLflow, written by one process alone: one client, and an explicit run id in every call."""

from __future__ import annotations

import errno
import hashlib
import importlib
import logging
import math
import os
import shlex
import socket
import sqlite3
import subprocess
import threading
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

from actors.evaluation.result_table import LEARNED
from actors.service.fault_policy import first_line
from actors.storage.full_disk import is_disk_full, is_full
from learner.config import RunConfig, config_hash, flat_params, user_files
from learner.file_names import USER_FILES
from learner.tracking.journal import FINAL, Row, mlflow_metrics
from learner.tracking.local_store import opening
from learner.tracking.mlflow_views import TAG, experiment_views, packed_view
from learner.tracking.redaction import VARIABLE, hide_secrets, public_uri
from learner.tracking.tracked_run import TrackedRun, TrackingError
from sim_core.checks import ConfigError

if TYPE_CHECKING:
    from actors.policy.policy import WeightsSnapshot
    from actors.rollout.vector_env import EnvShape

os.environ.setdefault("MLFLOW_DISABLE_TELEMETRY", "true")
os.environ.setdefault("MLFLOW_HTTP_REQUEST_MAX_RETRIES", "3")
os.environ.setdefault("MLFLOW_HTTP_REQUEST_TIMEOUT", "30")

import mlflow  # noqa: E402
from mlflow.entities import Experiment, LifecycleStage, Metric, Param, RunTag  # noqa: E402
from mlflow.exceptions import MlflowException  # noqa: E402
from mlflow.protos.databricks_pb2 import RESOURCE_ALREADY_EXISTS, ErrorCode  # noqa: E402
from requests import RequestException  # noqa: E402
from sqlalchemy.exc import SQLAlchemyError  # noqa: E402

from learner.tracking.empty_store import copy_empty_store  # noqa: E402
from learner.tracking.mlflow_registry import dataset_inputs, find_policy, register_policy  # noqa: E402

MLFLOW_ERRORS = (MlflowException, SQLAlchemyError, RequestException)
"""What MLflow's client raises when its store fails."""
MAX_BATCH = 900
"""Metrics in one request; MLflow accepts at most 1,000."""
CONNECT_TIMEOUT_S = 5.0
STORE_MODULES = ("mlflow.store.tracking.sqlalchemy_store",)
"""What MLflow imports once a database is opened."""
END_MODULES = ("learner.tracking.mlflow_policy", "torch._dynamo")
"""What `Tracker.log_policy` imports: MLflow's export of a network loads PyTorch's compiler."""


def load(modules: Iterable[str]) -> None:
    """Imports modules before they are needed."""
    for name in modules:
        importlib.import_module(name)


@contextmanager
def _told() -> Iterator[None]:
    """Raises TrackingError for what MLflow's client raises when its store fails; a full disk is told as such."""
    try:
        yield
    except MLFLOW_ERRORS as error:
        reason = first_line(error)
        if is_disk_full(error) and not is_full(reason):
            reason = f"{reason} ({os.strerror(errno.ENOSPC)})"
        raise TrackingError(reason) from error


def check_reachable(uri: str) -> None:
    """Raises ConfigError if `uri` is an HTTP address and no server answers there; other stores pass."""
    try:
        parts = urlsplit(uri)
        if parts.scheme not in ("http", "https"):
            return
        port = parts.port or (443 if parts.scheme == "https" else 80)
        socket.create_connection((parts.hostname or "", port), CONNECT_TIMEOUT_S).close()
    except (OSError, ValueError) as error:  # ValueError: not an address
        raise ConfigError(
            f"no MLflow server answers at {public_uri(uri)} ({error}); start one with `mlflow server`, "
            "or leave --tracking-uri out to log to a local file"
        ) from error


def mlflow_client(uri: str) -> mlflow.MlflowClient:
    """A client of the store at `uri`; silences MLflow's own log messages."""
    logging.getLogger("mlflow").setLevel(logging.ERROR)
    logging.getLogger("alembic").setLevel(logging.ERROR)
    return mlflow.MlflowClient(uri)


class Tracker(TrackedRun):
    """One MLflow run, written by this process.

    Args:
      uri: tracking URI.
      experiment: experiment name; created if missing. None for a run that is resumed, which has one.
      artifact_root: where a new experiment stores its artifacts, None for the server's default.

    Raises:
      ConfigError: the store cannot be opened, or the experiment is deleted.
    """

    def __init__(self, uri: str, experiment: str | None, artifact_root: str | None) -> None:
        check_reachable(uri)
        super().__init__(uri)
        self._logging_network = threading.Lock()
        self._logged: set[tuple[str, int]] = set()
        self._experiment_id = ""
        try:
            with opening(uri):
                copy_empty_store(uri, mlflow_client)
                self._client = mlflow_client(uri)
                if experiment is not None:
                    self._open_experiment(experiment, artifact_root)
        except (MlflowException, SQLAlchemyError, sqlite3.Error, OSError, ValueError, ImportError) as error:
            reason = hide_secrets(first_line(error), uri)
            raise ConfigError(
                f"the MLflow store {public_uri(uri)} cannot be opened ({reason}); name another --tracking-uri"
            ) from error

    def _open_experiment(self, name: str, artifact_root: str | None) -> None:
        """Finds the experiment, or makes it, with its views.

        Raises:
          ConfigError: it is deleted.
        """
        found = self._client.get_experiment_by_name(name)
        if found is None:
            try:
                self._experiment_id = str(self._client.create_experiment(name, artifact_root))
                self._set_views()
                return
            except MlflowException as error:
                found = self._client.get_experiment_by_name(name)  # another process may have made it meanwhile
                if found is None or error.error_code != ErrorCode.Name(RESOURCE_ALREADY_EXISTS):
                    raise
        self._refuse_deleted(found)
        self._experiment_id = str(found.experiment_id)

    def _refuse_deleted(self, experiment: Experiment) -> None:
        if experiment.lifecycle_stage == LifecycleStage.DELETED:
            restore = f"mlflow experiments restore -x {experiment.experiment_id}"
            raise ConfigError(
                f"the experiment {experiment.name!r} is deleted in the MLflow store {public_uri(self.uri)}: restore it "
                f"(`{self._variable()} {restore}`), or start a run with another --experiment"
            )

    def _variable(self) -> str:
        return f"{VARIABLE}={shlex.quote(public_uri(self.uri))}"

    @cached_property
    def _commit(self) -> str:
        return git_commit()

    @_told()
    def start(self, config: RunConfig, tags: dict[str, str] | None = None) -> None:
        """Creates the run with the whole config as params.

        Args:
          config: the run's config.
          tags: further tags, which come before those of the config that a user filters by.
        """
        config_tags = {
            "method": config.world.method_name if config.env.is_swarm else "none",
            "robots": _only({world.robots for world in config.env.worlds}),
            "groups": _only({world.groups for world in config.env.worlds}),
            "learners": config.world.learners if config.env.is_swarm else "none",
            "seed": str(config.seed),
            "engine": config.engine,
            "policy": LEARNED,
            "config_hash": config_hash(config),
            "mlflow.source.git.commit": self._commit,
        }
        run = self._client.create_run(
            self._experiment_id, tags={"mlflow.runName": config.name} | config_tags | (tags or {})
        )
        self.run_id, self.started_ms = run.info.run_id, run.info.start_time
        self.log_inputs(config)

    @_told()
    def start_trial(self, name: str, tags: dict[str, str]) -> None:
        """Creates a run of a search's trial."""
        given = {"mlflow.runName": name, "mlflow.source.git.commit": self._commit} | tags
        run = self._client.create_run(self._experiment_id, tags=given)
        self.run_id, self.started_ms = run.info.run_id, run.info.start_time

    @_told()
    def log_params(self, params: dict[str, str]) -> None:
        """Logs the settings that a search's trial varies; harmless to repeat."""
        self._client.log_batch(self.run_id, params=[Param(key, value) for key, value in params.items()])

    @_told()
    def log_inputs(self, config: RunConfig) -> None:
        """Logs the whole config with a user's own files, and the episodes it names; harmless to repeat."""
        params = [Param(key, _param_text(key, value)) for key, value in flat_params(config).items()]
        self._client.log_batch(self.run_id, params=params)
        for name, text in user_files(config).items():
            self._client.log_text(self.run_id, text, f"{USER_FILES}/{name}")
        self._client.log_inputs(self.run_id, datasets=dataset_inputs(config, self._commit))

    @_told()
    def find_run(self, tags: dict[str, str]) -> str | None:
        """Id of the experiment's oldest run with all `tags`; None if there is none."""
        has_all = " and ".join(f"tags.`{name}` = '{value}'" for name, value in tags.items())
        found = self._client.search_runs(
            [self._experiment_id], has_all, max_results=1, order_by=["attributes.start_time ASC"]
        )
        return found[0].info.run_id if found else None

    def is_finished(self, run_id: str) -> bool:
        """Whether the run's status in the store is FINISHED."""
        try:
            return bool(self._client.get_run(run_id).info.status == "FINISHED")
        except MlflowException:
            return False

    @_told()
    def resume(self, run_id: str) -> None:
        """Continues an existing run; its tag `attempts` counts the run's sessions.

        Raises:
          ConfigError: the store does not know it, or it is deleted.
        """
        try:
            run = self._client.get_run(run_id)
            self._experiment_id = run.info.experiment_id
            self._refuse_deleted(self._client.get_experiment(self._experiment_id))
            if run.info.lifecycle_stage == LifecycleStage.DELETED:
                raise ConfigError(
                    f"the run is deleted in the MLflow store {public_uri(self.uri)}: restore it "
                    f"(`{self._variable()} mlflow runs restore --run-id {run_id}`), or start a new run"
                )
            attempts = int(run.data.tags.get("attempts", "1"))
            self._client.update_run(run_id, status="RUNNING")
            self._client.log_batch(run_id, tags=[RunTag("attempts", str(attempts + 1))])
        except MlflowException as error:
            raise ConfigError(
                f"the MLflow store {public_uri(self.uri)} does not know run {run_id} ({first_line(error)}); put the "
                "store back that it was logged to, or start a new run"
            ) from error
        self.run_id, self.started_ms = run_id, run.info.start_time

    @_told()
    def rejoin(self, run_id: str) -> None:
        """Goes on with a run of this session, which another process has begun to write."""
        run = self._client.get_run(run_id)
        self._experiment_id = run.info.experiment_id
        self.run_id, self.started_ms = run_id, run.info.start_time

    @_told()
    def skip_logged_metrics(self) -> None:
        """Makes `push` skip each value whose metric the run already has at the same step."""
        for key in self._client.get_run(self.run_id).data.metrics:
            self._logged |= {(key, metric.step) for metric in self._client.get_metric_history(self.run_id, key)}

    @_told()
    def push(self, rows: list[Row]) -> None:
        """Logs journal rows (see `mlflow_metrics`); a row that is pushed twice is stored once."""
        metrics = [
            Metric(key, value, row.time_ms, row.env_steps)
            for row in rows
            for key, value in mlflow_metrics(row.metrics).items()
            if math.isfinite(value) and (key, row.env_steps) not in self._logged
        ]
        for start in range(0, len(metrics), MAX_BATCH):
            self._client.log_batch(self.run_id, metrics=metrics[start : start + MAX_BATCH])

    @_told()
    def log_results(self, metrics: dict[str, float], time_ms: int) -> None:
        """Logs the run's results at step 0, where the UI draws them as bars.

        Args:
          metrics: the results, without the prefix `final/`.
          time_ms: when they were measured; results that are logged twice with the same time are stored once.
        """
        self.push([Row(0, time_ms, {f"{FINAL}{key}": value for key, value in metrics.items()})])

    def load_end(self) -> None:
        """Does nothing: `log_policy` loads what it needs."""

    def begin_policy(self, weights: WeightsSnapshot, config: RunConfig, shape: EnvShape) -> None:
        """Does nothing: all of it is this process's work."""

    @_told()
    def log_network(self, weights: WeightsSnapshot, config: RunConfig, shape: EnvShape) -> str:
        """Logs the greedy policy's Q-network unless the run has it; returns the model's URI."""
        from learner.tracking.mlflow_policy import log_network  # here, since it imports torch

        with self._logging_network, tracking_at(self.uri):
            logged = find_policy(self._client, self._experiment_id, self.run_id, weights.version)
            return str(logged.model_uri) if logged else log_network(self.run_id, weights, config, shape)

    @_told()
    def log_policy(self, weights: WeightsSnapshot, config: RunConfig, shape: EnvShape, score: float) -> None:
        """Logs and registers the greedy policy's Q-network (see TrackedRun)."""
        uri = self.log_network(weights, config, shape)
        with tracking_at(self.uri):
            register_policy(self._client, config, self.run_id, weights.version, uri, score)

    @_told()
    def log_artifact(self, path: Path) -> None:
        """Uploads a file or a folder to the run's artifacts."""
        if path.is_dir():
            self._client.log_artifacts(self.run_id, str(path), path.name)
        else:
            self._client.log_artifact(self.run_id, str(path))

    @_told()
    def attach(self, run_id: str, path: Path, place: str) -> None:
        """Uploads a file to the folder `place` of the artifacts of a run that has ended."""
        self._client.log_artifact(run_id, str(path), place)

    def _set_views(self) -> None:
        """Adds the views of `mlflow_views` to the experiment; logs a warning for each that the store refuses."""
        now_ms = int(time.time() * 1000)
        for key, (name, state) in experiment_views().items():
            try:
                self._client.set_experiment_tag(self._experiment_id, TAG + key, packed_view(name, state, now_ms))
            except MlflowException as error:
                logging.getLogger(__name__).warning("no MLflow view %r: %s", name, first_line(error))

    @contextmanager
    def ending(self) -> Iterator[None]:
        """Ends the run with the `with` block: FINISHED, or FAILED if an error leaves the block."""
        status = "FAILED"
        try:
            yield
            status = "FINISHED"
        finally:
            self.end(status)

    @_told()
    def end(self, status: str) -> None:
        """Ends the run with the status FINISHED, KILLED or FAILED."""
        self._client.set_terminated(self.run_id, status)


@contextmanager
def tracking_at(uri: str) -> Iterator[None]:
    """Has MLflow's functions that know no client use the store at `uri`; the process's own store is as before after it.

    The model registry is one of them: without it, it would look for a logged model in the current folder.
    """
    before = os.environ.get(VARIABLE)
    mlflow.set_tracking_uri(uri)
    try:
        yield
    finally:
        mlflow.set_tracking_uri(None)  # it unsets the variable
        if before is not None:
            os.environ[VARIABLE] = before


def _only(values: set[int]) -> str:
    """The value that all setups have, as a tag; `several` if they differ."""
    return str(next(iter(values))) if len(values) == 1 else "several"


def _param_text(name: str, value: object) -> str:
    """The value of a param; for a user's own file its checksum, since MLflow limits the length of params."""
    is_file = name == "sources" and value
    return f"sha256:{hashlib.sha256(str(value).encode()).hexdigest()[:16]}" if is_file else str(value)


COMMIT = "SHOAL_COMMIT"
"""Environment variable with the commit, for a copy of the code without its history, as in a submitted job."""


def git_commit() -> str:
    """The commit in SHOAL_COMMIT, else that of the checkout around this module, else `unknown`."""
    if os.environ.get(COMMIT):
        return os.environ[COMMIT]
    here = Path(__file__).parent
    try:
        done = subprocess.run(["git", "rev-parse", "HEAD"], cwd=here, capture_output=True, text=True, check=False)
    except OSError:  # no git
        return "unknown"
    return done.stdout.strip() or "unknown"
