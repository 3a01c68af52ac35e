"""Recovery in one process: whatever fails, and whenever, the run finishes, learns, and its accounts balance."""

import dataclasses
import threading
from contextlib import closing

import numpy as np
import pytest

from actors.replay.node import ShardNode
from actors.rollout import node as rollout_node
from actors.rollout.node import RolloutNode
from actors.service.fault_policy import Action, ComponentKind, Fault, FaultTracker, RunFailed
from learner.checkpoints.checkpoint import newest_valid
from learner.checkpoints.writer import CheckpointWriter
from learner.loop import TrainingLoop
from learner.tracking.journal import Journal
from learner.training.cluster import ProcessCluster, rollout_settings
from learner.training.recovery import RunLost
from learner.update.learner_node import LearnerNode
from tests.learner.failing_calls import FailingCalls

KINDS = ("dies before", "dies after", "unreachable before", "unreachable after")


class Listener:
    def __init__(self):
        self.failures, self.recoveries, self.rows, self.checkpoints, self.unwritten = [], [], [], [], []

    def row(self, row):
        self.rows.append(row)

    def checkpoint(self, folder, journal_offset):
        self.checkpoints.append(folder)

    def checkpoint_failed(self, env_steps, reason):
        self.unwritten.append(reason)

    def failed(self, failure, decision):
        self.failures.append((failure, decision))

    def recovered(self, recovered):
        self.recoveries.append(recovered)


@pytest.fixture
def config(small_run):
    return dataclasses.replace(
        small_run,
        total_env_steps=3_000,
        workers=3,
        replay_shards=2,
        replay_placement="actors",
        samples_per_insert=2.0,
        updates_per_call=2,
        eval_every_env_steps=1_500,
        eval_episodes=2,
        log_every_env_steps=100,
        checkpoint_every_env_steps=1_000,
    )


@pytest.fixture
def run(monkeypatch, tmp_path):
    """Function: trains with a fault function; gives (loop, calls, listener, cluster).

    Training waits for its checkpoints, and is thus deterministic, unless it is `free_running`.
    """
    start = CheckpointWriter._start

    def start_and_wait(writer, *args):
        start(writer, *args)
        writer._thread.join()

    def train(config, fault, seed=0, free_running=False):
        if not free_running:
            monkeypatch.setattr(CheckpointWriter, "_start", start_and_wait)
        calls = FailingCalls(fault, seed)
        cluster = ProcessCluster(config, 0, calls)
        cluster.limits = cluster.limits._replace(collects_in_flight=2, blocks_in_flight=2 * config.workers)
        listener = Listener()
        with closing(Journal(tmp_path / "metrics.jsonl", 0)) as journal:
            loop = TrainingLoop(config, cluster, journal, tmp_path / "checkpoints", listener, bool, FaultTracker())
            assert loop.run()
        return loop, calls, listener, cluster

    return train


def at_random(seed, rate, kinds, nodes):
    """A fault function: a call of one of the node classes fails with probability `rate`.

    Calls of `saved` do not: their number depends on the speed of the disk.
    """
    rng = np.random.default_rng(seed)

    def fault(node, method):
        if not isinstance(node, nodes) or method == "saved" or rng.random() >= rate:
            return None
        return kinds[rng.integers(len(kinds))]

    return fault


def once(node_class, method, kind, number=3):
    """A fault function: the `number`th such call fails."""
    seen = iter(range(1_000_000))

    def fault(node, name):
        if isinstance(node, node_class) and name == method and next(seen) == number:
            return kind
        return None

    return fault


def assert_accounts(loop, listener, config):
    ledger, pacing = loop._progress.ledger, loop._progress.pacer.state
    assert ledger.produced == ledger.stored + sum(ledger.dropped.values())
    assert (pacing.inserted, pacing.sampled) == (ledger.stored, loop.updates * config.batch_size)
    for row in listener.rows:
        metrics = row.metrics
        if "account/produced" in metrics:
            assert metrics["account/produced"] == metrics["account/stored"] + metrics["account/dropped"]
    ahead = pacing.inserted * config.samples_per_insert - pacing.sampled - pacing.written_off
    lowest = config.min_replay * config.samples_per_insert
    call = config.batch_size * config.updates_per_call
    highest = lowest + 2 * call + 2 * config.workers * config.block_env_steps * config.samples_per_insert
    assert ahead <= highest + call  # the samples of failed updates are taken back


def test_a_run_without_faults_recovers_from_nothing(run, config):
    loop, calls, listener, cluster = run(config, lambda node, method: None)
    assert not listener.failures and calls.faults == 0
    assert sum(loop._progress.ledger.dropped.values()) == 0
    assert sum(shard.shard.get_state()["inserted"] for shard in cluster.targets) == loop._progress.ledger.stored
    assert_accounts(loop, listener, config)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("placement", ["actors", "learner"])
