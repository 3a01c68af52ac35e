"""A search as PNG: its progress, the importance of the settings, and every objective by every setting or the front."""

from __future__ import annotations

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from dashboards.analysis.searches import SearchSummary
from dashboards.figures.style import MUTED, TEXT, escaped, new_figure, style_axes

TRIAL, BEST, IMPORTANCE = "#56B4E9", "#D55E00", "#0072B2"
CHART_IN = 3.6
MOST_IMPORTANT = 12
"""Settings that the chart of importances shows at most."""


def search_figure(search: SearchSummary, title: str) -> Figure:
    """Two charts for each objective, its progress and its importances; with several, the front of the first two."""
    objectives = len(search.objectives)
    columns = 3 if objectives > 1 else 2
    figure = new_figure(CHART_IN * columns, 3.0 * objectives + 0.4, title)
    grid = figure.add_gridspec(objectives, columns)
    for place in range(objectives):
        _draw_progress(figure.add_subplot(grid[place, 0]), search, place)
        _draw_importances(figure.add_subplot(grid[place, 1]), search, place)
    if objectives > 1:
        _draw_front(figure.add_subplot(grid[:, 2]), search)
    return figure


def _draw_progress(axes: Axes, search: SearchSummary, place: int) -> None:
    numbers = [trial.number for trial in search.complete]
    axes.scatter(numbers, [trial.values[place] for trial in search.complete], s=18, color=TRIAL, label="trial")
    best = search.best_so_far(place)
    axes.step([n for n, _ in best], [v for _, v in best], where="post", color=BEST, lw=1.8, label="best so far")
    axes.set_title(escaped(search.objectives[place]), loc="left", fontsize=10, color=TEXT)
    axes.set_xlabel("trial", color=TEXT)
    style_axes(axes)
    if numbers:
        axes.legend(fontsize=8, frameon=False)


def _draw_importances(axes: Axes, search: SearchSummary, place: int) -> None:
    shares = sorted(search.importances[place].items(), key=lambda item: item[1])[-MOST_IMPORTANT:]
    axes.barh([escaped(name) for name, _ in shares], [share for _, share in shares], color=IMPORTANCE)
    axes.set_xlim(0.0, 1.0)
    axes.set_title("importance of the settings", loc="left", fontsize=10, color=TEXT)
    style_axes(axes)
    if not shares:
        axes.text(0.5, 0.5, "too few trials", ha="center", va="center", color=MUTED, transform=axes.transAxes)
        axes.set_yticks([])


def _draw_front(axes: Axes, search: SearchSummary) -> None:
    points = {trial.number: (trial.values[0], trial.values[1]) for trial in search.complete}
    best = sorted(points[number] for number in search.front)
    axes.scatter([x for x, _ in points.values()], [y for _, y in points.values()], s=18, color=TRIAL)
    axes.plot([x for x, _ in best], [y for _, y in best], color=BEST, marker="o", ms=5, lw=1.2)
    axes.set_title("front", loc="left", fontsize=10, color=TEXT)
    axes.set_xlabel(escaped(search.objectives[0]), color=TEXT)
    axes.set_ylabel(escaped(search.objectives[1]), color=TEXT)
    style_axes(axes)
