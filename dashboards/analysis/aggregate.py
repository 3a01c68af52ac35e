"""Results pooled over training seeds, and quantities computed from several pooled cells.

Rates have Wilson intervals on the pooled counts. Counts of different training seeds vary far more than those of one
policy's episodes. Where a rate pools several seeds, its interval is therefore widened to hold what another seed would
give. The factor is estimated for each outcome over the cells of one method and robot count, separately for Fixed and
Extrapolation.

The estimate takes variances over seeds as proportional to p(1 - p). Success in the setup of the training follows this.
The variances of rarer outcomes and of Extrapolation grow faster with p. Their intervals are too narrow, by up to a
half, near 50 % and too wide near 0. A rate of a single seed speaks of that policy alone.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from scipy.special import ndtri  # `scipy.stats` would take half a second to import

from actors.evaluation import statistics as estimates
from actors.evaluation.result_table import GROUPS, LEARNED, ROBOTS, ResultRow
from actors.evaluation.statistics import Estimate, dispersion
from actors.evaluation.value_table import ValueRow
from dashboards.analysis.methods import in_order
from sim_core.checks import require
from sim_core.outcomes import ENDED, Outcome

CELLS_PER_METHOD = len(ROBOTS) * len(GROUPS)
"""Number of the dissertation's setups."""


rate = functools.lru_cache(maxsize=8192)(estimates.rate)
"""`actors.evaluation.statistics.rate`, cached: a report asks for the same cells many times."""


class Setup(NamedTuple):
    """Robots per group, and groups."""

    robots: int
    groups: int

    def __str__(self) -> str:
        return f"{self.robots}r×{self.groups}g"


SETUPS = tuple(Setup(robots, groups) for robots in ROBOTS for groups in GROUPS)


class Measurement(NamedTuple):
    """A quantity with its 95 % interval, and the numbers of episodes and training seeds behind it.

    `seed_range` is the lowest and highest rate of a seed; None for one seed, or if the quantity is not a single rate.
    """

    estimate: Estimate
    episodes: int
    seeds: int = 1
    seed_range: tuple[float, float] | None = None


@dataclass(frozen=True)
class PooledCell:
    """The evaluations of one method, trained in one setup and tested in one, pooled over training seeds.

    `rows` has one row per seed; `overdispersion` the factor by which counts of seeds vary more than binomial ones, by
    outcome (1 if not given).
    """

    rows: tuple[ResultRow, ...]
    overdispersion: Mapping[Outcome, float] = field(default_factory=dict)

    @property
    def episodes(self) -> int:
        """Episodes over all seeds."""
        return sum(row.episodes for row in self.rows)

    def count(self, outcome: Outcome) -> int:
        """Episodes over all seeds that ended in `outcome`."""
        return sum(row.count(outcome) for row in self.rows)

    def share(self, outcome: Outcome) -> Measurement:
        """Share of episodes that end in `outcome`."""
        per_seed = [row.count(outcome) / row.episodes for row in self.rows]
        return Measurement(
            estimate=rate(self.count(outcome), self.episodes, self._factor(outcome)),
            episodes=self.episodes,
            seeds=len(self.rows),
            seed_range=(min(per_seed), max(per_seed)) if len(per_seed) > 1 else None,
        )

    def failures(self) -> Measurement:
        """Share of episodes that end in any outcome but the goal."""
        failed = self.episodes - self.count(Outcome.GOAL)
        return Measurement(rate(failed, self.episodes, self._factor(Outcome.GOAL)), self.episodes, len(self.rows))

    def failures_but_lost(self) -> Measurement:
        """Share of episodes that end neither in the goal nor lost."""
        others = [outcome for outcome in ENDED if outcome not in (Outcome.GOAL, Outcome.LOST)]
        count, factor = sum(map(self.count, others)), max(map(self._factor, others))
        return Measurement(rate(count, self.episodes, factor), self.episodes, len(self.rows))

    def _factor(self, outcome: Outcome) -> float:
        return self.overdispersion.get(outcome, 1.0) if len(self.rows) > 1 else 1.0

    def lost_minus_captured(self) -> Measurement:
        """Share of lost episodes minus share of captured ones.

        Both are shares of the same episodes, and one outcome excludes the other. The interval is Zou's (2007):
        Newcombe's with the correlation of the two.
        """
        lost, captured = self.share(Outcome.LOST).estimate, self.share(Outcome.CAPTURED).estimate
        odds = lost.value * captured.value / max((1 - lost.value) * (1 - captured.value), 1e-12)
        correlation = -min(float(np.sqrt(odds)), 1.0)
        value = lost.value - captured.value
        down = _half_width(lost.value - lost.low, captured.high - captured.value, correlation)
        up = _half_width(lost.high - lost.value, captured.value - captured.low, correlation)
        return Measurement(Estimate(value, value - down, value + up), self.episodes, len(self.rows))


def _half_width(first: float, second: float, correlation: float) -> float:
    """Half-width of a difference's interval, from those of its terms and the correlation of their estimates."""
    return float(np.sqrt(max(first**2 + second**2 - 2 * correlation * first * second, 0.0)))


def _kind(method: str, trained: Setup, played: Setup) -> tuple[str, int, bool]:
    """Method, robots of the training, whether Fixed: cells of one kind share an overdispersion factor."""
    return method, trained.robots, trained == played


