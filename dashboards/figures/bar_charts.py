"""Charts of rates with their 95 % intervals: grouped bars, or lines with markers.

Where a rate pools several training seeds, two dots show the lowest and the highest rate of a seed. A diamond marks a
number printed in the dissertation's text. Missing rates are left out.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.container import ErrorbarContainer
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MultipleLocator, PercentFormatter

from dashboards.analysis.aggregate import Measurement
from dashboards.figures.style import MUTED, TEXT, escaped, style_axes

BARS_WIDTH = 0.8
"""Width of a label's bars together, as a share of the distance between two labels."""
INTERVAL_STYLE: dict[str, Any] = {"ecolor": TEXT, "elinewidth": 1.0, "capsize": 2.5}


class Series(NamedTuple):
    """One entry of the legend: its name and style, and one rate per label, None if it is missing.

    `hatch` is a bar's hatch, or a line's style. `printed` holds numbers printed in the text, by the label's index.
    """

    name: str
    colour: str
    hatch: str
    marker: str
    rates: Sequence[Measurement | None]
    printed: Mapping[int, float] = {}


class Subplot(NamedTuple):
    """One chart of a figure: its title, the labels of its x axis, and its series."""

    title: str
    labels: Sequence[str]
    series: Sequence[Series]


def draw_bars(axes: Axes, subplot: Subplot) -> None:
    """Draws bars side by side, one group per label, on a y axis from 0 to 100 %."""
    width = BARS_WIDTH / len(subplot.series)
    for i, series in enumerate(subplot.series):
        for label, rate in _present(series):
            x = label + (i - (len(subplot.series) - 1) / 2) * width
            axes.bar(x, rate.estimate.value, width, color=series.colour, hatch=series.hatch, edgecolor="white", lw=0.8)
            _spread(axes, x, rate)
        offset = (i - (len(subplot.series) - 1) / 2) * width
        _printed(axes, series, offset)
    _finish(axes, subplot)
    axes.set_ylim(0.0, 1.04)
    axes.set_yticks(np.linspace(0.0, 1.0, 6))


def draw_lines(axes: Axes, subplot: Subplot, top: float) -> None:
    """Draws one line per series, on a y axis from 0 to `top`."""
    for i, series in enumerate(subplot.series):
        offset = 0.06 * (i - (len(subplot.series) - 1) / 2)
        axes.plot(
            [label + offset for label in range(len(series.rates))],
            [math.nan if rate is None else rate.estimate.value for rate in series.rates],
            color=series.colour,
            ls=series.hatch or "-",
            marker=series.marker,
            ms=6,
            lw=1.8,
            clip_on=False,
            zorder=3,
        )
        for label, rate in _present(series):
            _interval(axes, label + offset, rate, series.colour)
        _printed(axes, series, offset)
    _finish(axes, subplot)
    axes.yaxis.set_major_locator(_whole_percents(top))
    axes.set_ylim(0.0, top)


def _whole_percents(top: float) -> MultipleLocator:
    """At most seven ticks, at whole percents, so that their labels need no rounding."""
    step = next(step for step in (1, 2, 5, 10, 20) if 100 * top / step <= 7)
    return MultipleLocator(step / 100)


def _present(series: Series) -> Iterator[tuple[int, Measurement]]:
    return ((label, rate) for label, rate in enumerate(series.rates) if rate is not None)


def _interval(axes: Axes, x: float, rate: Measurement, colour: str = TEXT) -> ErrorbarContainer:
    value, low, high = rate.estimate
    spread = [[max(value - low, 0.0)], [max(high - value, 0.0)]]
    return axes.errorbar(x, value, yerr=spread, fmt="none", **{**INTERVAL_STYLE, "ecolor": colour})


def _spread(axes: Axes, x: float, rate: Measurement) -> None:
    """Draws the 95 % interval, and the lowest and highest rate of a seed."""
    _interval(axes, x, rate)
    if rate.seed_range is not None:
        axes.plot([x, x], rate.seed_range, ls="none", marker="o", ms=3, mfc="white", mec=TEXT, mew=0.8)


def _printed(axes: Axes, series: Series, offset: float) -> None:
    for label, value in series.printed.items():
        axes.plot(label + offset, value, ls="none", marker="D", ms=6, mfc="none", mec=TEXT, mew=1.3, zorder=4)


def _finish(axes: Axes, subplot: Subplot) -> None:
    axes.set_title(escaped(subplot.title), loc="left", fontsize=10, color=TEXT)
    axes.set_xticks(range(len(subplot.labels)), subplot.labels)
    axes.set_xlim(-0.6, len(subplot.labels) - 0.4)
    axes.yaxis.set_major_formatter(PercentFormatter(1.0, decimals=0))
    style_axes(axes, labelsize=9)
    if not any(rate is not None for series in subplot.series for rate in series.rates):
        axes.text(0.5, 0.5, "no data", transform=axes.transAxes, ha="center", color=MUTED)


def legend(figure: Figure, subplots: Sequence[Subplot], lines: bool, axes: Axes | None = None) -> None:
    """Draws one legend for all subplots: in a row below the figure, or in `axes`, which show nothing else."""
    series = subplots[0].series
    handles: list[Artist] = [_swatch(one, lines) for one in series]
    handles.append(Line2D([], [], color=TEXT, marker="|", ms=9, ls="none", label="95 % interval"))
    all_series = [one for subplot in subplots for one in subplot.series]
    if not lines and any(rate is not None and rate.seed_range is not None for one in all_series for rate in one.rates):
        dots: dict[str, Any] = {"marker": "o", "ms": 3, "mfc": "white", "mec": TEXT}
        handles.append(Line2D([], [], ls="none", label="lowest and highest seed", **dots))
    if any(one.printed for one in all_series):
        handles.append(Line2D([], [], ls="none", marker="D", mfc="none", mec=TEXT, label="as printed in the text"))
    if axes is None:
        figure.legend(handles=handles, loc="outside lower left", ncols=len(handles), frameon=False, fontsize=9)
    else:
        axes.set_axis_off()
        axes.legend(handles=handles, loc="center", frameon=False, fontsize=10, handlelength=2.4)


def _swatch(series: Series, lines: bool) -> Artist:
    if lines:
        style = series.hatch or "-"
        return Line2D([], [], color=series.colour, ls=style, marker=series.marker, lw=1.8, label=series.name)
    return Patch(facecolor=series.colour, hatch=series.hatch, edgecolor="white", label=series.name)
