"""The whole service over Ray, for benchmarks that watch its training loop."""

import tempfile
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path

from learner.config import RunConfig
from learner.journal import Journal
from learner.loop import Observer, TrainingLoop
from learner.place import Place
from learner.ray_edge import ray_cluster


@contextmanager
def ray_service(config: RunConfig) -> Iterator[Callable[[Observer, Callable[[], bool]], TrainingLoop]]:
    """Starts the parts of a run; what it gives makes the loop from an observer and a question whether to stop."""
    cluster = ray_cluster(config, 0, Place())
    try:
        with tempfile.TemporaryDirectory() as folder, closing(Journal(Path(folder) / "m.jsonl", 0)) as journal:
            checkpoints = Path(folder) / "checkpoints"
            yield lambda observer, stop: TrainingLoop(config, cluster, journal, checkpoints, observer, stop)
    finally:
        cluster.close()
