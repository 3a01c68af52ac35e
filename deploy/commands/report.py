"""`shoal report`: a table of results becomes figures, judged claims and a page that holds them."""

from __future__ import annotations

import re
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console

from actors.evaluation.result_table import read_table
from dashboards.analysis.aggregate import Results
from dashboards.analysis.claim_text import claims_markdown, tally
from dashboards.analysis.claims import judge
from dashboards.figures.result_figures import PICTURES
from dashboards.figures.style import save_png
from dashboards.report import DRAWINGS, PresetPart, baselines_of, presets_of, report_markdown
from deploy.runs.folders import make_folder, write_text
from deploy.runs.sweep_provenance import read_sittings
from learner.sweep.grid import world_of_label
from sim_core.checks import require

if TYPE_CHECKING:
    from deploy.options.results import Report


def report(command: Report) -> int:
    """Writes the report of one table or several; returns the exit code.

    Raises:
      ConfigError: a table cannot be read, none holds a learned policy, two count the same one, or the folder cannot be
        written to.
    """
    tables = command.results
    rows = list(dict.fromkeys(row for table in tables for row in read_table(table)))  # sweeps share their baselines
    presets = presets_of(rows)
    sources = ", ".join(map(str, tables))
    require(bool(presets), f"{sources} holds no results of a learned policy; run a sweep first")
    parts = []
    for preset in presets:
        own = [row for row in rows if row.preset == preset]
        folder = f"{_folder_name(preset)}/" if len(presets) > 1 else ""
        results = Results(own)
        parts.append(PresetPart(preset, results, judge(results), folder, baselines_of(own)))
    make_folder(command.out, "--out")
    _write(command.out, tables, parts)
    for part in parts:
        Console().print(f"{part.name}: {tally(part.claims)}", highlight=False)
    Console().print(str(command.out / "report.md"), highlight=False, soft_wrap=True)
    return 0


def _names(tables: Sequence[Path]) -> list[str]:
    """The tables' names, with their folders' where there are several."""
    return [table.name if len(tables) == 1 else f"{table.absolute().parent.name}/{table.name}" for table in tables]


def _folder_name(preset: str) -> str:
    """The preset's name where it can name a folder and stand in a link, else what is left of it and a hash."""
    plain = re.sub(r"[^\w.+=-]+", "-", preset)
    return plain if plain == preset else f"{plain}-{zlib.crc32(preset.encode()):08x}"


def _write(out: Path, tables: Sequence[Path], parts: list[PresetPart]) -> None:
    """All files; the page comes last, so that it never embeds what is not there."""
    for part in parts:
        folder = out / part.folder
        folder.mkdir(parents=True, exist_ok=True)
        for picture in PICTURES:
            save_png(picture.draw(part.results), folder / picture.file)
    for drawing in DRAWINGS:
        world = world_of_label(parts[0].name, drawing.method, *drawing.setup)
        save_png(drawing.draw(world), out / drawing.file)
    sittings = list(dict.fromkeys(sitting for table in tables for sitting in read_sittings(table)))
    write_text(out / "claims.md", claims_markdown({part.name: part.claims for part in parts}))
    write_text(out / "report.md", report_markdown(_names(tables), parts, sittings))
