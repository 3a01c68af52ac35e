"""Prefetching: the rows of the next call of updates are drawn while the learner makes those of this one."""

import threading

import pytest

from actors.replay.node import ShardNode, ShardSettings
from actors.rollout.worker import join_stats
from actors.service.fault_policy import CallFailed, ComponentFailed, Fault
from actors.service.messages import SCHEMA_VERSION, BlockHeader, TransitionBlock
from actors.service.rpc import Done, LocalCalls
from learner.update.learner_node import LearnerNode
from tests.checkpointing import saved
from tests.packed import pack

RATE = 1e-3
WAIT_S = 60.0


@pytest.fixture
def make_learner(learner_config, learner_shape, make_rows):
    """Function: a learner that prefetches from `num_shards` shards, and the shards."""

    def make(num_shards=1, calls=None):
        dtype = make_rows(0).dtype
        shards = [ShardNode(ShardSettings(dtype, 100, seed)) for seed in range(num_shards)]
        return LearnerNode(learner_config, learner_shape, shards, calls or LocalCalls(), prefetch=True), shards

    return make


def block(rows, sequence=0):
    header = BlockHeader(SCHEMA_VERSION, 0, 0, sequence, 0, 0.0, 0.0, len(rows))
    return TransitionBlock(header, pack(rows), join_stats([]))


def marked(make_rows, action):
    """Rows that are recognised by their action."""
    rows = make_rows(30)
    rows["action"] = action
    return rows


def note_what_is_learned(learner, monkeypatch, before=lambda: None):
    """A list that receives the actions of every call of updates; `before` is called when one begins."""
    learned, update = [], learner._learner.update

    def note(columns, *rest):
        before()
        learned.append(set(columns["action"].tolist()))
        return update(columns, *rest)

    monkeypatch.setattr(learner._learner, "update", note)
    return learned


def test_the_shards_draw_while_the_learner_computes(make_learner, make_rows, monkeypatch):
    learner, (shard,) = make_learner()
    drawn, sample = threading.Semaphore(0), shard.sample

    def note_sample(count):
        reply = sample(count)
        drawn.release()
        return reply

    monkeypatch.setattr(shard, "sample", note_sample)
    learner.add(block(marked(make_rows, 0)))
    calls = iter((2, 1, 1))  # the first call draws its own rows as well

    def wait_for_draws():
        assert all(drawn.acquire(timeout=WAIT_S) for _ in range(next(calls)))

    note_what_is_learned(learner, monkeypatch, wait_for_draws)
    for _ in range(3):
        learner.update(4, RATE)
    assert not drawn.acquire(blocking=False)


def test_rows_that_miss_a_prefetch_are_drawn_one_call_later(make_learner, make_rows, monkeypatch):
    learner, _ = make_learner()
    learned = note_what_is_learned(learner, monkeypatch)
    for sequence in range(3):
        learner.add(block(marked(make_rows, sequence), sequence))
        learner.update(16, RATE)
    assert learned == [{0}, {0}, {0, 1}]


def test_no_draw_runs_between_two_calls(make_learner, make_rows, monkeypatch):
    """A shard of this process must not be used by two threads at once."""
    learner, (shard,) = make_learner()
    learner.add(block(make_rows(30)))
    sample, computed, ended = shard.sample, threading.Event(), []

    def slow_sample(count):
        if threading.current_thread() is not threading.main_thread():
            assert computed.wait(WAIT_S)
        reply = sample(count)
        ended.append(count)
        return reply

    monkeypatch.setattr(shard, "sample", slow_sample)
    publish = learner.publish
    monkeypatch.setattr(learner, "publish", lambda: (publish(), computed.set()))
    learner.update(4, RATE)
    assert ended == [64, 64]


def test_a_call_of_another_length_draws_its_own_rows(make_learner, make_rows):
    learner, _ = make_learner()
    learner.add(block(make_rows(30)))
    learner.update(4, RATE)
    assert learner.update(3, RATE).version == 7


def test_a_restored_learner_learns_from_the_restored_rows_alone(make_learner, make_rows, monkeypatch, tmp_path):
    learner, _ = make_learner()
    learner.add(block(marked(make_rows, 0)))
    state = saved(learner, tmp_path)
    other, _ = make_learner()
    other.add(block(marked(make_rows, 1)))
    other.update(4, RATE)
    other.load(tmp_path, state)
    learned = note_what_is_learned(other, monkeypatch)
    other.update(4, RATE)
    assert learned == [{0}]


class LosingCalls(LocalCalls):
    """Loses the rows that the node `loses` draws, from the second draw on."""

    loses, drawn = None, 0

    def start(self, node, method, *args):
        if method.__name__ == "sample" and node is self.loses:
            self.drawn += 1
            if self.drawn > 1:
                return Done(self)
        return super().start(node, method, *args)

    def get(self, ref):
        if ref.value is self:
            raise CallFailed(Fault.DIED, "simulated")
        return super().get(ref)


@pytest.fixture
def losing(make_learner, make_rows):
    """A learner that has made one call of updates, during which the prefetch from one of its two shards failed."""
    calls = LosingCalls()
    learner, shards = make_learner(2, calls)
    for shard in shards:
        shard.add(block(make_rows(30)))
    calls.loses = shards[1]
    assert learner.update(4, RATE).version == 4
    return learner


def test_a_failed_prefetch_names_its_shard_before_another_update(losing):
    with pytest.raises(ComponentFailed) as failed:
        losing.update(4, RATE)
    assert failed.value.component.number == 1 and losing.weights().version == 4


def test_a_failed_prefetch_is_forgotten_once_its_shard_is_replaced(losing, make_learner):
    fresh = make_learner()[1][0]
    losing.replace_shard(1, fresh, 1)
    assert losing.update(4, RATE).version == 8
