"""The page of `shoal watch --drive`: a person drives the learning robot, then policy, rules and FL-ORCA do.

All meet the same start scenes. The page keeps the time: it asks for one decision after the other, so that a slow page
slows the world and misses nothing. What a person drove is stored in the run's artifacts, and a later call goes on.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from actors.evaluation.evaluator import Candidate, record_episode
from actors.evaluation.recording import Recording
from actors.evaluation.trajectory import Episode, load_episodes, save_episodes
from actors.policy.baselines import METHOD_RULES, Baseline, exists
from actors.policy.policy import WeightsSnapshot
from actors.rollout.env_spec import EnvSpec
from dashboards.pages.assets import SERVED
from dashboards.pages.player import player_data, player_page
from dashboards.pages.server import PageServer, Query, episode_number
from deploy.runs.folders import make_folder
from learner.config import RunConfig, config_hash
from learner.run_folder import RunFolder
from sim_core import ENV_ID
from sim_core.checks import ConfigError, require
from sim_core.config import ONE_LEARNER, WorldConfig
from sim_core.outcomes import OUTCOME_NAMES, Outcome
from sim_core.worlds import Command

SCENES = 25
"""Scenes of a score sheet."""
PERSON, POLICY = "you", "policy"
PATH_DIGITS = 3
"""Decimals of positions in metres that the page gets while a person drives."""


class Result(NamedTuple):
    """One episode of one player.

    `time_s` is the episode's simulated time; `goal_m` how near the learning robot came to its group's goal, `gap_m` how
    near to another robot, hull to hull (below 0: they overlap).
    """

    outcome: str
    time_s: float
    goal_m: float
    gap_m: float


class Total(NamedTuple):
    """A player's line of the score sheet; `time_s` is the mean of successes, None without one, the others of all."""

    player: str
    scenes: int
    successes: int
    time_s: float | None
    goal_m: float
    gap_m: float


class Played(NamedTuple):
    """An episode's result and the path `[T + 1, 2]` of the learning robot, metres."""

    result: Result
    path: NDArray[np.float32]


def played(episode: Episode, world: WorldConfig) -> Played:
    """What the score sheet shows of an episode."""
    path = episode.position[:, episode.learner]
    group = np.repeat(np.arange(world.groups), world.group_sizes)[episode.learner]
    others = np.delete(episode.position, episode.learner, axis=1)
    result = Result(
        outcome=OUTCOME_NAMES[Outcome(episode.outcome)],
        time_s=(len(path) - 1) * world.time_step_s,
        goal_m=float(np.linalg.norm(path - episode.goal[group], axis=-1).min()),
        gap_m=float(np.linalg.norm(others - path[:, None], axis=-1).min()) - 2 * world.robot_radius_m,
    )
    return Played(result, path)


def total(player: str, results: list[Result]) -> Total:
    """A player's line, of at least one result."""
    times = [result.time_s for result in results if result.outcome == OUTCOME_NAMES[Outcome.GOAL]]
    return Total(
        player=player,
        scenes=len(results),
        successes=len(times),
        time_s=float(np.mean(times)) if times else None,
        goal_m=float(np.mean([result.goal_m for result in results])),
        gap_m=float(np.mean([result.gap_m for result in results])),
    )


def driven_world(world: WorldConfig) -> WorldConfig:
    """The world with one learning robot, which a person drives, whatever learned in it."""
    return replace(world, learners=ONE_LEARNER)


def driven_store(folder: RunFolder, world: WorldConfig, seed: int) -> Path:
    """Where the episode that a person drove on a scene of this world is stored."""
    place = config_hash(RunConfig(world=driven_world(world)))
    return folder.artifacts / "driven" / place / f"episode-{seed}.zarr"


def load_driven(folder: RunFolder, world: WorldConfig, seed: int) -> Episode:
    """The episode that a person drove.

    Raises:
      ConfigError: nobody drove there yet, or its store is damaged.
    """
    store = driven_store(folder, world, seed)
    require(store.exists(), f"nobody has driven scene {seed} of this world; `shoal watch --drive` lets you")
    try:
        return load_episodes(store)[0][0]
    except ValueError as error:
        raise ConfigError(f"{error}; remove {store} and drive again") from error


