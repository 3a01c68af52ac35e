"""The inputs and outputs of exported policies: names, shapes, units and what they mean."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from actors.rollout.vector_env import EnvShape
from sim_core.config import WorldConfig
from sim_core.methods import make_method
from sim_core.methods.group_ellipses import ELLIPSE_COLUMNS

FRAME = (
    "positions are those of other robots and of goals less the robot's own; x and y along the axes of the world, "
    "the same for positions, goals and velocities, whichever way the robot faces"
)


class Port(NamedTuple):
    """One input or output of an exported policy; a size that is a name may be any number."""

    name: str
    dtype: str
    shape: tuple[int | str, ...]
    unit: str
    meaning: str

    def described(self) -> dict[str, Any]:
        """As plain values for JSON."""
        return {**self._asdict(), "shape": list(self.shape)}


def _sensor_inputs() -> list[Port]:
    unused = "False where a place is not used; its position then does not count"
    return [
        Port("own", "float32", ("batch", "own_robots", 2), "m", "relative positions of the own group's other robots"),
        Port("own_mask", "bool", ("batch", "own_robots"), "", unused),
        Port("other", "float32", ("batch", "other_robots", 2), "m", "relative positions of other groups' robots"),
        Port("other_mask", "bool", ("batch", "other_robots"), "", unused),
    ]


def _ellipse_inputs(config: WorldConfig) -> list[Port]:
    around = "in their order around the start circle, from the own one on"
    order = "in any order" if config.group_order == "nearest" else around
    groups = f"group 0 is the own one, without the robot itself; the others {order}"
    return [
        Port(
            "positions",
            "float32",
            ("batch", config.groups, "robots", 2),
            "m",
            f"relative positions of all robots of every group: {groups}",
        ),
        Port(
            "mask",
            "bool",
            ("batch", config.groups, "robots"),
            "",
            "False where a place is not used; its position then does not count; every group needs one robot",
        ),
        Port("goals", "float32", ("batch", config.groups, 2), "m", "relative positions of the groups' goals"),
    ]


def robot_inputs(config: WorldConfig) -> list[Port]:
    """What the module of `config.method` takes, in its order."""
    return _sensor_inputs() if config.method == "sensor" else _ellipse_inputs(config)


def _observation_meaning(config: WorldConfig) -> str:
    if config.method == "sensor":
        what = "own, then other robots" if config.sensor_counts == "separate" else "own less other robots"
        return (
            f"{what} in {config.sectors} sectors from angle -pi on, counterclockwise: "
            f"nearer than {config.inner_radius_m} m, then up to {config.outer_radius_m} m"
        )
    columns = "a, b, x_c, y_c, theta, x_g, y_g, u_apf_x, u_apf_y".split(", ")
    if config.method == "out":
        columns = columns[:ELLIPSE_COLUMNS]
    return (
        f"rows of groups, each {', '.join(columns)}; lengths of ellipses × {config.ellipse_scale_per_m} per m, "
        f"goals × {config.goal_scale_per_m} per m, theta in rad"
    )


def robot_outputs(config: WorldConfig) -> list[Port]:
    """What the module of `config.method` gives, in its order."""
    (size,) = make_method(config).observation_shape
    speed = config.learner_speed_limit_m_s if config.method == "out" else config.learner_speed_m_s
    undecided = "" if config.method == "sensor" else "; -1 and no velocity where a group has no robot"
    stop = ", the last one stops" if config.stop_action else ""
    return [
        Port("velocity", "float32", ("batch", 2), "m/s", f"what to drive until the next decision, at most {speed} m/s"),
        Port("action", "int64", ("batch",), "", f"sector to head for, from angle -pi on{stop}{undecided}"),
        Port(
            "action_values", "float32", ("batch", config.num_actions), "", "discounted reward promised by each action"
        ),
        Port("observation", "float32", ("batch", size), "", _observation_meaning(config)),
    ]


def bare_inputs(shape: EnvShape) -> list[Port]:
    """What a bare policy takes."""
    space = shape.observation_space
    assert space.dtype is not None
    dtype = np.dtype(space.dtype).name
    return [Port("observation", dtype, ("batch", *space.shape), "", "as the environment gives it")]


def bare_outputs(shape: EnvShape) -> list[Port]:
    """What a bare policy gives, in its order."""
    return [
        Port("action", "int64", ("batch",), "", "action of the highest value"),
        Port("action_values", "float32", ("batch", shape.num_actions), "", "discounted reward promised by each action"),
    ]
