"""The nodes of rollout workers and shards: pushes, replies, reports and state."""

import numpy as np
import pytest

from actors.replay.node import ShardNode, ShardSettings
from actors.rollout import node as rollout_node
from actors.rollout.node import RolloutNode
from actors.rollout.vector_env import env_shape
from actors.rollout.worker import RolloutSettings, RolloutWorker
from actors.service.fault_policy import CallFailed, Fault
from actors.service.messages import Delivered, Dropped, transition_dtype
from actors.service.rpc import LocalCalls
from actors.service.stopwatch import Stopwatch
from tests.checkpointing import saved
from tests.packed import as_rows, unpack

NUM_ENVS, STEPS = 2, 8
BLOCK = NUM_ENVS * STEPS


class Later:
    """A call that runs when its result is asked for."""

    def __init__(self, node, method, args):
        self.call, self.value, self.done = (node, method, args), None, False


class DeferredCalls(LocalCalls):
    """Calls that run when their results are asked for, as if in another, busy process."""

    def start(self, node, method, *args):
        return Later(node, method.__name__, args)

    def get(self, ref):
        if not ref.done:
            node, method, args = ref.call
            ref.value, ref.done = getattr(node, method)(*args), True
        return ref.value


@pytest.fixture
def make_shard(swarm):
    return lambda: ShardNode(ShardSettings(transition_dtype(env_shape(swarm).observation_space), 1000, 0))


@pytest.fixture
def settings(swarm):
    return RolloutSettings(swarm, NUM_ENVS, STEPS, 1, 0.9, 7)


@pytest.fixture
def make_node(swarm, settings, make_weights):
    """Function: a rollout node with weights of version 10."""

    def make(shards, calls=None, pushes_in_flight=0, worker_id=0):
        node = RolloutNode(settings, worker_id, 0, calls or LocalCalls(), shards, pushes_in_flight)
        node.set_weights(make_weights(swarm, version=10, time_s=100.0))
        return node

    return make


