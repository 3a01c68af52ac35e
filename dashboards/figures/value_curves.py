"""What DQN and Double DQN expect during training, beside the returns that their policies get."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

from actors.evaluation.value_table import ValueRow
from dashboards.analysis.aggregate import Results, Setup
from dashboards.analysis.methods import method_label
from dashboards.figures.style import MUTED, TEXT, new_figure, style_axes

ALGORITHMS = {"dqn": ("DQN", "#D55E00", "s"), "double_dqn": ("Double DQN", "#0072B2", "o")}
"""Label, colour and marker of each algorithm."""
PANELS = (("visited", "all states of an episode"), ("start", "first state"))


def value_curves(results: Results) -> Figure:
    """Values (lines) and discounted returns (dashed), means over seeds with their range: of all states, of the first.

    Raises:
      ValueError: the results have no values.
    """
    if not results.values:
        raise ValueError("the results have no values to draw")
    where = sorted({f"{method_label(row.method)} {Setup(row.robots, row.groups)}" for row in results.values})
    figure = new_figure(9.0, 3.8, f"Value of the greedy action, and the return that follows: {', '.join(where)}")
    for axes, (states, title) in zip(figure.subplots(1, 2), PANELS, strict=True):
        for algorithm in ALGORITHMS:
            _draw(axes, [row for row in results.values if row.algorithm == algorithm], algorithm, states)
        axes.axhline(0.0, color=MUTED, lw=0.8)
        axes.set_title(title, loc="left", fontsize=10, color=TEXT)
        axes.set_xlabel("env steps", color=TEXT)
        axes.set_ylabel("τ", color=TEXT)
        axes.xaxis.set_major_formatter(EngFormatter(sep=""))
        style_axes(axes)
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower left", ncols=4, frameon=False, fontsize=9)
    return figure


def _draw(axes: Axes, rows: Sequence[ValueRow], algorithm: str, states: str) -> None:
    label, colour, marker = ALGORITHMS[algorithm]
    steps = sorted({row.env_steps for row in rows})
    for quantity, name, dash in (("q", "value", "-"), ("return", "return", "--")):
        found = [[getattr(row, f"{quantity}_{states}") for row in rows if row.env_steps == step] for step in steps]
        axes.fill_between(steps, [min(each) for each in found], [max(each) for each in found], color=colour, alpha=0.15)
        means = [float(np.mean(each)) for each in found]
        axes.plot(steps, means, color=colour, ls=dash, lw=1.6, marker=marker, ms=3, label=f"{label}: {name}")
