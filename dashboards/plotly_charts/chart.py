"""The data of the HTML report's charts: Plotly figures, their tables of numbers, and the choices a reader has.

Colours are written `--name`, after the CSS variables in `web/base.css`. The page replaces them by the values of its
light or dark scheme.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

from plotly.offline import get_plotlyjs

from actors.evaluation.statistics import as_percent
from dashboards.analysis.aggregate import Measurement

Figure = dict[str, Any]
"""A Plotly figure: `data` and `layout`."""


class Table(NamedTuple):
    """A table as text; the first column names the row."""

    header: tuple[str, ...]
    rows: Sequence[tuple[str, ...]]


class Panel(NamedTuple):
    """One figure with its title; a `wide` one takes the whole width of the page."""

    title: str
    figure: Figure
    wide: bool = False


class Choice(NamedTuple):
    """A select: its name and label, its options as (value, label), and its initial value."""

    name: str
    label: str
    options: list[tuple[str, str]]
    default: str


class View(NamedTuple):
    """What a chart shows for one combination of choices."""

    panels: list[Panel]
    table: Table


class Chart(NamedTuple):
    """One section of the report. `views` are by the values of all choices, joined by `|`."""

    key: str
    title: str
    note: str
    choices: list[Choice]
    views: dict[str, View]


def plotly_js() -> str:
    """Plotly's JavaScript, to be embedded in a page."""
    return str(get_plotlyjs())


def as_json(chart: Chart) -> dict[str, Any]:
    """The chart, ready for JSON."""
    views = {
        key: {"panels": [panel._asdict() for panel in view.panels], "table": view.table._asdict()}
        for key, view in chart.views.items()
    }
    return {**chart._asdict(), "choices": [choice._asdict() for choice in chart.choices], "views": views}


def percent_text(measured: Measurement | None) -> str:
    """`89.8 % (87.8 … 91.5)`, `–` without data."""
    return "–" if measured is None else as_percent(measured.estimate)


def layout(**changes: Any) -> dict[str, Any]:
    """The layout that all figures share, with some changes. The page adds fonts and the colours of axes."""
    return {
        "margin": {"l": 48, "r": 12, "t": 8, "b": 40},
        "height": 300,
        "hovermode": "closest",
        "legend": {"orientation": "h", "x": 0, "y": 1.02, "yanchor": "bottom", "traceorder": "normal"},
        **changes,
    }


def share_axis(top: float = 1.0, **changes: Any) -> dict[str, Any]:
    """A y axis of shares from 0 to a little above `top`, in percent."""
    return {"range": [0.0, top * 1.04], "tickformat": ".0%", "rangemode": "tozero", "fixedrange": True, **changes}


def error_bars(rates: Sequence[Measurement]) -> dict[str, Any]:
    """Plotly's error bars: the interval of each rate."""
    return {
        "type": "data",
        "symmetric": False,
        "array": [rate.estimate.high - rate.estimate.value for rate in rates],
        "arrayminus": [rate.estimate.value - rate.estimate.low for rate in rates],
        "color": "--text",
        "thickness": 1.2,
        "width": 3,
    }


def patterned(colour: str, pattern: str) -> dict[str, Any]:
    """A bar's marker: a colour, under a pattern in the colour of the page."""
    shape = {"shape": pattern, "fillmode": "overlay", "fgcolor": "--page", "fgopacity": 0.8, "size": 7, "solidity": 0.2}
    return {"color": colour, "pattern": shape}
