"""Labels and styles of methods in every table, figure and chart."""

from __future__ import annotations

import zlib
from collections.abc import Iterable
from typing import NamedTuple

from sim_core.plugins import DISSERTATION_METHODS, METHODS, find


class MethodStyle(NamedTuple):
    """The style of a method; methods differ in more than their colours.

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
"""Styles of the dissertation's methods in their order, then of others; Okabe and Ito's colours, and grey."""


def method_label(name: str) -> str:
    """Label of a method, by its name in a table of results; a user's own method is called by its class."""
    return str(find(METHODS, name).label) if name in METHODS.built_in else name


def method_style(name: str) -> MethodStyle:
    """The style of a method: fixed for the dissertation's methods, chosen by a hash of the name for others."""
    if name in DISSERTATION_METHODS:
        return STYLES[DISSERTATION_METHODS.index(name)]
    others = STYLES[len(DISSERTATION_METHODS) :]
    return others[zlib.crc32(name.encode()) % len(others)]


def in_order(names: Iterable[str]) -> list[str]:
    """The dissertation's three methods, then the other methods in `names`."""
    return [*DISSERTATION_METHODS, *sorted(set(names) - set(DISSERTATION_METHODS))]
