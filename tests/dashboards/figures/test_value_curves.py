"""The figure of values beside returns: a line for each, at the means over seeds."""

import numpy as np
import pytest

from actors.evaluation.value_table import ValueRow
from dashboards.analysis.aggregate import Results
from dashboards.figures.result_figures import PICTURES, VALUES_PICTURE, pictures_of
from dashboards.figures.value_curves import value_curves

ROWS = [
    ValueRow("thesis", "sensor", 10, 2, algorithm, seed, steps, 1000, 100, 1.0 + seed, 2.0, 0.25 * seed, 0.5)
    for algorithm in ("dqn", "double_dqn")
    for seed in (0, 1)
    for steps in (250, 500)
]


def test_lines_are_means_over_seeds():
    every, first = value_curves(Results([], values=ROWS)).axes
    for axes, value, followed in ((every, 0.125, 0.5), (first, 1.5, 2.0)):
        lines = {line.get_label(): line for line in axes.lines}
        for algorithm in ("DQN", "Double DQN"):
            assert list(lines[f"{algorithm}: value"].get_xdata()) == [250, 500]
            np.testing.assert_allclose(lines[f"{algorithm}: value"].get_ydata(), value)
            np.testing.assert_allclose(lines[f"{algorithm}: return"].get_ydata(), followed)


def test_it_is_drawn_where_there_are_values():
    assert pictures_of(Results([])) == PICTURES
    assert pictures_of(Results([], values=ROWS)) == (*PICTURES, VALUES_PICTURE)
    with pytest.raises(ValueError, match="no values"):
        value_curves(Results([]))
