"""Success under bad senses and late commands as PNG: a panel for each condition, a curve for each player."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import PercentFormatter

from actors.evaluation.conditions import BROKEN
from actors.evaluation.statistics import Estimate
from dashboards.figures.style import LINE_STYLES, MARKERS, MUTED, TEXT, escaped, new_figure, save_png, style_axes

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#1C2024", "#8A5A2B")
COLUMNS = 2


class Panel(NamedTuple):
    """A condition and its values; of each player, by name, the success rate at every value."""

    title: str
    values: tuple[Any, ...]
    curves: dict[str, list[Estimate]]


def stress_curves_png(panels: list[Panel], path: Path, title: str) -> None:
    """Draws success rates with their 95 % intervals against the values of conditions.

    Args:
      panels: at least one; values that are no numbers are set side by side.
      path: the PNG; replaced if it exists.
      title: plain text.

    Raises:
      ValueError: there is no panel.
    """
    if not panels:
        raise ValueError(f"no conditions to draw in {path}")
    rows = -(-len(panels) // COLUMNS)
    figure = new_figure(5.0 * min(COLUMNS, len(panels)), 0.6 + 3.2 * rows, title)
    grid = figure.subplots(rows, min(COLUMNS, len(panels)), squeeze=False, sharey=True).ravel()
    for axes, panel in zip(grid, panels, strict=False):
        _draw(axes, panel)
    for axes in grid[len(panels) :]:
        axes.set_visible(False)
    figure.legend(*grid[0].get_legend_handles_labels(), loc="outside lower left", ncols=4, frameon=False, fontsize=9)
    save_png(figure, path)


def _draw(axes: Axes, panel: Panel) -> None:
    numeric = all(isinstance(value, int | float) for value in panel.values)
    places = list(panel.values) if numeric else list(range(len(panel.values)))
    dashes, markers = list(LINE_STYLES.values()), list(MARKERS.values())
    for i, (name, rates) in enumerate(panel.curves.items()):
        colour, dash, marker = COLOURS[i % len(COLOURS)], dashes[i % len(dashes)], markers[i % len(markers)]
        values, low, high = zip(*rates, strict=True)
        look: dict[str, Any] = {"color": colour, "marker": marker, "ms": 4, "label": escaped(name)}
        if numeric:
            axes.fill_between(places, low, high, color=colour, alpha=0.15, lw=0)
            axes.plot(places, values, ls=dash, lw=1.8, **look)
        else:
            below, above = np.subtract(values, low), np.subtract(high, values)
            axes.errorbar(places, values, [below, above], ls="", capsize=4, **look)
    axes.axhline(BROKEN, color=MUTED, lw=1, ls=":")
    axes.set_xlabel(escaped(panel.title), color=TEXT)
    axes.set_ylim(0.0, 1.02)
    axes.yaxis.set_major_formatter(PercentFormatter(1.0, decimals=None))
    axes.set_xticks(places, [str(value) for value in panel.values])
    style_axes(axes)
