"""The grid of conditions: what it holds, what it refuses, and where a player breaks."""

import pytest

from actors.evaluation.conditions import CONDITIONS, Axis, along, breaking_point, grid, parse_axis, world_under
from sim_core.checks import ConfigError
from sim_core.config import WorldConfig


def test_values_have_the_type_of_their_field():
    assert parse_axis("position_loss=0,0.5") == Axis("position_loss", (0.0, 0.5))
    assert parse_axis("dropped_mates=0,2") == Axis("dropped_mates", (0, 2))
    assert parse_axis("shield=none,orca") == Axis("shield", ("none", "orca"))
    assert parse_axis("kinematics=holonomic,unicycle") == Axis("kinematics", ("holonomic", "unicycle"))
    assert all(type(value) is float for value in parse_axis("position_loss=0,1").values)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("position_loss", "an axis is NAME=VALUE"),
        ("position_loss=", "an axis is NAME=VALUE"),
        ("robots=3,4", "'robots' is no condition; there are: position_noise_m, "),
        ("position_loss=0,x", "the values of position_loss must be numbers, not '0,x'"),
        ("dropped_mates=0,1.5", "the values of dropped_mates must be whole numbers"),
        ("position_loss=0,0.5,0", "position_loss must not repeat a value"),
    ],
)
def test_what_is_no_axis_is_refused(text, words):
    with pytest.raises(ConfigError, match=words):
        parse_axis(text)


def test_a_grid_is_every_combination_once():
    axes = [Axis("position_loss", (0.0, 0.5)), Axis("dropped_mates", (0, 1, 2))]
    found = grid(axes)
    assert len(found) == 6 and found[1] == {"position_loss": 0.0, "dropped_mates": 1}
    assert {tuple(one.values()) for one in found} == {(loss, k) for loss in (0.0, 0.5) for k in (0, 1, 2)}
    assert along(axes[1], axes) == [{"position_loss": 0.0, "dropped_mates": k} for k in (0, 1, 2)]
    assert all(condition in found for axis in axes for condition in along(axis, axes))
    with pytest.raises(ConfigError, match="name each axis once"):
        grid([axes[0], axes[0]])


def test_a_world_is_under_the_condition_alone_whatever_it_was_trained_with():
    trained = WorldConfig(
        position_loss=0.4, conditions="drawn", heading_error_deg=9.0, burst_steps=3.0, shield="orca", robots=7
    )
    played = world_under(trained, {"position_delay_steps": 4})
    assert played == WorldConfig(position_delay_steps=4, shield="orca", robots=7)
    assert world_under(trained, {"shield": "none"}).shield == "none"
    turning = WorldConfig(kinematics="unicycle", turn_rate_limit_deg_s=30.0)
    assert world_under(turning, {"position_loss": 0.5}) == WorldConfig(
        kinematics="unicycle", turn_rate_limit_deg_s=30.0, position_loss=0.5
    )
    plain = WorldConfig()
    assert world_under(trained, {}) == WorldConfig(shield="orca", robots=7)
    assert all(getattr(world_under(trained, {}), name) == getattr(plain, name) for name in CONDITIONS)


def test_a_condition_that_cannot_be_is_refused_in_one_sentence():
    with pytest.raises(ConfigError, match="dropped_mates must be between 0 and 4"):
        world_under(WorldConfig(robots=5), {"dropped_mates": 5})


@pytest.mark.parametrize(
    ("rates", "point"),
    [
        ([0.9, 0.8, 0.7], None),
        ([0.9, 0.6, 0.4], 0.75),
        ([0.9, 0.5, 0.1], 0.5),
        ([1.0, 0.0, 0.9], 0.25),
        ([0.4, 0.9, 0.9], 0.0),
    ],
)
def test_where_a_player_breaks(rates, point):
    assert breaking_point([0.0, 0.5, 1.0], rates) == (None if point is None else pytest.approx(point))
