"""What the report's pictures share: figures without pyplot, one look, and files that come out the same every time."""

from __future__ import annotations

import io
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

TEXT, MUTED, GRID = "#1C2024", "#5A6470", "#E3E6EA"
DPI = 100
PALETTE_COLOURS = 128
"""Colours of a picture; plenty for flat colours and their smoothed edges, and a third of the bytes of all colours."""


def new_figure(width_in: float, height_in: float, title: str) -> Figure:
    """An empty figure with its title above; `title` is plain text."""
    figure = Figure(figsize=(width_in, height_in), dpi=DPI, layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    figure.suptitle(plain(title), x=0.01, ha="left", fontsize=12, fontweight="bold", color=TEXT)
    return figure


def plain(text: str) -> str:
    """`text` with nothing left that matplotlib would read as mathematics."""
    return text.replace("$", r"\$")


def dress(axes: Axes) -> None:
    """Grid lines across, no box, quiet ticks."""
    axes.grid(axis="y", color=GRID)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(GRID)
    axes.tick_params(colors=MUTED, length=0, labelsize=9)


def save_png(figure: Figure, path: Path) -> None:
    """Writes the figure in few colours; an older file is replaced once the new is whole. Holds no date or version."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=DPI, metadata={"Software": None})
    buffer.seek(0)
    part = path.with_name(path.name + ".part")
    with Image.open(buffer) as image:
        few = image.convert("RGB").quantize(PALETTE_COLOURS, dither=Image.Dither.NONE)
    few.save(part, format="PNG", optimize=True)
    part.replace(path)
