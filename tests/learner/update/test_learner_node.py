"""The node of the learner: sampling over shards, publication, state; and the contract of whatever workers push to."""

import dataclasses
import json

import numpy as np
import pytest
from scipy import stats

from actors.policy.policy import Policy, WeightsSnapshot
from actors.replay.node import ShardNode, ShardSettings
from actors.replay.prioritised import PRIORITY_EPSILON, PrioritySettings
from actors.rollout.vector_env import env_shape
from actors.rollout.worker import join_stats
from actors.service.fault_policy import Diverged
from actors.service.messages import SCHEMA_VERSION, BlockHeader, TransitionBlock, transition_dtype
from actors.service.rpc import Done, LocalCalls
from actors.service.stopwatch import Stopwatch
from learner.config import RunConfig
from learner.update import learner_node as node_module
from learner.update.importance import importance_weights
from learner.update.learner import Learner
from learner.update.learner_node import LearnerNode
from sim_core.config import WorldConfig
from tests.checkpointing import saved
from tests.packed import as_rows, pack

RATE = 1e-3


def make_block(rows, sequence=0, worker_id=0, incarnation=0, version=0, schema=SCHEMA_VERSION):
    header = BlockHeader(schema, worker_id, incarnation, sequence, version, 0.0, 0.0, len(rows))
    return TransitionBlock(header, pack(rows), join_stats([]))


@pytest.fixture
def make_learner(learner_config, learner_shape, make_rows):
    """Function: a learner with embedded shards; also gives the shards."""

    def make(num_shards=1, capacity=50, priorities=None, calls=None, **other):
        settings = [ShardSettings(make_rows(0).dtype, capacity, seed, priorities) for seed in range(num_shards)]
        shards = [ShardNode(setting) for setting in settings]
        config = dataclasses.replace(learner_config, **other)
        return LearnerNode(config, learner_shape, shards, calls or LocalCalls()), shards

    return make


def test_all_of_the_learners_time_is_attributed(make_learner, make_rows, monkeypatch):
    now = [100.0]
    monkeypatch.setattr(node_module, "Stopwatch", lambda: Stopwatch(lambda: now[0]))
    learner, shards = make_learner()

    def lasts(owner, method, seconds):
        """Makes every call of this method take that many seconds."""
        before = getattr(owner, method)

        def call(*args):
            now[0] += seconds
            return before(*args)

        monkeypatch.setattr(owner, method, call)

    for owner, method, seconds in (
        (shards[0], "add", 1.0),
        (shards[0], "sample", 2.0),
        (learner._learner, "update", 4.0),
        (shards[0], "publish", 8.0),
    ):
        lasts(owner, method, seconds)
    learner.add(make_block(make_rows(30)))
    now[0] += 16.0
    first = learner.update(1, RATE).seconds
    now[0] += 32.0
    learner.add(make_block(make_rows(30), sequence=1))
    now[0] += 64.0
    second = learner.update(1, RATE).seconds
    once = {"samples": 2.0, "updates": 4.0, "publishes": 8.0, "stores": 1.0}
    assert first == once | {"waits": 16.0}
    assert second == once | {"waits": 96.0}


