"""Evaluation: one episode per seed, compared with a single environment in a plain loop."""

import dataclasses

import gymnasium as gym
import numpy as np
import pytest

from actors.evaluation import evaluator
from actors.evaluation.evaluator import (
    evaluate,
    evaluate_in_parallel,
    is_short,
    record_episode,
    record_frames,
    worthwhile_calls,
)
from actors.policy.baselines import PILOTS, Baseline
from actors.policy.policy import Policy
from actors.rollout.env_spec import EnvSpec
from actors.rollout.foreign_env import EnvError
from actors.service.messages import NO_OUTCOME
from actors.service.rpc import LocalCalls
from sim_core import ENV_ID
from sim_core.checks import ConfigError
from sim_core.config import WorldConfig
from sim_core.envs import SwarmEnv
from sim_core.outcomes import Outcome
from sim_core.pilot import Pilot
from sim_core.worlds import WorldBatch

SEEDS = [2_000_000_000 + i for i in range(7)]


def play(env, policy, seed):
    """(outcome, length, return) of one greedy episode."""
    observation, _ = env.reset(seed=seed)
    length, total, ended = 0, 0.0, False
    while not ended:
        observation, reward, terminated, truncated, info = env.step(policy.greedy(observation[None])[0])
        length, total, ended = length + 1, total + reward, terminated or truncated
    return info.get("outcome", NO_OUTCOME), length, total


@pytest.mark.parametrize("name", ["swarm", "cart_pole"])
def test_an_evaluation_equals_single_episodes(name, request, make_weights):
    spec = request.getfixturevalue(name)
    weights = make_weights(spec, seed=3)
    env = SwarmEnv(**spec.settings) if spec.is_swarm else gym.make(spec.env_id)
    expected = [play(env, Policy(weights), seed) for seed in SEEDS]
    stats = evaluate(spec, weights, SEEDS)
    assert list(zip(stats.outcome, stats.length_steps, strict=True)) == [row[:2] for row in expected]
    np.testing.assert_allclose(stats.episode_return, [row[2] for row in expected], rtol=1e-9)
    assert len(set(stats.length_steps)) > 1  # otherwise short episodes could not be over-represented
    env.close()


@pytest.mark.parametrize("chunk", [1, 2, 3, 7])
def test_an_evaluation_does_not_depend_on_the_number_of_environments(monkeypatch, swarm, make_weights, chunk):
    weights = make_weights(swarm)
    expected = evaluate(swarm, weights, SEEDS)
    monkeypatch.setattr(evaluator, "MAX_ENVS", chunk)
    for first, second in zip(evaluate(swarm, weights, SEEDS), expected, strict=True):
        np.testing.assert_array_equal(first, second)


def test_entries_are_in_the_order_of_the_seeds(swarm, make_weights):
    weights = make_weights(swarm)
    backwards = evaluate(swarm, weights, SEEDS[::-1])
    for first, second in zip(evaluate(swarm, weights, SEEDS), backwards, strict=True):
        np.testing.assert_array_equal(first, second[::-1])
    assert not any(len(column) for column in evaluate(swarm, weights, []))


def test_of_several_setups_each_seed_plays_in_the_next(swarm, make_weights):
    worlds = [dataclasses.replace(swarm.world, robots=robots) for robots in (3, 4, 5)]
    weights = make_weights(swarm)
    spec = swarm._replace(shares=tuple((world, 1.0) for world in worlds))
    seeds = [11, 3, 4, 5, 20, 2, 8]
    stats = evaluate(spec, weights, seeds)
    for i, seed in enumerate(seeds):
        alone = evaluate(spec.of_setup(worlds[seed % 3]), weights, [seed])
        assert [column[i] for column in stats[:3]] == [column[0] for column in alone[:3]]
    calls = LocalCalls()
    for joined, whole in zip(evaluate_in_parallel(calls, spec, calls.put(weights), seeds, 3), stats, strict=True):
        np.testing.assert_array_equal(joined, whole)


def with_rule(spec, baseline):
    """The environment, with a method that has the baseline."""
    return spec._replace(world=dataclasses.replace(spec.world, method="in")) if baseline == "field" else spec


