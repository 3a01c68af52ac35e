"""M_IN ("INforce"): the potential field is an input of the network; the robot moves by the network alone (Alg. 4.1)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_core.config import WorldConfig
from sim_core.methods.base import Preset, Rule
from sim_core.methods.group_ellipses import (
    BEST_WORLD,
    ELLIPSE_COLUMNS,
    FIELD_COLUMNS,
    MOST_GROUPS,
    POOLED,
    THESIS,
    TURNED,
    EllipseMethod,
)
from sim_core.methods.headings import heading_velocities

TAUGHT: dict[str, Any] = {**TURNED, "discount": 0.99, "teacher": "field"}


class InsideMethod(EllipseMethod):
    """M_IN: m x 9 values (a, b, x_c, y_c, theta, x_g, y_g, u_apf_x, u_apf_y), velocity u_nn."""

    label = "M_IN"
    robot_module = "learner.export.ellipse_methods:InsideRobot"
    row_size = ELLIPSE_COLUMNS + FIELD_COLUMNS
    presets = {
        "thesis": THESIS,
        "best": Preset(TAUGHT, BEST_WORLD),
        "generalist": Preset(TAUGHT | POOLED, {**BEST_WORLD, "group_rows": MOST_GROUPS, "apf_rows": "all"}),
    }

    @classmethod
    def rules(cls, config: WorldConfig) -> dict[str, Rule]:
        """`greedy` of the ellipse methods, and `field`: the action nearest to what the potential field asks for.

        That is u_apf of all robots, and the vector to the own group's centre, shortened to the learning robot's speed
        times 1 s (Khatib 1986: an attractive and a repulsive part).
        """
        velocities = heading_velocities(config, np.float64)
        every_row_holds_all = config.apf_rows == "all"

        def field(observation: NDArray[Any]) -> NDArray[np.int64]:
            rows = observation.reshape(len(observation), -1, cls.row_size).astype(np.float64)
            centre = rows[:, 0, 2:4] / config.ellipse_scale_per_m
            length = np.linalg.norm(centre, axis=1, keepdims=True)
            attraction = centre * np.minimum(1.0, config.learner_speed_m_s / np.maximum(length, 1e-9))
            repulsion = rows[:, 0, 7:] if every_row_holds_all else rows[:, :, 7:].sum(axis=1)
            error = np.linalg.norm((attraction + repulsion)[:, None] - velocities, axis=2)
            return np.asarray(error.argmin(axis=1), np.int64)

        return super().rules(config) | {"field": field}
