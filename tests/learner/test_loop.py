"""The training loop ends where it was told to, however far ahead its rollout workers go."""

import dataclasses
from contextlib import closing

import pytest

from actors.rollout_node import RolloutNode
from learner.cluster import process_cluster, rollout_settings
from learner.journal import Journal
from learner.loop import TrainingLoop
from tests.checkpointing import Silent

PUSHES = 2


@pytest.mark.parametrize("workers", [1, 3])
@pytest.mark.parametrize("blocks", [1.5, 7.0, 20.1])
def test_no_round_of_blocks_is_ordered_past_the_end(small_run, tmp_path, workers, blocks):
    block = small_run.block_env_steps
    config = dataclasses.replace(small_run, workers=workers, total_env_steps=int(blocks * block), min_replay=block)
    cluster = process_cluster(config, 0)
    nodes = [
        RolloutNode(rollout_settings(config), i, 0, cluster.calls, cluster.targets, PUSHES) for i in range(workers)
    ]
    cluster = cluster._replace(workers=nodes, collects_in_flight=2, blocks_in_flight=workers * (2 + PUSHES))
    with closing(Journal(tmp_path / "m.jsonl", 0)) as journal:
        loop = TrainingLoop(config, cluster, journal, tmp_path / "checkpoints", Silent(), bool)
        assert loop.run()
    assert config.total_env_steps <= loop.env_steps < config.total_env_steps + workers * block
    assert loop.saved is not None