def test_blocks_go_to_the_shards_in_turn(make_node, make_shard):
    shards = [make_shard() for _ in range(3)]
    node = make_node(shards, worker_id=4)
    sizes = []
    for _ in range(4):
        assert [report.stored for report in node.collect(0.5)] == [BLOCK]
        sizes.append([shard.size() // BLOCK for shard in shards])
    assert sizes == [[0, 1, 0], [0, 1, 1], [1, 1, 1], [1, 2, 1]]


def test_all_of_a_workers_time_is_attributed(make_node, make_shard, monkeypatch):
    now = [100.0]
    monkeypatch.setattr(rollout_node, "Stopwatch", lambda: Stopwatch(lambda: now[0]))

    class SlowCalls(DeferredCalls):
        def get(self, ref):
            now[0] += 0 if ref.done else 4.0
            return super().get(ref)

    node = make_node([make_shard()], SlowCalls(), pushes_in_flight=1)
    steps = node._worker.collect

    def slow_steps(rate):
        now[0] += 1.0
        return steps(rate)

    monkeypatch.setattr(node._worker, "collect", slow_steps)
    assert node.collect(0.5) == []
    now[0] += 16.0
    (report,) = node.collect(0.5)
    assert report.seconds == {"acts": 2.0, "waits": 16.0, "stores": 4.0}
    now[0] += 32.0
    node.settle()
    now[0] += 64.0
    assert node.collect(0.5) == []
    (report,) = node.collect(0.5)
    assert report.seconds == {"acts": 2.0, "waits": 96.0, "stores": 8.0}


def test_the_shard_stores_what_the_worker_collected(make_node, make_shard, settings, swarm, make_weights):
    shard, twin = make_shard(), RolloutWorker(settings, 0, 0)
    twin.set_weights(make_weights(swarm, version=10, time_s=100.0))
    report = make_node([shard]).collect(0.5)[0]
    block = twin.collect(0.5)
    assert report.header == block.header
    drawn = as_rows(shard.sample(500).columns)
    assert {row.tobytes() for row in drawn} == {row.tobytes() for row in unpack(block.packed, drawn.dtype)}


def test_newer_weights_arrive_with_the_reply(make_node, make_shard, swarm, make_weights):
    shard = make_shard()
    node = make_node([shard])
    shard.publish(make_weights(swarm, seed=1, version=13, time_s=200.0))
    first, second = node.collect(0.0)[0], node.collect(0.0)[0]
    assert (first.header.policy_version, first.staleness_updates) == (10, 3)
    assert (second.header.policy_version, second.header.policy_time_s, second.staleness_updates) == (13, 200.0, 0)


@pytest.mark.parametrize("version", [-1, 9, 10])
def test_weights_that_are_not_newer_do_not_travel(make_node, make_shard, swarm, make_weights, version):
    shard = make_shard()
    node = make_node([shard])
    if version >= 0:
        shard.publish(make_weights(swarm, seed=1, version=version))
    reports = [node.collect(0.0)[0] for _ in range(2)]
    assert [report.header.policy_version for report in reports] == [10, 10]
    assert [report.staleness_updates for report in reports] == [0, 0]


def test_a_late_reply_does_not_bring_older_weights_back(make_node, make_shard, swarm, make_weights):
    shards, calls = [make_shard(), make_shard()], DeferredCalls()
    node = make_node(shards, calls, pushes_in_flight=2)
    for shard, version in zip(shards, (15, 12), strict=True):
        shard.publish(make_weights(swarm, version=version))
    assert node.collect(0.0) == node.collect(0.0) == []
    assert [report.staleness_updates for report in node.settle()] == [5, 2]
    node.collect(0.0)
    assert node.settle()[0].header.policy_version == 15


def test_staleness_in_seconds_is_measured_from_publication(monkeypatch, make_node, make_shard):
    monkeypatch.setattr("actors.rollout.node.time.time", lambda: 142.5)
    assert make_node([make_shard()]).collect(0.0)[0].staleness_s == pytest.approx(42.5)


@pytest.mark.parametrize("limit", [0, 1, 3])
def test_a_block_is_reported_once_it_is_stored(make_node, make_shard, limit):
    shard = make_shard()
    node = make_node([shard], DeferredCalls(), pushes_in_flight=limit)
    reported = []
    for i in range(6):
        reports = node.collect(0.5)
        assert len(reports) == (1 if i >= limit else 0)
        reported += reports
        assert shard.size() == BLOCK * len(reported)
    settled = node.settle()
    assert len(settled) == limit and node.settle() == []
    assert [report.header.sequence for report in reported + settled] == list(range(6))
    assert shard.size() == 6 * BLOCK


def test_a_duplicate_is_reported_as_nothing_stored(make_node, make_shard):
    shard = make_shard()
    assert make_node([shard]).collect(0.5)[0].stored == BLOCK
    assert make_node([shard]).collect(0.5)[0].stored == 0
    assert shard.size() == BLOCK


def test_an_error_of_a_push_is_raised(make_node, make_shard, cart_pole):
    other = ShardNode(ShardSettings(transition_dtype(env_shape(cart_pole).observation_space), 1000, 0))
    with pytest.raises(ValueError, match="schema"):
        make_node([other]).collect(0.5)


def test_a_restored_node_goes_on_where_it_was(tmp_path, make_node, make_shard):
    shards = [make_shard(), make_shard()]
    node = make_node(shards)
    node.collect(0.5)
    state = saved(node, tmp_path / "worker.safetensors")
    expected = [node.collect(0.5)[0] for _ in range(2)]
    again = [make_shard(), make_shard()]
    resumed = make_node(again)
    resumed.load(tmp_path / "worker.safetensors", state)
    for report in expected:
        other = resumed.collect(0.5)[0]
        made = report.header.made - BLOCK  # counted from the start of the incarnation
        assert other.header == report.header._replace(made=made)
        for first, second in zip(other.episodes, report.episodes, strict=True):
            np.testing.assert_array_equal(first, second)
    assert [shard.size() // BLOCK for shard in again] == [1, 1]


def test_nothing_is_saved_while_pushes_are_in_flight(tmp_path, make_node, make_shard):
    node = make_node([make_shard()], DeferredCalls(), pushes_in_flight=1)
    node.collect(0.5)
    with pytest.raises(RuntimeError, match="settle"):
        node.save(tmp_path / "worker.safetensors")
    node.settle()
    saved(node, tmp_path / "worker.safetensors")


def test_damaged_files_are_refused(tmp_path, make_node, make_shard):
    node, path = make_node([make_shard()]), tmp_path / "worker.safetensors"
    state = saved(node, path)
    path.write_bytes(path.read_bytes()[:-9])
    for damaged in (path, tmp_path / "missing.safetensors"):
        with pytest.raises(ValueError, match="cannot be read"):
            node.load(damaged, state)


class Unreliable(LocalCalls):
    """Calls of which the first ones fail as given: (fault, whether the call was made nevertheless)."""

    def __init__(self, *faults):
        self.faults = list(faults)

    def start(self, node, method, *args):
        fault, made = self.faults.pop(0) if method.__name__ == "add" and self.faults else (None, True)
        result = super().start(node, method, *args) if made else None
        return (fault, result)

    def get(self, ref):
        fault, result = ref
        if fault is not None:
            raise CallFailed(fault, "simulated")
        return result.value


@pytest.mark.parametrize("made", [True, False])
@pytest.mark.parametrize("times", [1, 2])
def test_a_retried_push_is_stored_and_reported_once(make_node, make_shard, made, times):
    shard = make_shard()
    node = make_node([shard], Unreliable(*[(Fault.UNREACHABLE, made)] * times))
    (report,) = node.collect(0.5)
    assert (report.stored, report.rows, report.dropped, report.fault) == (BLOCK, BLOCK, None, None)
    assert (shard.size(), shard.shard.get_state()["dropped"]) == (BLOCK, times * BLOCK * made)


@pytest.mark.parametrize("fault", [Fault.DIED, Fault.LATE])
def test_a_block_whose_shard_is_gone_is_dropped_and_its_report_names_the_shard(make_node, make_shard, fault):
    shards = [make_shard(), make_shard()]
    node = make_node(shards, Unreliable((fault, False)))
    (report,) = node.collect(0.5)
    assert (report.stored, report.rows, report.dropped, report.fault) == (0, BLOCK, Dropped.SHARD_LOST, fault)
    assert (report.shard, report.shard_incarnation) == (0, 0)
    node.replace_shard(0, make_shard(), 7)
    reports = [node.collect(0.5)[0] for _ in range(2)]
    assert [(report.stored, *report[6:8]) for report in reports] == [(BLOCK, 1, 0), (BLOCK, 0, 7)]
    assert [report.header.made for report in reports] == [2 * BLOCK, 3 * BLOCK]


def test_a_shard_that_stays_unreachable_is_given_up(make_node, make_shard):
    node = make_node([make_shard()], Unreliable(*[(Fault.UNREACHABLE, False)] * 9))
    (report,) = node.collect(0.5)
    assert (report.dropped, report.fault) == (Dropped.SHARD_LOST, Fault.UNREACHABLE)


def test_a_block_that_a_later_one_overtook_is_dropped_as_outdated(make_node, make_shard, settings, swarm, make_weights):
    shard, worker = make_shard(), RolloutWorker(settings, 0, 0)
    worker.set_weights(make_weights(swarm))
    first, second = worker.collect(0.5), worker.collect(0.5)
    assert not shard.add(second).duplicate
    assert shard.add(second)[:2] == (0, True) and not shard.add(second).outdated
    assert shard.add(first).outdated and shard.size() == BLOCK


def test_a_fenced_worker_is_refused_and_its_deliveries_are_returned(make_shard, settings, swarm, make_weights):
    shard, workers = make_shard(), [RolloutWorker(settings, 0, incarnation) for incarnation in (0, 3)]
    for worker in workers:
        worker.set_weights(make_weights(swarm))
    blocks = [workers[0].collect(0.5) for _ in range(3)]
    for block in blocks[:2]:
        shard.add(block)
    episodes = sum(len(block.episodes.outcome) for block in blocks[:2])
    for _ in range(2):  # fencing twice changes nothing
        assert shard.fence(0, 0, 3) == (2 * BLOCK, 2 * BLOCK, episodes, 2 * BLOCK)
    assert shard.add(blocks[2]).outdated and shard.size() == 2 * BLOCK
    assert shard.fence(0, 3, 4) == Delivered()
    assert shard.add(workers[1].collect(0.5)).outdated, "fenced before it delivered anything"
    assert shard.fence(1, 0, 1) == Delivered(), "another worker"


def test_a_worker_without_weights_fails(settings, make_shard):
    with pytest.raises(CallFailed, match="no weights"):
        RolloutNode(settings, 0, 0, LocalCalls(), [make_shard()], 0).collect(0.5)
