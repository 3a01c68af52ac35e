"""The rollout worker: steps many environments with one policy and packs the transitions into blocks."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from actors.policy.policy import Policy, WeightsSnapshot
from actors.rollout.entry_point_env import EntryPointVectorEnv
from actors.rollout.env_spec import EnvSpec
from actors.rollout.exploration import draw_random_actions
from actors.rollout.joined_env import JoinedVectorEnv
from actors.rollout.nstep import NStepAssembler
from actors.rollout.step_kernels import StepLog, explore, record_step
from actors.rollout.vector_env import final_observations, make_rollout_env, num_worlds_of, reset_seeded, spaces_of
from actors.service.messages import (
    NO_OUTCOME,
    SCHEMA_VERSION,
    BlockHeader,
    EpisodeStats,
    TransitionBlock,
    transition_dtype,
)
from actors.service.packing import packed_dtype
from sim_core.checks import ConfigError
from sim_core.envs import SwarmVectorEnv
from sim_core.jit import StateKernel


class RolloutSettings(NamedTuple):
    """Settings of the run that a rollout worker needs."""

    env: EnvSpec
    num_envs: int
    steps_per_block: int
    n_step: int
    discount: float
    seed: int


REHEARSED_ENVS = 8
"""Environments of a rehearsal: what a vector of the simulator's kernels holds."""


def rehearse(settings: RolloutSettings, weights: WeightsSnapshot) -> None:
    """Loads all code that a rollout worker runs, by a short block of a worker that is thrown away.

    Args:
      settings: of the worker that is to be.
      weights: any of its policy's shape.
    """
    small = settings._replace(num_envs=min(settings.num_envs, REHEARSED_ENVS), steps_per_block=settings.n_step + 1)
    worker = RolloutWorker(small, 0, 0)
    worker.set_weights(weights)
    worker.collect(0.0)
    worker.close()


