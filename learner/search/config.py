"""What a search varies and what it trains: every trial is a small sweep with settings of its own."""

from __future__ import annotations

import dataclasses
import os
import re
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from actors.evaluation.result_table import LEARNED
from learner.presets import PresetName
from learner.search.space import Choices, Dimension, Value, assignment, check_values, parse_space
from learner.sweep.grid import BaselineName, Cell, SweepConfig, make_cell, make_cells
from sim_core.checks import ConfigError, check_fields, require

EVALUATIONS = 4
"""Parts of a training, with an evaluation after each, where bad trials are ended early."""
DRAWS = 16
"""Random settings with which an end of a range is tried before it is refused."""
BUDGET = re.compile(r"([1-9]\d*)|(\d+(?:\.\d+)?)h")

PolicyName = Literal["learned", BaselineName]


@dataclass(frozen=True, kw_only=True)
class SearchConfig:
    """A search: which settings it varies, for which objectives, in which setups.

    Raises:
      ConfigError: a value is out of range, or two contradict each other.
    """

    space: tuple[str, ...] = ()
    """Settings to vary, any of `shoal train`: NAME=LOW..HIGH, NAME=LOW..HIGH:log or NAME=A,B,C."""
    objective: tuple[str, ...] = ("success",)
    """What to optimise: success (mean of the cells), worst (cell), steps_to=SUCCESS (env steps), claims (distance from
    the dissertation's), FILE.py:FUNCTION or min:FILE.py:FUNCTION. Several give a front."""
    budget: str = "20"
    """Trials, or hours of searching as in 2h, over all sessions; a trial that has begun is finished."""
    prune: bool = False
    """End a trial at 1/4 or 1/2 of its training if its success is in the worse half (one objective of success only)."""
    sampler_seed: int = 0
    """Seed of the sampler (Optuna's multivariate TPE)."""

    preset: PresetName = "best"
    """Settings of every trial that are not varied."""
    methods: tuple[str, ...] = ("sensor",)
    """State representations of a trial's cells: names, or FILE.py:CLASS."""
    set: tuple[str, ...] = ()
    """Settings that override the preset's in every trial, as NAME=VALUE."""
    robots: tuple[int, ...] = (10,)
    """Robots per group of a trial's cells."""
    groups: tuple[int, ...] = (2,)
    """Group counts of a trial's cells."""
    seeds: tuple[int, ...] = (0,)
    """Training seeds of a trial's cells."""
    policy: PolicyName = "learned"
    """Who plays: a policy that is trained, or a rule that is not, as in `shoal evaluate`."""
    env_steps: int | None = None
    """Env steps of each training, the preset's by default; schedules are stretched to them."""
    episodes: int = 600
    """Greedy episodes that judge a cell."""
    extrapolation: Literal["all", "none"] = "none"
    """Whether every policy plays the other setups, too."""
    first_seed: int = 3_000_000_000
    """Seed of the first of these episodes: calibration's by default, which no evaluation plays."""

    def __post_init__(self) -> None:
        check_fields(self)
        require(BUDGET.fullmatch(self.budget) is not None, f"budget must be trials or hours (2h), not {self.budget!r}")
        require(self.hours is None or self.hours > 0, f"budget must be more than 0 hours, not {self.budget!r}")
        require(0 <= self.sampler_seed < 2**31, f"sampler_seed must be in 0..{2**31 - 1}, not {self.sampler_seed}")
        require(len(self.objective) > 0, "objective must name at least one")
        require(len(self.seeds) > 0, "seeds must have at least one value")
        require(len(set(self.labels)) == len(self.labels), f"objective must name each once, not {self.labels}")
        require(not self.prune or self.policy == LEARNED, f"prune ends trainings, and {self.policy} is not trained")
        check_values(self.dimensions, self.set)
        self.sweep({})

    @property
    def dimensions(self) -> tuple[Dimension, ...]:
        """The settings that are varied."""
        return parse_space(self.space)

    @property
    def labels(self) -> tuple[str, ...]:
        """What people call the objectives: a user's own by its file and function, without the folder."""
        return tuple(os.path.basename(name) for name in self.objective)

    @property
    def trials(self) -> int | None:
        """The budget in trials; None if it is one of hours."""
        return int(self.budget) if self.budget.isdecimal() else None

    @property
    def hours(self) -> float | None:
        """The budget in hours; None if it is one of trials."""
        return float(self.budget[:-1]) if self.budget.endswith("h") else None

    @property
    def name(self) -> str:
        """Name of the search's folder, unless the user gives one: the preset and the settings that it varies."""
        varied = "-".join(dimension.name for dimension in self.dimensions)
        return re.sub(r"[^\w.+=-]+", "-", "+".join((self.preset, *self.set, varied)))

    def identity(self) -> dict[str, Any]:
        """All that decides the trials, for comparison: the budget may change from session to session."""
        values = dataclasses.asdict(self)
        del values["budget"]
        return values

    def sweep(self, settings: dict[str, Value]) -> SweepConfig:
        """The sweep that one trial is.

        Args:
          settings: the varied settings and their values.
        """
        learned = self.policy == LEARNED
        grid = SweepConfig(
            preset=self.preset,
            methods=self.methods,
            set=(*self.set, *(assignment(name, value) for name, value in settings.items())),
            robots=self.robots,
            groups=self.groups,
            seeds=self.seeds,
            env_steps=self.env_steps,
            episodes=self.episodes,
            extrapolation=self.extrapolation if learned else "none",
            baselines=() if self.policy == "learned" else (self.policy,),
            baseline_episodes=self.episodes,
            first_seed=self.first_seed,
        )
        return grid if not self.prune else dataclasses.replace(grid, set=(*grid.set, self._rungs(grid)))

    def _rungs(self, grid: SweepConfig) -> str:
        """The override that evaluates a training at equal parts of it."""
        steps = make_cell(grid, self.methods[0], self.robots[0], self.groups[0], self.seeds[0]).config.total_env_steps
        return f"eval_every_env_steps={max(1, steps // EVALUATIONS)}"

    def cells(self, settings: dict[str, Value]) -> tuple[SweepConfig, list[Cell]]:
        """A trial's sweep and its cells.

        Raises:
          ConfigError: the settings contradict each other, or a setup is impossible with them.
        """
        sweep = self.sweep(settings)
        cells = [cell for cell in make_cells(sweep) if cell.policy == self.policy]
        require(len(cells) > 0, f"methods {', '.join(self.methods)} have no rule {self.policy}")
        return sweep, cells


