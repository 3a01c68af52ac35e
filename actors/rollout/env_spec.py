"""What an environment is, without its code: a config names one before any is made."""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

from sim_core import ENV_ID
from sim_core.config import WorldConfig


class EnvSpec(NamedTuple):
    """Specification of an environment: its Gymnasium id, and the world's settings if it is the swarm environment.

    `shares` are the worlds of several setups with their shares of the environments; empty where `world` is alone.
    """

    env_id: str
    world: WorldConfig
    shares: tuple[tuple[WorldConfig, float], ...] = ()

    @property
    def worlds(self) -> list[WorldConfig]:
        """The worlds of all setups."""
        return [world for world, _ in self.shares] or [self.world]

    @property
    def row_size(self) -> int:
        """Elements of a row, where an observation is rows of groups; else 0."""
        return self.world.method_class.row_size * self.world.history if self.is_swarm else 0

    def of_setup(self, world: WorldConfig) -> EnvSpec:
        """The environment of one setup alone."""
        return EnvSpec(self.env_id, world)

    @property
    def is_swarm(self) -> bool:
        """Whether this is the project's own swarm environment."""
        return self.env_id == ENV_ID

    @property
    def settings(self) -> dict[str, Any]:
        """Keyword arguments for Gymnasium's `make` and `make_vec`."""
        return dataclasses.asdict(self.world) if self.is_swarm else {}
