"""The learning robot's whole decision as one torch module: what it senses to the velocity it drives.

These modules compute what the simulator's `perceive` and `velocity` compute around the Q-network, for use outside
the simulator. They take positions relative to the robot (metres, along the axes of the world that the goals and
headings are in), of any number of robots: unused places are masked. They can be exported: no loop over
robots, no branch on data. Arithmetic is the simulator's: float32 where its arrays are, float64 in between.

Where M_IN or M_OUT is given a group of which it knows no robot, there is no ellipse and so no decision: the action
is NO_DECISION and the velocity zero.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from actors.policy.network import QNetwork
from sim_core.config import WorldConfig
from sim_core.methods.apf import NEAREST_M, field_params
from sim_core.methods.ellipse import ellipse_params
from sim_core.methods.group_ellipses import observation_limit
from sim_core.methods.headings import heading_velocities
from sim_core.methods.m_sensor import COUNT_LIMIT, sector_edges

NO_DECISION = -1
"""Action where the state cannot be formed."""


Decision = tuple[Tensor, Tensor, Tensor, Tensor]
"""What a module gives: velocity `[batch, 2]` float32 (m/s), action `[batch]` int64, action values `[batch, actions]`
float32, and the observation `[batch, size]` float32 that the network saw. Plain: a saved program needs no class.
"""


class BarePolicy(nn.Module):
    """Observation to action values and the greedy action, for any environment.

    Args:
      network: the trained network.
    """

    def __init__(self, network: QNetwork) -> None:
        super().__init__()
        self.network = network

    def forward(self, observation: Tensor) -> tuple[Tensor, Tensor]:
        """(action `[batch]` int64, action values `[batch, actions]`) of observations `[batch, *shape]`."""
        values = self.network(observation)
        return values.argmax(1), values


class SensorRobot(nn.Module):
    """M_sensor: counts of robots per sector and region (3.2.1), greedy action, velocity u_nn.

    Args:
      network: the trained network.
      config: the world that it was trained in.
    """

    radii_sq: Tensor
    edges: Tensor
    cells: Tensor
    headings: Tensor

    def __init__(self, network: QNetwork, config: WorldConfig) -> None:
        super().__init__()
        self.network = network
        self.sectors = config.sectors
        self.separate = config.sensor_counts == "separate"
        radii = torch.tensor([config.inner_radius_m, config.outer_radius_m], dtype=torch.float32)
        self.register_buffer("radii_sq", radii * radii)
        self.register_buffer("edges", torch.from_numpy(sector_edges(config.sectors)))
        self.register_buffer("cells", torch.arange(2 * config.sectors))
        self.register_buffer("headings", torch.from_numpy(heading_velocities(config, "float32")))

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
        cell, near = self._cells(torch.where(mask.unsqueeze(-1), positions, 0.0))
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
        mates, others = self._counts(own, own_mask), self._counts(other, other_mask)
        counts = torch.cat([mates, others], dim=1) if self.separate else mates - others
        observation = counts.clamp(-COUNT_LIMIT, COUNT_LIMIT)
        values = self.network(observation)
        action = values.argmax(1)
        return self.headings[action], action, values, observation


class RepulsiveField(nn.Module):
    """u_apf of `sim_core.methods.apf` over masked robots.

    Args:
      config: the world.
    """

    def __init__(self, config: WorldConfig) -> None:
        super().__init__()
        self.params = field_params(config)

    def parts(self, positions: Tensor, mask: Tensor) -> Tensor:
        """Velocity away from each robot `[..., robots, 2]` float64, m/s; zero where there is none or it is too far."""
        p = self.params
        distance = (positions[..., 0] * positions[..., 0] + positions[..., 1] * positions[..., 1]).sqrt()
        acts = mask & (distance < p.range_m) & (distance >= NEAREST_M)
        distance = torch.where(acts, distance, 1.0)
        speed = p.gain * (1.0 / distance.double() - 1.0 / p.range_m) / (distance * distance).double()
        speed = torch.where(acts, speed.clamp(max=p.limit_m_s), 0.0)
        return -speed.unsqueeze(-1) * positions.double() / distance.double().unsqueeze(-1)

    def limited(self, velocity: Tensor) -> Tensor:
        """`velocity` `[..., 2]`, shortened to the field's limit where it is longer."""
        return shortened(velocity, self.params.limit_m_s)


def shortened(vector: Tensor, limit: float) -> Tensor:
    """`vector` `[..., 2]`, shortened to the length `limit` where it is longer."""
    length = (vector * vector).sum(-1, keepdim=True).sqrt()
    return torch.where(length <= limit, vector, vector * (limit / length.clamp(min=limit)))


