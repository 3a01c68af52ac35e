"""What a training asks of its run in MLflow, and the error of a store that fails; without MLflow, which takes a second.

`learner.tracking.mlflow_run` writes to the store from this process, `learner.tracking.tracker_process` has a process of
its own do so.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from actors.policy.policy import WeightsSnapshot
    from actors.rollout.vector_env import EnvShape
    from learner.config import RunConfig
    from learner.tracking.journal import Row

SERVER_TIMEOUT_S = 600.0
"""How long a finished run waits for a server that does not answer."""


class TrackingError(Exception):
    """The MLflow store, or the process that writes to it, fails. The message is one line, the reason."""


class TrackedRun(ABC):
    """One MLflow run. Every call may raise TrackingError.

    Args:
      uri: tracking URI.

    Attributes:
      run_id: id of the run in MLflow; empty before one is started or resumed.
      started_ms: start of the run in ms since the epoch.
    """

    def __init__(self, uri: str) -> None:
        self.uri = uri
        self.run_id = ""
        self.started_ms = 0

    @property
    def retry_timeout_s(self) -> float:
        """How long to retry a failed call: a server may come back, a local store will not."""
        return SERVER_TIMEOUT_S if self.uri.startswith(("http:", "https:")) else 0.0

    @abstractmethod
    def start(self, config: RunConfig) -> None:
        """Creates the run with the whole config as params."""

    @abstractmethod
    def resume(self, run_id: str) -> None:
        """Continues an existing run; its tag `attempts` counts the run's sessions.

        Raises:
          ConfigError: the store does not know it, or it is deleted.
        """

    @abstractmethod
    def is_finished(self, run_id: str) -> bool:
        """Whether the run's status in the store is FINISHED."""

    @abstractmethod
    def push(self, rows: list[Row]) -> None:
        """Logs journal rows; a row that is pushed twice is stored once."""

    @abstractmethod
    def log_results(self, metrics: dict[str, float], time_ms: int) -> None:
        """Logs the run's results at step 0, where the UI draws them as bars.

        Args:
          metrics: the results, without the prefix `final/`.
          time_ms: when they were measured; results that are logged twice with the same time are stored once.
        """

    @abstractmethod
    def log_artifact(self, path: Path) -> None:
        """Uploads a file or a folder to the run's artifacts."""

    @abstractmethod
    def attach(self, run_id: str, path: Path, place: str) -> None:
        """Uploads a file to the folder `place` of the artifacts of a run that has ended."""

    @abstractmethod
    def load_end(self) -> None:
        """Begins to load what `log_policy` needs, as far as that is done beside this process's work."""

    @abstractmethod
    def begin_policy(self, weights: WeightsSnapshot, config: RunConfig, shape: EnvShape) -> None:
        """Begins to log the policy that `log_policy` will log, as far as that is done beside this process's work."""

    @abstractmethod
    def log_policy(self, weights: WeightsSnapshot, config: RunConfig, shape: EnvShape, score: float) -> None:
        """Logs and registers the greedy policy's Q-network, a model that maps observations to action values.

        A policy that is logged twice is stored once.

        Args:
          weights: the policy's weights.
          config: the run's config.
          shape: shape of its environment.
          score: by which the registry ranks the policies of a setup.
        """

    @abstractmethod
    def end(self, status: str) -> None:
        """Ends the run with the status FINISHED, KILLED or FAILED."""
