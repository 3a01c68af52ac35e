"""The k nearest robots within a range, nearest first."""

from __future__ import annotations

from sim_core.jit import kernel


@kernel
def find_neighbours(robot, pos_x, pos_y, hidden, range_sq, neighbours, distances_sq):
    """Finds one robot's nearest neighbours by brute force; ties go to the lower index.

    Args:
      robot: index of the robot.
      pos_x, pos_y: `[num_robots]`, one world's positions, metres.
      hidden: index of a robot that nobody perceives, or -1.
      range_sq: square of the largest distance, m^2 (exclusive).
      neighbours: `[max_neighbours]` int32, written, nearest first.
      distances_sq: scratch `[max_neighbours]`.

    Returns:
      Number of neighbours written.
    """
    capacity = neighbours.shape[0]
    count = 0
    limit_sq = range_sq
    x, y = pos_x[robot], pos_y[robot]
    for other in range(pos_x.shape[0]):
        dx, dy = x - pos_x[other], y - pos_y[other]
        dist_sq = dx * dx + dy * dy
        if dist_sq >= limit_sq or other == robot or other == hidden:
            continue
        if count < capacity:
            count += 1
        slot = count - 1
        while slot > 0 and dist_sq < distances_sq[slot - 1]:
            distances_sq[slot] = distances_sq[slot - 1]
            neighbours[slot] = neighbours[slot - 1]
            slot -= 1
        distances_sq[slot] = dist_sq
        neighbours[slot] = other
        if count == capacity:
            limit_sq = distances_sq[count - 1]
    return count
