"""Baselines: hand-made observations, FL-ORCA by hand, and randomness that no batching changes."""

import dataclasses
import math
import pickle

import numpy as np
import pytest

from actors.policy.baselines import Baseline, MethodRule, RandomRule, make_baseline
from sim_core.checks import ConfigError
from sim_core.config import WorldConfig
from sim_core.pilot import Pilot
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
    assert MethodRule(Q4, Baseline.GREEDY).act(counts(inner, ring)).tolist() == [sector]


def test_greedy_on_counts_apart_is_greedy_on_their_difference():
    rng = np.random.default_rng(0)
    own, others = rng.integers(0, 6, (2, 200, 16)).astype(np.int8)
    apart = MethodRule(WorldConfig(sensor_counts="separate"), Baseline.GREEDY).act(
        np.concatenate([own, others], axis=1)
    )
    assert apart.tolist() == MethodRule(WorldConfig(), Baseline.GREEDY).act(own - others).tolist()


def test_greedy_judges_each_episode_alone():
    rng = np.random.default_rng(0)
    observation = rng.integers(-5, 6, (200, 16)).astype(np.int8)
    rule = MethodRule(WorldConfig(), Baseline.GREEDY)
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
    assert isinstance(rule, MethodRule)
    np.testing.assert_array_equal(rule.act(observation), sector)


def test_greedy_at_the_centre_itself_takes_the_first_heading():
    config = WorldConfig(method="out", stop_action=True)
    assert MethodRule(config, Baseline.GREEDY).act(np.zeros((1, 14), np.float32)).tolist() == [0]


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


@pytest.mark.parametrize(
    "settings", [{}, {"sectors": 16, "stop_action": True, "apf_rows": "all"}, {"speed_levels": 2, "stop_action": True}]
)
def test_field_takes_the_action_nearest_to_attraction_and_repulsion(settings):
    config = WorldConfig(method="in", robots=6, groups=3, **settings)
    worlds = WorldBatch(config, 60)
    observation = worlds.reset()
    for _ in range(150):  # the groups meet
        observation = worlds.step(Pilot.FREE).observation
    chosen = MethodRule(config, Baseline.FIELD).act(observation)
    angle = math.pi / config.sectors + np.arange(config.sectors) * 2 * math.pi / config.sectors - math.pi
    actions = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    actions = np.concatenate([actions * (1 - level / config.speed_levels) for level in range(config.speed_levels)])
    if config.stop_action:
        actions = np.concatenate([actions, [[0.0, 0.0]]])
    positions, repelled = worlds.positions().astype(np.float64), 0
    for world, learner in enumerate(worlds.state.learner):
        offset = positions[world] - positions[world, learner]
        others = np.delete(offset, learner, axis=0)
        distance = np.linalg.norm(others, axis=1)
        near = distance < config.apf_range_m
        repulsion = np.zeros(2)
        for group in range(3):  # each group's part is limited
            mine = np.delete(np.arange(18) // 6 == group, learner) | (config.apf_rows == "all")
            d, away = distance[near & mine, None], -others[near & mine]
            part = (away / d * np.minimum(0.15 * (1 / d - 1 / 0.5) / d**2, 4.0)).sum(axis=0)
            part *= min(1.0, 4.0 / max(np.linalg.norm(part), 1e-9))
            repulsion += part / (3 if config.apf_rows == "all" else 1)
        members = [i for i in range(18) if i // 6 == learner // 6 and i != learner]
        centre = offset[members].mean(axis=0)
        wanted = centre * min(1.0, 1.0 / np.linalg.norm(centre)) + repulsion
        error = np.linalg.norm(actions - wanted, axis=1)
        assert error[chosen[world]] <= error.min() + 1e-5
        repelled += bool(near.any())
    assert repelled > 20


@pytest.mark.parametrize("method", ["sensor", "in", "out"])
def test_a_rule_sees_the_newest_of_a_history(method):
    plain = WorldBatch(WorldConfig(method=method, robots=4, groups=2), 30)
    seeing = WorldBatch(dataclasses.replace(plain.config, history=3), 30)
    first, second = plain.reset(), seeing.reset()
    rules = [MethodRule(worlds.config, Baseline.GREEDY) for worlds in (plain, seeing)]
    for _ in range(40):
        action = rules[0].act(first)
        np.testing.assert_array_equal(rules[1].act(second), action)
        first, second = plain.step(action).observation, seeing.step(action).observation


def test_a_rule_that_a_method_lacks_is_refused():
    with pytest.raises(ConfigError, match="sensor has no rule field; play one of: fl-orca, fl-orca-snapped, greedy, r"):
        make_baseline(Baseline.FIELD, WorldConfig(), [0])


def test_snapped_fl_orca_takes_the_action_nearest_to_its_velocity():
    config = WorldConfig(method="out", robots=5, groups=2, arena_radius_m=2.0, stop_action=True)
    worlds, free = WorldBatch(config, 30), WorldBatch(config, 30)
    worlds.reset(), free.reset()
    rule = make_baseline(Baseline.FL_ORCA_SNAPPED, config, list(range(30)))
    assert rule.act(np.zeros((30, 14))) is Pilot.SNAPPED
    for _ in range(60):
        before = {name: array.copy() for name, array in worlds.get_state().items()}
        action = worlds.actions_nearest_to_swarm()
        for name, array in worlds.get_state().items():
            np.testing.assert_array_equal(array, before[name])  # to ask changes nothing
        free.set_state(before)
        free.step(Pilot.FREE)
        everyone, learner = np.arange(30), worlds.state.learner
        wanted = np.stack([free.state.vel_x, free.state.vel_y], axis=-1)[everyone, learner]
        moved = []
        for choice in range(config.num_actions):
            free.set_state(before)
            free.step(np.full(30, choice))
            moved.append(np.stack([free.state.vel_x, free.state.vel_y], axis=-1)[everyone, learner])
        error = np.linalg.norm(np.array(moved) - wanted, axis=2)
        np.testing.assert_allclose(error[action, everyone], error.min(axis=0), atol=1e-6)
        worlds.step(Pilot.SNAPPED)
        taken = np.stack([worlds.state.vel_x, worlds.state.vel_y], axis=-1)[everyone, learner]
        np.testing.assert_array_equal(taken, np.array(moved)[action, everyone])


def test_fl_orca_takes_no_action():
    assert make_baseline(Baseline.FL_ORCA, Q4, [0]).act(np.zeros((3, 16))) is Pilot.FREE


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
    assert [str(baseline) for baseline in Baseline] == ["fl-orca", "fl-orca-snapped", "greedy", "field", "random"]
    for baseline in Baseline:
        assert pickle.loads(pickle.dumps(baseline)) is baseline
