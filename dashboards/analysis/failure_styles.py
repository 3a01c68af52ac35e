"""How charts show each way to fail, so that none is told by its colour alone. Names are those of Plotly."""

from __future__ import annotations

from typing import NamedTuple


class FailureStyle(NamedTuple):
    """Colour on white paper, pattern of a bar, dash of a line, and marker of a point."""

    colour: str
    pattern: str
    dash: str
    marker: str


FAILURE_STYLES = {
    "lost": FailureStyle("#D55E00", "", "solid", "circle"),
    "captured": FailureStyle("#882255", "/", "dash", "square"),
    "collision": FailureStyle("#009E73", "x", "dashdot", "triangle-up"),
    "timeout": FailureStyle("#5A6470", ".", "dot", "diamond"),
}
"""By the outcome's name. Pages have colours of their own, the CSS variables `--NAME`, for their light and dark form."""
