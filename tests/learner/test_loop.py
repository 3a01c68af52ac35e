"""The training loop ends where it should, however far its rollout workers run ahead."""

import dataclasses
from collections import Counter
from contextlib import closing

import pytest

from actors.rollout.node import RolloutNode
from learner.loop import TrainingLoop
from learner.tracking.journal import Journal
from learner.training.cluster import ProcessCluster, rollout_settings
from tests.checkpointing import Silent
from tests.learner.failing_calls import FailingCalls

PUSHES = 2


def run_ahead(config, calls=None):
    """A cluster in this process whose components may have two calls in flight, as over Ray."""
    cluster = ProcessCluster(config, 0, calls)
    cluster.workers = [
        RolloutNode(rollout_settings(config), i, 0, cluster.calls, cluster.targets, PUSHES)
        for i in range(config.workers)
    ]
    blocks = config.workers * (2 + PUSHES)
    cluster.limits = cluster.limits._replace(collects_in_flight=2, updates_in_flight=2, blocks_in_flight=blocks)
    return cluster


@pytest.mark.parametrize("workers", [1, 3])
@pytest.mark.parametrize("blocks", [1.5, 7.0, 20.1])
def test_no_round_of_blocks_is_ordered_past_the_end(small_run, tmp_path, workers, blocks):
    block = small_run.block_env_steps
    config = dataclasses.replace(small_run, workers=workers, total_env_steps=int(blocks * block), min_replay=block)
    with closing(Journal(tmp_path / "m.jsonl", 0)) as journal:
        loop = TrainingLoop(config, run_ahead(config), journal, tmp_path / "checkpoints", Silent(), bool)
        assert loop.run()
    assert config.total_env_steps <= loop.env_steps < config.total_env_steps + workers * block
    assert loop.saved is not None


@pytest.mark.parametrize("workers", [1, 3])
def test_a_checkpoint_waits_for_one_call_of_each_component(small_run, tmp_path, monkeypatch, workers):
    block = small_run.block_env_steps
    config = dataclasses.replace(
        small_run, workers=workers, total_env_steps=60 * block, checkpoint_every_env_steps=10 * block, min_replay=block
    )
    begun, rounds = [], []

    def note():
        rounds.append(most())
        if loop._checkpoints._writer._thread is not None:
            loop._checkpoints._writer._thread.join()  # so that no due checkpoint is held up by the one before

    def most():
        calls = Counter(call.component for call in loop._in_flight._calls.values())
        return max(calls.values(), default=0)

    with closing(Journal(tmp_path / "m.jsonl", 0)) as journal:
        cluster = run_ahead(config, FailingCalls(lambda node, method: None))
        loop = TrainingLoop(config, cluster, journal, tmp_path / "checkpoints", Silent(), note)
        begin = loop.begin_checkpoint
        monkeypatch.setattr(loop, "begin_checkpoint", lambda: (begun.append(most()), begin()))
        assert loop.run()
    assert max(rounds) == 2  # else nothing was held back
    assert len(begun) >= 5 and max(begun) == 1
