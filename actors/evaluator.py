"""Greedy evaluation on fixed seeds: one episode a seed, so that short episodes are not over-counted."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from actors.calls import Calls, Ref
from actors.network import Policy, WeightsSnapshot
from actors.rollout import join_stats
from actors.trajectory import Episode
from actors.transitions import NO_OUTCOME, EpisodeStats
from actors.vector_env import EnvSpec, make_vector_env, reset_seeded
from sim_core.worlds import WorldBatch, is_done

MAX_ENVS = 250
"""Environments stepped at once."""


def evaluate(spec: EnvSpec, weights: WeightsSnapshot, seeds: list[int]) -> EpisodeStats:
    """Plays the greedy policy for one episode from each seed.

    Returns:
      One entry a seed, in order.
    """
    policy = Policy(weights)
    chunks = [seeds[i : i + MAX_ENVS] for i in range(0, len(seeds), MAX_ENVS)]
    return join_stats([_play(spec, policy, chunk) for chunk in chunks])


def evaluate_in_parts(calls: Calls, spec: EnvSpec, weights: Ref, seeds: list[int], parts: int) -> EpisodeStats:
    """`evaluate` as up to `parts` calls at once; `weights` refers to a WeightsSnapshot.

    Returns:
      One entry a seed; their order is not that of the seeds.
    """
    refs = [calls.run(evaluate, spec, weights, seeds[i::parts]) for i in range(min(parts, len(seeds)))]
    return join_stats([calls.get(ref) for ref in refs])


def _play(spec: EnvSpec, policy: Policy, seeds: list[int]) -> EpisodeStats:
    count = len(seeds)
    stats = EpisodeStats(np.full(count, NO_OUTCOME, np.int8), np.zeros(count, np.int32), np.zeros(count))
    env = make_vector_env(spec, count)
    observation = reset_seeded(env, seeds)
    running = np.ones(count, np.bool_)
    while running.any():
        observation, reward, terminated, truncated, infos = env.step(policy.greedy(observation))
        stats.length_steps[running] += 1
        stats.episode_return[running] += reward[running]
        ended = running & (terminated | truncated)
        if ended.any():
            outcome = infos.get("final_info", {}).get("outcome")
            if outcome is not None:
                stats.outcome[ended] = outcome[ended]
            running &= ~ended
    env.close()
    return stats


def record_episode(spec: EnvSpec, weights: WeightsSnapshot, seed: int) -> Episode:
    """Plays one greedy episode of our own environment and keeps every state."""
    worlds = WorldBatch(spec.world, 1)
    policy = Policy(weights)
    worlds.seed([seed])
    observation = worlds.reset()
    states, actions, rewards = [_state_of(worlds)], list[int](), list[float]()
    outcome = 0
    while not outcome:
        action = policy.greedy(observation)
        result = worlds.step(action)
        observation = result.observation
        states.append(_state_of(worlds))
        actions.append(int(action[0]))
        rewards.append(float(result.reward[0]))
        outcome = int(result.outcome[0]) if is_done(result.outcome)[0] else 0
    position, velocity, machine = (np.stack(column) for column in zip(*states, strict=True))
    return Episode(
        position=position,
        velocity=velocity,
        machine=machine,
        action=np.array([*actions, -1], np.int64),
        reward=np.array([*rewards, 0.0], np.float32),
        goal=worlds.goals()[0],
        learner=int(worlds.state.learner[0]),
        outcome=outcome,
        seed=seed,
    )


def record_frames(spec: EnvSpec, weights: WeightsSnapshot, seed: int) -> tuple[list[NDArray[np.uint8]], float]:
    """Plays one greedy episode of any Gymnasium environment and keeps its images.

    Returns:
      (images `[height, width, 3]`, images per second); no images where the environment has no rgb_array mode.
    """
    policy = Policy(weights)
    try:
        env = gym.make(spec.env_id, render_mode="rgb_array")
    except (TypeError, gym.error.Error):
        return [], 0.0
    frames_per_s = float(env.metadata.get("render_fps", 30))
    observation, _ = env.reset(seed=seed)
    frames, ended = list[NDArray[np.uint8]](), False
    while not ended:
        frames.append(np.asarray(env.render(), np.uint8))
        observation, _, terminated, truncated, _ = env.step(policy.greedy(observation[None])[0])
        ended = terminated or truncated
    env.close()
    return frames, frames_per_s


def _state_of(worlds: WorldBatch) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    velocity = np.stack([worlds.state.vel_x[0], worlds.state.vel_y[0]], axis=-1)
    return worlds.positions()[0], velocity, worlds.state.machine[0].copy()
