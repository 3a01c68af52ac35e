"""The dissertation's result figures, redrawn from a table of results: 3.4 to 3.7, 4.4, 4.5, and a heat map.

They are arranged as in the dissertation: Fixed beside Extrapolation (trained in the setup named above the chart,
tested in the setup on the x axis), and for the three methods one chart per robot count. The x axis starts at the setup
of the training, because Extrapolation goes to harder setups. Diamonds mark the numbers printed in the dissertation's
text; its figures are lost.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from actors.evaluation.result_table import GROUPS, ROBOTS
from dashboards.analysis.aggregate import (
    Measurement,
    Metric,
    Results,
    Setup,
    captured,
    lost,
    measured,
    over_groups,
    over_robots,
    success,
)
from dashboards.analysis.failure_styles import FAILURE_STYLES
from dashboards.analysis.methods import method_label, method_style
from dashboards.figures.bar_charts import Series, Subplot, draw_bars, draw_lines, legend
from dashboards.figures.style import LINE_STYLES, MARKERS, MUTED, TEXT, new_figure
from dashboards.figures.value_curves import value_curves

FIXED_STYLE, TRANSFER_STYLE = ("#0072B2", "", "o"), ("#E69F00", "////", "s")
HEAT_MAP, NO_CELL = "cividis", "#F0F0F0"
SUBPLOT_LETTERS = "abcdefgh"

Printed = dict[int, float]
MORE_ROBOTS_1G: dict[Setup, Printed] = {Setup(5, 1): {5: 1.0}, Setup(10, 1): dict.fromkeys(ROBOTS[1:], 0.85)}
MORE_GROUPS_1G: dict[Setup, Printed] = {Setup(5, 1): {1: 1.0, 8: 0.5}, Setup(10, 1): {}}
MORE_ROBOTS: dict[Setup, Printed] = {
    Setup(5, 2): {},
    Setup(5, 3): {},
    Setup(10, 2): {10: 0.9, 25: 0.6},
    Setup(10, 3): {},
}
MORE_GROUPS: dict[Setup, Printed] = {
    Setup(5, 2): {2: 0.9, 8: 0.55},
    Setup(5, 3): {},
    Setup(10, 2): {2: 0.9},
    Setup(10, 3): {},
}
"""Training setups with one subplot each, and the Fixed success printed in the text, by the number on the x axis."""
PRINTED_OUT: dict[int, Printed] = {5: {1: 1.0}, 20: {1: 1.0}, 25: {1: 1.0}}
"""M_OUT's success in Figure 4.4, by robots and groups."""
PRINTED_LOST: Printed = {10: 0.04, 20: 0.08}
"""M_sensor's lost robots in Figure 4.5 (b), by robots."""


def figure_3_4(results: Results) -> Figure:
    """M_sensor trained on one group: more robots (a, b), more groups (c, d)."""
    subplots = [_more_robots(results, *item) for item in MORE_ROBOTS_1G.items()]
    subplots += [_more_groups(results, *item) for item in MORE_GROUPS_1G.items()]
    return _transfer_figure("Figure 3.4  M_sensor trained on 1 group: success", subplots)


def figure_3_5(results: Results) -> Figure:
    """M_sensor trained on two or three groups: more robots."""
    subplots = [_more_robots(results, *item) for item in MORE_ROBOTS.items()]
    return _transfer_figure("Figure 3.5  M_sensor trained on 2 or 3 groups: success with more robots", subplots)


def figure_3_6(results: Results) -> Figure:
    """M_sensor trained on two or three groups: more groups."""
    subplots = [_more_groups(results, *item) for item in MORE_GROUPS.items()]
    return _transfer_figure("Figure 3.6  M_sensor trained on 2 or 3 groups: success with more groups", subplots)


def _more_robots(results: Results, trained: Setup, printed: Printed) -> Subplot:
    played = [Setup(robots, trained.groups) for robots in ROBOTS if robots >= trained.robots]
    return _transfer_subplot(results, trained, played, {Setup(n, trained.groups): v for n, v in printed.items()})


def _more_groups(results: Results, trained: Setup, printed: Printed) -> Subplot:
    played = [Setup(trained.robots, groups) for groups in GROUPS if groups >= trained.groups]
    return _transfer_subplot(results, trained, played, {Setup(trained.robots, m): v for m, v in printed.items()})


