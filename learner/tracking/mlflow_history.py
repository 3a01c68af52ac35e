"""Reads a run's metrics back from MLflow, to compare them with the journal."""

from __future__ import annotations

from typing import NamedTuple

from learner.run_folder import RunIdentity
from learner.tracking.mlflow_run import mlflow_client


class MetricValue(NamedTuple):
    """One value of a metric; `time_ms` is in ms since the epoch."""

    time_ms: int
    env_steps: int
    value: float


class MlflowHistory:
    """Reads a run in MLflow.

    Args:
      identity: the run.
    """

    def __init__(self, identity: RunIdentity) -> None:
        self._client = mlflow_client(identity.tracking_uri)
        self._run_id = identity.mlflow_run_id

    def status(self) -> str:
        """MLflow's status of the run, such as FINISHED."""
        return str(self._client.get_run(self._run_id).info.status)

    def newest(self) -> dict[str, float]:
        """The newest value of every metric."""
        return dict(self._client.get_run(self._run_id).data.metrics)

    def metric(self, key: str) -> list[MetricValue]:
        """All values of one metric."""
        history = self._client.get_metric_history(self._run_id, key)
        return [MetricValue(metric.timestamp, metric.step, metric.value) for metric in history]