class ShardContract:
    """What a rollout worker may expect of any push target."""

    @pytest.fixture
    def target(self, make_learner):
        """(node with `add`, its only shard, function that publishes a version)."""
        raise NotImplementedError

    def test_stores_a_block(self, target, make_rows):
        node, shard, _ = target
        reply = node.add(make_block(make_rows(30)))
        assert (reply.stored, reply.duplicate, shard.size()) == (30, False, 30)

    def test_stores_a_block_once(self, target, make_rows):
        node, shard, _ = target
        node.add(make_block(make_rows(30), sequence=3, incarnation=1))
        for sequence, incarnation in ((3, 1), (2, 1), (9, 0)):
            reply = node.add(make_block(make_rows(30), sequence, incarnation=incarnation))
            assert (reply.stored, reply.duplicate, shard.size()) == (0, True, 30)

    def test_holds_no_more_than_its_capacity(self, target, make_rows):
        node, shard, _ = target
        for sequence in range(3):
            assert node.add(make_block(make_rows(30, seed=sequence), sequence)).stored == 30
        assert shard.size() == 50
        newest = np.concatenate([make_rows(30, seed=sequence) for sequence in range(3)])[-50:]
        assert {row.tobytes() for row in as_rows(shard.sample(2000).columns)} == {row.tobytes() for row in newest}

    def test_refuses_another_schema(self, target, make_rows):
        node, shard, _ = target
        with pytest.raises(ValueError, match="schema"):
            node.add(make_block(make_rows(3), schema=SCHEMA_VERSION + 1))
        assert shard.size() == 0

    def test_the_reply_carries_newer_weights_only(self, target, make_rows):
        node, _, publish = target
        publish()
        publish()
        replies = [node.add(make_block(make_rows(3), version, version=version)) for version in range(4)]
        assert [reply.weights_version for reply in replies] == [2] * 4
        assert [reply.weights is None for reply in replies] == [False, False, True, True]
        weights = replies[0].weights
        assert isinstance(weights, WeightsSnapshot) and weights.version == 2


class TestShardAsANode(ShardContract):
    priorities = None

    @pytest.fixture
    def target(self, make_rows):
        node, versions = ShardNode(ShardSettings(make_rows(0).dtype, 50, 0, self.priorities)), iter((1, 2))

        def publish():
            version = next(versions)
            node.publish(WeightsSnapshot(version, 0.0, ()))

        return node, node, publish


class TestPrioritisedShardAsANode(TestShardAsANode):
    priorities = PrioritySettings(0.6, 16)


class TestShardEmbeddedInTheLearner(ShardContract):
    priorities = None

    @pytest.fixture
    def target(self, make_learner, make_rows):
        learner, (shard,) = make_learner(priorities=self.priorities)

        def publish():
            learner._learner.update(make_rows(16), RATE)
            learner.publish()

        return learner, shard, publish


class TestPrioritisedShardEmbeddedInTheLearner(TestShardEmbeddedInTheLearner):
    priorities = PrioritySettings(0.6, 16)


def test_embedded_shards_take_blocks_in_turn(make_learner, make_rows):
    learner, shards = make_learner(3)
    for sequence in range(5):
        learner.add(make_block(make_rows(4), sequence))
    assert [shard.size() for shard in shards] == [8, 8, 4]


def test_an_update_learns_publishes_and_reports(make_learner, make_rows):
    learner, (shard,) = make_learner()
    learner.add(make_block(make_rows(40)))
    before = learner.weights()
    report = learner.update(3, RATE)
    after = learner.weights()
    assert (before.version, report.version, after.version) == (0, 3, 3)
    assert after.time_s >= before.time_s
    assert any(not np.array_equal(a, b) for a, b in zip(before.arrays, after.arrays, strict=True))
    assert shard.add(make_block(make_rows(1), 1)).weights is after


