"""What the contenders of `tests.benchmarks.peers` have in common: the work that is set, the watch and the judge.

A contender is a module of `tests.benchmarks.contenders` that runs in a process, and where need be an environment, of
its own: `python -m tests.benchmarks.contenders.sb3 HEAT` with the heat as JSON, and prints its finding as JSON.
"""

import dataclasses
import json
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np

import sim_core  # noqa: F401  registers our environment, in whatever process this is
from actors.evaluation.evaluator import evaluate
from actors.policy.policy import WeightsSnapshot
from actors.rollout.env_spec import EnvSpec
from learner.config import RunConfig, from_dict, to_dict
from learner.training.evaluation_summary import score, summarise

WARM_S = 3.0
"""From the first update to the start of the count, where a rate is measured."""
JUDGED_FROM = 3_100_000_000
"""First seed of the judge's episodes; no training draws its worlds from there."""


@dataclass(frozen=True)
class Heat:
    """One contender's turn.

    `config` is the work: environment, network, batch, samples per insert and every setting of the learning that the
    contender knows. `envs` and `threads` are the contender's own to choose. With a `threshold` the heat ends when the
    judge's score reaches it or after `seconds`; without one, env steps and updates are counted for `seconds`.
    """

    config: RunConfig
    envs: int
    threads: int
    seconds: float
    threshold: float | None
    variant: str = ""
    """Of several ways that a contender has, which."""
    began_s: float = 0.0
    """Wall time at which the process was asked for."""

    def to_json(self) -> str:
        return json.dumps({**dataclasses.asdict(self), "config": to_dict(self.config)})


def heat_of(text: str) -> Heat:
    values = json.loads(text)
    return Heat(**{**values, "config": from_dict(values["config"])})


class Finding(NamedTuple):
    """What a heat gave; times are None where the threshold was not asked for or not reached."""

    env_steps_per_s: float
    updates_per_s: float
    start_up_s: float
    to_threshold_s: float | None
    env_steps: int
    score: float | None


class Lap:
    """The watch of one heat: stands still while the judge plays.

    Args:
      heat: the turn.
    """

    def __init__(self, heat: Heat) -> None:
        self._heat = heat
        self._start_s = time.perf_counter()
        self._start_up_s = time.time() - heat.began_s
        self._judged_s = 0.0
        self._next_judgement = heat.config.eval_every_env_steps
        self._marks: list[tuple[float, int, int]] = []
        self._score: float | None = None
        self._reached_s: float | None = None

    def _now_s(self) -> float:
        return time.perf_counter() - self._start_s - self._judged_s

    def over(self, env_steps: int, updates: int, weights: Callable[[], WeightsSnapshot] | None = None) -> bool:
        """Takes note of where the training stands; whether it may end.

        Args:
          env_steps, updates: so far.
          weights: gives the policy for the judge; None where there is no threshold.
        """
        now_s = self._now_s()
        if updates and (not self._marks or now_s >= self._marks[-1][0] + 0.05):
            self._marks.append((now_s, env_steps, updates))
        if self._heat.threshold is None:
            return bool(self._marks) and now_s >= self._marks[0][0] + WARM_S + self._heat.seconds
        if weights is not None and updates and env_steps >= self._next_judgement:
            self._next_judgement = env_steps + self._heat.config.eval_every_env_steps
            self._judge(weights())
        return self._reached_s is not None or now_s >= self._heat.seconds

    def _judge(self, weights: WeightsSnapshot) -> None:
        start_s = time.perf_counter()
        config = self._heat.config
        seeds = list(range(JUDGED_FROM, JUDGED_FROM + config.eval_episodes))
        found = score(summarise(evaluate(config.env, weights, seeds)))
        self._judged_s += time.perf_counter() - start_s
        self._score = found
        if self._heat.threshold is not None and found >= self._heat.threshold and self._reached_s is None:
            self._reached_s = self._now_s()

    def finding(self) -> Finding:
        """What the heat gave; rates are of the time after the warm-up, or of all if it ended before."""
        if not self._marks:
            return Finding(0.0, 0.0, self._start_up_s, None, 0, None)
        warm = [mark for mark in self._marks if mark[0] >= self._marks[0][0] + WARM_S]
        (start_s, first_steps, first_updates), (end_s, steps, updates) = (warm or self._marks)[0], self._marks[-1]
        elapsed_s = max(end_s - start_s, 1e-9)
        return Finding(
            (steps - first_steps) / elapsed_s,
            (updates - first_updates) / elapsed_s,
            self._start_up_s,
            self._reached_s,
            steps,
            self._score,
        )


def compete(train: Callable[[Heat], Finding]) -> None:
    """Runs a contender as the program that this process is."""
    print(json.dumps(train(heat_of(sys.argv[1]))._asdict()))


def policy_of(network: Any) -> WeightsSnapshot:
    """A peer's Q-network for the judge: a PyTorch module whose parameters are those of our plain network."""
    from actors.policy.network import snapshot  # PyTorch, which our driver over Ray does not import

    return snapshot(network, 0, 0.0)


def float_env(spec: EnvSpec) -> gym.Env:
    """One environment whose observations are float32, for libraries whose networks take nothing else."""
    return gym.wrappers.DtypeObservation(gym.make(spec.env_id, **spec.settings), np.float32)


class Rhythm(NamedTuple):
    """So many updates after so many steps of all environments at once, as peers that alternate are told."""

    vector_steps: int
    updates: int


def rhythm(config: RunConfig, envs: int) -> Rhythm:
    """The rhythm nearest to the config's samples per insert."""
    wanted = config.samples_per_insert * envs / config.batch_size
    if wanted >= 1:
        return Rhythm(1, round(wanted))
    return Rhythm(round(1 / wanted), 1)


def target_every_env_steps(config: RunConfig) -> int:
    """The target network's period in env steps, for peers that count those."""
    return max(1, round(config.target_update_interval * config.batch_size / config.samples_per_insert))
