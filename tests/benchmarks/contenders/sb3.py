"""Stable-Baselines3's DQN."""

from typing import Any

import gymnasium as gym
import numpy as np
import torch
from stable_baselines3 import DQN
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecEnv

from actors.rollout.vector_env import final_observations, make_vector_env, reset_seeded
from tests.benchmarks.contest import Finding, Heat, Lap, compete, policy_of, rhythm, target_every_env_steps


class Vectorised(VecEnv):
    """A Gymnasium `VectorEnv` that restarts in the same step as Stable-Baselines3's own kind: faster than its loop."""

    def __init__(self, env: gym.vector.VectorEnv) -> None:
        self.env = env
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)
        self.action: np.ndarray | None = None

    def reset(self):
        seeds = self._seeds
        self._reset_seeds()
        return reset_seeded(self.env, seeds)

    def step_async(self, actions: np.ndarray) -> None:
        self.action = actions

    def step_wait(self):
        observation, reward, terminated, truncated, infos = self.env.step(self.action)
        done = terminated | truncated
        own: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        if done.any():
            reached = final_observations(observation, done, infos)
            for i in np.flatnonzero(done):
                own[i] = {"terminal_observation": reached[i], "TimeLimit.truncated": truncated[i] and not terminated[i]}
        return observation, reward, done, own

    def close(self) -> None:
        self.env.close()

    def get_attr(self, attr_name, indices=None):
        return [getattr(self.env, attr_name)] * self.num_envs

    def set_attr(self, attr_name, value, indices=None):
        raise NotImplementedError

    def env_method(self, method_name, *args, indices=None, **kwargs):
        raise NotImplementedError

    def env_is_wrapped(self, wrapper_class, indices=None):
        return [False] * self.num_envs


class Watch(BaseCallback):
    """Tells the lap of every step."""

    def __init__(self, lap: Lap) -> None:
        super().__init__()
        self.lap = lap

    def _on_step(self) -> bool:
        updates = self.model._n_updates
        return not self.lap.over(self.num_timesteps, updates, lambda: policy_of(self.model.q_net))


def train(heat: Heat) -> Finding:
    config = heat.config
    torch.set_num_threads(heat.threads)
    if heat.variant == "vectorised":
        env: VecEnv = Vectorised(make_vector_env(config.env, heat.envs))
    else:
        env = make_vec_env(config.env_id, heat.envs, seed=config.seed, env_kwargs=config.env.settings)
    beat = rhythm(config, heat.envs)
    change = config.learning_rate_end - config.learning_rate
    model = DQN(
        "MlpPolicy",
        env,
        learning_rate=lambda left: config.learning_rate + (1 - left) * change,
        buffer_size=config.replay_capacity,
        learning_starts=config.min_replay,
        batch_size=config.batch_size,
        gamma=config.decision_discount,
        n_steps=config.n_step,
        train_freq=beat.vector_steps,
        gradient_steps=beat.updates,
        target_update_interval=target_every_env_steps(config),
        exploration_initial_eps=config.epsilon_start,
        exploration_final_eps=config.epsilon_end,
        exploration_fraction=config.epsilon_decay_env_steps / config.total_env_steps,
        max_grad_norm=config.max_gradient_norm,
        policy_kwargs={"net_arch": list(config.hidden_sizes)},
        seed=config.seed,
        device="cpu",
    )
    lap = Lap(heat)
    model.learn(config.total_env_steps, callback=Watch(lap))
    return lap.finding()


if __name__ == "__main__":
    compete(train)
