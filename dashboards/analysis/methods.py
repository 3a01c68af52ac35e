"""How methods are called and drawn, in every table, figure and chart."""

from __future__ import annotations

import zlib
from collections.abc import Iterable
from typing import NamedTuple

from sim_core.plugins import METHODS, load


class MethodStyle(NamedTuple):
    """How a method is drawn, so that none is told by its colour alone.

    `colour`, `hatch` and `marker` are matplotlib's; `css_colour` (a variable of base.css), `dash` and `symbol` are
    Plotly's.
    """

    colour: str
    hatch: str
    marker: str
    css_colour: str
    dash: str
    symbol: str


STYLES = (
    MethodStyle("#0072B2", "", "o", "--sensor", "solid", "circle"),
    MethodStyle("#999999", "....", "^", "--in", "dot", "triangle-up"),
    MethodStyle("#E69F00", "////", "s", "--out", "dash", "square"),
    MethodStyle("#009E73", "xx", "D", "--other-1", "dashdot", "diamond"),
    MethodStyle("#CC79A7", "\\\\\\\\", "v", "--other-2", "longdash", "triangle-down"),
    MethodStyle("#56B4E9", "++", "P", "--other-3", "longdashdot", "cross"),
)
"""Of the dissertation's methods in their order, then of others; Okabe and Ito's colours, and grey."""
DISSERTATION = tuple(METHODS.built_in)[:3]
"""M_sensor, M_IN and M_OUT."""


def method_label(name: str) -> str:
    """What people call a method that a table of results names; a user's own is called by its class."""
    return str(load(METHODS, name, "").label) if name in METHODS.built_in else name


def method_style(name: str) -> MethodStyle:
    """How a method is drawn: the dissertation's as always, another one by its name."""
    if name in DISSERTATION:
        return STYLES[DISSERTATION.index(name)]
    others = STYLES[len(DISSERTATION) :]
    return others[zlib.crc32(name.encode()) % len(others)]


def in_order(names: Iterable[str]) -> list[str]:
    """The dissertation's three methods, then those of `names` that are others."""
    return [*DISSERTATION, *sorted(set(names) - set(DISSERTATION))]