def test_workers_that_fail_at_random_lose_nothing_that_was_delivered(run, config, seed, placement):
    config = dataclasses.replace(config, replay_placement=placement)
    loop, calls, listener, cluster = run(config, at_random(seed, 0.08, KINDS, RolloutNode), seed)
    assert calls.faults >= 5
    assert_accounts(loop, listener, config)
    assert loop._progress.ledger.dropped["shard lost"] == 0
    shards = [node.shard for node in (cluster.targets if placement == "actors" else cluster.learner._shards)]
    assert sum(shard.get_state()["inserted"] for shard in shards) == loop._progress.ledger.stored
    assert loop.updates > 50


@pytest.mark.parametrize("seed", range(3))
def test_shards_that_fail_at_random_are_rebuilt_empty(run, config, seed):
    loop, calls, listener, cluster = run(config, at_random(seed, 0.04, KINDS, ShardNode), seed)
    assert calls.faults >= 5
    assert_accounts(loop, listener, config)
    assert loop._progress.ledger.dropped["worker lost"] == 0
    assert loop._progress.ledger.replay_size == sum(shard.size() for shard in cluster.targets)
    assert loop.updates > 50


@pytest.mark.parametrize("seed", range(3))
def test_everything_but_the_learner_fails_at_random(run, config, seed):
    loop, calls, listener, cluster = run(config, at_random(seed, 0.04, KINDS, (RolloutNode, ShardNode)), seed)
    kinds = {failure.component.kind for failure, _ in listener.failures}
    assert calls.faults >= 8 and kinds == {ComponentKind.WORKER, ComponentKind.SHARD}
    assert_accounts(loop, listener, config)
    assert loop._progress.ledger.replay_size == sum(shard.size() for shard in cluster.targets)
    assert loop.updates > 50


@pytest.mark.parametrize("kind", ["unreachable before", "unreachable after"])
def test_a_push_whose_reply_is_lost_is_stored_once(run, config, kind):
    loop, calls, listener, cluster = run(config, at_random(0, 0.1, (kind,), ShardNode))
    assert calls.faults >= 20
    assert_accounts(loop, listener, config)
    inserted = sum(shard.shard.get_state()["inserted"] for shard in cluster.targets)
    if not any(decision.action is Action.RESTART for _, decision in listener.failures):
        assert inserted == loop._progress.ledger.stored
    refused = sum(shard.shard.get_state()["dropped"] for shard in cluster.targets)
    assert (refused > 0) == (kind == "unreachable after")


def test_a_restarted_worker_has_a_new_incarnation_fresh_streams_and_the_current_weights(run, config, tmp_path):
    loop, _, listener, cluster = run(config, once(RolloutNode, "collect", "dies before", 40))
    ((failure, decision),) = listener.failures
    assert (failure.fault, decision.action) == (Fault.DIED, Action.RESTART)
    worker_id = failure.component.number
    incarnations = [worker._worker._incarnation for worker in cluster.workers]
    assert incarnations == [1 if i == worker_id else 0 for i in range(3)]
    assert cluster.workers[worker_id]._worker.policy_version > 0
    assert [recovered.component for recovered in listener.recoveries] == [failure.component]
    state = newest_valid(tmp_path / "checkpoints")[0].state
    assert state["incarnation"] == 1


def test_every_shard_refuses_the_old_incarnation_of_a_worker(run, config):
    loop, calls, listener, cluster = run(config, once(RolloutNode, "collect", "unreachable after", 10))
    ((failure, _),) = listener.failures
    stored = loop._progress.ledger.stored
    zombie = RolloutNode(rollout_settings(config), failure.component.number, 0, calls, cluster.targets, 0)
    zombie.set_weights(loop.newest_weights())
    zombie._worker._sequence = 1_000  # blocks that no shard has seen
    for _ in range(3):
        (report,) = zombie.collect(0.5)
        assert report.stored == 0 and report.dropped == "outdated"
    assert loop._progress.ledger.stored == stored


def test_a_lost_learner_ends_the_attempt(run, config):
    with pytest.raises(RunLost) as lost:
        run(config, once(LearnerNode, "update", "dies after", 5))
    assert lost.value.incarnation == 0 and "learner died" in str(lost.value)


def test_a_component_that_fails_again_and_again_ends_the_run_and_is_named(run, config):
    def fault(node, method):
        second = isinstance(node, RolloutNode) and node._worker._worker_id == 1
        return "dies before" if second and method == "collect" else None

    with pytest.raises(RunFailed, match="rollout worker 1 died .* 6 times in a row"):
        run(dataclasses.replace(config, total_env_steps=100_000), fault)


def test_the_only_shard_may_be_lost_repeatedly(run, config):
    config = dataclasses.replace(config, replay_shards=1)
    fault = at_random(1, 0.02, ("dies before",), ShardNode)
    loop, calls, listener, cluster = run(config, fault)
    assert len(listener.failures) >= 3
    assert_accounts(loop, listener, config)
    assert loop._progress.pacer.state.written_off > 0
    assert loop._progress.ledger.replay_size == cluster.targets[0].size()


