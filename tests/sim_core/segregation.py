"""Segregation of the groups (Eq. 3.1) and their distance to their goals (Eq. 3.2)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def mean_pairwise_distances_m(pos: NDArray[np.floating], groups: int, count_self: bool = True) -> NDArray[np.float64]:
    """Mean pairwise distance d_XY between every two groups (Eq. 3.1).

    Args:
      pos: `[..., num_robots, 2]`, metres; groups are contiguous blocks of equal size.
      groups: number of groups.
      count_self: whether d_XX includes each robot's zero distance to itself, as Eq. 3.1 is printed, or only pairs
        i != j (then NaN for groups of one robot).

    Returns:
      `[..., groups, groups]` float64, metres, with d_XX on the diagonal. As printed, 2 d_XY - d_XX - d_YY is the
      energy distance of the two groups and never negative. Groups of equal spread therefore count as segregated even
      when they are mixed.
    """
    points = np.asarray(pos, np.float64)
    delta = points[..., :, None, :] - points[..., None, :, :]
    distance = np.sqrt((delta**2).sum(-1))
    size = points.shape[-2] // groups
    blocks = distance.reshape(*distance.shape[:-2], groups, size, groups, size)
    means: NDArray[np.float64] = blocks.mean(axis=(-3, -1))
    if not count_self:
        own = np.arange(groups)
        means[..., own, own] *= size / (size - 1) if size > 1 else np.nan
    return means


def segregated_fraction(pos: NDArray[np.floating], groups: int, count_self: bool = True) -> NDArray[np.float64]:
    """Fraction of the pairs of groups X != Y that are segregated: d_XX < d_XY and d_YY < d_XY (Section 3.1).

    Args:
      pos: `[..., num_robots, 2]`, metres.
      groups: number of groups.
      count_self: see `mean_pairwise_distances_m`. If false, mixed groups of equal spread are not segregated.

    Returns:
      `[...]` float64 in [0, 1]; 1 if all groups are segregated or there is only one.
    """
    mean = mean_pairwise_distances_m(pos, groups, count_self)
    if groups == 1:
        return np.ones(mean.shape[:-2])
    own = np.diagonal(mean, axis1=-2, axis2=-1)
    segregated = (own[..., :, None] < mean) & (own[..., None, :] < mean)
    first, second = np.triu_indices(groups, 1)
    fraction: NDArray[np.float64] = segregated[..., first, second].mean(-1)
    return fraction


def mean_goal_distance_m(pos: NDArray[np.floating], goal: NDArray[np.floating]) -> NDArray[np.float64]:
    """Mean distance of each group's robots to the group's goal (Eq. 3.2).

    Args:
      pos: `[..., num_robots, 2]`, metres; groups are contiguous blocks of equal size.
      goal: `[..., groups, 2]`, metres.

    Returns:
      `[..., groups]` float64, metres.
    """
    points = np.asarray(pos, np.float64)
    groups = goal.shape[-2]
    by_group = points.reshape(*points.shape[:-2], groups, -1, 2)
    distance = np.sqrt(((by_group - np.asarray(goal, np.float64)[..., :, None, :]) ** 2).sum(-1))
    means: NDArray[np.float64] = distance.mean(-1)
    return means