class RolloutWorker:
    """Steps `num_envs` environments; one `collect` makes one block of `num_envs * steps_per_block` env steps.

    Where several robots of a world learn, an environment is a learning robot (`EnvSpec.counts`). It has an n-step chain
    and episodes of its own, and it makes no step from its episode's end until its world restarts: an env step is a
    decision of a learning robot.

    Args:
      settings: see RolloutSettings.
      worker_id: index among the workers.
      incarnation: distinguishes the starts of this worker; each one has its own random streams.
    """

    def __init__(self, settings: RolloutSettings, worker_id: int, incarnation: int) -> None:
        self._settings = settings
        self._worker_id = worker_id
        self._incarnation = incarnation
        self._sequence = 0
        self._made = 0
        self._env = make_rollout_env(settings.env, settings.num_envs)
        shape = spaces_of(self._env)
        self._num_actions = shape.num_actions
        self._num_envs = num_envs = self._env.num_envs
        self._may_wait = max(settings.env.learners()) > 1 or isinstance(self._env, EntryPointVectorEnv)
        self._dtype = packed_dtype(transition_dtype(shape.observation_space))
        seeds = np.random.SeedSequence((settings.seed, worker_id, incarnation))
        env_seeds, policy_seed = seeds.spawn(2)
        self._rng = np.random.Generator(np.random.PCG64(policy_seed))
        self._nstep = NStepAssembler(self._dtype, num_envs, settings.n_step, settings.discount)
        self._steps = steps = self._nstep.room(settings.steps_per_block)
        size = steps.done.shape
        self._ended = ended = EpisodeStats(np.zeros(size, np.int8), np.zeros(size, np.int32), np.zeros(size))
        written = steps.action, steps.reward, steps.terminated, steps.done, steps.decided
        self._log, self._record = StepLog(*written, ended.length_steps, ended.episode_return), StateKernel(record_step)
        self._length = np.zeros(num_envs, np.int32)
        self._return = np.zeros(num_envs, np.float64)
        words = env_seeds.generate_state(num_worlds_of(self._env)) // 2  # Gymnasium takes 31 bits
        self._observation = reset_seeded(self._env, [int(word) for word in words])
        self._policy: Policy | None = None

    @property
    def policy_version(self) -> int:
        """Version of the weights in use; -1 before the first ones."""
        return -1 if self._policy is None else self._policy.weights.version

    def set_weights(self, weights: WeightsSnapshot) -> None:
        """Acts with these weights from the next env step on."""
        self._policy = Policy(weights)

    def collect(self, epsilon: float) -> TransitionBlock:
        """Steps every environment `steps_per_block` times with exploration rate `epsilon`.

        Raises:
          RuntimeError: no weights have been set.
          ConfigError: a return is not finite, or a user's own code does what it must not.
        """
        if self._policy is None:
            raise RuntimeError("a rollout worker needs weights before it collects")
        steps = self._steps
        random_actions = draw_random_actions(steps.done.shape, epsilon, self._num_actions, self._rng)
        for i in range(len(random_actions)):
            self._step(self._policy, random_actions[i], i)
        packed = self._nstep.push(steps)
        if not np.isfinite(packed.rows["reward"]).all():
            raise ConfigError(self._too_large(packed.rows["reward"]))
        self._made += len(packed.rows)
        weights = self._policy.weights
        header = BlockHeader(
            schema_version=SCHEMA_VERSION,
            worker_id=self._worker_id,
            incarnation=self._incarnation,
            sequence=self._sequence,
            policy_version=weights.version,
            policy_time_s=weights.time_s,
            epsilon=epsilon,
            env_steps=int(np.count_nonzero(steps.decided)),
            made=self._made,
        )
        self._sequence += 1
        return TransitionBlock(header, packed, select_stats(self._ended, steps.done))

    def _too_large(self, reward: NDArray[np.float32]) -> str:
        env, bad = self._settings.env, reward[~np.isfinite(reward)][0]
        cause = f"reward_scale {env.world.reward_scale:g}" if env.is_swarm else f"env_id {env.env_id!r}"
        what = f"{self._settings.n_step}-step return of {bad}, which float32 does not hold"
        return f"{cause} gives a {what}; scale its rewards down"

    def _step(self, policy: Policy, random_actions: NDArray[np.int64], i: int) -> None:
        """Steps every environment once; writes step i of the block, and of its episodes where one ends.

        Next observations are written in the last step, and where an episode ends.
        """
        steps = self._steps
        action = explore(self._greedy(policy), random_actions)
        observation, reward, terminated, truncated, infos = self._env.step(action)
        told = action, reward, terminated, truncated
        if self._may_wait:
            steps.decided[i] = infos.get("decided", True)
        any_ended = self._record(self._log, i, *told, self._length, self._return)
        steps.observation[i] = self._observation
        self._observation = observation
        done = steps.done[i]
        if i + 1 == len(steps.done):
            steps.next_observation[i] = final_observations(observation, done, infos)
        if any_ended:
            steps.next_observation[i, done] = infos["final_obs"][done]
            final = infos.get("final_info", {})
            self._ended.outcome[i] = final.get("outcome", NO_OUTCOME)
            if self._settings.env.is_swarm:
                self._ended.length_steps[i] = final["episode_length"]

    def _greedy(self, policy: Policy) -> NDArray[np.int64]:
        """The policy's actions `[num_envs]`; 0 where no action is taken until an episode begins."""
        if not self._may_wait:
            return policy.greedy(self._observation)
        assert isinstance(self._env, SwarmVectorEnv | JoinedVectorEnv | EntryPointVectorEnv)
        return policy.greedy(self._observation, ~self._env.waiting())

    def close(self) -> None:
        """Closes the environments."""
        self._env.close()

    def get_state(self) -> dict[str, Any]:
        """Everything that a checkpoint needs: `arrays` by name, and `meta` for JSON.

        Only the swarm environment can save its worlds; others start new episodes after a resume.
        """
        arrays = {f"nstep_{name}": array for name, array in self._nstep.get_state().items()}
        arrays |= {"length": self._length.copy(), "return": self._return.copy()}
        if isinstance(self._env, SwarmVectorEnv | JoinedVectorEnv):
            arrays |= {f"world_{name}": array for name, array in self._env.get_state().items()}
        meta = {"sequence": self._sequence, "rng": self._rng.bit_generator.state, "policy": None}
        if self._policy is not None:
            version, time_s, layers, row_size = self._policy.weights
            arrays |= {f"policy_{i}": array for i, array in enumerate(layers)}
            meta["policy"] = [version, time_s, row_size]
        return {"arrays": arrays, "meta": meta}

    def set_state(self, arrays: dict[str, NDArray[Any]], meta: dict[str, Any]) -> None:
        """Restores a `get_state`; the incarnation stays that of this start."""
        self._sequence = meta["sequence"]
        self._rng.bit_generator.state = meta["rng"]
        if meta["policy"] is not None:
            count = sum(name.startswith("policy_") for name in arrays)
            version, time_s, row_size = meta["policy"]
            layers = tuple(arrays[f"policy_{i}"] for i in range(count))
            self.set_weights(WeightsSnapshot(version, time_s, layers, row_size))
        if not isinstance(self._env, SwarmVectorEnv | JoinedVectorEnv):
            return
        worlds = {name.removeprefix("world_"): array for name, array in arrays.items() if name.startswith("world_")}
        self._observation = self._env.set_state(worlds)
        nstep = {name.removeprefix("nstep_"): array for name, array in arrays.items() if name.startswith("nstep_")}
        self._nstep.set_state(nstep)
        self._length[:], self._return[:] = arrays["length"], arrays["return"]


def join_stats(stats: list[EpisodeStats]) -> EpisodeStats:
    """Concatenates EpisodeStats in order."""
    if not stats:
        return EpisodeStats(np.zeros(0, np.int8), np.zeros(0, np.int32), np.zeros(0, np.float64))
    columns = zip(*stats, strict=True)
    return EpisodeStats(*(np.concatenate(column) for column in columns))


def select_stats(stats: EpisodeStats, rows: NDArray[Any] | slice) -> EpisodeStats:
    """The episodes of `rows`: a mask, indices or a slice."""
    columns: list[NDArray[Any]] = [column[rows] if len(column) else column for column in stats]
    return EpisodeStats(*columns)