@pytest.mark.parametrize("max_calls", [1, 2, 3, 5, 7, 20])
@pytest.mark.parametrize("name", ["learned", *Baseline])
def test_a_parallel_evaluation_equals_the_whole_in_the_order_of_the_seeds(swarm, make_weights, name, max_calls):
    swarm = with_rule(swarm, name)
    spec = swarm._replace(world=dataclasses.replace(swarm.world, horizon_steps=100))
    candidate = make_weights(spec) if name == "learned" else Baseline(name)
    calls = LocalCalls()
    seeds = SEEDS[::-1]
    whole = evaluate(spec, candidate, seeds)
    joined = evaluate_in_parallel(calls, spec, calls.put(candidate), seeds, max_calls)
    for first, second in zip(joined, whole, strict=True):
        np.testing.assert_array_equal(first, second)
    assert len(set(whole.length_steps)) > 3  # otherwise a wrong order would not show


def test_a_process_more_is_worth_a_thousand_episodes_of_twenty_robots(swarm):
    ten_in_two, large = swarm._replace(world=WorldConfig(robots=10, groups=2)), WorldConfig(robots=25, groups=4)
    both = ten_in_two._replace(shares=((ten_in_two.world, 1.0), (large, 1.0)))
    episodes = (0, 100, 1_000, 3_999, 4_000, 100_000)
    assert [worthwhile_calls(ten_in_two, count, 16) for count in episodes] == [1, 1, 1, 3, 4, 16]
    assert [worthwhile_calls(both, count, 16) for count in episodes] == [1, 1, 6, 16, 16, 16]
    foreign = EnvSpec("CartPole-v1", swarm.world)
    assert worthwhile_calls(foreign, 10, 16) == 16, "how long its episodes take is not known"
    assert [is_short([ten_in_two], count) for count in (0, 3_999, 4_000)] == [True, True, False]
    assert [is_short([both, ten_in_two], count) for count in (571, 572)] == [True, False]
    assert not is_short([foreign], 1) and not is_short([ten_in_two, foreign], 1)


def test_a_parallel_evaluation_of_no_seeds_is_empty(swarm):
    calls = LocalCalls()
    none = evaluate_in_parallel(calls, swarm, calls.put(Baseline.RANDOM), [], 4)
    assert not any(len(column) for column in none)


@pytest.mark.parametrize("method", ["sensor", "in", "out"])
def test_the_fl_orca_baseline_steps_the_swarm_without_an_action(method):
    world = WorldConfig(method=method, robots=4, groups=2, arena_radius_m=2.0, horizon_steps=300)
    stats = evaluate(EnvSpec(ENV_ID, world), Baseline.FL_ORCA, SEEDS)
    for i, seed in enumerate(SEEDS):
        worlds = WorldBatch(world, 1)
        worlds.seed([seed])
        worlds.reset()
        result = worlds.step(Pilot.FREE)
        while result.outcome[0] == Outcome.RUNNING:
            result = worlds.step(Pilot.FREE)
        assert (stats.outcome[i], stats.length_steps[i]) == (result.outcome[0], result.steps[0])
        assert stats.episode_return[i] == pytest.approx(result.episode_return[0], rel=1e-6)
    assert len(set(stats.length_steps)) > 1


@pytest.mark.parametrize("baseline", Baseline)
@pytest.mark.parametrize("chunk", [1, 3])
def test_a_baseline_does_not_depend_on_the_number_of_environments(monkeypatch, swarm, baseline, chunk):
    swarm = with_rule(swarm, baseline)
    expected = evaluate(swarm, baseline, SEEDS)
    monkeypatch.setattr(evaluator, "MAX_ENVS", chunk)
    for first, second in zip(evaluate(swarm, baseline, SEEDS), expected, strict=True):
        np.testing.assert_array_equal(first, second)


@pytest.mark.parametrize("baseline", Baseline)
def test_a_recorded_baseline_equals_the_evaluated_one(swarm, baseline):
    swarm = with_rule(swarm, baseline)
    stats = evaluate(swarm, baseline, SEEDS)
    for i, seed in enumerate(SEEDS):
        episode = record_episode(swarm, baseline, seed)
        assert (episode.outcome, len(episode.action)) == (stats.outcome[i], stats.length_steps[i] + 1)
        assert ((episode.action[:-1] == -1) == (baseline in PILOTS)).all()


def test_a_baseline_in_another_environment_is_refused(cart_pole):
    with pytest.raises(ConfigError, match="random plays in the swarm environment only, not in CartPole-v1"):
        evaluate(cart_pole, Baseline.RANDOM, SEEDS)


