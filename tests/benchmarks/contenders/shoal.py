"""Ours, over Ray."""

import dataclasses
import tempfile
from contextlib import closing
from pathlib import Path

from learner.journal import Journal
from learner.loop import TrainingLoop
from learner.place import Place
from learner.ray_edge import ray_cluster
from tests.benchmarks.contest import Finding, Heat, Lap, compete
from tests.checkpointing import Silent


class Watcher(Silent):
    """Tells the lap of the service's own evaluations, which go on beside the training and count in its time."""

    def __init__(self, lap: Lap, score: str) -> None:
        self.lap = lap
        self.score = score

    def row(self, row):
        if self.score in row.metrics:
            self.lap.judged(row.metrics[self.score])


def train(heat: Heat) -> Finding:
    config = dataclasses.replace(heat.config, envs_per_worker=heat.envs)
    if heat.threshold is None:
        config = dataclasses.replace(config, eval_every_env_steps=10**9)
    cluster = ray_cluster(config, 0, Place())
    try:
        with tempfile.TemporaryDirectory() as folder, closing(Journal(Path(folder) / "m.jsonl", 0)) as journal:
            lap = Lap(heat)
            watcher = Watcher(lap, "eval/success_rate" if config.env.is_swarm else "eval/return")

            def stop() -> bool:
                return lap.over(loop.env_steps, loop.updates)

            loop = TrainingLoop(config, cluster, journal, Path(folder) / "checkpoints", watcher, stop)
            loop.run()
            return lap.finding()
    finally:
        cluster.close()


if __name__ == "__main__":
    compete(train)
