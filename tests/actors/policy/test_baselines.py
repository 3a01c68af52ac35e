"""Baselines: hand-made observations, FL-ORCA by hand, and randomness that no batching changes."""

import math
import pickle

import numpy as np
import pytest

from actors.policy.baselines import Baseline, FlOrcaRule, GreedyMethodRule, RandomRule, make_baseline
from sim_core.config import WorldConfig
from sim_core.worlds import WorldBatch

Q4 = WorldConfig(sectors=4)


def counts(inner, ring):
    return np.array([inner + ring], np.int8)


@pytest.mark.parametrize(
    ("inner", "ring", "sector"),
    [
        ([0, 0, 3, 0], [0, 0, 0, 0], 2),  # the inner region counts
        ([0, 0, 0, 0], [0, 2, 0, 0], 1),  # and so does the ring
        ([0, 2, 0, 0], [0, 0, 0, 3], 3),
        ([0, 2, 0, 1], [0, 0, 0, 2], 3),  # their sum decides
        ([0, 2, 0, 5], [0, 0, 0, -4], 1),  # other robots count against a sector
        ([-1, -2, -3, -4], [0, 0, 0, 0], 0),  # nobody of its own: where fewest others are
        ([0, 2, 0, 0], [0, 0, 0, 2], 3),  # equal: the ring's robots are about to be lost
        ([9, 0, 0, 0], [0, 3, 0, 9], 3),
        ([0, 1, 1, 0], [0, 1, 1, 0], 1),  # equal in all: the lowest index
        ([127, 0, 0, -128], [126, 126, 127, -128], 0),  # no overflow of int8
    ],
)
def test_greedy_on_counts(inner, ring, sector):
    assert GreedyMethodRule(Q4).act(counts(inner, ring)).tolist() == [sector]


def test_greedy_on_counts_apart_is_greedy_on_their_difference():
    rng = np.random.default_rng(0)
    own, others = rng.integers(0, 6, (2, 200, 16)).astype(np.int8)
    apart = GreedyMethodRule(WorldConfig(sensor_counts="separate")).act(np.concatenate([own, others], axis=1))
    assert apart.tolist() == GreedyMethodRule(WorldConfig()).act(own - others).tolist()


def test_greedy_judges_each_episode_alone():
    rng = np.random.default_rng(0)
    observation = rng.integers(-5, 6, (200, 16)).astype(np.int8)
    rule = GreedyMethodRule(WorldConfig())
    batched = rule.act(observation)
    assert batched.dtype == np.int64
    expected = [
        max(range(8), key=lambda sector, row=row: (row[sector] + row[8 + sector], row[8 + sector], -sector))
        for row in observation.astype(int).tolist()
    ]
    assert batched.tolist() == expected


@pytest.mark.parametrize(("method", "columns"), [("in", 9), ("out", 7)])
@pytest.mark.parametrize("stop_action", [False, True])
def test_greedy_turns_to_the_own_groups_centre(method, columns, stop_action):
    config = WorldConfig(method=method, groups=3, stop_action=stop_action)
    rng = np.random.default_rng(0)
    observation = rng.normal(size=(500, 3 * columns)).astype(np.float32)  # decoys in all other columns
    angle = np.arctan2(observation[:, 3], observation[:, 2])
    sector = np.floor((angle + math.pi) / (2 * math.pi / 8)).astype(int) % 8  # Eq. 3.3: the heading is its middle
    rule = make_baseline(Baseline.GREEDY, config, [0])
    assert isinstance(rule, GreedyMethodRule)
    np.testing.assert_array_equal(rule.act(observation), sector)


def test_greedy_at_the_centre_itself_takes_the_first_heading():
    config = WorldConfig(method="out", stop_action=True)
    assert GreedyMethodRule(config).act(np.zeros((1, 14), np.float32)).tolist() == [0]


@pytest.mark.parametrize("method", ["sensor", "in", "out"])
def test_greedy_nears_its_group_in_a_world(method):
    worlds = WorldBatch(WorldConfig(method=method, robots=6, groups=2), 20)
    worlds.seed(list(range(20)))
    observation = worlds.reset()
    rule = make_baseline(Baseline.GREEDY, worlds.config, list(range(20)))
    for _ in range(60):
        observation = worlds.step(rule.act(observation)).observation
    robot, group = worlds.state.learner, worlds.state.learner // 6
    position = worlds.positions()
    centre = position.reshape(20, 2, 6, 2).mean(axis=2)[np.arange(20), group]
    distance_m = np.linalg.norm(position[np.arange(20), robot] - centre, axis=1)
    assert np.median(distance_m) < 1.0


def test_fl_orca_takes_no_action():
    assert FlOrcaRule().act(np.zeros((3, 16))) is None


def test_random_actions_depend_on_the_episodes_seed_alone():
    config = WorldConfig(horizon_steps=40)
    seeds = [5, 2_000_000_000, 2**32 - 1, 7, 6]
    together = RandomRule(config, seeds)
    alone = [RandomRule(config, [seed]) for seed in seeds]
    for _ in range(config.horizon_steps):
        actions = together.act(np.zeros((5, 16)))
        assert actions.tolist() == [int(rule.act(np.ones((1, 16)))[0]) for rule in alone]


@pytest.mark.parametrize("stop_action", [False, True])
def test_random_actions_are_uniform_and_differ_between_seeds(stop_action):
    config = WorldConfig(stop_action=stop_action)
    rule = RandomRule(config, list(range(40)))
    actions = np.stack([rule.act(np.zeros(0)) for _ in range(config.horizon_steps)])
    share = np.bincount(actions.ravel(), minlength=config.num_actions) / actions.size
    assert len(share) == config.num_actions
    np.testing.assert_allclose(share, 1 / config.num_actions, atol=0.01)  # 4.5 standard errors
    assert len({tuple(column) for column in actions.T}) == 40


def test_a_baseline_travels_as_its_name():
    assert [str(baseline) for baseline in Baseline] == ["fl-orca", "greedy", "random"]
    for baseline in Baseline:
        assert pickle.loads(pickle.dumps(baseline)) is baseline
