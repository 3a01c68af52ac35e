"""M_IN ("INforce"): the potential field is an input of the network; the robot moves by the network alone (Alg. 4.1)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_core.config import WorldConfig
from sim_core.methods.group_ellipses import ELLIPSE_COLUMNS, FIELD_COLUMNS, EnclosedMethod
from sim_core.methods.headings import heading_velocities, write_headings
from sim_core.state import WorldState


class InsideMethod(EnclosedMethod):
    """M_IN: m x 9 values (a, b, x_c, y_c, theta, x_g, y_g, u_apf_x, u_apf_y), velocity u_nn."""

    def __init__(self, config: WorldConfig) -> None:
        """Takes its constants from `config`."""
        super().__init__(config, ELLIPSE_COLUMNS + FIELD_COLUMNS)
        self._velocities = heading_velocities(config, np.float32)

    def velocity(self, state: WorldState, action: NDArray[np.int64], out_x: Any, out_y: Any) -> None:
        """Eq. 3.4: constant speed towards the chosen sector's centre.

        Raises:
          ValueError: there is not one action a world, or one is none of the actions.
        """
        write_headings(self._velocities, action, out_x, out_y)
