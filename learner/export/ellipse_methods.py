"""M_IN's and M_OUT's decisions as torch modules (see `robot_module`).

Where a group is given of which the robot knows no robot, there is no ellipse and so no decision: the action is
NO_DECISION and the velocity zero. A policy that has learned with bad senses decides there, too, on zeros.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from actors.policy.network import Network
from learner.export.ports import Port
from learner.export.robot_module import NO_DECISION, Decision, RobotModule, measured, relative_positions
from sim_core.config import WorldConfig
from sim_core.methods.apf import NEAREST_M, field_params
from sim_core.methods.ellipse import ellipse_params
from sim_core.methods.group_ellipses import COLUMN_NAMES, observation_limit
from sim_core.worlds import WorldBatch

DECIDE = -1
"""Stands for no held action: the robot decides."""


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


class EllipseRobot(RobotModule):
    """What M_IN and M_OUT share: one ellipse a group (4.2.1), greedy action.

    Args:
      network: the trained network.
      config: the world that it was trained in.
    """

    counted: Tensor
    places: Tensor

    def __init__(self, network: Network, config: WorldConfig) -> None:
        super().__init__(network, config)
        self.config = config
        self.ellipse = ellipse_params(config)
        self.field = RepulsiveField(config)
        self.limit = observation_limit(config)
        method = config.method_class
        self.absent = len(method.observation_names(config)) - config.groups * method.row_size
        counted = torch.zeros(config.groups, dtype=torch.float64)
        counted[0] = float(self.ellipse.counts_learner)
        self.register_buffer("counted", counted)  # the robot itself, in the ellipse of its own group
        self.register_buffer("places", torch.arange(config.groups))

    @classmethod
    def inputs(cls, config: WorldConfig) -> list[Port]:
        """Relative positions of every group's robots with their mask, and the groups' goals."""
        around = "in their order around the start circle, from the own one on"
        order = "in any order" if config.group_order == "nearest" else around
        groups = f"group 0 is the own one, without the robot itself; the others {order}"
        meaning = f"relative positions of all robots of every group: {groups}"
        unused = "False where a place is not used; its position then does not count"
        unused += "" if config.senses_badly else "; every group needs one robot"
        return [
            Port("positions", "float32", ("batch", config.groups, "robots", 2), "m", meaning),
            Port("mask", "bool", ("batch", config.groups, "robots"), "", unused),
            Port("goals", "float32", ("batch", config.groups, 2), "m", "relative positions of the groups' goals"),
        ]

    @classmethod
    def observation_meaning(cls, config: WorldConfig) -> str:
        """Rows of groups."""
        columns, size = config.method_class.row_size, len(config.method_class.observation_names(config))
        return (
            f"{size // columns} rows of groups, zeros where there is none, each {', '.join(COLUMN_NAMES[:columns])}; "
            f"lengths of ellipses × {config.ellipse_scale_per_m} per m, goals × {config.goal_scale_per_m} per m, theta "
            "in rad"
        )

    @classmethod
    def undecided(cls, config: WorldConfig) -> str:
        """There is no decision without an ellipse of every group."""
        return super().undecided(config) + ("" if config.senses_badly else ", or a group has no robot")

    @classmethod
    def sense(cls, worlds: WorldBatch) -> dict[str, NDArray[Any]]:
        """All groups' robots and goals, the own group first."""
        relative, mask, goals = relative_positions(worlds)
        return {"positions": relative, "mask": mask, "goals": goals}

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
        ellipse = torch.stack([a, b, centre[..., 0], centre[..., 1], self._angle(shared, half)], dim=-1)
        return torch.where(count.unsqueeze(-1) > 0.0, ellipse, 0.0)

    def _angle(self, shared: Tensor, half: Tensor) -> Tensor:
        """Angle from the x-axis to the longer half-axis, in (-pi/2, pi/2]."""
        if not self.ellipse.full:
            return torch.where(half >= 0.0, 0.0, 0.5 * math.pi).double()
        shared = torch.where(shared == 0.0, 0.0, shared)  # no -0, whose angle would be -pi/2
        root = (half * half + shared * shared).sqrt()
        # tan of half the angle of (half, shared), in the form that does not cancel; ONNX has no atan2
        tangent = torch.where(half >= 0.0, shared / (root + half), (root - half) / shared)
        return torch.where(root == 0.0, 0.0, torch.atan(tangent.float()).double())

    def _matrix(self, positions: Tensor, mask: Tensor, goals: Tensor) -> Tensor:
        """The state matrix `[batch, groups, columns]` float32, rows in the order of the input."""
        config, wide = self.config, positions.double()
        ellipses = self._ellipses(wide, mask)
        scaled = torch.cat([ellipses[..., :4] * config.ellipse_scale_per_m, ellipses[..., 4:]], dim=-1)
        parts = [scaled, goals.double() * config.goal_scale_per_m]
        parts += self._more_columns(positions, mask)
        return torch.cat(parts, dim=-1).float().clamp(-self.limit, self.limit)

    def _nearest_first(self, matrix: Tensor, positions: Tensor, mask: Tensor) -> Tensor:
        """Rows with the other groups by the distance of their centres, equal ones in the order of the input."""
        centre, count = self._centres(positions.double(), mask)
        distance_sq = torch.where(count > 0.0, (centre * centre).sum(-1), math.inf)
        distance_sq = torch.where(self.places == 0, -1.0, distance_sq)  # the own group stays first
        here, there = distance_sq.unsqueeze(2), distance_sq.unsqueeze(1)
        earlier = self.places.unsqueeze(0) < self.places.unsqueeze(1)
        rank = ((there < here) | ((there == here) & earlier)).sum(-1)
        chosen = rank.unsqueeze(1) == self.places.unsqueeze(1)  # [batch, place, group]
        return torch.where(chosen.unsqueeze(-1), matrix.unsqueeze(1), 0.0).sum(2)

    def _more_columns(self, positions: Tensor, mask: Tensor) -> list[Tensor]:
        """Columns `[batch, groups, columns]` float64 behind those of the ellipses and goals."""
        return []

    def _velocity(self, action: Tensor, positions: Tensor, mask: Tensor) -> Tensor:
        """The velocity `[batch, 2]` float32 of an action: u_nn."""
        return self.headings[action]

    def forward(self, positions: Tensor, mask: Tensor, goals: Tensor) -> Decision:
        """Decides for a batch of robots.

        Args:
          positions: relative positions `[batch, groups, robots, 2]` float32 of every group's robots; the own group is
            group 0, the robot itself left out.
          mask: `[batch, groups, robots]` bool, False where there is no robot.
          goals: relative positions `[batch, groups, 2]` float32 of every group's goal.
        """
        return self._decide(positions, mask, goals, None)

    def _decide(self, positions: Tensor, mask: Tensor, goals: Tensor, held: Tensor | None) -> Decision:
        """As `forward`; goes on with the actions `held` `[batch]` int64 where they are not DECIDE."""
        positions, known = measured(positions, mask)
        goals, goals_known = measured(goals, torch.ones_like(goals[..., 0]) > 0.0)
        matrix = self._matrix(positions, mask, goals)
        if self.config.group_order == "nearest":
            matrix = self._nearest_first(matrix, positions, mask)
        observation = functional.pad(matrix.flatten(1), (0, self.absent))
        values = self.network(observation)
        known = known & goals_known
        if not self.decides_always:
            known = known & mask.any(2).all(1)
        action = values.argmax(1)
        if held is not None:
            action = torch.where(held >= 0, held, action)
        velocity = torch.where(known.unsqueeze(1), self._velocity(action, positions, mask), 0.0)
        return velocity, torch.where(known, action, NO_DECISION), values, observation


