"""Compares the kernels with RVO2 (pyrvo) robot by robot: one step of the same scene.

Three differences are allowed. Each is counted, and verified for the robot that differs:

* ties: two neighbours are equally far. RVO2 lists them in the order of its tree, the kernels by index. The order of
  the half-planes decides which of several equally good velocities is taken. Verified by numbering the robot's
  neighbours in RVO2's order: the kernels must then give RVO2's velocity.
* coincident: a neighbour has the robot's position and velocity. RVO2 divides 0 by 0. Every comparison with the NaN
  half-plane is false, so RVO2 ignores the neighbour. The kernels separate the two. Verified by removing such
  neighbours: the kernels must then give RVO2's velocity. Coincident robots of different velocities are no exception.
* too fast: RVO2's third program can leave the speed disc where half-planes are almost parallel. The kernels clip its
  result, so they must match RVO2's clipped velocity.
"""

from typing import NamedTuple

import numpy as np
import pyrvo

from tests.sim_core.kernels import orca_velocities
from tests.sim_core.orca_scenes import Scene, tie_margin_sq

BOUND_M_S = 1e-5
"""Largest allowed difference from RVO2 in either component."""
TOO_FAST, CLIPPED = 1 + 4e-6, 1 + 1e-5
"""Factors of the speed limit: above the first RVO2 counts as too fast, above the second the kernels clip for sure."""
DEFAULTS = {
    "radius_m": 0.2,
    "horizon_s": 2.0,
    "time_step_s": 0.05,
    "max_speed_m_s": 1.0,
    "range_m": 1.5,
    "max_neighbours": 10,
}
SETTINGS = {
    "default": {},
    "long range": {"range_m": 3.0, "max_neighbours": 24, "horizon_s": 5.0},
    "short range": {"range_m": 0.7, "max_neighbours": 3, "horizon_s": 0.4, "time_step_s": 0.1},
    "large and fast": {"radius_m": 0.35, "max_speed_m_s": 2.5, "time_step_s": 0.02},
    "one neighbour": {"max_neighbours": 1},
}
"""Settings under which the two are compared, as changes of the defaults."""


class Parity(NamedTuple):
    """Counts of one comparison; `total` adds several."""

    robots: int = 0
    equal: int = 0  # bit for bit
    too_fast: int = 0
    ties: int = 0
    coincident: int = 0
    unexplained: int = 0
    infeasible: int = 0  # no velocity satisfies all of RVO2's half-planes
    worst_m_s: float = 0.0  # of the robots that need no allowed difference


def total(parities):
    """The sums of the counts, and the largest `worst_m_s`."""
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
    """Indices of the robot's neighbours in RVO2's order."""
    return [sim.get_agent_agent_neighbor(robot, k) for k in range(sim.get_agent_num_agent_neighbors(robot))]


def rvo2_half_planes(sim, robot):
    """Half-planes `[count, 4]` float64: point, direction; permitted velocities lie to the left."""
    lines = [sim.get_agent_orca_line(robot, k) for k in range(sim.get_agent_num_orca_lines(robot))]
    return np.array([[*point, *direction] for direction, point in lines], np.float64).reshape(-1, 4)


def worst_violation(lines, velocity):
    """How far `velocity` lies outside the worst half-plane, m/s; negative inside all. NaN half-planes are ignored."""
    violation = lines[:, 2] * (lines[:, 1] - velocity[1]) - lines[:, 3] * (lines[:, 0] - velocity[0])
    return np.nanmax(violation, initial=-np.inf)


def speeds(velocity):
    """Speeds `[n, 1]` float64, m/s."""
    return np.linalg.norm(velocity.astype(np.float64), axis=1, keepdims=True)


def differences(own, theirs, limit_m_s):
    """Per robot, how far its velocity is from RVO2's, or from RVO2's clipped velocity where that is too fast, m/s."""
    speed = speeds(theirs)
    clipped = theirs * np.where(speed > limit_m_s, limit_m_s / np.maximum(speed, limit_m_s), 1.0)
    to_clipped, to_theirs = (np.abs(own - velocity).max(axis=1, initial=0.0) for velocity in (clipped, theirs))
    return np.where(speed[:, 0] > limit_m_s * CLIPPED, to_clipped, np.minimum(to_clipped, to_theirs))


def explanation(scene, robot, sim, **settings):
    """Name of the count for a robot whose velocity differs from RVO2's: "ties", "coincident" or "unexplained"."""
    listed = rvo2_neighbours(sim, robot)
    same = [(scene.pos[j] == scene.pos[robot]).all() and (scene.vel[j] == scene.vel[robot]).all() for j in listed]
    kept = [j for j, gone in zip(listed, same, strict=True) if not gone] + [robot]
    again = orca_velocities(*(array[kept] for array in scene), **settings)[-1:]
    limit_m_s = (DEFAULTS | settings)["max_speed_m_s"]
    if not differences(again, rvo2_velocities(sim)[robot : robot + 1], limit_m_s) <= BOUND_M_S:
        return "unexplained"
    if any(same):
        return "coincident"
    search = {name: settings[name] for name in ("range_m", "max_neighbours") if name in settings}
    return "ties" if tie_margin_sq(scene.pos, **search)[robot] == 0 else "unexplained"


def compare(scene: Scene, own=None, **settings):
    """The Parity of one step of the scene.

    Args:
      scene: one world.
      own: the velocities `[n, 2]` to compare; the kernels' own for this scene by default.
      settings: as of `orca_velocities`.
    """
    own = orca_velocities(*scene, **settings) if own is None else own
    sim = rvo2_step(scene, **settings)
    theirs = rvo2_velocities(sim)
    limit_m_s = (DEFAULTS | settings)["max_speed_m_s"]
    error = differences(own, theirs, limit_m_s)
    fits = error <= BOUND_M_S  # false for NaN
    counts = {"ties": 0, "coincident": 0, "unexplained": 0}
    for robot in np.flatnonzero(~fits):
        counts[explanation(scene, robot, sim, **settings)] += 1
    violated = [worst_violation(rvo2_half_planes(sim, i), theirs[i]) > 1e-4 for i in range(len(theirs))]
    return Parity(
        robots=len(own),
        equal=int((own == theirs).all(axis=1).sum()),
        too_fast=int((speeds(theirs) > limit_m_s * TOO_FAST).sum()),
        infeasible=int(sum(violated)),
        worst_m_s=float(error[fits].max(initial=0.0)),
        **counts,
    )