def _transfer_subplot(
    results: Results, trained: Setup, played: Sequence[Setup], printed: dict[Setup, float]
) -> Subplot:
    fixed = [measured(results.fixed("sensor", setup), success) for setup in played]
    foreign = [measured(results.transferred("sensor", trained, setup), success) for setup in played]
    places = {played.index(setup): value for setup, value in printed.items()}
    return Subplot(
        title=f"Extrapolation trained on {trained}",
        labels=[str(setup) for setup in played],
        series=[Series("Fixed", *FIXED_STYLE, fixed, places), Series("Extrapolation", *TRANSFER_STYLE, foreign)],
    )


def _transfer_figure(title: str, subplots: list[Subplot]) -> Figure:
    figure = new_figure(9.0, 6.0, title)
    subplots = _lettered(subplots)
    for axes, subplot in zip(figure.subplots(2, 2, sharey=True).flat, subplots, strict=True):
        draw_bars(axes, subplot)
    legend(figure, subplots, lines=False)
    return figure


def figure_3_7(results: Results) -> Figure:
    """M_sensor's lost and captured robots, by robots (a) and by groups (b)."""
    causes: list[tuple[str, Metric]] = [("lost", lost), ("captured", captured)]
    by_robots = [_cause(name, [over_groups(results, "sensor", n, cause) for n in ROBOTS]) for name, cause in causes]
    by_groups = [_cause(name, [over_robots(results, "sensor", m, cause) for m in GROUPS]) for name, cause in causes]
    subplots = [
        Subplot("by robots per group, mean of 1 to 8 groups", [f"{n}r" for n in ROBOTS], by_robots),
        Subplot("by groups, mean of 5 to 25 robots", [f"{m}g" for m in GROUPS], by_groups),
    ]
    return _line_figure("Figure 3.7  M_sensor: lost and captured, share of all episodes", subplots)


def _cause(name: str, rates: list[Measurement | None]) -> Series:
    style = FAILURE_STYLES[name]
    return Series(name, style.colour, LINE_STYLES[style.dash], MARKERS[style.marker], rates)


def figure_4_4(results: Results) -> Figure:
    """The three methods, one chart per robot count."""
    figure = new_figure(9.0, 8.0, "Figure 4.4  Success of the three methods")
    subplots = _lettered([_methods_subplot(results, robots) for robots in ROBOTS])
    *charts, rest = figure.subplots(3, 2, sharey=True).flat
    for axes, subplot in zip(charts, subplots, strict=True):
        draw_bars(axes, subplot)
    legend(figure, subplots, lines=False, axes=rest)
    return figure


def _methods_subplot(results: Results, robots: int) -> Subplot:
    series = []
    for method in results.methods():
        rates = [measured(results.fixed(method, Setup(robots, groups)), success) for groups in GROUPS]
        printed = PRINTED_OUT.get(robots, {}) if method == "out" else {}
        places = {GROUPS.index(groups): value for groups, value in printed.items()}
        series.append(Series(method_label(method), *method_style(method)[:3], rates, places))
    return Subplot(f"{robots} robots per group", [f"{groups}g" for groups in GROUPS], series)


def figure_4_5(results: Results) -> Figure:
    """Captured (a) and lost (b) robots of M_sensor and M_OUT, by robots."""
    subplots = [
        Subplot(f"{name}, mean of 1 to 8 groups", [f"{n}r" for n in ROBOTS], _two_methods(results, cause, printed))
        for name, cause, printed in (("captured", captured, {}), ("lost", lost, PRINTED_LOST))
    ]
    return _line_figure("Figure 4.5  M_sensor and M_OUT: captured and lost, share of all episodes", subplots)


def _two_methods(results: Results, cause: Metric, printed: Printed) -> list[Series]:
    places = {ROBOTS.index(robots): value for robots, value in printed.items()}
    series = []
    for method, line in (("sensor", "-"), ("out", "--")):
        colour, _, marker = method_style(method)[:3]
        rates = [over_groups(results, method, robots, cause) for robots in ROBOTS]
        series.append(Series(method_label(method), colour, line, marker, rates, places if method == "sensor" else {}))
    return series


