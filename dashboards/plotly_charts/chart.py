"""Charts of the HTML report as data: Plotly figures whose colours are names of the page's own, and tables of numbers.

A colour is written `--name`, a CSS variable in `web/base.css`; the page puts the light or the dark value in its place.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

from plotly.offline import get_plotlyjs

from actors.evaluation.statistics import as_percent
from dashboards.analysis.aggregate import Measured

Figure = dict[str, Any]
"""A Plotly figure: `data` and `layout`."""
FAILURES = {
    "lost": ("--lost", "", "solid", "circle"),
    "captured": ("--captured", "/", "dash", "square"),
    "collision": ("--collision", "x", "dashdot", "triangle-up"),
    "timeout": ("--timeout", ".", "dot", "diamond"),
}
"""Colour, pattern, line and marker of each way to fail, so that none is told by its colour alone."""


class Table(NamedTuple):
    """The numbers of a figure, as text; the first column names the row."""

    header: tuple[str, ...]
    rows: Sequence[tuple[str, ...]]


class Panel(NamedTuple):
    """One figure with what stands above it; `wide` asks for the whole row."""

    title: str
    figure: Figure
    wide: bool = False


class Choice(NamedTuple):
    """What the reader may choose: its name, the options as (value, label), and the value to start with."""

    name: str
    label: str
    options: list[tuple[str, str]]
    default: str


class View(NamedTuple):
    """What a chart shows for one choice of everything."""

    panels: list[Panel]
    table: Table


class Chart(NamedTuple):
    """One section of the report: `views` by the values of its choices, joined by `|`."""

    key: str
    title: str
    note: str
    choices: list[Choice]
    views: dict[str, View]


def plotly_js() -> str:
    """Plotly's own JavaScript, for a page that carries it inside."""
    return str(get_plotlyjs())


def as_json(chart: Chart) -> dict[str, Any]:
    """The chart as the page takes it."""
    views = {
        key: {"panels": [panel._asdict() for panel in view.panels], "table": view.table._asdict()}
        for key, view in chart.views.items()
    }
    return {**chart._asdict(), "choices": [choice._asdict() for choice in chart.choices], "views": views}


def percent_text(measured: Measured | None) -> str:
    """`89.8 % (87.8 … 91.5)`, `–` without data."""
    return "–" if measured is None else as_percent(measured.estimate)


def layout(**changes: Any) -> dict[str, Any]:
    """What all figures share; fonts and the colours of axes come from the page."""
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


def error_bars(rates: Sequence[Measured]) -> dict[str, Any]:
    """Plotly's error bars from each value to the limits of its interval."""
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
    """A bar's fill: a colour, with a pattern in the colour of the page on it."""
    shape = {"shape": pattern, "fillmode": "overlay", "fgcolor": "--page", "fgopacity": 0.8, "size": 7, "solidity": 0.2}
    return {"color": colour, "pattern": shape}