class InsideRobot(EllipseRobot):
    """M_IN: u_apf is part of the state, velocity u_nn.

    Args:
      network: the trained network.
      config: the world that it was trained in.
    """

    def _more_columns(self, positions: Tensor, mask: Tensor) -> list[Tensor]:
        """u_apf of every row `[batch, groups, 2]` float64."""
        total = self.field.parts(positions, mask).sum(2)
        if self.config.apf_rows == "all":
            total = total.sum(1, keepdim=True).expand_as(total)
        return [self.field.limited(total)]


class OutsideRobot(EllipseRobot):
    """M_OUT: velocity u_nn + u_apf. Between two decisions u_nn stays, and u_apf is that of every simulator step.

    Args:
      network: the trained network.
      config: the world that it was trained in.
    """

    @classmethod
    def inputs(cls, config: WorldConfig) -> list[Port]:
        """As the others', and the action to hold."""
        meaning = f"the action of the last decision, to go on with it, or {DECIDE} to decide"
        return [*super().inputs(config), Port("held", "int64", ("batch",), "", meaning)]

    @classmethod
    def sense(cls, worlds: WorldBatch) -> dict[str, NDArray[Any]]:
        """As the others', with no held action."""
        return super().sense(worlds) | {"held": np.full(worlds.num_worlds, DECIDE)}

    def forward(self, positions: Tensor, mask: Tensor, goals: Tensor, held: Tensor) -> Decision:  # type: ignore[override]
        """Decides for a batch of robots, or goes on with their decisions.

        Args:
          positions, mask, goals: as the others'.
          held: `[batch]` int64, the action of the last decision, or DECIDE.
        """
        return self._decide(positions, mask, goals, held)

    def _velocity(self, action: Tensor, positions: Tensor, mask: Tensor) -> Tensor:
        """The velocity `[batch, 2]` float32 of an action: u_nn + u_apf, no faster than the limit."""
        total = self.field.parts(positions, mask).sum((1, 2))
        velocity = self.headings[action] + self.field.limited(total)
        return shortened(velocity, self.config.learner_speed_limit_m_s).float()
