"""The look that all PNG figures share: drawn without pyplot and a display, and the same bytes every time."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from actors.storage.atomic_write import replacing_file

TEXT, MUTED, GRID = "#1C2024", "#5A6470", "#E3E6EA"
DPI = 100
PALETTE_COLOURS = 128
"""Colours of a PNG; enough for flat colours and their smoothed edges, at a third of the bytes of full colour."""
LINE_STYLES = {"solid": "-", "dash": "--", "dashdot": "-.", "dot": ":"}
MARKERS = {"circle": "o", "square": "s", "triangle-up": "^", "diamond": "D"}
"""matplotlib's names of lines and markers, by Plotly's."""


def new_figure(width_in: float, height_in: float, title: str, dpi: int = DPI) -> Figure:
    """An empty figure with its title, plain text, above."""
    figure = Figure(figsize=(width_in, height_in), dpi=dpi, layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    figure.suptitle(escaped(title), x=0.01, ha="left", fontsize=12, fontweight="bold", color=TEXT)
    return figure


def escaped(text: str) -> str:
    """Plain text, escaped so that matplotlib finds no mathematics in it."""
    return text.replace("$", r"\$")


def style_axes(axes: Axes, **tick_params: Any) -> None:
    """Horizontal grid lines, no frame above and to the right, and ticks without marks."""
    axes.grid(axis="y", color=GRID)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(GRID)
    axes.tick_params(colors=MUTED, length=0, **tick_params)


def save_png(figure: Figure, path: Path) -> None:
    """Writes the figure with a reduced palette, and without date and version; an older file is replaced atomically."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=DPI, metadata={"Software": None})
    buffer.seek(0)
    with Image.open(buffer) as image:
        few = image.convert("RGB").quantize(PALETTE_COLOURS, dither=Image.Dither.NONE)
    with replacing_file(path) as partial:
        few.save(partial, format="PNG", optimize=True)
