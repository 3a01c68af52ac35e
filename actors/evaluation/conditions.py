"""A grid of conditions to test players under: its axes, its worlds, and where a player breaks. Pure functions."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Sequence
from typing import Any, NamedTuple

from sim_core.checks import require
from sim_core.config import COMMAND_CONDITIONS, SENSE_CONDITIONS, WorldConfig

CONDITIONS = (*SENSE_CONDITIONS, *COMMAND_CONDITIONS, "burst_steps")
"""Fields of the world that a grid sets; what no axis names has its default."""
VARIABLE = (*CONDITIONS, "track_steps", "shield", "kinematics", "turn_rate_limit_deg_s", "acceleration_limit_m_s2")
"""Fields of the world that an axis may name."""
PART_OF = {
    "turn_rate_limit_deg_s": (("kinematics",), "kinematics=unicycle"),
    "acceleration_limit_m_s2": (("kinematics",), "kinematics=unicycle"),
    "burst_steps": (("burst_loss",), "burst_loss=0.3"),
    "track_steps": (("position_loss", "burst_loss", "sensing_range_m", "field_of_view_deg"), "position_loss=0.5"),
}
"""Fields that change nothing where others all have their defaults; with an axis of one of those."""
DEFAULTS = {field.name: field.default for field in dataclasses.fields(WorldConfig)}
BROKEN = 0.5
"""A player breaks where its success rate falls to this."""

Condition = dict[str, Any]
"""Values of the fields that axes name."""


class Axis(NamedTuple):
    """A field of the world and its values, the first of which is the one that other axes are shown at."""

    name: str
    values: tuple[Any, ...]


def parse_axis(text: str) -> Axis:
    """Parses `NAME=VALUE,VALUE,...`.

    Raises:
      ConfigError: it is none, the name is no condition, or a value is no number or stands there twice.
    """
    name, sign, listed = text.partition("=")
    require(bool(sign) and bool(listed), f"an axis is NAME=VALUE,VALUE,..., not {text!r}")
    require(name in VARIABLE, f"{name!r} is no condition; there are: {', '.join(VARIABLE)}")
    kind: Any = type(DEFAULTS[name])
    try:
        values = tuple(kind(value) for value in listed.split(","))
    except ValueError:
        values = ()
    what = "whole numbers" if kind is int else "numbers"
    require(bool(values), f"the values of {name} must be {what}, not {listed!r}")
    require(len(set(values)) == len(values), f"{name} must not repeat a value, as in {listed!r}")
    return Axis(name, values)


def parse_condition(texts: Sequence[str]) -> Condition:
    """Parses a condition, `NAME=VALUE` each.

    Raises:
      ConfigError: see `parse_axis` and `grid`; or a field has several values.
    """
    axes = [parse_axis(text) for text in texts]
    for axis in axes:
        require(len(axis.values) == 1, f"{axis.name} must have one value here; `shoal stress` plays several")
    return grid(axes)[0]


def grid(axes: Sequence[Axis]) -> list[Condition]:
    """All combinations of the axes' values; those of the last axis change first.

    Raises:
      ConfigError: two axes have the same name.
    """
    names = [axis.name for axis in axes]
    require(len(set(names)) == len(names), f"name each axis once, not {', '.join(names)}")
    return [dict(zip(names, values, strict=True)) for values in itertools.product(*(axis.values for axis in axes))]


def world_under(world: WorldConfig, condition: Condition) -> WorldConfig:
    """The world under a condition alone, whatever it was trained with; shield and kinematics stay unless it has them.

    Raises:
      ConfigError: a value cannot be.
    """
    none = {name: DEFAULTS[name] for name in (*CONDITIONS, "conditions")}
    return dataclasses.replace(world, **{**none, **condition})


def check_effects(axes: Sequence[Axis], worlds: Sequence[WorldConfig]) -> None:
    """Refuses axes along which none of the grid's worlds can change.

    Raises:
      ConfigError: there is such an axis.
    """
    for axis in axes:
        if axis.name in PART_OF:
            others, example = PART_OF[axis.name]
            has_effect = any(getattr(world, other) != DEFAULTS[other] for world in worlds for other in others)
            require(has_effect, f"{axis.name} changes nothing by itself; add --vary {example}")


def along(axis: Axis, axes: Sequence[Axis]) -> list[Condition]:
    """The conditions of one axis, in its order, with the others at their first values."""
    first = {other.name: other.values[0] for other in axes}
    return [first | {axis.name: value} for value in axis.values]


def breaking_point(values: Sequence[float], rates: Sequence[float]) -> float | None:
    """Where the success rate first falls to BROKEN along an axis, linearly between its values; None if it does not."""
    if rates[0] <= BROKEN:
        return values[0]
    for (low, before), (high, after) in itertools.pairwise(zip(values, rates, strict=True)):
        if after <= BROKEN:
            return low + (before - BROKEN) / (before - after) * (high - low)
    return None
