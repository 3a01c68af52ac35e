"""By how much trainings overestimate: values of their policies' actions less the discounted returns that follow.

Both are means over all states of greedy episodes, as van Hasselt et al. (2016, Section 4) compare them. First states
alone would mislead for M_sensor: its reward falls with the step, which its state does not hold. Values begin near 0 and
are learned, so only the second half of a training counts.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from actors.evaluation.statistics import mean
from actors.evaluation.value_table import ValueRow
from dashboards.analysis.aggregate import Measurement


def late(rows: Sequence[ValueRow], algorithm: str) -> list[ValueRow]:
    """The evaluations in the second half of an algorithm's trainings."""
    return [row for row in rows if row.algorithm == algorithm and 2 * row.env_steps >= row.total_env_steps]


def overestimation(rows: Sequence[ValueRow], algorithm: str) -> Measurement | None:
    """Mean overestimation of an algorithm's trainings in units of reward; None if there are none.

    Each training is one sample: the interval is Student's over trainings.
    """
    by_training: dict[tuple[object, ...], list[ValueRow]] = {}
    for row in late(rows, algorithm):
        by_training.setdefault((row.method, row.robots, row.groups, row.seed), []).append(row)
    if not by_training:
        return None
    means = [np.mean([row.q_visited - row.return_visited for row in found]) for found in by_training.values()]
    episodes = sum(row.episodes for found in by_training.values() for row in found)
    return Measurement(mean(np.array(means)), episodes, len(means))
