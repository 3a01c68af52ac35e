"""Rows of a run as Ray metrics, which each machine of a cluster exports to Prometheus; `metric_names` explains them."""

from __future__ import annotations

import math

from ray.util.metrics import Counter, Gauge

from learner.tracking.journal import Row
from learner.tracking.metric_names import ENV_STEPS, METRICS, MetricSpec

RUN = "run"
"""The label that distinguishes runs."""


class RayMetrics:
    """Exports the newest values of a run; this process must have joined a Ray cluster.

    Args:
      run: name of the run, a label of every metric.
    """

    def __init__(self, run: str) -> None:
        self._labels = {RUN: run}
        self._gauges = {known.journal: _made(Gauge, known) for known in METRICS if known.kind == "gauge"}
        self._counters = {known.journal: _made(Counter, known) for known in METRICS if known.kind == "counter"}
        self._counted = dict.fromkeys(self._counters, 0.0)
        self._newest: dict[str, float] = {}

    def row(self, row: Row) -> None:
        """Exports a row and the newest values of earlier rows: Ray drops a gauge that misses two of its reports."""
        self._newest |= row.metrics | {ENV_STEPS: row.env_steps}
        for name, gauge in self._gauges.items():
            value = self._newest.get(name, math.nan)
            if math.isfinite(value):
                gauge.set(value, tags=self._labels)
        for name, counter in self._counters.items():
            more = self._newest.get(name, 0.0) - self._counted[name]  # an evaluation's row is of an earlier env step
            if more > 0:
                counter.inc(more, tags=self._labels)
                self._counted[name] += more


def _made(kind: type[Counter] | type[Gauge], known: MetricSpec) -> Counter | Gauge:
    return kind(known.name, f"{known.unit}: {known.meaning}", (RUN,))
