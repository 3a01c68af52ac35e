"""FL-ORCA's states, weights and constants. The kernels that use them are in `sim_core.swarm.flocking`.

The dissertation names the states and terms (Algorithm 3, Figure 2.2) but no weights. The rules `published` take the
weights that the authors' lab has published since. The rules `uniform` take one weight per term in all states.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from sim_core.config import WorldConfig

SINGLE_GROUP, VISION_FREE, FOLLOWER, TURN_RIGHT = 0, 1, 2, 3
"""States of the state machine (Figure 2.2)."""
STATE_NAMES = ("single group", "vision free", "follower", "turn right")

SEES_OTHER_GROUP, VIEW_FREE, FOLLOWER_LEVEL_1, FOLLOWER_LEVEL_2 = 1, 2, 4, 8
"""Bits of a robot's flags. A level-1 follower follows a robot with a free view, a level-2 follower a level-1 one.
In the text's state machine a robot that sees no other group counts as one with a free view; nobody is of level 2."""

NO_FLOCK, PUBLISHED, UNIFORM = range(3)
"""Rule sets: no flocking, straight to the goal; the published weights; one weight per term."""

COHESION, SEPARATION, ALIGNMENT, PREFERRED, LEADER, RIGHT = range(6)
"""Terms of the weighted sum."""
PUBLISHED_WEIGHTS = {
    # (state, sees another group): cohesion, separation, alignment, preferred, leader, right.
    # The rows are complete: Vision Free needs another group in sight, and a robot that sees another group and whose
    # view is not free follows or turns right.
    (SINGLE_GROUP, False): (1.0, 0.0, 1.0, 1.0, 0.0, 0.0),
    (VISION_FREE, True): (15.0, 0.5, 5.0, 0.35, 0.0, 0.0),
    (FOLLOWER, False): (10.0, 0.0, 0.0, 1.0, 50.0, 0.0),
    (FOLLOWER, True): (15.0, 0.5, 0.0, 0.0, 50.0, 0.0),
    (TURN_RIGHT, False): (15.0, 0.0, 2.0, 1.0, 0.0, 50.0),
    (TURN_RIGHT, True): (50.0, 0.5, 1.0, 0.0, 0.0, 15.0),
}


class FlockParams(NamedTuple):
    """Flocking constants in the worlds' dtype; weights `[4, 2, 8]` as of `flock_weights`."""

    rules: int
    follows_text: bool
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
    """Weights `[state, sees another group, term]` of `config.flocking`: `[4, 2, 8]`, the last two terms unused."""
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
    """The flocking constants of `config`; reals are scalars of `dtype`."""
    real = np.dtype(dtype).type

    def cosine(angle_deg: float) -> Any:
        return real(0.0 if angle_deg == 90.0 else math.cos(math.radians(angle_deg)))

    return FlockParams(
        rules=("none", "published", "uniform").index(config.flocking),
        follows_text=config.state_machine == "text",
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
