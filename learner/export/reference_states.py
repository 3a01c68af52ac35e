"""What a robot of `robot_module` senses in states of real rollouts, and what the simulator decides there.

This is the other side of the comparison that every export passes: the simulator's own perception, the numpy
policy that rollout workers act with, and the simulator's velocity.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from actors.evaluation.evaluator import Candidate, make_action_rule
from actors.policy.policy import Policy, WeightsSnapshot
from actors.rollout.env_spec import EnvSpec
from actors.rollout.vector_env import make_vector_env, reset_seeded
from learner.export.robot_module import NO_DECISION, RobotModule, robot_class
from sim_core import ENV_ID
from sim_core.config import ONE_LEARNER, WorldConfig
from sim_core.worlds import WorldBatch, is_done

MAX_WORLDS = 100
"""Worlds that play at once."""
EVERY_STEPS = 5
"""Env steps between two states of a world that are taken."""


class Sensed(NamedTuple):
    """States: the inputs by name, and what is expected of them by output name; first axis: `[states, ...]`."""

    inputs: dict[str, NDArray[Any]]
    expected: dict[str, NDArray[Any]]


def swarm_states(config: WorldConfig, driver: Candidate, weights: WeightsSnapshot, seed: int, count: int) -> Sensed:
    """`count` states of rollouts in our own world, episodes from `seed` on.

    Args:
      config: the world.
      driver: who drives the learning robots while states are taken.
      weights: the policy that is asked in every state.
      seed: seed of the first episode.
      count: states to take.

    Returns:
      Inputs of the module of `config.method`, and the simulator's `velocity`, `action`, `action_values` and
      `observation`.
    """
    config = replace(config, learners=ONE_LEARNER)  # the policy of a robot is the same, whatever others do
    size = min(MAX_WORLDS, count)
    seeds = list(range(seed, seed + size))
    worlds, policy = WorldBatch(config, size), Policy(weights)
    robot = robot_class(config)
    rule = make_action_rule(EnvSpec(ENV_ID, config), driver, seeds)
    worlds.seed(seeds)
    observation, taken = worlds.reset(), list[Sensed]()
    for step in range(EVERY_STEPS * -(-count // size)):
        if step % EVERY_STEPS == 0:
            taken.append(Sensed(robot.sense(worlds), _decided(worlds, robot, policy, observation)))
        result = worlds.step(rule.act(observation))
        done = is_done(result.outcome)
        observation = worlds.reset(done) if done.any() else result.observation
    return _joined(taken, count)


def _decided(
    worlds: WorldBatch, robot: type[RobotModule], policy: Policy, observation: NDArray[Any]
) -> dict[str, NDArray[Any]]:
    values, action, decides = policy.values(observation), policy.greedy(observation), robot.decides(worlds)
    velocity = np.zeros((2, worlds.num_worlds), np.float32)
    worlds.method.velocity(worlds.sensed, action, velocity[0], velocity[1])
    seen, velocity[:, ~decides] = observation.astype(np.float32), 0.0
    return {
        "velocity": velocity.T,
        "action": np.where(decides, action, NO_DECISION),
        "action_values": values,
        "observation": seen,
    }


def _joined(taken: list[Sensed], count: int) -> Sensed:
    def joined(parts: list[dict[str, NDArray[Any]]]) -> dict[str, NDArray[Any]]:
        return {name: np.concatenate([part[name] for part in parts])[:count] for name in parts[0]}

    return Sensed(joined([part.inputs for part in taken]), joined([part.expected for part in taken]))


def observed_states(spec: EnvSpec, weights: WeightsSnapshot, seed: int, count: int) -> Sensed:
    """`count` observations of greedy rollouts in any environment, episodes from `seed` on, and the policy's answers.

    Returns:
      `observation` as the environment gives it; expected `action` and `action_values`.
    """
    size = min(MAX_WORLDS, count)
    spec, policy = spec.with_one_learner(), Policy(weights)
    env = make_vector_env(spec, size)
    observation, taken = reset_seeded(env, list(range(seed, seed + size))), list[Sensed]()
    for _ in range(-(-count // size)):
        action = policy.greedy(observation)
        expected: dict[str, NDArray[Any]] = {"action": action, "action_values": policy.values(observation)}
        taken.append(Sensed({"observation": observation.copy()}, expected))
        observation = env.step(action)[0]
    env.close()
    return _joined(taken, count)
