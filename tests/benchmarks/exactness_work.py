"""The pieces of `exactness`, each small enough for one process: what is run and what is measured of it."""

from typing import Any, NamedTuple

import numpy as np
from numba import njit

from sim_core.config import WorldConfig
from sim_core.pilot import Pilot
from sim_core.worlds import WorldBatch
from tests.sim_core.orca_scenes import goal_scene, heading_scene, numbered_scene, world_scene
from tests.sim_core.parity import Parity, compare, total
from tests.sim_core.precision import drifts, one_step_difference
from tests.sim_core.segregation import mean_goal_distance_m, segregated_fraction

WHOLE_STEPS = 500
WATCHED_STEPS = tuple(range(50, WHOLE_STEPS + 1, 50))


def scene_parity(kind: str, numbers: range, settings: dict[str, float]) -> tuple[Parity, list[int]]:
    """Parity of one step of numbered scenes, and the scenes in which a robot is unexplained."""
    found = [compare(numbered_scene(kind, number), **settings) for number in numbers]
    return total(found), [number for number, one in zip(numbers, found, strict=True) if one.unexplained]


def fresh_worlds(robots: int, groups: int, seeds: range, **settings: Any) -> WorldBatch:
    """Worlds of the default settings but for `settings`, at the start of an episode, one a seed."""
    worlds = WorldBatch(WorldConfig(robots=robots, groups=groups, **settings), len(seeds))
    worlds.seed(list(seeds))
    worlds.reset()
    return worlds


def kernel_parity(robots: int, groups: int, seeds: range, every: int) -> Parity:
    """Parity of one step from every `every`-th state of whole FL-ORCA episodes."""
    worlds, rng, found = fresh_worlds(robots, groups, seeds), np.random.default_rng(seeds.start), []
    for step in range(WHOLE_STEPS):
        if step % every == 0:
            found += [compare(heading_scene(worlds, world, rng)) for world in range(len(seeds))]
        worlds.step(Pilot.FREE)
    return total(found)


def world_parity(robots: int, groups: int, seeds: range, every: int) -> Parity:
    """Parity of every `every`-th step itself of whole episodes without flocking."""
    worlds, found = fresh_worlds(robots, groups, seeds, flocking="none"), []
    for step in range(WHOLE_STEPS):
        before = [goal_scene(worlds, world) for world in range(len(seeds))] if step % every == 0 else []
        worlds.step(Pilot.FREE)
        found += [compare(scene, world_scene(worlds, world).vel) for world, scene in enumerate(before)]
    return total(found)


def scene_precision(kind: str, numbers: range) -> np.ndarray:
    """float32 against float64 after one step, m/s, one entry a robot."""
    return np.concatenate([one_step_difference(numbered_scene(kind, number)) for number in numbers])


def episode_precision(robots: int, groups: int, seeds: range, starts: tuple[int, ...]) -> np.ndarray:
    """float32 against float64 positions, `[steps, robots]` metres, from states of FL-ORCA episodes at `starts`."""
    worlds, found = fresh_worlds(robots, groups, seeds), []
    for step in range(max(starts) + 1):
        if step in starts:
            found += [drifts(*world_scene(worlds, world)) for world in range(len(seeds))]
        worlds.step(Pilot.FREE)
    return np.concatenate(found, axis=1)


class Episodes(NamedTuple):
    """Whole episodes of FL-ORCA alone, one entry an episode."""

    nearest_m: np.ndarray  # smallest distance of two centres at any step
    overlap_steps: np.ndarray  # steps with any pair nearer than two physical radii
    arrival_step: np.ndarray  # first step with all groups at their goals at once; WHOLE_STEPS + 1: never
    segregated: np.ndarray  # [episodes, WATCHED_STEPS], share of group pairs that are segregated
    fastest_m_s: np.ndarray  # largest speed at any step; NaN where a velocity was not finite
    speed_limit_m_s: np.ndarray


@njit(fastmath={"nnan", "nsz"})
def nearest_pairs_sq(pos_x, pos_y, nearest_sq):
    """Smallest squared distance of two robots of every world, into `nearest_sq` `[num_worlds]`."""
    for world in range(pos_x.shape[0]):
        x, y = pos_x[world], pos_y[world]
        least = np.float32(np.inf)
        for i in range(x.shape[0]):
            for j in range(i):
                dx, dy = x[i] - x[j], y[i] - y[j]
                least = min(least, dx * dx + dy * dy)
        nearest_sq[world] = least


def swarm_episodes(robots: int, groups: int, seeds: range, settings: dict[str, Any]) -> Episodes:
    """FL-ORCA drives everybody from the start to WHOLE_STEPS, beyond arrivals and collisions."""
    worlds, count = fresh_worlds(robots, groups, seeds, **settings), len(seeds)
    config, near_sq = worlds.config, np.zeros(count, np.float32)
    nearest_sq, overlaps, fastest = np.full(count, np.inf), np.zeros(count, int), np.zeros(count)
    arrival, segregated = np.full(count, WHOLE_STEPS + 1), []
    limits = np.full(count, config.max_speed_m_s)
    for step in range(1, WHOLE_STEPS + 1):
        worlds.step(Pilot.FREE)
        pos, state = worlds.positions(), worlds.get_state()
        nearest_pairs_sq(np.ascontiguousarray(pos[..., 0]), np.ascontiguousarray(pos[..., 1]), near_sq)
        nearest_sq = np.minimum(nearest_sq, near_sq)
        overlaps += near_sq < (2 * config.robot_radius_m) ** 2
        fastest = np.maximum(fastest, np.hypot(state["vel_x"], state["vel_y"]).max(axis=1))
        there = (mean_goal_distance_m(pos, worlds.goals()) < config.outer_radius_m).all(axis=1)
        arrival[there & (arrival > step)] = step
        if step in WATCHED_STEPS:
            segregated.append(segregated_fraction(pos, groups))
    return Episodes(np.sqrt(nearest_sq), overlaps, arrival, np.stack(segregated, axis=1), fastest, limits)


def joined(parts: list[Episodes]) -> Episodes:
    """All episodes of several parts."""
    return Episodes(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))
