"""Compiles the kernels that most tests need, so that each of pytest's processes finds them in the cache.

It needs none of the packages that tests add, so that it runs while those are being installed.

python -m tests.precompile
"""

import dataclasses
import tempfile
from contextlib import closing
from pathlib import Path

from learner.config import RunConfig
from learner.loop import TrainingLoop
from learner.tracking.journal import Journal
from learner.training.cluster import ProcessCluster
from sim_core.config import WorldConfig
from tests.checkpointing import Silent

SHORT = RunConfig(
    world=WorldConfig(robots=3, groups=2, horizon_steps=60),
    engine="process",
    total_env_steps=3_000,
    envs_per_worker=8,
    steps_per_block=16,
    min_replay=512,
    replay_capacity=4_000,
    batch_size=32,
    hidden_sizes=(16,),
    eval_every_env_steps=2_000,
    eval_episodes=4,
    log_every_env_steps=1_000,
    checkpoint_every_env_steps=2_000,
)
OTHERWISE = {"replay": "prioritised", "network": "dueling", "loss": "mse", "random_turns": True, "teacher": "greedy"}


def main() -> None:
    """Trains a short run of every method, with plain and with prioritised replay, and one of another environment."""
    for method in ("sensor", "in", "out"):
        config = dataclasses.replace(SHORT, world=dataclasses.replace(SHORT.world, method=method))
        train(config)
        train(dataclasses.replace(config, **OTHERWISE))
    train(dataclasses.replace(SHORT, env_id="CartPole-v1"))


def train(config: RunConfig) -> None:
    with tempfile.TemporaryDirectory() as name, closing(Journal(Path(name, "metrics.jsonl"), 0)) as journal:
        assert TrainingLoop(config, ProcessCluster(config, 0), journal, Path(name, "checkpoints"), Silent(), bool).run()


if __name__ == "__main__":
    main()
