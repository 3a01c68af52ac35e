"""Evaluation on fixed seeds: one episode per seed, so that short episodes are not over-represented.

The same loop plays learned policies, which act greedily, and baselines. Where several robots of a world learn, a seed
is a world, in which each of them has an episode.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import closing
from itertools import count, pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from actors.evaluation.recording import Recording
from actors.evaluation.trajectory import Episode
from actors.evaluation.value_meter import ValueMeter
from actors.policy.baselines import ActionRule, Baseline, make_baseline
from actors.policy.policy import Policy, WeightsSnapshot
from actors.rollout.env_spec import EnvSpec
from actors.rollout.foreign_env import EnvError, ForeignVectorEnv
from actors.rollout.foreign_spaces import shown
from actors.rollout.vector_env import make_vector_env, reset_seeded
from actors.rollout.worker import join_stats, select_stats
from actors.service.fault_policy import Action, CallFailed, ComponentKind, decide
from actors.service.messages import NO_OUTCOME, NO_TEAM, NO_VALUES, TEAM_DTYPE, EpisodeStats
from actors.service.rpc import Calls, Ref, by_reference
from sim_core.checks import require
from sim_core.config import ONE_LEARNER, WorldConfig
from sim_core.outcomes import Outcome
from sim_core.pilot import Pilot
from sim_core.worlds import WorldBatch, is_done

MAX_ENVS = 250
"""Most environments stepped together."""
ROBOT_EPISODES_PER_PROCESS = 20_000
"""Episodes of the swarm, times the robots of each, that take as long as a process takes to start that plays them."""
SHORT_PROCESSES = 4
"""Starts of a process in the time in which a Ray of its own starts, plays and ends."""
MAX_EPISODE_STEPS = 100_000
"""Longest episode of a foreign environment in an evaluation; one that never ends would keep a run from its end."""
RGB = "rgb_array"
"""Render mode of environments that draw images."""
FRAMES_PER_S = 30.0
"""Images per second where an environment does not say."""
MAX_FRAMES = 10_000
"""Most images of a recorded episode."""

Candidate = WeightsSnapshot | Baseline
"""What is evaluated, as data that can be sent to another process: a policy's weights, or a baseline's name."""


class GreedyPolicy:
    """A learned policy that takes the action of the highest value; implements `baselines.ActionRule`.

    Args:
      weights: the snapshot to act with.
    """

    def __init__(self, weights: WeightsSnapshot) -> None:
        self._policy = Policy(weights)

    def act(self, observation: NDArray[Any]) -> NDArray[np.int64]:
        """Greedy actions `[batch]` for observations `[batch, *shape]`; the lowest index among equals."""
        return self._policy.greedy(observation)

    def values(self) -> NDArray[np.float32]:
        """Values `[batch]` of the actions of the last call of `act`."""
        return self._policy.highest_values()


def make_action_rule(spec: EnvSpec, candidate: Candidate, seeds: list[int]) -> ActionRule:
    """Makes the action rule of a candidate for one episode per seed, all played together.

    Raises:
      ConfigError: the candidate is a baseline and the environment is not the swarm's.
    """
    if isinstance(candidate, WeightsSnapshot):
        return GreedyPolicy(candidate)
    require(spec.is_swarm, f"the baseline {candidate} plays in the swarm environment only, not in {spec.env_id}")
    return make_baseline(candidate, spec.world, seeds)


def evaluate(spec: EnvSpec, candidate: Candidate, seeds: list[int], discount: float | None = None) -> EpisodeStats:
    """Plays one episode per seed; of n setups, in that of index seed modulo n.

    Args:
      spec: the environment.
      candidate: who plays.
      seeds: of the episodes.
      discount: per decision, to have the values that a policy expects beside the returns that it gets.

    Returns:
      One entry per seed, in order; one per learning robot of each seed's world where several learn.

    Raises:
      ConfigError: see `make_action_rule`.
    """
    if spec.shares:
        return _evaluate_in_turn(spec, candidate, np.array(seeds, np.int64), discount)
    most = max(1, MAX_ENVS // spec.learners()[0])
    chunks = [seeds[i : i + most] for i in range(0, len(seeds), most)]
    return join_stats([_play(spec, make_action_rule(spec, candidate, chunk), chunk, discount) for chunk in chunks])


def _evaluate_in_turn(
    spec: EnvSpec, candidate: Candidate, seeds: NDArray[np.int64], discount: float | None
) -> EpisodeStats:
    worlds = spec.worlds
    order = np.argsort(seeds % len(worlds), kind="stable")
    parts = [seeds[seeds % len(worlds) == i].tolist() for i in range(len(worlds))]
    setups = [spec.of_setup(world) for world in worlds]
    played = [evaluate(setup, candidate, part, discount) for setup, part in zip(setups, parts, strict=True)]
    learners = np.array(spec.learners())[seeds[order] % len(worlds)]
    first = np.cumsum(learners) - learners  # entry of each seed, setup after setup
    places = [np.arange(first[at], first[at] + learners[at]) for at in np.argsort(order)]
    return select_stats(join_stats(played), np.concatenate(places))


def worthwhile_calls(spec: EnvSpec, episodes: int, most: int) -> int:
    """How many simultaneous calls of `evaluate` are worth a process each, where one runs already; at most `most`.

    Args:
      spec: the environment; how long an episode of a foreign one takes is not known, so it gets `most`.
      episodes: to be played in each setup.
      most: calls that can run at once.
    """
    return max(1, min(most, int(_processes([spec], episodes)))) if spec.is_swarm else most


def is_short(specs: list[EnvSpec], episodes: int) -> bool:
    """Whether one process plays so many episodes in each setup sooner than a Ray of its own would start for them."""
    return all(spec.is_swarm for spec in specs) and _processes(specs, episodes) < SHORT_PROCESSES


def _processes(specs: list[EnvSpec], episodes: int) -> float:
    """How many processes start while the swarm's episodes are played, so many in each setup."""
    robots = sum(world.num_robots for spec in specs for world in spec.worlds)
    return episodes * robots / ROBOT_EPISODES_PER_PROCESS


