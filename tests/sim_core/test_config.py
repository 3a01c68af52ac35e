"""WorldConfig: every refusal names its field, every setup of the dissertation is accepted."""

import dataclasses
import itertools
import math

import pytest

from sim_core.checks import ConfigError
from sim_core.config import (
    ANGLES,
    LARGEST,
    LARGEST_REWARD,
    MAX_DELAY_STEPS,
    MAX_HEADINGS,
    MAX_SPEED_LEVELS,
    MAX_TRACK_STEPS,
    NON_NEGATIVE,
    POSITIVE,
    SHARES,
    WorldConfig,
)
from sim_core.scenes.circle import start_grid_radius_m

DEFAULTS = {field.name: field.default for field in dataclasses.fields(WorldConfig)}
WHOLE = [name for name, value in DEFAULTS.items() if type(value) is int]
REALS = [name for name, value in DEFAULTS.items() if type(value) is float]
FLAGS = [name for name, value in DEFAULTS.items() if type(value) is bool]
OTHER_BOUNDS = {  # values that are accepted, and values that are refused
    "burst_loss": ((0.0, 0.5, 10 / 11), (-0.1, 0.92, 1.0, 2.0)),  # a burst of 10 steps, then one step without
    "burst_steps": ((1.0, 500.0), (0.99, 0.0, -1.0, 1e7)),
    "sensing_range_m": ((0.0, 0.2, 100.0), (0.19, -1.0, 1e7)),
    "field_of_view_deg": ((0.1, 360.0), (0.0, -90.0, 360.1)),
    "heading_error_deg": ((0.0, 180.0), (-0.1, 180.1)),
}
NAMES = [name for name, value in DEFAULTS.items() if type(value) is str]


def refuses(field, **settings):
    """Checks that the settings are refused with a message that names `field`."""
    with pytest.raises(ConfigError, match=rf"\b{field}\b"):
        WorldConfig(**settings)


@pytest.mark.parametrize(
    ("robots", "groups", "method"),
    list(itertools.product((5, 10, 15, 20, 25), (1, 2, 3, 4, 8), ("sensor", "in", "out"))),
)
def test_setups_of_the_dissertation_are_accepted(robots, groups, method):
    config = WorldConfig(robots=robots, groups=groups, method=method)
    assert config.num_robots == robots * groups
    assert config.setup == f"{robots}r×{groups}g"


def test_table_3_2_is_the_default():
    config = WorldConfig()
    assert (config.inner_radius_m, config.outer_radius_m, config.learner_speed_m_s) == (0.5, 1.5, 1.0)
    assert (config.horizon_steps, config.reward_scale) == (500, 1.0)


def test_fields_are_of_four_kinds_and_every_real_one_has_a_bound():
    assert len(WHOLE) + len(REALS) + len(FLAGS) + len(NAMES) + len(["sources"]) == len(DEFAULTS)
    assert sorted(POSITIVE + NON_NEGATIVE + ANGLES + SHARES + list(OTHER_BOUNDS)) == sorted(REALS)


@pytest.mark.parametrize("name", REALS)
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, "1", None, True])
def test_reals_must_be_finite_numbers(name, value):
    refuses(name, **{name: value})


@pytest.mark.parametrize("name", WHOLE)
@pytest.mark.parametrize("value", [3.0, "3", None, True])
def test_whole_numbers_must_be_whole(name, value):
    refuses(name, **{name: value})


@pytest.mark.parametrize("name", FLAGS)
@pytest.mark.parametrize("value", [1, 0.0, "yes", None])
def test_flags_must_be_bool(name, value):
    refuses(name, **{name: value})


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("value", ["", "other", True, None])
def test_names_must_be_known(name, value):
    refuses(name, **{name: value})


@pytest.mark.parametrize("name", POSITIVE)
@pytest.mark.parametrize("value", [0.0, -1.0, 0])
def test_positive_fields(name, value):
    refuses(name, **{name: value})


@pytest.mark.parametrize("name", NON_NEGATIVE)
def test_non_negative_fields(name):
    refuses(name, **{name: -0.01})
    WorldConfig(**{name: 0.0})


