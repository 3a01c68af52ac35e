"""M_IN ("INforce"): the potential field is an input of the network; the robot moves by the network alone (Alg. 4.1)."""

from __future__ import annotations

from sim_core.methods.group_ellipses import ELLIPSE_COLUMNS, FIELD_COLUMNS, EllipseMethod


class InsideMethod(EllipseMethod):
    """M_IN: m x 9 values (a, b, x_c, y_c, theta, x_g, y_g, u_apf_x, u_apf_y), velocity u_nn."""

    label = "M_IN"
    robot_module = "learner.export.ellipse_methods:InsideRobot"
    columns = ELLIPSE_COLUMNS + FIELD_COLUMNS
