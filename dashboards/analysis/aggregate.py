"""The table of results as cells: counts pooled over training seeds, and quantities made of several cells' rates.

Rates have Wilson intervals on the pooled counts. Where several training seeds stand behind a rate, its interval also
holds what another seed would change: counts of different seeds vary far more than those of one policy's episodes, by a
factor that is estimated over the cells of one method and as many robots, for each outcome, apart for Fixed and
Extrapolation. That is, variances over seeds are taken as proportional to p(1 - p), which success in the setup of the
training follows; the variance of rarer outcomes and of Extrapolation grows faster with p, so that their intervals are
too narrow, by up to a half, near 50 % and too wide near 0. With one seed it speaks of that policy alone.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from actors.evaluation import statistics as estimates
from actors.evaluation.result_table import GROUPS, LEARNED, ROBOTS, ResultRow
from actors.evaluation.statistics import Estimate, dispersion
from dashboards.analysis.methods import in_order
from sim_core.checks import require
from sim_core.outcomes import ENDED, Outcome

CELLS_PER_METHOD = len(ROBOTS) * len(GROUPS)
"""The dissertation's setups."""


rate = functools.lru_cache(maxsize=8192)(estimates.rate)
"""`actors.evaluation.statistics.rate`, remembered: a report asks for the same cells many times."""


class Setup(NamedTuple):
    """Robots per group, and groups."""

    robots: int
    groups: int

    def __str__(self) -> str:
        return f"{self.robots}r×{self.groups}g"


SETUPS = tuple(Setup(robots, groups) for robots in ROBOTS for groups in GROUPS)


class Measured(NamedTuple):
    """A quantity with its 95 % interval, the episodes behind it, and where it is one rate, its range over seeds."""

    estimate: Estimate
    episodes: int
    seeds: int = 1
    seed_range: tuple[float, float] | None = None


@dataclass(frozen=True)
class Cell:
    """All evaluations of one method, trained in one setup and played in one, a row a training seed."""

    rows: tuple[ResultRow, ...]
    spread: Mapping[Outcome, float] = field(default_factory=dict)

    @property
    def episodes(self) -> int:
        """Episodes over all seeds."""
        return sum(row.episodes for row in self.rows)

    def count(self, outcome: Outcome) -> int:
        """Episodes over all seeds that ended in `outcome`."""
        return sum(row.count(outcome) for row in self.rows)

    def share(self, outcome: Outcome) -> Measured:
        """How often an episode ends in `outcome`."""
        per_seed = [row.count(outcome) / row.episodes for row in self.rows]
        return Measured(
            estimate=rate(self.count(outcome), self.episodes, self._spread(outcome)),
            episodes=self.episodes,
            seeds=len(self.rows),
            seed_range=(min(per_seed), max(per_seed)) if len(per_seed) > 1 else None,
        )

    def failures(self) -> Measured:
        """How often an episode does not end in the goal, for whatever reason."""
        failed = self.episodes - self.count(Outcome.GOAL)
        return Measured(rate(failed, self.episodes, self._spread(Outcome.GOAL)), self.episodes, len(self.rows))

    def _spread(self, outcome: Outcome) -> float:
        return self.spread.get(outcome, 1.0) if len(self.rows) > 1 else 1.0

    def lost_less_captured(self) -> Measured:
        """Share of lost episodes less that of captured ones.

        Both are shares of the same episodes, where one outcome excludes the other; the interval is Zou's (2007), which
        is Newcombe's with their correlation.
        """
        lost, captured = self.share(Outcome.LOST).estimate, self.share(Outcome.CAPTURED).estimate
        odds = lost.value * captured.value / max((1 - lost.value) * (1 - captured.value), 1e-12)
        correlation = -min(float(np.sqrt(odds)), 1.0)
        value = lost.value - captured.value
        down = _joined(lost.value - lost.low, captured.high - captured.value, correlation)
        up = _joined(lost.high - lost.value, captured.value - captured.low, correlation)
        return Measured(Estimate(value, value - down, value + up), self.episodes, len(self.rows))


def _joined(first: float, second: float, correlation: float) -> float:
    """Half-width of a difference from those of its terms, whose estimates correlate."""
    return float(np.sqrt(max(first**2 + second**2 - 2 * correlation * first * second, 0.0)))


def _kind(method: str, trained: Setup, played: Setup) -> tuple[str, int, bool]:
    """Cells of one kind share how much seeds differ: method, robots of the training, whether Fixed."""
    return method, trained.robots, trained == played


def _spread_over_seeds(cells: Sequence[Sequence[ResultRow]]) -> dict[Outcome, float]:
    """How much the counts of cells, each a row a seed, vary over seeds; one policy in many setups is one seed."""
    policies = {(row.trained_robots, row.trained_groups, row.seed) for rows in cells for row in rows}
    freedom = len(policies) - len({policy[:2] for policy in policies})
    return {
        outcome: dispersion([[(row.count(outcome), row.episodes) for row in rows] for rows in cells], freedom)
        for outcome in ENDED
    }


