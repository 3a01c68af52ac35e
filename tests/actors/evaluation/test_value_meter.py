"""Values beside returns: every sum against one that is made from the whole episode."""

import numpy as np
import pytest

from actors.evaluation.evaluator import evaluate
from actors.evaluation.value_meter import ValueMeter
from actors.policy.baselines import Baseline
from actors.policy.policy import Policy
from sim_core.envs import SwarmEnv

SEEDS = [2_000_000_000 + i for i in range(5)]


def by_hand(values, rewards, discount):
    """VALUE_DTYPE's fields of one whole episode."""
    returns = [sum(discount**k * r for k, r in enumerate(rewards[t:])) for t in range(len(rewards))]
    return values[0], returns[0], np.mean(values), np.mean(returns)


@pytest.mark.parametrize("discount", [0.9, 1.0])
def test_sums_are_those_of_whole_episodes(discount):
    rng = np.random.default_rng(0)
    lengths = np.array([3, 1, 7])
    values, rewards = rng.normal(size=(2, 7, 3)).astype(np.float32)
    steps = iter(values)
    meter = ValueMeter(lambda: next(steps), 3, discount)
    for t in range(7):
        meter.add(rewards[t].astype(np.float64), t < lengths)
    for i, length in enumerate(lengths):
        expected = by_hand(values[:length, i], rewards[:length, i], discount)
        np.testing.assert_allclose(meter.values()[i].tolist(), expected, rtol=1e-5)


def test_an_evaluation_measures_its_own_policy(swarm, make_weights):
    weights = make_weights(swarm, seed=3)
    policy, env = Policy(weights), SwarmEnv(**swarm.settings)
    stats = evaluate(swarm, weights, SEEDS, 0.97)
    for seed, found in zip(SEEDS, stats.values, strict=True):
        observation, _ = env.reset(seed=seed)
        values, rewards, ended = [], [], False
        while not ended:
            values.append(policy.values(observation[None]).max())
            observation, reward, terminated, truncated, _ = env.step(policy.greedy(observation[None])[0])
            rewards.append(reward)
            ended = terminated or truncated
        np.testing.assert_allclose(found.tolist(), by_hand(values, rewards, 0.97), rtol=1e-5)


def test_nothing_is_measured_unasked_nor_of_a_rule(swarm, make_weights):
    asked, plain = (evaluate(swarm, make_weights(swarm), SEEDS, discount) for discount in (0.97, None))
    assert len(plain.values) == 0 and len(evaluate(swarm, Baseline.GREEDY, SEEDS, 0.97).values) == 0
    for with_values, without in zip(asked[:4], plain[:4], strict=True):
        np.testing.assert_array_equal(with_values, without)
