"""The kernels against RVO2 (pyrvo): one step of the same scene, robot by robot, and the few reasons to differ.

Allowed differences, each shown for the very robot that differs and counted:

* ties: two neighbours are equally far. RVO2 lists them in its tree's order, the worlds by index, and the order
  of the half-planes decides which of several equally good velocities is taken. Shown by numbering the robot's
  neighbours in RVO2's order: the kernels must then give RVO2's velocity.
* same place: a neighbour has the robot's position and velocity. RVO2 divides 0 by 0; every comparison with the
  NaN half-plane is false, so that the neighbour is passed over. The worlds part the two.
  Shown by taking such neighbours away: the kernels must then give RVO2's velocity. Coinciding robots of
  different velocities are no exception.
* too fast: RVO2's third program can leave the speed disc where half-planes are nearly parallel. The worlds clip
  its result, so RVO2's clipped velocity is what they must match.
"""

from typing import NamedTuple

import numpy as np
import pyrvo

from tests.sim_core.kernels import orca_velocities
from tests.sim_core.orca_scenes import Scene, tie_margin_sq

BOUND_M_S = 1e-5
"""Largest difference from RVO2 in either component."""
TOO_FAST, CLIPPED = 1 + 4e-6, 1 + 1e-5
"""Shares of the speed limit above which RVO2 counts as too fast, and above which the worlds surely clip."""
DEFAULTS = {
    "radius_m": 0.2,
    "horizon_s": 2.0,
    "time_step_s": 0.05,
    "max_speed_m_s": 1.0,
    "range_m": 1.5,
    "max_neighbours": 10,
}
SETTINGS = {
    "the worlds' own": {},
    "far sight": {"range_m": 3.0, "max_neighbours": 24, "horizon_s": 5.0},
    "short sight": {"range_m": 0.7, "max_neighbours": 3, "horizon_s": 0.4, "time_step_s": 0.1},
    "large and fast": {"radius_m": 0.35, "max_speed_m_s": 2.5, "time_step_s": 0.02},
    "one neighbour": {"max_neighbours": 1},
}
"""Settings to compare under, as changes of the defaults."""


class Parity(NamedTuple):
    """What a comparison found; sums of several add up with `total`."""

    robots: int = 0
    equal: int = 0  # bit for bit
    too_fast: int = 0
    ties: int = 0
    same_place: int = 0
    unexplained: int = 0
    infeasible: int = 0  # robots that no velocity satisfies by RVO2's half-planes
    worst_m_s: float = 0.0  # among those that need no excuse


def total(parities):
    """Counts added, worst of all."""
    found = list(parities)
    sums = [sum(values) for values in zip(*found, strict=True)][:-1]
    return Parity(*sums, worst_m_s=max((one.worst_m_s for one in found), default=0.0))


def rvo2_step(scene, **settings):
    """RVO2's simulator after one step of the scene."""
    s = DEFAULTS | settings
    horizon_s = s["horizon_s"]
    sim = pyrvo.RVOSimulator(
        s["time_step_s"], s["range_m"], s["max_neighbours"], horizon_s, horizon_s, s["radius_m"], s["max_speed_m_s"]
    )
    pos, vel, pref = (np.asarray(array, np.float32).tolist() for array in scene)
    for i in range(len(pos)):
        sim.add_agent(tuple(pos[i]))
        sim.set_agent_velocity(i, tuple(vel[i]))
        sim.set_agent_pref_velocity(i, tuple(pref[i]))
    sim.do_step()
    return sim


def rvo2_velocities(sim):
    """The simulator's velocities `[n, 2]` float32."""
    new = [sim.get_agent_velocity(i) for i in range(sim.get_num_agents())]
    return np.array([[v.x, v.y] for v in new], np.float32)


def rvo2_neighbours(sim, robot):
    """Indices in RVO2's order."""
    return [sim.get_agent_agent_neighbor(robot, k) for k in range(sim.get_agent_num_agent_neighbors(robot))]


def rvo2_half_planes(sim, robot):
    """Half-planes `[count, 4]` float64: point, direction; permitted velocities lie to the left."""
    lines = [sim.get_agent_orca_line(robot, k) for k in range(sim.get_agent_num_orca_lines(robot))]
    return np.array([[*point, *direction] for direction, point in lines], np.float64).reshape(-1, 4)


def worst_violation(lines, velocity):
    """How far `velocity` lies outside the worst half-plane, m/s (negative: inside all); NaN planes do not count."""
    gap = lines[:, 2] * (lines[:, 1] - velocity[1]) - lines[:, 3] * (lines[:, 0] - velocity[0])
    return np.nanmax(gap, initial=-np.inf)


def speeds(velocity):
    """`[n, 1]` float64."""
    return np.linalg.norm(velocity.astype(np.float64), axis=1, keepdims=True)


def differences(own, theirs, limit_m_s):
    """Per robot, how far its velocity is from RVO2's, m/s, or from RVO2's clipped one where that is too fast."""
    speed = speeds(theirs)
    clipped = theirs * np.where(speed > limit_m_s, limit_m_s / np.maximum(speed, limit_m_s), 1.0)
    to_clipped, to_theirs = (np.abs(own - velocity).max(axis=1, initial=0.0) for velocity in (clipped, theirs))
    return np.where(speed[:, 0] > limit_m_s * CLIPPED, to_clipped, np.minimum(to_clipped, to_theirs))


def excuse(scene, robot, sim, **settings):
    """Name of the count that explains why a robot's velocity is not RVO2's, or "unexplained"."""
    listed = rvo2_neighbours(sim, robot)
    same = [(scene.pos[j] == scene.pos[robot]).all() and (scene.vel[j] == scene.vel[robot]).all() for j in listed]
    kept = [j for j, gone in zip(listed, same, strict=True) if not gone] + [robot]
    again = orca_velocities(*(array[kept] for array in scene), **settings)[-1:]
    limit_m_s = (DEFAULTS | settings)["max_speed_m_s"]
    if not differences(again, rvo2_velocities(sim)[robot : robot + 1], limit_m_s) <= BOUND_M_S:
        return "unexplained"
    if any(same):
        return "same_place"
    reach = {name: settings[name] for name in ("range_m", "max_neighbours") if name in settings}
    return "ties" if tie_margin_sq(scene.pos, **reach)[robot] == 0 else "unexplained"


def compare(scene: Scene, own=None, **settings):
    """Parity of one step of the scene.

    Args:
      scene: one world.
      own: the velocities `[n, 2]` to compare; by default the kernels' own for this scene.
      settings: as of `orca_velocities`.
    """
    own = orca_velocities(*scene, **settings) if own is None else own
    sim = rvo2_step(scene, **settings)
    theirs = rvo2_velocities(sim)
    limit_m_s = (DEFAULTS | settings)["max_speed_m_s"]
    error = differences(own, theirs, limit_m_s)
    fits = error <= BOUND_M_S  # false for NaN
    counts = {"ties": 0, "same_place": 0, "unexplained": 0}
    for robot in np.flatnonzero(~fits):
        counts[excuse(scene, robot, sim, **settings)] += 1
    violated = [worst_violation(rvo2_half_planes(sim, i), theirs[i]) > 1e-4 for i in range(len(theirs))]
    return Parity(
        robots=len(own),
        equal=int((own == theirs).all(axis=1).sum()),
        too_fast=int((speeds(theirs) > limit_m_s * TOO_FAST).sum()),
        infeasible=int(sum(violated)),
        worst_m_s=float(error[fits].max(initial=0.0)),
        **counts,
    )
