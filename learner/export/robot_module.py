"""The learning robot's whole decision as one torch module: from what it senses to the velocity it drives.

A module computes what the simulator's `perceive` and `velocity` compute around the Q-network, for use outside the
simulator. It takes positions relative to the robot (metres, along the axes of the world that the goals and headings are
in), of any number of robots: unused places are masked. It can be exported: no loop over robots, no branch on data.
Arithmetic is the simulator's: float32 where its arrays are, float64 in between.
"""

from __future__ import annotations

import importlib
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from actors.policy.network import Network
from learner.export.ports import Port
from sim_core.checks import ConfigError
from sim_core.config import WorldConfig
from sim_core.methods.headings import heading_velocities
from sim_core.worlds import WorldBatch

Decision = tuple[Tensor, Tensor, Tensor, Tensor]
"""What a module gives: velocity `[batch, 2]` float32 (m/s), action `[batch]` int64, action values `[batch, actions]`
float32, and the observation `[batch, size]` float32 that the network saw. Plain: a saved program needs no class.
"""


NO_DECISION = -1
"""Action where the state cannot be formed; the velocity is then zero."""
FARTHEST = 1e9
"""A number beyond it, and one that is none (NaN), is no measurement."""


def is_measured(values: Tensor) -> Tensor:
    """Where `values` are numbers and not infinite, by a comparison that an exported graph keeps."""
    return values.abs() <= FARTHEST


def measured(positions: Tensor, used: Tensor) -> tuple[Tensor, Tensor]:
    """Positions `[batch, ..., 2]` with zeros in places that are not used or were not measured.

    Also whether all places that are used were measured, `[batch]`; `used` is `[batch, ...]` bool.
    """
    good = is_measured(positions).all(-1)
    missing = (used & ~good).flatten(1).float().sum(1)
    return torch.where((used & good).unsqueeze(-1), positions, 0.0), missing == 0.0


class BarePolicy(nn.Module):
    """Observation to action values and the greedy action, for any environment.

    Args:
      network: the trained network.
    """

    def __init__(self, network: Network) -> None:
        super().__init__()
        self.network = network

    def forward(self, observation: Tensor) -> tuple[Tensor, Tensor]:
        """(action `[batch]` int64, action values `[batch, actions]`) of observations `[batch, *shape]`.

        The action is NO_DECISION where an element of the observation is not a number or infinite.
        """
        values = self.network(observation)
        known = is_measured(observation.float()).flatten(1).all(1)
        return torch.where(known, values.argmax(1), NO_DECISION), values


class RobotModule(nn.Module):
    """The decision of one method; `Method.robot_module` names the class.

    Args:
      network: the trained network.
      config: the world that it was trained in.
    """

    headings: Tensor

    def __init__(self, network: Network, config: WorldConfig) -> None:
        super().__init__()
        self.network = network
        self.decides_always = config.senses_badly
        self.register_buffer("headings", torch.from_numpy(heading_velocities(config, "float32")))

    @classmethod
    def inputs(cls, config: WorldConfig) -> list[Port]:
        """What the module takes, in its order."""
        raise NotImplementedError

    @classmethod
    def observation_meaning(cls, config: WorldConfig) -> str:
        """What the observation's elements are, in words."""
        raise NotImplementedError

    @classmethod
    def undecided(cls, config: WorldConfig) -> str:
        """What to say of an action where the state cannot be formed."""
        return f"; {NO_DECISION} and no velocity where a position that is used is not a number or infinite"

    @classmethod
    def decides(cls, worlds: WorldBatch) -> NDArray[np.bool_]:
        """The worlds `[num_worlds]` whose learning robot senses enough to decide."""
        return np.ones(worlds.num_worlds, np.bool_)

    @classmethod
    def sense(cls, worlds: WorldBatch) -> dict[str, NDArray[Any]]:
        """What the learning robots of a batch of worlds sense, as the module's inputs by name."""
        raise NotImplementedError

    @classmethod
    def outputs(cls, config: WorldConfig) -> list[Port]:
        """What the module gives, in its order."""
        size = len(config.method_class.observation_names(config))
        speed = config.method_class.top_speed_m_s(config)
        q, levels = config.sectors, config.speed_levels
        slower = f"; action a: sector a mod {q} at ({levels} - a div {q}) / {levels} of the speed" if levels > 1 else ""
        stop = ", the last one stops" if config.stop_action else ""
        heading = f"sector to head for, from angle -pi on{slower}{stop}{cls.undecided(config)}"
        values = "discounted reward promised by each action"
        return [
            Port(
                "velocity",
                "float32",
                ("batch", 2),
                "m/s",
                f"what to drive, at most {speed} m/s",
            ),
            Port("action", "int64", ("batch",), "", heading),
            Port("action_values", "float32", ("batch", config.num_actions), "", values),
            Port("observation", "float32", ("batch", size), "", cls.observation_meaning(config)),
        ]


def robot_class(config: WorldConfig) -> type[RobotModule]:
    """The module class of the world's method.

    Raises:
      ConfigError: the method has none.
    """
    place = config.method_class.robot_module
    if not place:
        raise ConfigError(
            f"what a robot senses is not known for method {config.method_name}; export observation to action values "
            "with --bare True"
        )
    module, _, name = place.partition(":")
    found: type[RobotModule] = getattr(importlib.import_module(module), name)
    return found


def make_robot(network: Network, config: WorldConfig) -> RobotModule:
    """The module of the world's method (see `robot_class` for errors)."""
    return robot_class(config)(network, config)


def relative_positions(worlds: WorldBatch) -> tuple[NDArray[np.float32], NDArray[np.bool_], NDArray[np.float32]]:
    """What the robots sense, relative to them, the own group first; the robot itself and robots not sensed are masked.

    Returns:
      Positions `[num_worlds, groups, largest group, 2]`, their mask `[num_worlds, groups, largest group]` and goals
      `[num_worlds, groups, 2]`; metres.
    """
    config, state = worlds.config, worlds.sensed
    rows, sizes = np.arange(worlds.num_worlds), np.array(config.group_sizes)
    robot = state.group_begin[:-1, None] + np.arange(sizes.max())
    there = np.arange(sizes.max()) < sizes[:, None]
    positions = worlds.sensed_positions()
    itself = positions[rows, state.learner]
    relative = (positions - itself[:, None])[:, np.where(there, robot, 0)]
    mask = there & (robot != state.learner[:, None, None]) & np.isfinite(relative[..., 0])
    relative[~mask] = 0.0
    order = (state.group[state.learner][:, None] + np.arange(config.groups)) % config.groups
    arrays = (relative, mask, worlds.goals() - itself[:, None])
    own_first = [
        np.take_along_axis(array, order.reshape(*order.shape, *(1,) * (array.ndim - 2)), 1) for array in arrays
    ]
    return own_first[0], own_first[1], own_first[2]
