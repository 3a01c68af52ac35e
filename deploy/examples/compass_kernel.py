"""The method of compass.py with a kernel: `shoal train --method deploy/examples/compass_kernel.py:FastCompass`."""

import numpy as np

from sim_core.jit import kernel
from sim_core.methods.base import Method
from sim_core.state import own_group


@kernel
def perceive(state, mask, out):
    for world in range(mask.shape[0]):
        if not mask[world]:
            continue
        learner, (_, begin, end) = state.learner[world], own_group(state, world)
        pos_x, pos_y, nearest_sq, known = state.pos_x[world], state.pos_y[world], np.inf, 0
        out[world, :] = 0.0
        for robot in range(pos_x.shape[0]):
            dx, dy = pos_x[robot] - pos_x[learner], pos_y[robot] - pos_y[learner]
            if not np.isfinite(dx):  # a robot that is not sensed
                continue
            if begin <= robot < end:
                out[world, 0], out[world, 1], known = out[world, 0] + dx, out[world, 1] + dy, known + 1
            elif dx * dx + dy * dy < nearest_sq:
                nearest_sq, out[world, 2], out[world, 3] = dx * dx + dy * dy, dx, dy
        out[world, 0], out[world, 1] = out[world, 0] / known, out[world, 1] / known


class FastCompass(Method):
    """Two offsets in metres, cut at R2; headings, reward and outcome are M_sensor's."""

    swarm_knows_learner = True
    fits_any_groups = True

    @classmethod
    def observation_names(cls, config):
        return "x of the group", "y of the group", "x of the nearest other", "y of the nearest other"

    def perceive(self, state, mask, out):
        perceive(state, mask, out)
        np.clip(out, -self.config.outer_radius_m, self.config.outer_radius_m, out=out)