class Results:
    """The learned policies' results of one preset, by method and setup.

    Raises:
      ConfigError: two rows count the same policy in the same setup.
    """

    def __init__(self, rows: Iterable[ResultRow]) -> None:
        found: dict[tuple[str, Setup, Setup], list[ResultRow]] = {}
        for row in sorted(rows):
            if row.policy == LEARNED:
                trained, played = Setup(row.trained_robots, row.trained_groups), Setup(row.robots, row.groups)
                found.setdefault((row.method, trained, played), []).append(row)
        for (method, trained, played), same in found.items():
            seeds = [row.seed for row in same]
            require(
                len(seeds) == len(set(seeds)),
                f"the results count {method} trained in {trained} and played in {played} twice for one seed; "
                "make the table again",
            )
        kin: dict[tuple[str, int, bool], list[list[ResultRow]]] = {}
        for key, same in found.items():
            kin.setdefault(_kind(*key), []).append(same)
        spreads = {kind: _spread_over_seeds(cells) for kind, cells in kin.items()}
        self._cells = {key: Cell(tuple(same), spreads[_kind(*key)]) for key, same in found.items()}

    def fixed(self, method: str, setup: Setup) -> Cell | None:
        """The cell trained and played in `setup`, None if it is missing."""
        return self._cells.get((method, setup, setup))

    def transferred(self, method: str, trained: Setup, played: Setup) -> Cell | None:
        """The cell trained in one setup and played in one, None if it is missing."""
        return self._cells.get((method, trained, played))

    def cells(self) -> list[Cell]:
        """All cells, Fixed and Extrapolation."""
        return list(self._cells.values())

    def methods(self) -> list[str]:
        """The dissertation's three methods, then others that there are results of."""
        return in_order(method for method, _, _ in self._cells)

    def fixed_present(self, method: str) -> list[Setup]:
        """The dissertation's setups whose Fixed cell is there."""
        return [setup for setup in SETUPS if self.fixed(method, setup) is not None]


Measure = Callable[[Cell], Measured]


def success(cell: Cell) -> Measured:
    """Share of episodes that end in the goal."""
    return cell.share(Outcome.GOAL)


def lost(cell: Cell) -> Measured:
    """Share of all episodes in which the robot is lost."""
    return cell.share(Outcome.LOST)


def captured(cell: Cell) -> Measured:
    """Share of all episodes in which the robot is captured."""
    return cell.share(Outcome.CAPTURED)


def measured(cell: Cell | None, measure: Measure) -> Measured | None:
    """`measure` of a cell, None where it is missing."""
    return None if cell is None else measure(cell)


def weighted_sum(parts: Sequence[tuple[float, Measured | None]]) -> Measured | None:
    """The sum of weight × quantity, None where a quantity is missing; quantities are independent.

    Its interval is Donner and Zou's (2012): each quantity's distance to its limit, weighted, squared and added. For two
    rates with weights 1 and -1 it is Newcombe's.
    """
    terms = [(weight, part) for weight, part in parts if part is not None]
    if len(terms) < len(parts):
        return None
    value = sum(weight * part.estimate.value for weight, part in terms)
    down, up = 0.0, 0.0
    for weight, part in terms:
        to_low, to_high = part.estimate.value - part.estimate.low, part.estimate.high - part.estimate.value
        below, above = (to_low, to_high) if weight >= 0 else (to_high, to_low)
        down, up = down + (weight * below) ** 2, up + (weight * above) ** 2
    estimate = Estimate(value, value - float(np.sqrt(down)), value + float(np.sqrt(up)))
    return Measured(
        estimate, sum(part.episodes for _, part in terms), max((part.seeds for _, part in terms), default=0)
    )


def difference(first: Measured | None, second: Measured | None) -> Measured | None:
    """`first` less `second`."""
    return weighted_sum([(1.0, first), (-1.0, second)])


def average(parts: Sequence[Measured | None]) -> Measured | None:
    """The mean of quantities, each with the same weight however many episodes it has; None where one is missing."""
    return weighted_sum([(1.0 / len(parts), part) for part in parts])


def over_groups(results: Results, method: str, robots: int, measure: Measure) -> Measured | None:
    """`measure` of the Fixed cells with `robots` per group, the mean of all group counts."""
    return average([measured(results.fixed(method, Setup(robots, groups)), measure) for groups in GROUPS])


def over_robots(results: Results, method: str, groups: int, measure: Measure) -> Measured | None:
    """`measure` of the Fixed cells with `groups` groups, the mean of all robot counts."""
    return average([measured(results.fixed(method, Setup(robots, groups)), measure) for robots in ROBOTS])
