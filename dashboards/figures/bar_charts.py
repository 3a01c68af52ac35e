"""Charts of rates with their 95 % intervals: grouped bars, and lines with a marker a point.

Where several training seeds are pooled, two dots show the lowest and the highest rate of a seed. A diamond stands where
the dissertation's text gives a number. What is missing is left out.
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

from dashboards.analysis.aggregate import Measured
from dashboards.figures.style import MUTED, TEXT, dress, plain

BAR_ROOM = 0.8
"""Share of the distance between two labels that bars take."""
INTERVAL_STYLE: dict[str, Any] = {"ecolor": TEXT, "elinewidth": 1.0, "capsize": 2.5}


class Series(NamedTuple):
    """One legend entry: its name, colour, hatch and marker, and a rate a label, None where it is missing."""

    name: str
    colour: str
    hatch: str
    marker: str
    rates: Sequence[Measured | None]
    printed: Mapping[int, float] = {}
    """What the text prints, by the place of the label."""


class Panel(NamedTuple):
    """One chart: what stands above it, what its labels are, and its series."""

    title: str
    labels: Sequence[str]
    series: Sequence[Series]


def draw_bars(axes: Axes, panel: Panel) -> None:
    """Bars side by side, a group a label, on an axis from 0 to 100 %."""
    width = BAR_ROOM / len(panel.series)
    for place, series in enumerate(panel.series):
        for label, rate in _present(series):
            x = label + (place - (len(panel.series) - 1) / 2) * width
            axes.bar(x, rate.estimate.value, width, color=series.colour, hatch=series.hatch, edgecolor="white", lw=0.8)
            _spread(axes, x, rate)
        offset = (place - (len(panel.series) - 1) / 2) * width
        _printed(axes, series, offset)
    _finish(axes, panel)
    axes.set_ylim(0.0, 1.04)
    axes.set_yticks(np.linspace(0.0, 1.0, 6))


def draw_lines(axes: Axes, panel: Panel, top: float) -> None:
    """A line a series, on an axis from 0 to `top`."""
    for place, series in enumerate(panel.series):
        offset = 0.06 * (place - (len(panel.series) - 1) / 2)
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
    _finish(axes, panel)
    axes.yaxis.set_major_locator(_whole_percents(top))
    axes.set_ylim(0.0, top)


def _whole_percents(top: float) -> MultipleLocator:
    """Ticks at whole percents, at most seven: what a tick says is where it stands."""
    step = next(step for step in (1, 2, 5, 10, 20) if 100 * top / step <= 7)
    return MultipleLocator(step / 100)


def _present(series: Series) -> Iterator[tuple[int, Measured]]:
    return ((label, rate) for label, rate in enumerate(series.rates) if rate is not None)


def _interval(axes: Axes, x: float, rate: Measured, colour: str = TEXT) -> ErrorbarContainer:
    value, low, high = rate.estimate
    spread = [[max(value - low, 0.0)], [max(high - value, 0.0)]]
    return axes.errorbar(x, value, yerr=spread, fmt="none", **{**INTERVAL_STYLE, "ecolor": colour})


def _spread(axes: Axes, x: float, rate: Measured) -> None:
    """The 95 % interval, and the lowest and highest rate of a seed."""
    _interval(axes, x, rate)
    if rate.seed_range is not None:
        axes.plot([x, x], rate.seed_range, ls="none", marker="o", ms=3, mfc="white", mec=TEXT, mew=0.8)


def _printed(axes: Axes, series: Series, offset: float) -> None:
    for label, value in series.printed.items():
        axes.plot(label + offset, value, ls="none", marker="D", ms=6, mfc="none", mec=TEXT, mew=1.3, zorder=4)


def _finish(axes: Axes, panel: Panel) -> None:
    axes.set_title(plain(panel.title), loc="left", fontsize=10, color=TEXT)
    axes.set_xticks(range(len(panel.labels)), panel.labels)
    axes.set_xlim(-0.6, len(panel.labels) - 0.4)
    axes.yaxis.set_major_formatter(PercentFormatter(1.0, decimals=0))
    dress(axes)
    if not any(rate is not None for series in panel.series for rate in series.rates):
        axes.text(0.5, 0.5, "no data", transform=axes.transAxes, ha="center", color=MUTED)


def legend(figure: Figure, panels: Sequence[Panel], lines: bool, place: Axes | None = None) -> None:
    """One legend for all panels: in a row under the figure's title, or in `place`, an axes that shows nothing else."""
    series = panels[0].series
    handles: list[Artist] = [_swatch(one, lines) for one in series]
    handles.append(Line2D([], [], color=TEXT, marker="|", ms=9, ls="none", label="95 % interval"))
    every = [one for panel in panels for one in panel.series]
    if not lines and any(rate is not None and rate.seed_range is not None for one in every for rate in one.rates):
        dots: dict[str, Any] = {"marker": "o", "ms": 3, "mfc": "white", "mec": TEXT}
        handles.append(Line2D([], [], ls="none", label="lowest and highest seed", **dots))
    if any(one.printed for one in every):
        handles.append(Line2D([], [], ls="none", marker="D", mfc="none", mec=TEXT, label="as printed in the text"))
    if place is None:
        figure.legend(handles=handles, loc="outside lower left", ncols=len(handles), frameon=False, fontsize=9)
    else:
        place.set_axis_off()
        place.legend(handles=handles, loc="center", frameon=False, fontsize=10, handlelength=2.4)


def _swatch(series: Series, lines: bool) -> Artist:
    if lines:
        style = series.hatch or "-"
        return Line2D([], [], color=series.colour, ls=style, marker=series.marker, lw=1.8, label=series.name)
    return Patch(facecolor=series.colour, hatch=series.hatch, edgecolor="white", label=series.name)
