"""What a method is: four parts, each over a whole batch of worlds."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_core.config import WorldConfig
from sim_core.state import WorldState


class Method(ABC):
    """State representation, velocity, reward and outcome of the learning robot.

    Attributes:
      observation_shape: shape of one world's observation.
      observation_dtype: its dtype.
      observation_limit: largest absolute value in an observation.
    """

    observation_shape: tuple[int, ...]
    observation_dtype: Any
    observation_limit: float

    @abstractmethod
    def __init__(self, config: WorldConfig) -> None:
        """Takes its constants from `config`."""

    @abstractmethod
    def velocity(self, state: WorldState, action: NDArray[np.int64], out_x: Any, out_y: Any) -> None:
        """Writes the learning robots' velocities `[num_worlds]` (m/s) for `action` `[num_worlds]`."""

    @abstractmethod
    def perceive(self, state: WorldState, mask: NDArray[np.bool_], out: NDArray[Any]) -> None:
        """Writes observations `[num_worlds, *observation_shape]` of the worlds where `mask` is set."""

    @abstractmethod
    def outcome(self, state: WorldState, out: NDArray[np.int8]) -> None:
        """Writes each world's Outcome `[num_worlds]` after a step; called once a step, it may count steps."""

    @abstractmethod
    def reward(self, state: WorldState, outcome: NDArray[np.int8], out: NDArray[np.float32]) -> None:
        """Writes the rewards `[num_worlds]` of the step and moves the method's memory on."""