def test_a_recorded_episode_equals_the_evaluated_one(swarm, make_weights):
    weights = make_weights(swarm, seed=5)
    stats = evaluate(swarm, weights, SEEDS)
    for i, seed in enumerate(SEEDS):
        episode = record_episode(swarm, weights, seed)
        assert (episode.outcome, episode.seed) == (stats.outcome[i], seed)
        assert len(episode.action) == stats.length_steps[i] + 1
        assert episode.reward.sum(dtype=np.float64) == pytest.approx(stats.episode_return[i], rel=1e-6)
        assert episode.action[-1] == -1 and episode.reward[-1] == 0 and (episode.action[:-1] >= 0).all()


def test_a_recorded_episode_holds_every_state(swarm, make_weights):
    episode = record_episode(swarm, make_weights(swarm), SEEDS[0])
    worlds = SwarmEnv(**swarm.settings)
    worlds.reset(seed=SEEDS[0])
    for t, action in enumerate(episode.action):
        np.testing.assert_array_equal(episode.position[t], worlds.worlds.positions()[0])
        np.testing.assert_array_equal(episode.machine[t], worlds.worlds.state.machine[0])
        np.testing.assert_array_equal(episode.velocity[t, :, 0], worlds.worlds.state.vel_x[0])
        np.testing.assert_array_equal(episode.velocity[t, :, 1], worlds.worlds.state.vel_y[0])
        if action >= 0:
            assert worlds.step(action)[1] == episode.reward[t]
    moved = np.diff(episode.position, axis=0)
    step_s = swarm.world.time_step_s
    np.testing.assert_allclose(moved, episode.velocity[1:] * step_s, atol=1e-5)
    np.testing.assert_array_equal(episode.goal, worlds.worlds.goals()[0])
    assert 0 <= episode.learner < swarm.world.num_robots


NO_PICTURE = {
    "Plain": "has no render mode rgb_array; it has \\[\\]",
    "TakesNoMode": "cannot be made by Gymnasium: TypeError",
    "CannotRender": "render\\(\\) raised NotImplementedError",
    "DrawsNothing": "render\\(\\) gave None, no RGB image",
    "DrawsText": "render\\(\\) gave 'A robot.', no RGB image",
    "DrawsGrey": "render\\(\\) gave uint8 \\(32, 48\\), no RGB image",
    "DrawsSizes": "render\\(\\) gave images of several sizes",
}


@pytest.mark.parametrize("name", NO_PICTURE)
def test_an_environment_that_cannot_be_drawn_is_refused(name, make_weights):
    spec = EnvSpec(f"tests.odd_envs:{name}-v0", WorldConfig())
    with pytest.raises(ConfigError, match=NO_PICTURE[name]):
        list(record_frames(spec, make_weights(spec), 1)[0])


def test_images_are_those_of_the_steps(make_weights):
    spec = EnvSpec("tests.odd_envs:Images-v0", WorldConfig())
    frames, frames_per_s = record_frames(spec, make_weights(spec), 1)
    assert [frame.max() for frame in frames] == [10 * step for step in range(20)] and frames_per_s == 20


def test_an_episode_that_never_ends_is_refused(monkeypatch, make_weights):
    monkeypatch.setattr(evaluator, "MAX_EPISODE_STEPS", 50)
    spec = EnvSpec("tests.odd_envs:NeverEnds-v0", WorldConfig())
    with pytest.raises(EnvError, match="has not ended after 50 steps; give the environment a time limit"):
        evaluate(spec, make_weights(spec), [1])


def test_the_outcome_of_another_environment_is_its_own(make_weights):
    spec = EnvSpec("tests.odd_envs:OwnOutcome-v0", WorldConfig())
    stats = evaluate(spec, make_weights(spec), [1, 2])
    assert stats.outcome.tolist() == [NO_OUTCOME] * 2 and stats.length_steps.tolist() == [20] * 2


@pytest.mark.parametrize(("name", "rate"), [("cart_pole", 50), ("swarm", 20)])
def test_recorded_frames_have_one_image_per_step(name, rate, request, make_weights):
    spec = request.getfixturevalue(name)
    weights = make_weights(spec)
    drawn, frames_per_s = record_frames(spec, weights, 4)
    frames = list(drawn)
    if not spec.is_swarm:  # gym.make ignores the spec's world
        assert len(frames) == evaluate(spec, weights, [4]).length_steps[0]
    assert frames_per_s == rate
    assert frames[0].dtype == np.uint8 and frames[0].ndim == 3