def _overdispersion(cells: Sequence[Sequence[ResultRow]]) -> dict[Outcome, float]:
    """The overdispersion factor of each outcome over cells of one kind, each with one row per seed.

    A policy tested in many setups counts as one seed in the degrees of freedom.
    """
    policies = {(row.trained_robots, row.trained_groups, row.seed) for rows in cells for row in rows}
    freedom = len(policies) - len({policy[:2] for policy in policies})
    return {
        outcome: dispersion([[(row.count(outcome), row.episodes) for row in rows] for rows in cells], freedom)
        for outcome in ENDED
    }


class Results:
    """Results of one preset's learned policies, pooled over seeds, by method and setup.

    Args:
      rows: its rows; those of baselines are left out.
      variants: results of the preset with settings that override it, by the settings.
      values: what its trainings expected beside what they got.

    Raises:
      ConfigError: two rows hold the same policy in the same setup.
    """

    def __init__(
        self,
        rows: Iterable[ResultRow],
        variants: Mapping[str, Results] = MappingProxyType({}),
        values: Sequence[ValueRow] = (),
    ) -> None:
        self.variants = variants
        self.values = values
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
        by_kind: dict[tuple[str, int, bool], list[list[ResultRow]]] = {}
        for key, same in found.items():
            by_kind.setdefault(_kind(*key), []).append(same)
        factors = {kind: _overdispersion(cells) for kind, cells in by_kind.items()}
        self._cells = {key: PooledCell(tuple(same), factors[_kind(*key)]) for key, same in found.items()}

    def fixed(self, method: str, setup: Setup) -> PooledCell | None:
        """The cell trained and tested in `setup`; None if it is missing."""
        return self._cells.get((method, setup, setup))

    def transferred(self, method: str, trained: Setup, played: Setup) -> PooledCell | None:
        """The cell trained in the setup `trained` and tested in `played`; None if it is missing."""
        return self._cells.get((method, trained, played))

    def cells(self) -> list[PooledCell]:
        """All cells, Fixed and Extrapolation."""
        return list(self._cells.values())

    def methods(self) -> list[str]:
        """The dissertation's three methods, then others that have results."""
        return in_order(method for method, _, _ in self._cells)

    def fixed_present(self, method: str) -> list[Setup]:
        """The dissertation's setups that have a Fixed cell."""
        return [setup for setup in SETUPS if self.fixed(method, setup) is not None]


Metric = Callable[[PooledCell], Measurement]
"""A quantity of one cell."""


def success(cell: PooledCell) -> Measurement:
    """Share of episodes that end in the goal."""
    return cell.share(Outcome.GOAL)


def lost(cell: PooledCell) -> Measurement:
    """Share of all episodes in which the robot is lost."""
    return cell.share(Outcome.LOST)


def captured(cell: PooledCell) -> Measurement:
    """Share of all episodes in which the robot is captured."""
    return cell.share(Outcome.CAPTURED)


def measured(cell: PooledCell | None, metric: Metric) -> Measurement | None:
    """`metric` of a cell; None if the cell is missing."""
    return None if cell is None else metric(cell)


def weighted_sum(weighted: Sequence[tuple[float, Measurement | None]]) -> Measurement | None:
    """The sum of weight × quantity over independent quantities; None if one is missing.

    The interval is Donner and Zou's (2012): the weighted distances of the quantities to their limits, added in
    quadrature. For two rates with weights 1 and -1 it is Newcombe's.
    """
    terms = [(weight, term) for weight, term in weighted if term is not None]
    if len(terms) < len(weighted):
        return None
    value = sum(weight * term.estimate.value for weight, term in terms)
    down, up = 0.0, 0.0
    for weight, term in terms:
        to_low, to_high = term.estimate.value - term.estimate.low, term.estimate.high - term.estimate.value
        below, above = (to_low, to_high) if weight >= 0 else (to_high, to_low)
        down, up = down + (weight * below) ** 2, up + (weight * above) ** 2
    estimate = Estimate(value, value - float(np.sqrt(down)), value + float(np.sqrt(up)))
    return Measurement(
        estimate, sum(term.episodes for _, term in terms), max((term.seeds for _, term in terms), default=0)
    )


def difference(first: Measurement | None, second: Measurement | None) -> Measurement | None:
    """`first` minus `second`; None if one is missing."""
    return weighted_sum([(1.0, first), (-1.0, second)])


def for_comparisons(measurement: Measurement | None, comparisons: int) -> Measurement | None:
    """The quantity with an interval for one of so many comparisons (Bonferroni), by the normal quantiles' ratio."""
    if measurement is None:
        return None
    value, low, high = measurement.estimate
    wider = float(ndtri(1 - 0.025 / comparisons) / ndtri(0.975))
    estimate = Estimate(value, value - wider * (value - low), value + wider * (high - value))
    return measurement._replace(estimate=estimate)


def average(terms: Sequence[Measurement | None]) -> Measurement | None:
    """The unweighted mean of quantities, whatever their numbers of episodes; None if one is missing."""
    return weighted_sum([(1.0 / len(terms), term) for term in terms])


def over_groups(results: Results, method: str, robots: int, metric: Metric) -> Measurement | None:
    """`metric` of the Fixed cells with `robots` per group, averaged over all group counts; None if one is missing."""
    return average([measured(results.fixed(method, Setup(robots, groups)), metric) for groups in GROUPS])


def over_robots(results: Results, method: str, groups: int, metric: Metric) -> Measurement | None:
    """`metric` of the Fixed cells with `groups` groups, averaged over all robot counts; None if one is missing."""
    return average([measured(results.fixed(method, Setup(robots, groups)), metric) for robots in ROBOTS])