class DrivenRun:
    """The answers to the page's requests.

    Args:
      folder: the run, whose artifacts keep what is driven.
      world: where all drive.
      weights: its policy.
      first_seed: seed of the first scene; scene n has seed `first_seed + n`, modulo 2^32.
    """

    def __init__(self, folder: RunFolder, world: WorldConfig, weights: WeightsSnapshot, first_seed: int) -> None:
        self._folder = folder
        self._world = world = driven_world(world)
        self._spec = EnvSpec(ENV_ID, world)
        self._first_seed = first_seed
        rules = [rule for rule in (*METHOD_RULES, Baseline.FL_ORCA) if exists(rule, world)]
        self._others: dict[str, Candidate] = {POLICY: weights} | {str(rule): rule for rule in rules}
        self._played: dict[tuple[int, str], Played] = {}
        self._number = 0
        self._driving: Recording | None = None

    def page(self, query: Query) -> str:
        """The page with the player."""
        title = f"{self._folder.path.name}: {self._world.method_name} {self._world.setup}, you drive"
        return player_page(title, {}, ["request.js", "drive.js"], SERVED)

    def sheet(self, query: Query) -> dict[str, Any]:
        """The score sheet: the next scene (None at the end), all results of driven scenes, and every player's line."""
        players = (PERSON, *self._others)
        driven = [number for number in range(SCENES) if self._store(number).exists()]
        results = {number: {player: self._play(number, player).result for player in players} for number in driven}
        totals = [total(player, [each[player] for each in results.values()]) for player in players if results]
        rows = [
            {"number": number, "results": {player: result._asdict() for player, result in each.items()}}
            for number, each in results.items()
        ]
        left = [number for number in range(SCENES) if number not in driven]
        return {
            "scenes": SCENES,
            "next": left[0] if left else None,
            "players": list(players),
            "rows": rows,
            "totals": [line._asdict() for line in totals],
        }

    def paths(self, query: Query) -> dict[str, Any]:
        """The learning robot's path of every player on a driven scene, metres."""
        number = self._scene(query)
        return {player: _rounded(self._play(number, player).path) for player in (PERSON, *self._others)}

    def episode(self, query: Query) -> dict[str, Any]:
        """A player's episode of a driven scene."""
        number, player = self._scene(query), query.get("player", "")
        if player not in (PERSON, *self._others):
            raise LookupError(f"player {player!r}")
        return player_data(self._recorded(number, player), self._world)

    def begin(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """Sets up scene `number`; returns its first state.

        Raises:
          LookupError: there is no such scene.
          ConfigError: it was driven before: the first attempt counts.
        """
        number = values.get("number")
        if not (isinstance(number, int) and 0 <= number < SCENES):
            raise LookupError(f"scene {number!r}")
        require(not self._store(number).exists(), f"scene {number + 1} has been driven; the first attempt counts")
        self._number, self._driving = number, Recording(self._world, self._seed(number))
        first = player_data(self._driving.episode(), self._world)
        return {**first, "horizon_steps": self._world.horizon_steps}

    def move(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """Takes one decision with the velocity that a person asks for.

        Args:
          values: `step`, the simulator steps that the page has seen; `x`, `y`, the velocity as a share of the learning
            robot's speed, shortened to 1.

        Returns:
          Positions `[steps][2 num_robots]` (metres), FL-ORCA's states `[steps][num_robots]`, positions as sensed (None:
          senses well) of the simulator steps made, and the outcome.

        Raises:
          ConfigError: no scene runs, or another page drives it.
          ValueError: the velocity is none.
        """
        driving = self._driving
        if driving is None or driving.outcome != Outcome.RUNNING or driving.steps != values.get("step"):
            raise ConfigError("this page has lost its scene; reload it")
        velocity = self._world.learner_speed_m_s * _direction(values.get("x"), values.get("y"))
        seen = driving.steps
        outcome = driving.step(Command(velocity[:, None]))
        new = driving.episode(seen)
        if outcome != Outcome.RUNNING:
            save_episodes(self._store(self._number), [driving.episode()], self._world)
        return {
            "positions": [_rounded(state.ravel()) for state in new.position[1:]],
            "machine": new.machine[1:].tolist(),
            "sensed": [_rounded(state.ravel()) for state in new.sensed[1:]] if len(new.sensed) else None,
            "outcome": OUTCOME_NAMES[outcome],
        }

    def _scene(self, query: Query) -> int:
        number = episode_number(query)
        if number >= SCENES or not self._store(number).exists():
            raise LookupError(f"driven scene {number}")
        return number

    def _seed(self, number: int) -> int:
        return (self._first_seed + number) % 2**32

    def _store(self, number: int) -> Path:
        return driven_store(self._folder, self._world, self._seed(number))

    def _recorded(self, number: int, player: str) -> Episode:
        seed = self._seed(number)
        if player == PERSON:
            return load_driven(self._folder, self._world, seed)
        return record_episode(self._spec, self._others[player], seed)

    def _play(self, number: int, player: str) -> Played:
        """A player's episode of a driven scene, which is played once."""
        if (number, player) not in self._played:
            self._played[number, player] = played(self._recorded(number, player), self._world)
        return self._played[number, player]


def _direction(x: Any, y: Any) -> NDArray[np.float32]:
    """The vector (x, y), shortened to length 1; raises ValueError unless both are finite numbers."""
    if not all(isinstance(value, int | float) and abs(value) <= sys.float_info.max for value in (x, y)):
        raise ValueError(f"a velocity is two numbers, not {x!r} and {y!r}")
    return (np.array([x, y], np.float64) / max(1.0, math.hypot(x, y))).astype(np.float32)


def _rounded(metres: NDArray[np.float32]) -> list[Any]:
    """Numbers for JSON; None in place of NaN."""
    plain: list[Any] = np.round(metres.astype(np.float64), PATH_DIGITS).tolist()
    return [None if value != value else value for value in plain]


def drive_server(
    folder: RunFolder, world: WorldConfig, weights: WeightsSnapshot, first_seed: int, port: int
) -> PageServer:
    """The server of the page on which a person drives.

    Raises:
      ConfigError: the port is taken, or the run's folder may not be written to.
    """
    make_folder(driven_store(folder, world, first_seed).parent, "the run's folder")
    run = DrivenRun(folder, world, weights, first_seed)
    answers = {"/": run.page, "/sheet.json": run.sheet, "/paths.json": run.paths, "/episode.json": run.episode}
    return PageServer(answers, port, {"/begin.json": run.begin, "/move.json": run.move})