class EllipseRobot(nn.Module):
    """M_IN and M_OUT: one ellipse a group (4.2.1), greedy action, velocity u_nn, in M_OUT with u_apf added.

    Args:
      network: the trained network.
      config: the world that it was trained in.
    """

    counted: Tensor
    headings: Tensor
    places: Tensor

    def __init__(self, network: QNetwork, config: WorldConfig) -> None:
        super().__init__()
        self.network = network
        self.config = config
        self.ellipse = ellipse_params(config)
        self.field = RepulsiveField(config)
        self.limit = observation_limit(config)
        counted = torch.zeros(config.groups, dtype=torch.float64)
        counted[0] = float(self.ellipse.counts_learner)
        self.register_buffer("counted", counted)  # the robot itself, in the ellipse of its own group
        self.register_buffer("headings", torch.from_numpy(heading_velocities(config, "float32")))
        self.register_buffer("places", torch.arange(config.groups))

    def _centres(self, positions: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
        """(centres `[batch, groups, 2]`, robots `[batch, groups]` that count): the robot itself stands at 0."""
        count = mask.double().sum(-1) + self.counted
        return positions.sum(2) / count.clamp(min=1.0).unsqueeze(-1), count

    def _ellipses(self, positions: Tensor, mask: Tensor) -> Tensor:
        """(a, b, x_c, y_c, theta) of every group `[batch, groups, 5]` float64; metres, radians."""
        centre, count = self._centres(positions, mask)
        offset = torch.where(mask.unsqueeze(-1), positions - centre.unsqueeze(2), 0.0)
        itself = self.counted.unsqueeze(-1) * centre
        freedom = (count - 1.0).clamp(min=1.0)
        spread = ((offset * offset).sum(2) + itself * centre) / freedom.unsqueeze(-1)
        shared = ((offset[..., 0] * offset[..., 1]).sum(2) + itself[..., 0] * centre[..., 1]) / freedom
        shared = shared if self.ellipse.full else torch.zeros_like(shared)
        mean, half = 0.5 * (spread[..., 0] + spread[..., 1]), 0.5 * (spread[..., 0] - spread[..., 1])
        root = (half * half + shared * shared).sqrt()
        axes = [self.ellipse.axis_scale * value.clamp(min=0.0).sqrt() for value in (mean - root, mean + root)]
        a, b = (axis.clamp(min=self.ellipse.smallest_m) for axis in axes)
        return torch.stack([a, b, centre[..., 0], centre[..., 1], self._angle(shared, half)], dim=-1)

    def _angle(self, shared: Tensor, half: Tensor) -> Tensor:
        """Angle from the x-axis to the longer half-axis, in (-pi/2, pi/2]."""
        if not self.ellipse.full:
            return torch.where(half >= 0.0, 0.0, 0.5 * math.pi).double()
        shared = torch.where(shared == 0.0, 0.0, shared)  # no -0, whose angle would be -pi/2
        root = (half * half + shared * shared).sqrt()
        # tan of half the angle of (half, shared), in the form that does not cancel; ONNX has no atan2
        tangent = torch.where(half >= 0.0, shared / (root + half), (root - half) / shared)
        return torch.where(root == 0.0, 0.0, torch.atan(tangent.float()).double())

    def _fields(self, positions: Tensor, mask: Tensor) -> Tensor:
        """u_apf of every row `[batch, groups, 2]` float64."""
        total = self.field.parts(positions, mask).sum(2)
        if self.config.apf_rows == "all":
            total = total.sum(1, keepdim=True).expand_as(total)
        return self.field.limited(total)

    def _matrix(self, positions: Tensor, mask: Tensor, goals: Tensor) -> Tensor:
        """The state matrix `[batch, groups, columns]` float32, rows in the order of the input."""
        config, wide = self.config, positions.double()
        ellipses = self._ellipses(wide, mask)
        scaled = torch.cat([ellipses[..., :4] * config.ellipse_scale_per_m, ellipses[..., 4:]], dim=-1)
        parts = [scaled, goals.double() * config.goal_scale_per_m]
        if config.method == "in":
            parts.append(self._fields(positions, mask))
        return torch.cat(parts, dim=-1).float().clamp(-self.limit, self.limit)

    def _nearest_first(self, matrix: Tensor, positions: Tensor, mask: Tensor) -> Tensor:
        """Rows with the other groups by the distance of their centres, equal ones in the order of the input."""
        centre, _ = self._centres(positions.double(), mask)
        distance_sq = (centre * centre).sum(-1)
        distance_sq = torch.where(self.places == 0, -1.0, distance_sq)  # the own group stays first
        here, there = distance_sq.unsqueeze(2), distance_sq.unsqueeze(1)
        earlier = self.places.unsqueeze(0) < self.places.unsqueeze(1)
        rank = ((there < here) | ((there == here) & earlier)).sum(-1)
        chosen = rank.unsqueeze(1) == self.places.unsqueeze(1)  # [batch, place, group]
        return torch.where(chosen.unsqueeze(-1), matrix.unsqueeze(1), 0.0).sum(2)

    def _velocity(self, action: Tensor, positions: Tensor, mask: Tensor) -> Tensor:
        velocity = self.headings[action]
        if self.config.method == "out":
            total = self.field.parts(positions, mask).sum((1, 2))
            velocity = shortened(velocity + self.field.limited(total), self.config.learner_speed_limit_m_s).float()
        return velocity

    def forward(self, positions: Tensor, mask: Tensor, goals: Tensor) -> Decision:
        """Decides for a batch of robots.

        Args:
          positions: relative positions `[batch, groups, robots, 2]` float32 of every group's robots; the own group is
            group 0, the robot itself left out.
          mask: `[batch, groups, robots]` bool, False where there is no robot.
          goals: relative positions `[batch, groups, 2]` float32 of every group's goal.
        """
        positions = torch.where(mask.unsqueeze(-1), positions, 0.0)
        matrix = self._matrix(positions, mask, goals)
        if self.config.group_order == "nearest":
            matrix = self._nearest_first(matrix, positions, mask)
        observation = matrix.flatten(1)
        values = self.network(observation)
        known = mask.any(2).all(1)
        action = values.argmax(1)
        velocity = torch.where(known.unsqueeze(1), self._velocity(action, positions, mask), 0.0)
        return velocity, torch.where(known, action, NO_DECISION), values, observation


def make_robot(network: QNetwork, config: WorldConfig) -> SensorRobot | EllipseRobot:
    """The module of the world's method."""
    return SensorRobot(network, config) if config.method == "sensor" else EllipseRobot(network, config)
