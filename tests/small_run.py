"""A run of a few seconds in one process, its other options, and its training; needs no package that tests add."""

from contextlib import closing
from pathlib import Path

from learner.checkpoints.checkpoint import newest_valid
from learner.config import RunConfig
from learner.loop import TrainingLoop
from learner.tracking.journal import Journal
from learner.training.cluster import ProcessCluster
from sim_core.config import WorldConfig
from tests.checkpointing import Silent

SMALL = RunConfig(
    world=WorldConfig(robots=3, groups=2, horizon_steps=60),
    engine="process",
    total_env_steps=6_000,
    envs_per_worker=8,
    steps_per_block=16,
    min_replay=512,
    replay_capacity=4_000,
    samples_per_insert=4.0,
    batch_size=32,
    updates_per_call=4,
    hidden_sizes=(16,),
    n_step=2,
    target_update_interval=20,
    epsilon_decay_env_steps=2_000,
    learning_rate_decay_env_steps=5_000,
    eval_every_env_steps=2_000,
    eval_episodes=6,
    final_eval_episodes=8,
    log_every_env_steps=1_000,
    checkpoint_every_env_steps=2_000,
)
OPTIONS = {
    "replay": "prioritised",
    "importance_exponent_env_steps": 5_000,
    "network": "dueling",
    "loss": "mse",
    "target_update": "soft",
    "learning_rate_schedule": "cosine",
    "random_turns": True,
    "teacher": "greedy",
}


def train(config, folder: Path, observer=None) -> None:
    """Trains to the end, from the newest checkpoint in the folder if there is one."""
    saved = newest_valid(folder / "checkpoints")[0] if (folder / "checkpoints").exists() else None
    cluster = ProcessCluster(config, saved.state["incarnation"] + 1 if saved else 0)
    with closing(Journal(folder / "metrics.jsonl", saved.state["journal_offset"] if saved else 0)) as journal:
        loop = TrainingLoop(config, cluster, journal, folder / "checkpoints", observer or Silent(), bool)
        if saved:
            loop.restore(saved)
        assert loop.run()
