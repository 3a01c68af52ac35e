"""M_IN and M_OUT: which velocity the learning robot gets."""

import numpy as np
import pytest

from sim_core.config import WorldConfig
from sim_core.methods import make_method
from sim_core.methods.apf import field_params, repulsion
from sim_core.methods.headings import heading_velocities

REAL = np.float32
FAR = [(20, 20), (30, 30), (40, 40)]


def velocity(make_state, others, action=4, **settings):
    """u_l of a robot at (0, 0) with its mates at `others`; action 4 of 8 heads 22.5 degrees above the x-axis."""
    config = WorldConfig(**({"robots": 4, "groups": 1} | settings))
    state = make_state(config, [(0, 0), *others], [(9, 9)])
    out_x, out_y = np.zeros(1, REAL), np.zeros(1, REAL)
    make_method(config).velocity(state, np.array([action]), out_x, out_y)
    return np.array([out_x[0], out_y[0]])


def test_nobody_near_leaves_the_heading(make_state):
    for action, expected in enumerate(heading_velocities(WorldConfig(), REAL)):
        for method in ("in", "out"):
            np.testing.assert_allclose(velocity(make_state, FAR, action, method=method), expected, atol=1e-6)


def test_m_out_adds_the_field_and_m_in_does_not(make_state):
    others, heading = [(-0.4, 0.1), *FAR[1:]], heading_velocities(WorldConfig(), REAL)[4]
    push = repulsion(-0.4, 0.1, field_params(WorldConfig()))
    np.testing.assert_allclose(velocity(make_state, others, method="in"), heading, atol=1e-6)
    found = velocity(make_state, others, method="out", learner_speed_limit_m_s=3.0)
    np.testing.assert_allclose(found, heading + push, atol=1e-6)


def test_the_sum_keeps_its_direction_and_the_speed_limit(make_state):
    others, heading = [(-0.3, 0.1), *FAR[1:]], heading_velocities(WorldConfig(), REAL)[4]
    total = heading + repulsion(-0.3, 0.1, field_params(WorldConfig()))
    for limit in (1.0, 1.2):
        found = velocity(make_state, others, method="out", learner_speed_limit_m_s=limit)
        np.testing.assert_allclose(found, total * limit / np.hypot(*total), atol=1e-6)


def test_the_field_can_turn_the_heading_round(make_state):
    found = velocity(make_state, [(0.22, 0.09), *FAR[1:]], method="out")
    assert found[0] < -0.5


@pytest.mark.parametrize("method", ["in", "out"])
@pytest.mark.parametrize("action", [[0, 8], [-1, 0], [0], [0, 1, 2]])
def test_velocity_refuses_what_is_no_action(method, action):
    chosen, out_x, out_y = make_method(WorldConfig(method=method)), np.zeros(2, REAL), np.zeros(2, REAL)
    with pytest.raises(ValueError, match="action"):
        chosen.velocity(None, np.array(action), out_x, out_y)