@pytest.mark.parametrize("name", ANGLES)
def test_angles(name):
    refuses(name, **{name: 0.0})
    refuses(name, **{name: 180.1})
    WorldConfig(**{name: 180.0})


@pytest.mark.parametrize("name", SHARES)
def test_shares(name):
    for value in (-0.01, 1.01, 2.0):
        refuses(name, **{name: value})
    for value in (0.0, 1.0):
        WorldConfig(**{name: value})


@pytest.mark.parametrize("name", OTHER_BOUNDS)
def test_other_bounds(name):
    accepted, refused = OTHER_BOUNDS[name]
    for value in refused:
        refuses(name, **{name: value})
    for value in accepted:
        assert getattr(WorldConfig(**{name: value}), name) == value


def test_conditions_that_make_nothing_worse_are_none():
    assert not WorldConfig().senses_badly and not WorldConfig().drives_badly
    assert not WorldConfig(burst_steps=3.0, shield="orca", conditions="drawn").senses_badly
    assert WorldConfig(field_of_view_deg=359.0).senses_badly and WorldConfig(dropped_mates=1).senses_badly
    assert WorldConfig(command_delay_steps=1).drives_badly and not WorldConfig(speed_error=0.1).senses_badly


def test_a_speed_error_counts_for_the_distance_of_a_step():
    refuses("time_step_s", learner_speed_m_s=3.0, speed_error=0.5)
    assert WorldConfig(learner_speed_m_s=2.0, speed_error=0.5).top_speed_m_s == 3.0


@pytest.mark.parametrize(
    ("name", "below", "lowest", "highest", "above"),
    [
        ("robots", 1, 2, None, None),
        ("groups", 0, 1, None, None),
        ("sectors", 1, 2, MAX_HEADINGS, MAX_HEADINGS + 1),
        ("speed_levels", 0, 1, MAX_SPEED_LEVELS, MAX_SPEED_LEVELS + 1),
        ("horizon_steps", 0, 1, None, None),
        ("max_neighbours", 0, 1, 64, 65),
        ("outside_limit_steps", 0, 1, None, None),
        ("position_delay_steps", -1, 0, MAX_DELAY_STEPS, MAX_DELAY_STEPS + 1),
        ("command_delay_steps", -1, 0, MAX_DELAY_STEPS, MAX_DELAY_STEPS + 1),
        ("track_steps", -1, 0, MAX_TRACK_STEPS, MAX_TRACK_STEPS + 1),
        ("dropped_mates", -1, 0, 9, 10),  # of 10 robots a group one is the learning robot
    ],
)
def test_counts(name, below, lowest, highest, above):
    refuses(name, **{name: below})
    assert getattr(WorldConfig(**{name: lowest}), name) == lowest
    if highest is not None:
        assert getattr(WorldConfig(**{name: highest}), name) == highest
        refuses(name, **{name: above})


def test_too_many_robots_for_one_world():
    for field in ("robots", "groups"):
        refuses(field, robots=1001, groups=100, arena_radius_m=1e5)


def test_pairs_that_contradict_each_other():
    for field in ("inner_radius_m", "outer_radius_m"):
        refuses(field, inner_radius_m=1.5, outer_radius_m=1.5)
    for field in ("orca_radius_m", "robot_radius_m"):
        refuses(field, orca_radius_m=0.09)
    WorldConfig(orca_radius_m=0.1)


@pytest.mark.parametrize("speed", ["max_speed_m_s", "learner_speed_m_s"])
def test_a_robot_may_not_jump_past_another(speed):
    refuses("time_step_s", **{speed: 5.0})
    WorldConfig(**{speed: 4.0})


def test_the_sum_of_two_velocities_may_not_jump_past_another_robot():
    refuses("time_step_s", method="out", learner_speed_limit_m_s=5.0)
    WorldConfig(method="out", learner_speed_limit_m_s=4.0)
    WorldConfig(method="in", learner_speed_limit_m_s=5.0)
    for field in ("learner_speed_limit_m_s", "learner_speed_m_s"):
        refuses(field, method="out", learner_speed_limit_m_s=0.9)
    assert WorldConfig(method="out", learner_speed_limit_m_s=3.0).top_speed_m_s == 3.0
    assert WorldConfig(method="in", learner_speed_limit_m_s=3.0).top_speed_m_s == 1.0