def _line_figure(title: str, subplots: list[Subplot]) -> Figure:
    figure = new_figure(9.0, 3.6, title)
    subplots = _lettered(subplots)
    limits = [
        rate.estimate.high for subplot in subplots for one in subplot.series for rate in one.rates if rate is not None
    ]
    limits += [value for subplot in subplots for one in subplot.series for value in one.printed.values()]
    top = max(1.1 * max(limits, default=0.0), 0.05)
    for axes, subplot in zip(figure.subplots(1, 2, sharey=True).flat, subplots, strict=True):
        draw_lines(axes, subplot, top)
    legend(figure, subplots[::-1], lines=True)
    return figure


def _lettered(subplots: list[Subplot]) -> list[Subplot]:
    return [
        subplot._replace(title=f"({letter}) {subplot.title}")
        for letter, subplot in zip(SUBPLOT_LETTERS, subplots, strict=False)
    ]


def heatmap(results: Results) -> Figure:
    """Fixed success of every cell in percent, each with its 95 % interval below."""
    methods = results.methods()
    figure = new_figure(10.0 * len(methods) / 3, 4.0, "Success of all Fixed setups in percent, 95 % intervals below")
    for axes, method in zip(figure.subplots(1, len(methods)), methods, strict=True):
        _draw_heatmap(axes, results, method)
        axes.set_title(method_label(method), loc="left", fontsize=10, color=TEXT)
    return figure


def _draw_heatmap(axes: Axes, results: Results, method: str) -> None:
    rates = [[measured(results.fixed(method, Setup(n, m)), success) for m in GROUPS] for n in ROBOTS]
    shares = np.array([[np.nan if rate is None else rate.estimate.value for rate in line] for line in rates])
    axes.set_facecolor(NO_CELL)
    axes.imshow(shares, cmap=HEAT_MAP, vmin=0.0, vmax=1.0, aspect="auto")
    for row, line in enumerate(rates):
        for column, rate in enumerate(line):
            _write_cell(axes, column, row, rate)
    axes.set_xticks(range(len(GROUPS)), [f"{groups}g" for groups in GROUPS])
    axes.set_yticks(range(len(ROBOTS)), [f"{robots}r" for robots in ROBOTS])
    axes.tick_params(colors=MUTED, length=0)
    axes.spines[:].set_visible(False)


def _write_cell(axes: Axes, column: int, row: int, rate: Measurement | None) -> None:
    if rate is None:
        axes.text(column, row, "–", ha="center", va="center", color=MUTED)
        return
    value, low, high = (100 * number for number in rate.estimate)
    colour = "black" if rate.estimate.value > 0.45 else "white"
    axes.text(column, row, f"{value:.1f}", ha="center", va="bottom", fontsize=10, fontweight="bold", color=colour)
    axes.text(column, row + 0.08, f"{low:.0f}–{high:.0f}", ha="center", va="top", fontsize=8, color=colour)


class Picture(NamedTuple):
    """A figure of results: its file name, its description, and the function that draws it."""

    file: str
    alt: str
    draw: Callable[[Results], Figure]


PICTURES = (
    Picture("heatmap.png", "Success of every setup and method with 95 % intervals", heatmap),
    Picture("figure-3-4.png", "Figure 3.4: M_sensor trained on one group, Fixed beside Extrapolation", figure_3_4),
    Picture("figure-3-5.png", "Figure 3.5: M_sensor, Fixed beside Extrapolation to more robots", figure_3_5),
    Picture("figure-3-6.png", "Figure 3.6: M_sensor, Fixed beside Extrapolation to more groups", figure_3_6),
    Picture("figure-3-7.png", "Figure 3.7: M_sensor's lost and captured robots by robots and by groups", figure_3_7),
    Picture("figure-4-4.png", "Figure 4.4: success of the three methods, one chart a robot count", figure_4_4),
    Picture("figure-4-5.png", "Figure 4.5: captured and lost robots of M_sensor and M_OUT by robots", figure_4_5),
)
VALUES_PICTURE = Picture(
    "values.png", "Values that DQN and Double DQN expect during training, and the returns that follow", value_curves
)


def pictures_of(results: Results) -> tuple[Picture, ...]:
    """The figures of a preset's results: `PICTURES`, and that of values where there are some."""
    return (*PICTURES, VALUES_PICTURE) if results.values else PICTURES