def draw(dimensions: tuple[Dimension, ...], rng: np.random.Generator) -> dict[str, Value]:
    """Settings drawn at random from the space."""
    return {dimension.name: _drawn(dimension, rng) for dimension in dimensions}


def _drawn(dimension: Dimension, rng: np.random.Generator) -> Value:
    if isinstance(dimension, Choices):
        return dimension.values[rng.integers(len(dimension.values))]
    if dimension.whole:
        return int(rng.integers(int(dimension.low), int(dimension.high) + 1))
    if dimension.log:
        return float(np.exp(rng.uniform(np.log(dimension.low), np.log(dimension.high))))
    return float(rng.uniform(dimension.low, dimension.high))


def check_search(search: SearchConfig) -> None:
    """Refuses a search before anything runs: every end of a range and every choice must be possible with some others.

    Raises:
      ConfigError: one is not; the message is that of the setting.
    """
    rng = np.random.default_rng(search.sampler_seed)
    search.cells({})
    for dimension in search.dimensions:
        for end in dimension.ends:
            _check_possible(search, {dimension.name: end}, rng)


def _check_possible(search: SearchConfig, given: dict[str, Value], rng: np.random.Generator) -> None:
    refusals = []
    for others in ({}, *(draw(search.dimensions, rng) for _ in range(DRAWS))):
        try:
            search.cells(others | given)
            return
        except ConfigError as error:
            refusals.append(error)
    (name, value), *_ = given.items()
    raise ConfigError(f"space {assignment(name, value)}: {refusals[0]}")
