"""The whole service under a run's engine, for benchmarks that watch its training loop."""

import math
import statistics
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from learner.cluster_options import ClusterOptions
from learner.config import RunConfig
from learner.engine import open_cluster
from learner.loop import Observer, TrainingLoop
from learner.tracking.journal import Journal
from tests.benchmarks.processes import cpu_seconds
from tests.checkpointing import Silent

ENDLESS: dict[str, Any] = dict.fromkeys(
    ("total_env_steps", "eval_every_env_steps", "checkpoint_every_env_steps"), 10**9
)
"""Settings of a run that only trains for as long as a benchmark looks at it."""
WARM_S = 3.0
"""From the first update to where a run counts as steady."""


@contextmanager
def whole_service(config: RunConfig) -> Iterator[Callable[[Observer, Callable[[], bool]], TrainingLoop]]:
    """Starts the parts of a run; what it gives makes the loop from an observer and a question whether to stop."""
    cluster = open_cluster(config, 0, ClusterOptions())
    try:
        with tempfile.TemporaryDirectory() as folder, closing(Journal(Path(folder) / "m.jsonl", 0)) as journal:
            checkpoints = Path(folder) / "checkpoints"
            yield lambda observer, stop: TrainingLoop(config, cluster, journal, checkpoints, observer, stop)
    finally:
        cluster.close()


class Point(NamedTuple):
    """What the service did: rates, CPU seconds per env step by process, and shares of waiting."""

    env_steps_per_s: float
    updates_per_s: float
    cpu_s: dict[str, float]
    waits: dict[str, float]


class Rows(Silent):
    """Keeps rows of metrics."""

    def __init__(self) -> None:
        self.rows: list[dict[str, float]] = []

    def row(self, row):
        self.rows.append(row.metrics)

    def mean(self, name: str) -> float:
        """Over the rows that have it; NaN where none has."""
        found = [metrics[name] for metrics in self.rows if name in metrics]
        return statistics.fmean(found) if found else math.nan


def measured_point(config: RunConfig, seconds: float) -> Point:
    """The service in its steady state, looked at for so many seconds."""
    marks: list[tuple[float, int, int, dict[str, float]]] = []
    observer = Rows()
    with whole_service(config) as make_loop:
        begun_s: list[float] = []

        def mark() -> None:
            marks.append((time.perf_counter(), loop.env_steps, loop.updates, cpu_seconds()))

        def stop() -> bool:
            now_s = time.perf_counter()
            if not begun_s and loop.updates:
                begun_s.append(now_s)
            elif begun_s and not marks and now_s - begun_s[0] > WARM_S:
                observer.rows.clear()
                mark()
            elif marks and now_s - marks[0][0] > seconds:
                mark()
                return True
            return False

        loop = make_loop(observer, stop)
        loop.run()
    (start_s, first, first_updates, before), (end_s, last, updates, after) = marks
    spent = {kind: (after[kind] - before.get(kind, 0.0)) / (last - first) for kind in after}
    waits = {name: observer.mean(f"time/{name}") for name in ("worker_stores", "worker_waits", "learner_waits")}
    return Point((last - first) / (end_s - start_s), (updates - first_updates) / (end_s - start_s), spent, waits)
