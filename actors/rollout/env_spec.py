"""What an environment is, without its code: a config names one before any is made."""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import numpy as np

from sim_core import ENV_ID
from sim_core.config import ONE_LEARNER, WorldConfig


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

    def with_one_learner(self) -> EnvSpec:
        """The same worlds with one learning robot each."""
        alone = [(dataclasses.replace(world, learners=ONE_LEARNER), share) for world, share in self.shares]
        return EnvSpec(self.env_id, dataclasses.replace(self.world, learners=ONE_LEARNER), tuple(alone))

    def learners(self) -> list[int]:
        """Learning robots of a world of each setup; 1 for a foreign environment."""
        return [world.num_learners for world in self.worlds] if self.is_swarm else [1]

    def counts(self, num_envs: int) -> list[int]:
        """Rows of each setup in `num_envs` environments: whole worlds, so `num_envs` in all or a little off.

        At least one world each, the rest in proportion to the shares (largest remainder); where several robots of a
        world learn, each takes the place of an environment, as far as whole worlds fit.
        """
        quotas = _counts(self, num_envs) if self.shares else [num_envs]
        return [max(1, quota // size) * size for quota, size in zip(quotas, self.learners(), strict=True)]

    @property
    def is_swarm(self) -> bool:
        """Whether this is the project's own swarm environment."""
        return self.env_id == ENV_ID

    @property
    def settings(self) -> dict[str, Any]:
        """Keyword arguments for Gymnasium's `make` and `make_vec`."""
        return dataclasses.asdict(self.world) if self.is_swarm else {}


def _counts(spec: EnvSpec, num_envs: int) -> list[int]:
    """`num_envs` divided among the setups: at least one each, the rest by their shares (largest remainder)."""
    shares = np.array([share for _, share in spec.shares])
    quotas = shares / shares.sum() * (num_envs - len(shares))
    counts = np.floor(quotas).astype(int)
    most_left = np.argsort(counts - quotas, kind="stable")[: num_envs - len(shares) - counts.sum()]
    counts[most_left] += 1
    return [int(count) + 1 for count in counts]
