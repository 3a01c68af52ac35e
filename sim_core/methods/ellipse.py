"""The ellipse that stands for a group: a confidence region of its robots' positions (4.2.1, Eq. 4.1 to 4.7).

The positions count as a sample of a Gaussian. C is their covariance (divided by n - 1), e_1 and e_2 the
directions of its larger and smaller eigenvalue. As in Eq. 4.3 and 4.4, `a` belongs to e_2 and `b` to e_1: `a` is the
smaller half-axis. The equations take lengths of eigenvectors, which would make all ellipses alike; eigenvalues are
meant. `theta` is the angle from the x-axis to e_1, in (-pi/2, pi/2]. Eq. 4.2 as printed is the same ellipse if its
theta is read as the angle from the y-axis (tan theta = e_1x / e_1y); with the angle from the x-axis it would put the
smaller half-axis along e_1.

Does the learning robot count in its own group's ellipse? The text has it in the group (4.1) and takes all robots
(4.2.1), which says yes. But one of n robots is never farther than (n - 1) / sqrt(n) deviations from a sample that it
is part of: with 5 robots and C = 5.991 it could hardly leave its ellipse, and the text reports lost robots there.
So the default is no; with the axes as printed, half as long, yes works too.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from sim_core.config import WorldConfig
from sim_core.jit import kernel

NOBODY = -1
"""Robot to leave out of an ellipse where none is."""


class EllipseParams(NamedTuple):
    """Constants of a group's ellipse."""

    full: bool
    axis_scale: float
    smallest_m: float
    counts_learner: bool


def ellipse_params(config: WorldConfig) -> EllipseParams:
    """The constants of `config`; half-axes are `axis_scale` standard deviations."""
    scale = math.sqrt(config.ellipse_chi_square)
    return EllipseParams(
        full=config.ellipse_covariance == "full",
        axis_scale=scale if config.ellipse_axes == "confidence" else scale / 2,
        smallest_m=float(config.ellipse_smallest_half_axis_m),
        counts_learner=config.ellipse_counts_learner,
    )


@kernel
def group_centre(begin, end, pos_x, pos_y, left_out):
    """(x_c, y_c, n): mean position of robots begin..end-1 but `left_out`, metres, and their number (Eq. 4.5, 4.6).

    Robots at NaN, which are not sensed, do not count; the mean of none is NaN.
    """
    x, y, count = 0.0, 0.0, 0
    for i in range(begin, end):
        if i != left_out and pos_x[i] == pos_x[i]:
            x, y, count = x + pos_x[i], y + pos_y[i], count + 1
    return x / count, y / count, count


@kernel
def group_covariance(begin, end, pos_x, pos_y, left_out):
    """(x_c, y_c, sigma_x^2, sigma_xy, sigma_y^2) of robots begin..end-1 but `left_out`; all 0 with one robot."""
    x_c, y_c, count = group_centre(begin, end, pos_x, pos_y, left_out)
    xx, xy, yy = 0.0, 0.0, 0.0
    for i in range(begin, end):
        if i != left_out and pos_x[i] == pos_x[i]:
            dx, dy = pos_x[i] - x_c, pos_y[i] - y_c
            xx, xy, yy = xx + dx * dx, xy + dx * dy, yy + dy * dy
    freedom = max(count - 1, 1)
    return x_c, y_c, xx / freedom, xy / freedom, yy / freedom


@kernel
def principal_axes(xx, xy, yy):
    """(largest, smallest, theta): eigenvalues of [[xx, xy], [xy, yy]] and the angle from the x-axis to the first.

    theta is in (-pi/2, pi/2]; it is 0 where all directions are alike.
    """
    mean, half = 0.5 * (xx + yy), 0.5 * (xx - yy)
    root = math.sqrt(half * half + xy * xy)
    theta = 0.5 * math.atan2(xy + 0.0, half)  # + 0.0 turns -0 into 0, whose angle would be -pi
    return mean + root, max(mean - root, 0.0), theta


@kernel
def group_ellipse(begin, end, pos_x, pos_y, left_out, p):
    """(a, b, x_c, y_c, theta) of robots begin..end-1 but `left_out`; metres, radians. `p`: EllipseParams."""
    x_c, y_c, xx, xy, yy = group_covariance(begin, end, pos_x, pos_y, left_out)
    largest, smallest, theta = principal_axes(xx, xy if p.full else 0.0, yy)
    a = max(p.axis_scale * math.sqrt(smallest), p.smallest_m)
    b = max(p.axis_scale * math.sqrt(largest), p.smallest_m)
    return a, b, x_c, y_c, theta


@kernel
def in_ellipse(x, y, a, b, x_c, y_c, theta):
    """Eq. 4.2: whether the point (x, y) lies in the ellipse, its edge included."""
    cos, sin = math.cos(theta), math.sin(theta)
    along = (x - x_c) * cos + (y - y_c) * sin
    across = (y - y_c) * cos - (x - x_c) * sin
    return (across / a) ** 2 + (along / b) ** 2 <= 1.0


@kernel
def left_out_of(learner, p):
    """The robot that does not count in an ellipse: the learning robot, or NOBODY."""
    return NOBODY if p.counts_learner else learner
