"""Data augmentation: a sampled transition is replaced by one of those that a turn of its world makes of it.

The rules of the world know no direction. Turned by any angle, robots, goals and observations are those of another world
that evolves alike; the headings turn with them. So every stored transition stands for as many as the method has turns
(`Method.turns`), and the network needs not learn each direction by itself (Laskin et al. 2020).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from learner.config import RunConfig
from sim_core.methods import make_method


class RandomTurns:
    """Turns sampled transitions by random angles.

    Args:
      config: the run.
    """

    def __init__(self, config: RunConfig) -> None:
        self._method = make_method(config.world)
        self._turns = self._method.turns(config.world)

    def __call__(self, columns: dict[str, NDArray[Any]], rng: np.random.Generator) -> dict[str, NDArray[Any]]:
        """The turned columns of transitions `[rows, ...]`; arrays that can be written are changed in place."""
        turned = columns | {
            name: np.require(columns[name], requirements="W") for name in ("observation", "action", "next_observation")
        }
        parts = rng.integers(self._turns, size=len(turned["action"]))
        self._method.turn(turned["observation"], parts)
        self._method.turn(turned["next_observation"], parts)
        self._method.turn_actions(turned["action"], parts)
        return turned
