"""The training loop ends where it should, however far its rollout workers run ahead."""

import dataclasses
from collections import Counter
from contextlib import closing

import numpy as np
import pytest
from safetensors.numpy import load_file

from actors.rollout.node import RolloutNode
from actors.service.fault_policy import Diverged
from learner.checkpoints.checkpoint import newest_valid
from learner.loop import TrainingLoop
from learner.tracking.journal import Journal
from learner.training.cluster import ProcessCluster, rollout_settings
from learner.update.learner_node import WEIGHTS, LearnerNode
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


@pytest.mark.parametrize(("message_s", "replay"), [(0.0, "uniform"), (1e9, "uniform"), (1e9, "prioritised")])
def test_a_message_asks_for_the_updates_that_are_due_within_its_time(small_run, tmp_path, message_s, replay):
    """Where none fits, and with priorities, one call of updates; the first message cannot know how long one takes."""
    block, asked, failed = small_run.block_env_steps, [], []
    config = dataclasses.replace(
        small_run,
        total_env_steps=40 * block,
        min_replay=block,
        samples_per_insert=8.0,
        replay=replay,
        updates_per_call=2,
    )
    update = LearnerNode.update

    def note(node, updates, *more):
        asked.append(updates)
        return update(node, updates, *more)

    def tenth_fails(node, method):
        if method != "update" or len(asked) != 9 or failed:
            return None
        failed.append(method)
        return "unreachable before"

    with closing(Journal(tmp_path / "m.jsonl", 0)) as journal, pytest.MonkeyPatch.context() as patch:
        cluster = run_ahead(config, FailingCalls(tenth_fails))
        cluster.limits = cluster.limits._replace(message_s=message_s)
        loop = TrainingLoop(config, cluster, journal, tmp_path / "checkpoints", Silent(), bool)
        patch.setattr(LearnerNode, "update", note)
        note.__name__ = "update"
        patch.setattr(loop, "_recover", lambda failure: None)  # the samples that failed are drawn by others
        assert loop.run()
    assert failed and asked[0] == config.updates_per_call
    assert not any(updates % config.updates_per_call for updates in asked)
    assert (max(asked) > config.updates_per_call) == (message_s > 0 and replay == "uniform")
    assert loop.updates == sum(asked)
    assert loop._pacer.state.sampled == loop.updates * config.batch_size
    assert loop._pacer.ratio() == pytest.approx(8.0, rel=0.1)


def test_a_run_that_diverges_keeps_its_last_finite_checkpoint_and_names_it(small_run, tmp_path):
    """The learning rate is sane for two checkpoints, and then is not."""
    block = small_run.block_env_steps
    config = dataclasses.replace(
        small_run, total_env_steps=100 * block, checkpoint_every_env_steps=10 * block, min_replay=block
    )
    with closing(Journal(tmp_path / "m.jsonl", 0)) as journal:
        cluster = ProcessCluster(config, 0)
        loop = TrainingLoop(config, cluster, journal, tmp_path / "checkpoints", Silent(), bool)
        update = LearnerNode.update

        def step_too_far(node, updates, learning_rate, *more):
            return update(node, updates, learning_rate if loop.env_steps < 25 * block else 1e30, *more)

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(LearnerNode, "update", step_too_far)
            step_too_far.__name__ = "update"
            with pytest.raises(Diverged, match="the training has diverged: .* updates, at env step") as caught:
                loop.run()
    checkpoint, skipped = newest_valid(tmp_path / "checkpoints")
    assert not skipped and f"the last checkpoint, {checkpoint.folder}, has finite numbers" in str(caught.value)
    assert 10 * block <= checkpoint.state["env_steps"] <= 30 * block
    assert f"at env step {loop.env_steps:,};" in str(caught.value)
    tensors = load_file(checkpoint.folder / WEIGHTS)
    assert tensors and all(np.isfinite(tensor).all() for tensor in tensors.values())


def test_a_run_that_diverges_at_once_says_that_it_has_no_checkpoint(small_run, tmp_path):
    config = dataclasses.replace(small_run, learning_rate=1e30, learning_rate_end=1e30)
    with closing(Journal(tmp_path / "m.jsonl", 0)) as journal:
        loop = TrainingLoop(config, ProcessCluster(config, 0), journal, tmp_path / "checkpoints", Silent(), bool)
        with pytest.raises(Diverged, match="no checkpoint has finite numbers"):
            loop.run()