@pytest.mark.parametrize("sizes", [(50, 50), (40, 10), (10, 30, 20)])
def test_rows_of_all_shards_are_drawn_equally_often(make_learner, make_rows, sizes):
    learner, shards = make_learner(len(sizes))
    for number, (shard, size) in enumerate(zip(shards, sizes, strict=True)):
        rows = make_rows(size)
        rows["action"] = 1000 * number + np.arange(size)
        shard.add(make_block(rows))
    drawn = np.concatenate([learner._sample(900).columns["action"] for _ in range(20)])
    counts = [np.bincount(drawn[drawn // 1000 == i] % 1000, minlength=size) for i, size in enumerate(sizes)]
    assert stats.chisquare(np.concatenate(counts)).pvalue > 1e-4


def test_every_minibatch_mixes_the_shards(make_learner, make_rows):
    learner, shards = make_learner(2)
    for number, shard in enumerate(shards):
        rows = make_rows(50)
        rows["action"] = number
        shard.add(make_block(rows))
    means = learner._sample(64 * 16).columns["action"].reshape(64, 16).mean(axis=1)
    assert 0.1 < means.min() and means.max() < 0.9


def test_an_empty_shard_is_no_obstacle(make_learner, make_rows):
    """The first updates may come before every shard has had a block."""
    learner, shards = make_learner(3)
    shards[1].add(make_block(make_rows(40)))
    assert learner.update(2, RATE).version == 2
    shards[0].add(make_block(make_rows(40)))
    shards[2].add(make_block(make_rows(40)))
    assert learner.update(2, RATE).version == 4


@pytest.mark.parametrize("priorities", [None, PrioritySettings(0.6, 16)])
@pytest.mark.parametrize("num_shards", [1, 3])
def test_a_restored_node_goes_on_bit_for_bit(tmp_path, make_learner, make_rows, num_shards, priorities):
    learner, shards = make_learner(num_shards, priorities=priorities)
    for sequence in range(6):
        learner.add(make_block(make_rows(30, seed=sequence), sequence))
    learner.update(4, RATE, 0.5)
    state = json.loads(json.dumps(saved(learner, tmp_path)))
    expected = [(learner.update(4, RATE, 0.5), learner.weights()) for _ in range(2)]
    resumed, again = make_learner(num_shards, priorities=priorities, seed=99)
    resumed.load(tmp_path, state)
    assert resumed.weights().version == 4
    for report, weights in expected:
        other = resumed.update(4, RATE, 0.5)
        assert (other.stats, other.version) == (report.stats, report.version)
        for first, second in zip(resumed.weights().arrays, weights.arrays, strict=True):
            np.testing.assert_array_equal(first, second)
    assert [shard.mass() for shard in again] == [shard.mass() for shard in shards]
    assert [shard.add(make_block(make_rows(1), 9)).weights_version for shard in again] == [12] * num_shards


def test_a_restored_node_publishes_its_weights(tmp_path, make_learner, make_rows):
    learner, (shard,) = make_learner()
    shard.add(make_block(make_rows(30)))
    learner.update(4, RATE)
    state = saved(learner, tmp_path)
    resumed, (again,) = make_learner()
    resumed.load(tmp_path, state)
    assert resumed.weights().version == 4
    assert again.add(make_block(make_rows(1), 9)).weights is resumed.weights()


def test_another_number_of_shards_is_refused(tmp_path, make_learner, make_rows):
    learner, _ = make_learner(2)
    state = saved(learner, tmp_path)
    with pytest.raises(ValueError, match="2 shards, this run 3"):
        make_learner(3)[0].load(tmp_path, state)


@pytest.mark.parametrize("content", [None, b"damaged"])
def test_a_damaged_file_is_refused(tmp_path, make_learner, content):
    learner, _ = make_learner()
    state = saved(learner, tmp_path)
    (tmp_path / "learner.safetensors").unlink()
    if content is not None:
        (tmp_path / "learner.safetensors").write_bytes(content)
    with pytest.raises(ValueError, match="cannot be read"):
        learner.load(tmp_path, state)


HALF = PrioritySettings(0.5, 16)


def numbered(make_rows, count, first):
    """Rows with distinct rewards, counted from `first`."""
    rows = make_rows(count, seed=first)
    rows["reward"] = first + np.arange(count)
    return rows


def fill(learner, shards, make_rows, sizes):
    """Fills every shard with rows whose rewards are 1000 x shard + number."""
    for i, (shard, size) in enumerate(zip(shards, sizes, strict=True)):
        shard.add(make_block(numbered(make_rows, size, 1000 * i)))


def td_errors_by_hand(weights, rows):
    """TD errors of Double DQN before the first update: both networks are equal, so the best next value counts."""
    policy = Policy(weights)
    best = policy.values(rows["next_observation"]).max(axis=1)
    return (
        rows["reward"] + rows["discount"] * best - policy.values(rows["observation"])[range(len(rows)), rows["action"]]
    )


@pytest.mark.parametrize("sizes", [(40,), (40, 10), (10, 30, 20)])
def test_td_errors_go_back_to_their_rows(make_learner, make_rows, sizes):
    learner, shards = make_learner(len(sizes), priorities=HALF)
    fill(learner, shards, make_rows, sizes)
    weights, sampled, real = learner.weights(), [], learner._samples.take
    learner._samples.take = lambda count: sampled.append(real(count)) or sampled[0]
    learner.update(1, RATE, 1.0)
    drawn = {round(reward) for reward in sampled[0].columns["reward"].tolist()}
    assert 1 < len(drawn) <= 16
    for i, (shard, size) in enumerate(zip(shards, sizes, strict=True)):
        rows = numbered(make_rows, size, 1000 * i)
        changed = (np.abs(td_errors_by_hand(weights, rows)) + PRIORITY_EPSILON) ** 0.5
        new = [1000 * i + number in drawn for number in range(size)]
        np.testing.assert_allclose(shard.shard.priorities, np.where(new, changed, 1.0), rtol=1e-5)


@pytest.mark.parametrize("sizes", [(40,), (40, 10), (10, 30, 20)])
def test_rows_of_all_shards_are_drawn_in_proportion_to_their_priorities(make_learner, make_rows, sizes):
    learner, shards = make_learner(len(sizes), priorities=HALF)
    fill(learner, shards, make_rows, sizes)
    for i, (shard, size) in enumerate(zip(shards, sizes, strict=True)):
        shard.set_priorities(np.arange(size), np.linspace(0.1, 2 + i, size, dtype=np.float32) ** 2)
    samples = [learner._sample(1600) for _ in range(20)]
    drawn = np.concatenate([sample.columns["reward"] for sample in samples]).astype(int)
    priorities = [shard.shard.priorities for shard in shards]
    shares = [part / np.concatenate(priorities).sum() for part in priorities]
    counts = [np.bincount(drawn[drawn // 1000 == i] % 1000, minlength=size) for i, size in enumerate(sizes)]
    assert stats.chisquare(np.concatenate(counts), len(drawn) * np.concatenate(shares)).pvalue > 1e-4
    for sample in samples:
        numbers = sample.columns["reward"].astype(int)
        expected = [shares[number // 1000][number % 1000] for number in numbers]
        np.testing.assert_allclose(sample.draws.probability, expected, rtol=1e-9)
        np.testing.assert_array_equal(sample.draws.insertion_index, numbers % 1000)
        if len(sizes) > 1:
            np.testing.assert_array_equal(sample.shard, numbers // 1000)


@pytest.mark.parametrize("exponent", [0.0, 0.4, 1.0])
def test_updates_weight_their_rows_by_importance(make_learner, make_rows, learner_config, learner_shape, exponent):
    learner, (shard,) = make_learner(priorities=HALF)
    twin, (other,) = make_learner(priorities=HALF)
    for copy in (shard, other):
        copy.add(make_block(make_rows(50)))
        copy.set_priorities(np.arange(50), np.geomspace(0.1, 9, 50).astype(np.float32))
    learner.update(3, RATE, exponent)
    plain = Learner(learner_config, learner_shape)
    sample = other.sample(3 * 16)
    probability = other.shard.priorities[sample.draws.insertion_index] / other.shard.priorities.sum()
    plain.update(sample.columns, RATE, importance_weights(probability, 16, exponent))
    for array, expected in zip(learner.weights().arrays, plain.weights(0.0).arrays, strict=True):
        np.testing.assert_array_equal(array, expected)


class OvertakenCalls(LocalCalls):
    """Stores a block before every priority update, as a rollout worker may do."""

    def __init__(self, blocks):
        self.blocks = blocks

    def start(self, node, method, *args):
        if method.__name__ == "set_priorities":
            node.add(next(self.blocks))
        return super().start(node, method, *args)


def test_priorities_of_overwritten_rows_do_not_reach_their_successors(make_learner, make_rows):
    blocks = iter([make_block(make_rows(50, seed=1), 1)])
    learner, (shard,) = make_learner(priorities=HALF, calls=OvertakenCalls(blocks))
    shard.add(make_block(make_rows(50)))
    learner.update(2, RATE, 1.0)
    assert shard.shard.get_state()["stale"] == 32
    np.testing.assert_array_equal(shard.shard.priorities, np.ones(50))


def test_a_checkpoint_waits_for_priority_updates(tmp_path, make_learner, make_rows):
    """Over Ray a priority update is in flight when `update` returns."""

    class Late(LocalCalls):
        late = []

        def start(self, node, method, *args):
            if method.__name__ != "set_priorities":
                return super().start(node, method, *args)
            self.late.append((node, args))
            return Done(len(self.late) - 1)

        def get(self, ref):
            if isinstance(ref.value, int):
                node, args = self.late[ref.value]
                return node.set_priorities(*args)
            return ref.value

    learner, (shard,) = make_learner(priorities=HALF, calls=Late())
    shard.add(make_block(make_rows(50)))
    learner.update(2, RATE, 1.0)
    assert shard.mass() == 50
    state = learner.save(tmp_path)
    assert shard.mass() != 50 and state["sizes"] == [shard.mass()]


def test_a_teachers_action_leads_after_updates_with_its_weight_and_not_without():
    """Its action is the rule's in the sampled state, also after a random turn of it."""
    world = WorldConfig(method="in", robots=3, groups=2)
    config = RunConfig(
        world=world, teacher="field", teacher_margin=1.0, random_turns=True, min_replay=1, hidden_sizes=(64,)
    )
    shape = env_shape(config.env)
    states = np.random.default_rng(0).normal(size=(512, *shape.observation_space.shape)).astype(np.float32)
    rule = world.method_class.rules(world)["field"]
    agreements = []
    for weight in (1.0, 0.0):
        rows = np.zeros(512, transition_dtype(shape.observation_space))
        rows["observation"] = rows["next_observation"] = states
        learner = LearnerNode(config, shape, [ShardNode(ShardSettings(rows.dtype, 512, 0))], LocalCalls())
        learner.add(make_block(rows))
        for _ in range(40):
            learner.update(8, 3e-3, teacher_weight=weight)
        agreements.append(float((Policy(learner.weights()).greedy(states) == rule(states)).mean()))
    assert agreements[0] > 0.8 > 0.4 > agreements[1]


def test_divergence_ends_the_run(make_learner, make_rows):
    learner, (shard,) = make_learner(priorities=HALF)
    rows = make_rows(50)
    rows["reward"] = np.inf
    shard.add(make_block(rows))
    with pytest.raises(Diverged, match="loss is inf after 1 updates"):
        learner.update(1, RATE, 1.0)


@pytest.mark.parametrize("settings", [{}, {"gradients": "autograd"}, {"loss": "mse"}, {"policy_average_updates": 10}])
def test_weights_that_are_not_finite_are_neither_published_nor_saved(make_learner, make_rows, tmp_path, settings):
    learner, shards = make_learner(**settings)
    learner.add(make_block(make_rows(30)))
    for _ in range(3):
        learner.update(1, RATE)
    published = learner.weights()
    with pytest.raises(Diverged, match=r"(loss|td_error|q_mean) is (nan|-?inf)|a weight is not finite"):
        for _ in range(20):
            learner.update(1, 1e30)
            published = learner.weights()
    assert learner.weights() is published and all(np.isfinite(array).all() for array in published.arrays)
    reply = learner.add(make_block(make_rows(5), sequence=1))
    assert reply.weights_version == published.version
    with pytest.raises(Diverged, match="is not finite after"):
        learner.save(tmp_path / "c")
    assert not (tmp_path / "c").exists()


def test_moments_that_are_not_finite_are_not_saved(make_learner, make_rows, tmp_path):
    learner, _ = make_learner()
    learner.add(make_block(make_rows(30)))
    learner.update(1, RATE)
    state = learner._learner.optimiser.state
    state["exp_avg_sq"][0] = np.inf
    with pytest.raises(Diverged, match="optimiser.exp_avg_sq is not finite after 1 updates"):
        learner.save(tmp_path / "c")
