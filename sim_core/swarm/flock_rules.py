"""FL-ORCA's states, weights and constants; the kernels that use them are in `sim_core.swarm.flocking`.

The dissertation names terms and states but no weights: `published` takes those that the authors' lab has
published since, `uniform` one weight per term in all states. A robot cannot see another group, have a
blocked view and stand in none of the published rows, so the rows are complete.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from sim_core.config import WorldConfig

SINGLE_GROUP, VISION_FREE, FOLLOWER, TURN_RIGHT = 0, 1, 2, 3
STATE_NAMES = ("single group", "vision free", "follower", "turn right")

SEES, FREE, FOLLOWS_FREE, FOLLOWS_FOLLOWER = 1, 2, 4, 8
"""Bits of a robot's flags: sees another group, free view, level-1 follower, level-2 follower."""

NO_FLOCK, PUBLISHED, UNIFORM = range(3)
"""Rule sets: straight to the goal, the published table, one weight a term."""

COHESION, SEPARATION, ALIGNMENT, PREFERRED, LEADER, RIGHT = range(6)
PUBLISHED_WEIGHTS = {
    # (state, sees another group): cohesion, separation, alignment, preferred, leader, right
    (SINGLE_GROUP, False): (1.0, 0.0, 1.0, 1.0, 0.0, 0.0),
    (VISION_FREE, True): (15.0, 0.5, 5.0, 0.35, 0.0, 0.0),
    (FOLLOWER, False): (10.0, 0.0, 0.0, 1.0, 50.0, 0.0),
    (FOLLOWER, True): (15.0, 0.5, 0.0, 0.0, 50.0, 0.0),
    (TURN_RIGHT, False): (15.0, 0.0, 2.0, 1.0, 0.0, 50.0),
    (TURN_RIGHT, True): (50.0, 0.5, 1.0, 0.0, 0.0, 15.0),
}


class FlockParams(NamedTuple):
    """The flock's constants in the worlds' dtype; weights `[state, sees, term]`, two unused terms last."""

    rules: int
    weights: Any
    separation_range_sq: Any
    separation_cos: Any
    separation_noise: Any
    sight_range_sq: Any
    sight_cos: Any
    view_range_sq: Any
    view_cos: Any
    uniform_separation_range_m: Any
    uniform_view_corridor_m: Any
    uniform_slow_radius_m: Any
    max_speed_m_s: Any
    zero: Any
    one: Any


def flock_weights(config: WorldConfig, dtype: Any) -> np.ndarray:
    """Weights `[4, 2, 8]` (state, sees another group, term, two unused) of `config.flocking`."""
    weights = np.zeros((4, 2, 8), dtype)
    if config.flocking == "published":
        for (state, sees), row in PUBLISHED_WEIGHTS.items():
            weights[state, int(sees), :6] = row
        return weights
    weights[:, :, COHESION] = config.cohesion_weight
    weights[:, :, SEPARATION] = config.separation_weight
    weights[:, :, ALIGNMENT] = config.alignment_weight
    for state, term in ((SINGLE_GROUP, PREFERRED), (VISION_FREE, PREFERRED), (FOLLOWER, LEADER), (TURN_RIGHT, RIGHT)):
        weights[state, :, term] = 1.0
    return weights


def flock_params(config: WorldConfig, dtype: Any) -> FlockParams:
    """The flock's constants of `config`, each a scalar of `dtype`."""
    real = np.dtype(dtype).type

    def cosine(angle_deg: float) -> Any:
        return real(0.0 if angle_deg == 90.0 else math.cos(math.radians(angle_deg)))

    return FlockParams(
        rules=("none", "published", "uniform").index(config.flocking),
        weights=flock_weights(config, dtype),
        separation_range_sq=real(config.separation_range_m) ** 2,
        separation_cos=cosine(config.separation_angle_deg),
        separation_noise=real(config.separation_noise),
        sight_range_sq=real(config.sight_range_m) ** 2,
        sight_cos=cosine(config.sight_angle_deg),
        view_range_sq=real(config.view_range_m) ** 2,
        view_cos=cosine(config.view_angle_deg),
        uniform_separation_range_m=real(config.uniform_separation_range_m),
        uniform_view_corridor_m=real(config.uniform_view_corridor_m),
        uniform_slow_radius_m=real(config.uniform_slow_radius_m),
        max_speed_m_s=real(config.max_speed_m_s),
        zero=real(0),
        one=real(1),
    )