def evaluate_in_parallel(
    calls: Calls, spec: EnvSpec, candidate: Ref[Candidate], seeds: list[int], max_calls: int
) -> EpisodeStats:
    """Splits an evaluation into up to `max_calls` simultaneous calls of `evaluate`.

    Args:
      calls: how to start the calls.
      spec: the environment.
      candidate: who plays.
      seeds: one episode is played per seed.
      max_calls: most calls to start.

    Returns:
      Entries as of `evaluate`.

    Raises:
      CallFailed: one of the calls keeps failing.
    """
    num_calls = min(max_calls, len(seeds))
    bounds = [len(seeds) * i // num_calls for i in range(num_calls + 1)] if num_calls else []
    chunks = [seeds[begin:end] for begin, end in pairwise(bounds)]
    refs = [calls.run(evaluate, spec, by_reference(candidate), chunk) for chunk in chunks]
    return join_stats([_get_result(calls, spec, candidate, *call) for call in zip(chunks, refs, strict=True)])


def _get_result(
    calls: Calls, spec: EnvSpec, candidate: Ref[Candidate], seeds: list[int], ref: Ref[EpisodeStats]
) -> EpisodeStats:
    """Waits for a call of `evaluate`, and makes it again as long as the decision table says so."""
    for attempt in count(1):
        try:
            return calls.get(ref)
        except CallFailed as failure:
            if decide(ComponentKind.EVALUATOR, failure.fault, attempt, 0.0) is Action.STOP:
                raise
            ref = calls.run(evaluate, spec, by_reference(candidate), seeds)
    raise AssertionError("count never ends")


class _Step(NamedTuple):
    """Result of stepping every episode `[batch, ...]`; `outcome` is valid where an episode has ended.

    `steps` are those of the episode so far, as EpisodeStats counts them.
    """

    observation: NDArray[Any]
    reward: NDArray[np.float64]
    ended: NDArray[np.bool_]
    outcome: NDArray[np.int8]
    steps: NDArray[np.int32]


class _SwarmEpisodes:
    """Episodes of the swarm environment; once half of the worlds have ended, only the others are stepped."""

    def __init__(self, config: WorldConfig, seeds: list[int]) -> None:
        self._worlds = WorldBatch(config, len(seeds))
        self._worlds.seed(seeds)
        self._per_world, self._is_team = config.num_learners, config.learners != ONE_LEARNER
        count = self.num_episodes = self._worlds.num_rows
        self._seed = np.arange(len(seeds))  # index of the seed of every world that is still stepped
        self._episode = np.arange(count)  # index of the episode of every row of these worlds
        self._over = np.zeros(len(seeds), np.bool_)  # which of these worlds have ended
        self._segregation, self._decisions = np.zeros(len(seeds)), np.zeros(len(seeds))
        self._hit_learner = np.zeros(count, np.bool_)
        self._last = _Step(
            observation=self._worlds.reset(),
            reward=np.zeros(count),
            ended=np.zeros(count, np.bool_),
            outcome=np.zeros(count, np.int8),
            steps=np.zeros(count, np.int32),
        )

    def start(self) -> NDArray[Any]:
        return self._last.observation

    def step(self, action: NDArray[np.int64] | Pilot) -> _Step:
        result = self._worlds.step(action if isinstance(action, Pilot) else action[self._episode])
        done = is_done(result.outcome)
        last, episode = self._last, self._episode
        last.observation[episode] = result.observation
        last.reward[episode] = result.reward
        last.ended[episode] = done
        last.outcome[episode] = result.outcome
        last.steps[episode] = result.steps
        if self._is_team:
            self._watch_team()
        self._over |= self._worlds.ended_worlds()
        if self._over.mean() >= 0.5 and not self._over.all():
            self._drop_ended()
        return self._last

    def _watch_team(self) -> None:
        going_on = ~self._over
        self._segregation[self._seed[going_on]] += self._worlds.segregation()[going_on]
        self._decisions[self._seed[going_on]] += 1
        rows = self._worlds.rows_of(going_on)
        self._hit_learner[self._episode[rows]] = self._worlds.hit_learner[rows]

    def _drop_ended(self) -> None:
        running = ~self._over
        self._episode = self._episode[self._worlds.rows_of(running)]
        self._seed, self._over = self._seed[running], self._over[running]
        hit_learner = self._hit_learner[self._episode]
        self._worlds = self._worlds.alone(running)
        self._worlds.hit_learner[:] = hit_learner

    def team(self) -> NDArray[np.void]:
        """TEAM_DTYPE `[episodes]`; empty where `learners` is one, so in all setups or in none."""
        if not self._is_team:
            return NO_TEAM
        team = np.zeros(self.num_episodes, TEAM_DTYPE)
        team["learners"] = self._per_world
        team["segregation"] = np.repeat(self._segregation / np.maximum(self._decisions, 1), self._per_world)
        team["hit_learner"] = self._hit_learner
        return team

    def close(self) -> None:
        pass


class _GymEpisodes:
    """Episodes of any Gymnasium id; environments restart when they end, and those further episodes are ignored."""

    def __init__(self, spec: EnvSpec, seeds: list[int]) -> None:
        self._env = make_vector_env(spec, len(seeds))
        self.num_episodes = len(seeds)
        self._env_id = spec.env_id
        self._seeds = seeds
        self._steps = np.zeros(len(seeds), np.int32)
        self._outcome = np.full(len(seeds), NO_OUTCOME, np.int8)

    def start(self) -> NDArray[Any]:
        return reset_seeded(self._env, self._seeds)

    def step(self, action: NDArray[np.int64] | Pilot) -> _Step:
        assert not isinstance(action, Pilot)
        observation, reward, terminated, truncated, _ = self._env.step(action)
        self._steps += 1
        if self._steps[0] > MAX_EPISODE_STEPS:
            raise EnvError(
                f"env_id {self._env_id!r}: an evaluated episode has not ended after {MAX_EPISODE_STEPS:,} steps; give "
                "the environment a time limit, such as max_episode_steps of gymnasium.register"
            )
        return _Step(observation, reward, terminated | truncated, self._outcome, self._steps)

    def team(self) -> NDArray[np.void]:
        return NO_TEAM

    def close(self) -> None:
        self._env.close()


def _play(spec: EnvSpec, rule: ActionRule, seeds: list[int], discount: float | None) -> EpisodeStats:
    episodes = _SwarmEpisodes(spec.world, seeds) if spec.is_swarm else _GymEpisodes(spec, seeds)
    count = episodes.num_episodes
    stats = EpisodeStats(np.full(count, NO_OUTCOME, np.int8), np.zeros(count, np.int32), np.zeros(count))
    meter = None
    if discount is not None and isinstance(rule, GreedyPolicy):
        meter = ValueMeter(rule.values, count, discount)
    observation = episodes.start()
    running = np.ones(count, np.bool_)
    while running.any():
        observation, reward, done, outcome, steps = episodes.step(rule.act(observation))
        if meter is not None:
            meter.add(reward, running)
        stats.episode_return[running] += reward[running]
        ended = running & done
        stats.outcome[ended], stats.length_steps[ended] = outcome[ended], steps[ended]
        running &= ~ended
    stats = stats._replace(team=episodes.team(), values=NO_VALUES if meter is None else meter.values())
    episodes.close()
    return stats


def record_episode(spec: EnvSpec, candidate: Candidate, seed: int, number: int | None = None) -> Episode:
    """Plays one episode of the swarm environment and records the state after every simulator step.

    Where several robots of the world learn, it is that of the learning robot `number` (see Recording).
    """
    recording, rule = Recording(spec.world, seed, number), make_action_rule(spec, candidate, [seed])
    while recording.outcome == Outcome.RUNNING:
        recording.step(rule.act(recording.observation))
    return recording.episode()


def record_frames(spec: EnvSpec, weights: WeightsSnapshot, seed: int) -> tuple[Iterator[NDArray[np.uint8]], float]:
    """Plays one greedy episode of any Gymnasium environment and draws every step, until `MAX_FRAMES`.

    Returns:
      (images `[height, width, 3]` uint8, drawn as they are asked for; images per second).

    Raises:
      ConfigError: it cannot be drawn, at once or while images are asked for.
    """
    with closing(ForeignVectorEnv(spec.env_id, 1)) as plain:
        modes = plain.metadata.get("render_modes")
    has_mode = isinstance(modes, list | tuple) and RGB in modes
    require(has_mode, f"env_id {spec.env_id!r} has no render mode {RGB}; it has {shown(modes)}")
    env = ForeignVectorEnv(spec.env_id, 1, RGB)
    rate = env.metadata.get("render_fps")
    frames_per_s = float(rate) if isinstance(rate, int | float) and 0 < rate < math.inf else FRAMES_PER_S
    return _frames(env, Policy(weights), seed), frames_per_s


def _frames(env: ForeignVectorEnv, policy: Policy, seed: int) -> Iterator[NDArray[np.uint8]]:
    with closing(env):
        observation = reset_seeded(env, [seed])
        shape = None
        for _ in range(MAX_FRAMES):
            image = _image(env)
            shape = shape or image.shape
            require(image.shape == shape, f"env_id {env.env_id!r}: render() gave images of several sizes")
            yield image
            observation, _, terminated, truncated, _ = env.step(policy.greedy(observation))
            if terminated[0] or truncated[0]:
                return


def _image(env: ForeignVectorEnv) -> NDArray[np.uint8]:
    """What the environment draws; raises ConfigError if it is no RGB image."""
    image = env.render()[0]
    is_image = isinstance(image, np.ndarray) and image.dtype == np.uint8 and image.shape[2:] == (3,) and image.size
    what = f"{image.dtype} {image.shape}" if isinstance(image, np.ndarray) else shown(image)
    require(bool(is_image), f"env_id {env.env_id!r}: render() gave {what}, no RGB image [height, width, 3] uint8")
    drawn: NDArray[np.uint8] = image
    return drawn
