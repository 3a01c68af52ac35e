"""Evaluations of worlds in which several robots learn: an entry a robot, and what the robots do together."""

import numpy as np
import pytest

from actors.evaluation.evaluation_store import StoredEvaluation, entry_seeds, load_evaluation, save_evaluation
from actors.evaluation.evaluator import evaluate, make_action_rule, record_episode
from actors.policy.baselines import Baseline
from actors.rollout.env_spec import EnvSpec
from sim_core import ENV_ID
from sim_core.config import WorldConfig
from sim_core.outcomes import Outcome
from sim_core.worlds import WorldBatch, is_done
from tests.sim_core.segregation import segregated_fraction

SMALL = {"robots": 4, "groups": 2, "arena_radius_m": 2.5, "horizon_steps": 150, "decision_interval_steps": 2}
SEEDS = list(range(30, 42))


def spec_of(**settings):
    return EnvSpec(ENV_ID, WorldConfig(**(SMALL | {"learners": 1.0} | settings)))


def played_alone(spec, candidate, seed):
    """Outcome, length, return and collisions with others of each robot of a world, and its segregation, by hand."""
    worlds, rule = WorldBatch(spec.world, 1), make_action_rule(spec, candidate, [seed])
    worlds.seed([seed])
    observation, count = worlds.reset(), worlds.num_rows
    gained, hit, segregation = np.zeros(count), np.zeros(count, bool), []
    radius_m = spec.world.robot_radius_m

    def watch():
        """Pairs of learning robots that touch in the step in which both end."""
        position = worlds.positions()[0][worlds.state.learner]
        apart = np.linalg.norm(position[:, None] - position[None], axis=-1) + 9 * np.eye(count)
        ran = ~over
        over[:] = is_done(worlds.outcome)
        touches = ((apart < 2 * radius_m) & ran[None]).any(axis=1)
        hit[ran & (worlds.outcome == Outcome.COLLISION)] = touches[ran & (worlds.outcome == Outcome.COLLISION)]

    over = np.zeros(count, bool)
    while not over.all():
        result = worlds.step(rule.act(observation), watch)
        observation = result.observation
        gained += result.reward
        segregation.append(segregated_fraction(worlds.positions(), 2)[0])
    return result.outcome, result.steps, gained, hit, np.mean(segregation)


@pytest.mark.parametrize("candidate", [Baseline.GREEDY, Baseline.RANDOM])
def test_an_entry_a_robot_and_measures_of_its_world(candidate):
    spec = spec_of()
    stats = evaluate(spec, candidate, SEEDS)
    assert len(stats.outcome) == 8 * len(SEEDS) and (stats.team["learners"] == 8).all()
    for i, seed in enumerate(SEEDS):
        rows = slice(8 * i, 8 * (i + 1))
        outcome, length, gained, hit, segregation = played_alone(spec, candidate, seed)
        np.testing.assert_array_equal(stats.outcome[rows], outcome)
        np.testing.assert_array_equal(stats.length_steps[rows], length)
        np.testing.assert_allclose(stats.episode_return[rows], gained, rtol=1e-5)
        np.testing.assert_array_equal(stats.team["hit_learner"][rows], hit)
        np.testing.assert_allclose(stats.team["segregation"][rows], segregation, rtol=1e-6)
    if candidate is Baseline.RANDOM:
        assert 0 < stats.team["hit_learner"].sum() < (stats.outcome == Outcome.COLLISION).sum() + 1
        assert 0 < stats.team["segregation"].mean() < 1


def test_several_setups_keep_the_order_of_their_seeds():
    worlds = [WorldConfig(**(SMALL | {"robots": robots, "learners": 0.5})) for robots in (4, 6)]
    spec = EnvSpec(ENV_ID, worlds[0], tuple((world, 1.0) for world in worlds))
    stats = evaluate(spec, Baseline.GREEDY, SEEDS)
    at = 0
    for seed in SEEDS:
        world = worlds[seed % 2]
        alone = evaluate(spec.of_setup(world), Baseline.GREEDY, [seed])
        rows = slice(at, at + world.num_learners)
        for name in ("outcome", "length_steps", "team"):
            np.testing.assert_array_equal(getattr(stats, name)[rows], getattr(alone, name))
        at += world.num_learners
    assert at == len(stats.outcome)


def test_a_setup_in_which_a_share_is_one_robot_is_a_team_beside_others():
    """A quarter of a single group of two is one robot: its episodes stand beside those of worlds with several."""
    worlds = [WorldConfig(**(SMALL | size | {"learners": 0.25})) for size in ({"robots": 2, "groups": 1}, {})]
    spec = EnvSpec(ENV_ID, worlds[0], tuple((world, 1.0) for world in worlds))
    assert spec.learners() == [1, 2]
    stats = evaluate(spec, Baseline.GREEDY, SEEDS[:4])
    assert stats.team["learners"].tolist() == [1, 2, 2, 1, 2, 2] and len(stats.outcome) == 6


@pytest.mark.parametrize("ended", ["fl-orca", "leave"])
def test_a_recorded_episode_is_one_robots_own(ended):
    spec = spec_of(ended_learners=ended)
    stats = evaluate(spec, Baseline.GREEDY, SEEDS[:3])
    for entry in range(24):
        episode = record_episode(spec, Baseline.GREEDY, SEEDS[entry // 8], entry % 8)
        assert episode.outcome == stats.outcome[entry] and len(episode.action) == stats.length_steps[entry] + 1
        assert episode.reward.sum() == pytest.approx(stats.episode_return[entry], rel=1e-5)
        assert episode.learner == entry % 8 and np.isfinite(episode.position[:, episode.learner]).all()
    assert record_episode(spec, Baseline.GREEDY, 13).learner == 5  # by default the seed's, modulo their number


def test_a_stored_evaluation_keeps_teams(tmp_path):
    spec, seeds = spec_of(), SEEDS[:2]
    stats = evaluate(spec, Baseline.GREEDY, seeds)
    stored = StoredEvaluation(spec, "greedy", 0, entry_seeds(seeds, stats), stats)
    assert stored.seed.tolist() == [30] * 8 + [31] * 8
    save_evaluation(tmp_path / "e.zarr", stored)
    found = load_evaluation(tmp_path / "e.zarr")
    for a, b in zip((found.seed, *found.stats), (stored.seed, *stats), strict=True):
        np.testing.assert_array_equal(a, b)