def test_an_ellipse_needs_two_robots_besides_the_learning_robot():
    for method in ("in", "out"):
        refuses("robots", method=method, robots=2)
        WorldConfig(method=method, robots=2, ellipse_counts_learner=True)


@pytest.mark.parametrize(
    ("method", "known", "fails"), [("sensor", True, False), ("in", False, True), ("out", False, True)]
)
def test_the_method_decides_what_is_left_to_it(method, known, fails):
    config = WorldConfig(method=method)
    assert (config.learner_is_known, config.timeout_fails) == (known, fails)
    for word, answer in (("yes", True), ("no", False)):
        assert WorldConfig(method=method, swarm_knows_learner=word).learner_is_known == answer
    for word, answer in (("failure", True), ("cut", False)):
        assert WorldConfig(method=method, horizon_is=word).timeout_fails == answer


def test_robots_may_not_overlap_at_the_start():
    refuses("start_spacing_m", start_spacing_m=0.29)
    WorldConfig(start_spacing_m=0.31)
    refuses("start_jitter_m", start_jitter_m=0.13)


def test_the_learning_robot_may_not_start_lost():
    WorldConfig(start_spacing_m=1.3)
    refuses("start_spacing_m", start_spacing_m=1.4)
    # neighbours on the grid can be shifted apart on both axes: hypot(1.48, 0.28) > 1.5 > 1.48
    refuses("start_jitter_m", robots=2, start_spacing_m=1.2, start_jitter_m=0.14)


def test_groups_must_fit_the_circle():
    for field in ("arena_radius_m", "robots", "groups"):
        refuses(field, robots=25, groups=8, arena_radius_m=3.0)
    refuses("arena_radius_m", robots=25, groups=2, arena_radius_m=1.4)


def test_start_grid_radius_reaches_the_corner():
    config = WorldConfig(robots=10, start_spacing_m=0.5, start_jitter_m=0.1)  # a grid of 3 rows by 4 columns
    assert start_grid_radius_m(config) == pytest.approx(math.hypot(0.75 + 0.1, 0.5 + 0.1))


def test_the_configuration_is_frozen_and_refuses_unknown_keys():
    with pytest.raises(dataclasses.FrozenInstanceError):
        WorldConfig().robots = 3
    with pytest.raises(TypeError, match="wheels"):
        WorldConfig(wheels=4)


def test_actions_are_headings_with_every_speed_and_a_stop():
    assert WorldConfig(sectors=6).num_actions == 6
    assert WorldConfig(sectors=6, speed_levels=3, stop_action=True).num_actions == 19
    assert WorldConfig(sectors=6, stop_action=True).num_actions == 7


@pytest.mark.parametrize("name", POSITIVE + NON_NEGATIVE)
def test_a_number_that_float32_cannot_square_is_refused(name):
    largest = LARGEST_REWARD if name == "reward_scale" else LARGEST
    refuses(name, **{name: 10 * largest})


@pytest.mark.parametrize("method", ["sensor", "in", "out"])
@pytest.mark.parametrize(
    ("field", "settings"),
    [
        ("orca_horizon_s", {"orca_horizon_s": 0.01}),
        ("orca_horizon_s", {"orca_horizon_s": 0.15, "time_step_s": 0.16}),
        ("shield_horizon_s", {"shield_horizon_s": 0.01}),
        ("neighbour_range_m", {"neighbour_range_m": 0.4}),
        ("neighbour_range_m", {"orca_radius_m": 0.8}),
    ],
)
def test_ranges_and_horizons_that_see_nothing_in_time_are_refused(method, field, settings):
    refuses(field, method=method, **settings)


@pytest.mark.parametrize(
    ("method", "field"), [("sensor", "inner_radius_m"), ("in", "apf_range_m"), ("out", "apf_range_m")]
)
def test_a_range_of_colliding_robots_alone_is_refused(method, field):
    refuses(field, method=method, **{field: 0.2})
    assert getattr(WorldConfig(method=method, **{field: 0.21}), field) == 0.21
    other = {"sensor": "in"}.get(method, "sensor")
    assert getattr(WorldConfig(method=other, **{field: 0.2}), field) == 0.2
