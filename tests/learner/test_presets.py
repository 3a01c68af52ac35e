"""The presets: possible in every setup, and what the text says of `thesis`."""

import dataclasses
from pathlib import Path

import pytest

import deploy
from actors.evaluation.result_table import GROUPS, ROBOTS
from actors.rollout.exploration import epsilon
from learner.presets import preset_config

EXAMPLES = Path(deploy.__file__).parent / "examples"


@pytest.mark.parametrize("name", ["thesis", "best"])
@pytest.mark.parametrize("method", ["sensor", "in", "out"])
def test_every_setup_of_the_dissertation_is_possible(name, method):
    for robots in ROBOTS:
        for groups in GROUPS:
            config = preset_config(name, method, robots, groups)
            assert (config.world.method, config.world.robots, config.world.groups) == (method, robots, groups)


@pytest.mark.parametrize("method", ["sensor", "in", "out"])
def test_thesis_has_the_numbers_of_tables_3_2_and_4_2(method):
    config = preset_config("thesis", method, 10, 2)
    world = config.world
    rates = {config.learning_rate_at(step) for step in (0, 100_000, config.total_env_steps)}
    epsilons = {epsilon(config.epsilon_settings, step, 0, 1) for step in (0, 50_000, config.total_env_steps)}
    assert rates == {0.001} and epsilons == {0.05} and config.loss == "mse"
    assert world.captured_is == "surrounded" and world.lost_ends_episode == (method != "sensor")
    assert (world.horizon_steps, world.learner_speed_m_s, world.reward_scale) == (500, 1.0, 1.0)
    assert (world.inner_radius_m, world.outer_radius_m) == (0.5, 1.5)
    assert world.ellipse_chi_square == 5.991 and world.apf_range_m == world.inner_radius_m
    assert world.swarm_knows_learner == "method" and config.algorithm == "double_dqn"


OURS = {
    "sensor": {"captured_is", "sensor_counts", "decision_interval_steps", "horizon_is"},
    "in": {"captured_is", "lost_ends_episode", "ellipse_reward", "apf_gain_m4_s"},
    "out": {"captured_is", "lost_ends_episode", "ellipse_reward", "apf_gain_m4_s", "decision_interval_steps"},
}
"""World settings in which `best` differs from `thesis`."""


@pytest.mark.parametrize("method", OURS)
def test_best_differs_from_thesis_in_these_settings_of_the_world_alone(method):
    thesis, best = (dataclasses.asdict(preset_config(name, method, 10, 2).world) for name in ("thesis", "best"))
    assert {name for name in thesis if thesis[name] != best[name]} == OURS[method]


@pytest.mark.parametrize("method", OURS)
def test_a_generalist_learns_all_setups_in_the_world_of_best(method):
    best, general = (preset_config(name, method, 10, 2) for name in ("best", "generalist"))
    assert [(world.robots, world.groups) for world in general.env.worlds] == [(r, g) for r in ROBOTS for g in GROUPS]
    one, other = (dataclasses.asdict(config.world) for config in (best, general))
    assert {name for name in one if one[name] != other[name]} <= {"group_rows", "apf_rows"}  # how the state is written
    assert (general.network == "pooled") == (method != "sensor")


@pytest.mark.parametrize("name", ["thesis", "best", "generalist"])
def test_a_method_without_presets_takes_m_sensors_and_its_transitions_are_not_turned(name):
    own, ours = (preset_config(name, method) for method in (f"{EXAMPLES}/compass.py:Compass", "sensor"))
    assert not own.random_turns
    assert dataclasses.replace(own, world=ours.world, random_turns=ours.random_turns) == ours
