"""M_OUT ("OUTforce"): the robot moves by the sum of the network's velocity and the potential field's (Alg. 4.2).

The text bounds neither summand. Here u_apf is limited (see apf.py), and the sum is shortened to the learning robot's
speed limit, which keeps its direction; with the default of 1 m/s it is never faster than u_nn or the swarm.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_core.checks import require
from sim_core.config import WorldConfig
from sim_core.jit import StateKernel, kernel
from sim_core.methods.apf import field_of, field_params, limited
from sim_core.methods.base import Preset
from sim_core.methods.group_ellipses import BEST_WORLD, MOST_GROUPS, POOLED, THESIS, TURNED, EllipseMethod
from sim_core.packed import packed
from sim_core.state import WorldState, world_of

TAUGHT: dict[str, Any] = {**TURNED, "teacher": "greedy"}
SLOW_WORLD: dict[str, Any] = {**BEST_WORLD, "decision_interval_steps": 4}


@kernel
def _add_field(state, out_x, out_y, speed_limit_m_s, params):
    p = params[0]
    for row in range(out_x.shape[0]):
        world = world_of(state, row)
        pos_x, pos_y = state.pos_x[world], state.pos_y[world]
        x, y = field_of(state.learner[row], 0, pos_x.shape[0], pos_x, pos_y, p)
        out_x[row], out_y[row] = limited(out_x[row] + x, out_y[row] + y, speed_limit_m_s)


class OutsideMethod(EllipseMethod):
    """M_OUT: m x 7 values (a, b, x_c, y_c, theta, x_g, y_g), velocity u_nn + u_apf."""

    label = "M_OUT"
    robot_module = "learner.export.ellipse_methods:OutsideRobot"
    presets = {
        "thesis": THESIS,
        "best": Preset(TAUGHT, SLOW_WORLD),
        "generalist": Preset(TAUGHT | POOLED, {**SLOW_WORLD, "group_rows": MOST_GROUPS}),
    }

    def __init__(self, config: WorldConfig) -> None:
        super().__init__(config)
        self._add_field = StateKernel(_add_field)
        self._field = packed(field_params(config))
        self._speed_limit_m_s = float(config.learner_speed_limit_m_s)

    @classmethod
    def check(cls, config: WorldConfig) -> None:
        """Raises ConfigError where M_IN's would, or where the sum may be slower than u_nn alone."""
        super().check(config)
        require(
            config.learner_speed_limit_m_s >= config.learner_speed_m_s,
            f"learner_speed_limit_m_s ({config.learner_speed_limit_m_s}) must be at least learner_speed_m_s "
            f"({config.learner_speed_m_s}), the speed of u_nn alone",
        )

    @classmethod
    def top_speed_m_s(cls, config: WorldConfig) -> float:
        """The limit of the sum u_nn + u_apf."""
        return config.learner_speed_limit_m_s

    def velocity(self, state: WorldState, action: NDArray[np.int64], out_x: Any, out_y: Any) -> None:
        """u_l = u_nn + u_apf (4.2.2), with u_nn of Eq. 3.4.

        Raises:
          ValueError: there is not one action a row, or one is none of the actions.
        """
        super().velocity(state, action, out_x, out_y)
        self._add_field(state, out_x, out_y, self._speed_limit_m_s, self._field)
