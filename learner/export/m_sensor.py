"""M_sensor's decision as a torch module (see `robot_module`).

Where the robot senses none of its group there is no decision. A policy that has learned with bad senses decides there,
too.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from actors.policy.network import Network
from learner.export.ports import Port
from learner.export.robot_module import NO_DECISION, Decision, RobotModule, measured, relative_positions
from sim_core.config import WorldConfig
from sim_core.methods.m_sensor import COUNT_LIMIT, sector_edges
from sim_core.worlds import WorldBatch


class SensorRobot(RobotModule):
    """M_sensor: counts of robots per sector and region (3.2.1), greedy action, velocity u_nn.

    Args:
      network: the trained network.
      config: the world that it was trained in.
    """

    radii_sq: Tensor
    edges: Tensor
    cells: Tensor

    def __init__(self, network: Network, config: WorldConfig) -> None:
        super().__init__(network, config)
        self.sectors = config.sectors
        self.separate = config.sensor_counts == "separate"
        radii = torch.tensor([config.inner_radius_m, config.outer_radius_m], dtype=torch.float32)
        self.register_buffer("radii_sq", radii * radii)
        self.register_buffer("edges", torch.from_numpy(sector_edges(config.sectors)))
        self.register_buffer("cells", torch.arange(2 * config.sectors))

    @classmethod
    def inputs(cls, config: WorldConfig) -> list[Port]:
        """Relative positions of own and other robots, with their masks."""
        unused = "False where a place is not used; its position then does not count"
        others = "relative positions of other groups' robots"
        return [
            Port(
                "own", "float32", ("batch", "own_robots", 2), "m", "relative positions of the own group's other robots"
            ),
            Port("own_mask", "bool", ("batch", "own_robots"), "", unused),
            Port("other", "float32", ("batch", "other_robots", 2), "m", others),
            Port("other_mask", "bool", ("batch", "other_robots"), "", unused),
        ]

    @classmethod
    def observation_meaning(cls, config: WorldConfig) -> str:
        """Counts by region and sector."""
        what = "own, then other robots" if config.sensor_counts == "separate" else "own less other robots"
        return (
            f"{what} in {config.sectors} sectors from angle -pi on, counterclockwise: "
            f"nearer than {config.inner_radius_m} m, then up to {config.outer_radius_m} m"
        )

    @classmethod
    def undecided(cls, config: WorldConfig) -> str:
        """A robot that senses none of its group is lost, where an episode of its training has ended."""
        alone = "" if config.senses_badly else f", or no robot of the own group is within {config.outer_radius_m} m"
        return super().undecided(config) + alone

    @classmethod
    def decides(cls, worlds: WorldBatch) -> NDArray[np.bool_]:
        """Where a robot of the own group is within R2; everywhere if the policy has learned with bad senses."""
        relative, mask, _ = relative_positions(worlds)
        x, y = relative[:, 0, :, 0], relative[:, 0, :, 1]
        near = mask[:, 0] & (x * x + y * y < np.float32(worlds.config.outer_radius_m) ** 2)
        return np.asarray(near.any(1) | worlds.config.senses_badly)

    @classmethod
    def sense(cls, worlds: WorldBatch) -> dict[str, NDArray[Any]]:
        """Own and other robots, whose places beyond a smaller group's robots are masked."""
        relative, mask, _ = relative_positions(worlds)
        return {
            "own": relative[:, 0],
            "own_mask": mask[:, 0],
            "other": relative[:, 1:].reshape(len(relative), -1, 2),
            "other_mask": mask[:, 1:].reshape(len(relative), -1),
        }

    def _cells(self, positions: Tensor) -> tuple[Tensor, Tensor]:
        """(cell `[batch, robots]` int64, whether it is within R2): inner disc 0..q-1, ring q..2q-1."""
        dx, dy = positions[..., 0], positions[..., 1]
        distance_sq = dx * dx + dy * dy
        x, y = dx.double().unsqueeze(-1), dy.double().unsqueeze(-1)
        left = self.edges[:, 0] * y - self.edges[:, 1] * x >= 0.0
        half = (self.sectors + 1) // 2  # the first edge at or above angle 0
        above = half - 1 + left[..., half:].sum(-1)
        below = left[..., 1:half].sum(-1)
        ring = torch.where(distance_sq < self.radii_sq[0], 0, self.sectors)
        return torch.where(dy >= 0.0, above, below) + ring, distance_sq < self.radii_sq[1]

    def _counts(self, positions: Tensor, mask: Tensor) -> Tensor:
        """Robots per cell `[batch, 2q]` float32."""
        cell, near = self._cells(positions)
        here = (cell.unsqueeze(-1) == self.cells) & (near & mask).unsqueeze(-1)
        return here.float().sum(1)

    def forward(self, own: Tensor, own_mask: Tensor, other: Tensor, other_mask: Tensor) -> Decision:
        """Decides for a batch of robots.

        Args:
          own: relative positions `[batch, own robots, 2]` float32 of robots of the own group, itself left out.
          own_mask: `[batch, own robots]` bool, False where there is no robot.
          other: relative positions `[batch, other robots, 2]` float32 of robots of other groups.
          other_mask: `[batch, other robots]` bool.
        """
        own, own_known = measured(own, own_mask)
        other, other_known = measured(other, other_mask)
        mates, others = self._counts(own, own_mask), self._counts(other, other_mask)
        counts = torch.cat([mates, others], dim=1) if self.separate else mates - others
        observation = counts.clamp(-COUNT_LIMIT, COUNT_LIMIT)
        values = self.network(observation)
        action, known = values.argmax(1), own_known & other_known
        if not self.decides_always:
            known = known & (mates.sum(1) > 0.0)
        velocity = torch.where(known.unsqueeze(1), self.headings[action], 0.0)
        return velocity, torch.where(known, action, NO_DECISION), values, observation