def test_a_shard_lost_while_a_worker_is_being_replaced_is_replaced_first(run, config):
    faults = iter(["dies before"])

    def fault(node, method):
        if isinstance(node, RolloutNode) and method == "collect" and not calls_seen:
            calls_seen.append(node)
            return "dies before"
        if isinstance(node, ShardNode) and method == "fence":
            return next(faults, None)
        return None

    calls_seen = []
    loop, _, listener, _ = run(config, fault)
    assert [failure.component.kind for failure, _ in listener.failures] == [ComponentKind.WORKER, ComponentKind.SHARD]
    assert_accounts(loop, listener, config)


@pytest.mark.parametrize(
    ("node_class", "method"),
    [
        (RolloutNode, "save"),
        (ShardNode, "save"),
        (RolloutNode, "saved"),
        (ShardNode, "saved"),
        (RolloutNode, "settle"),
    ],
)
@pytest.mark.parametrize("kind", ["dies before", "dies after"])
def test_a_component_lost_during_a_checkpoint_does_not_corrupt_it(run, config, tmp_path, node_class, method, kind):
    loop, _, listener, _ = run(config, once(node_class, method, kind, 0))
    assert len(listener.failures) == 1
    assert len(listener.unwritten) == (0 if method == "settle" else 1)
    found, skipped = newest_valid(tmp_path / "checkpoints")
    assert not skipped and found.state["env_steps"] == loop.env_steps
    assert_accounts(loop, listener, config)


@pytest.mark.parametrize("method", ["save", "saved"])
def test_a_component_lost_during_the_last_checkpoint_causes_another_one(run, config, tmp_path, method):
    config = dataclasses.replace(config, checkpoint_every_env_steps=100_000)
    loop, _, listener, _ = run(config, once(RolloutNode, method, "dies before", 1))
    assert len(listener.failures) == len(listener.unwritten) == 1
    assert listener.checkpoints == [loop.saved] and loop.saved is not None
    assert newest_valid(tmp_path / "checkpoints")[0].state["env_steps"] == loop.env_steps
    assert_accounts(loop, listener, config)


def test_a_learner_lost_while_it_is_saved_ends_the_attempt_and_older_checkpoints_stay(run, config, tmp_path):
    seen = []

    def fault(node, method):
        if isinstance(node, LearnerNode) and method == "save":
            seen.append(node)
        return "dies before" if method == "saved" and len(seen) == 2 and isinstance(node, LearnerNode) else None

    with pytest.raises(RunLost, match="learner died"):
        run(config, fault)
    found, skipped = newest_valid(tmp_path / "checkpoints")
    assert 1_000 <= found.state["env_steps"] < 2_000 and not skipped


def test_late_writes_of_a_replaced_component_are_in_no_checkpoint(run, config, tmp_path, monkeypatch):
    """The first worker hangs while it writes, is replaced, and writes on once the checkpoint is complete."""
    go_on, stuck = threading.Event(), []

    def fault(node, method):
        if isinstance(node, RolloutNode) and method == "saved" and not stuck:
            stuck.append(node._writer)
            return "dies before"
        return None

    to_bytes = rollout_node.to_bytes
    writers = []

    def slow_save(arrays):
        writers.append(threading.current_thread())
        if len(writers) == 1:
            go_on.wait(60)
        return to_bytes(arrays)

    monkeypatch.setattr(rollout_node, "to_bytes", slow_save)
    config = dataclasses.replace(config, workers=1)
    loop, _, listener, _ = run(config, fault)
    go_on.set()
    writers[0].join(60)
    assert len(listener.failures) == 1 and len(listener.unwritten) == 1
    found, skipped = newest_valid(tmp_path / "checkpoints")
    assert not skipped and found.state["env_steps"] == loop.env_steps


@pytest.mark.parametrize("seed", range(3))
def test_components_fail_while_training_goes_on_and_checkpoints_are_written(run, config, tmp_path, seed):
    config = dataclasses.replace(config, checkpoint_every_env_steps=300)
    rng, asked = np.random.default_rng(seed), set()

    def fault(node, method):
        if method == "saved" and id(node) in asked:
            return None  # how often a node is asked depends on the speed of the disk
        if method == "saved":
            asked.add(id(node))
        elif method == "save":
            asked.discard(id(node))
        rate = 0.08 if method in ("save", "saved") else 0.01
        if not isinstance(node, RolloutNode | ShardNode) or rng.random() >= rate:
            return None
        return KINDS[rng.integers(len(KINDS))]

    loop, calls, listener, _ = run(config, fault, seed, free_running=True)
    assert calls.faults >= 5
    found, skipped = newest_valid(tmp_path / "checkpoints")
    assert not skipped and found.folder == loop.saved and found.state["env_steps"] == loop.env_steps
    assert_accounts(loop, listener, config)
