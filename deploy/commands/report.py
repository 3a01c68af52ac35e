"""`shoal report`: figures, judged claims and a Markdown page from tables of results."""

from __future__ import annotations

import re
import zlib
from collections.abc import Sequence
from pathlib import Path

from actors.evaluation.result_table import read_table
from dashboards.analysis.claim_text import claims_markdown, tally
from dashboards.analysis.claims import judge
from dashboards.analysis.comparison import baselines_of, results_of
from dashboards.figures.result_figures import pictures_of
from dashboards.figures.style import save_png
from dashboards.report import DRAWINGS, PresetSection, report_markdown
from deploy.console.terminal import plain_console
from deploy.options.results import Report
from deploy.report_data.beside import values_beside, variants_beside
from deploy.runs.folders import make_folder, write_text
from deploy.runs.sweep_provenance import read_provenance
from learner.sweep.grid import world_of_label
from sim_core.checks import require


def run(command: Report) -> int:
    """Writes the report on one table or several; returns the exit code.

    Raises:
      ConfigError: a table cannot be read, none holds a learned policy, two hold different results of the same one, or
        the folder cannot be written to.
    """
    tables = command.results
    rows = list(dict.fromkeys(row for table in tables for row in read_table(table)))  # sweeps may share baselines
    presets = results_of(rows, variants_beside(tables), values_beside(tables))
    require(bool(presets), f"{', '.join(map(str, tables))} holds no results of a learned policy; run a sweep first")
    sections = []
    for preset, results in presets.items():
        own = [row for row in rows if row.preset == preset]
        folder = f"{_folder_name(preset)}/" if len(presets) > 1 else ""
        sections.append(PresetSection(preset, results, judge(results), folder, baselines_of(own)))
    make_folder(command.out, "--out")
    _write(command.out, tables, sections)
    for section in sections:
        plain_console().print(f"{section.name}: {tally(section.claims)}")
    plain_console().print(str(command.out / "report.md"), soft_wrap=True)
    return 0


def _names(tables: Sequence[Path]) -> list[str]:
    """Names of the tables, with their folders' names if there are several."""
    return [table.name if len(tables) == 1 else f"{table.absolute().parent.name}/{table.name}" for table in tables]


def _folder_name(preset: str) -> str:
    """The preset's name if it can name a folder and stand in a link; otherwise a reduced form of it and a hash."""
    plain = re.sub(r"[^\w.+=-]+", "-", preset)
    return plain if plain == preset else f"{plain}-{zlib.crc32(preset.encode()):08x}"


def _write(out: Path, tables: Sequence[Path], sections: list[PresetSection]) -> None:
    """Writes all files; the page comes last, so that its figures exist."""
    for section in sections:
        folder = out / section.folder
        folder.mkdir(parents=True, exist_ok=True)
        for picture in pictures_of(section.results):
            save_png(picture.draw(section.results), folder / picture.file)
    for drawing in DRAWINGS:
        world = world_of_label(sections[0].name, drawing.method, *drawing.setup)
        save_png(drawing.draw(world), out / drawing.file)
    provenance = list(dict.fromkeys(each for table in tables for each in read_provenance(table)))
    write_text(out / "claims.md", claims_markdown({section.name: section.claims for section in sections}))
    write_text(out / "report.md", report_markdown(_names(tables), sections, provenance))
