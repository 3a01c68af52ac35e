"""The report of a sweep, or of its table of results alone."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from actors.evaluation.result_table import ResultRow, read_table
from dashboards.analysis.aggregate import CELLS_PER_METHOD, Results
from dashboards.analysis.claim_text import tally
from dashboards.analysis.claims import judge
from dashboards.analysis.comparison import BASELINES_NOTE, baselines_of, comparison_rows, results_of, rule_rows
from dashboards.pages.report_page import ReportContents, TableSection
from dashboards.plotly_charts.chart import Chart, Table
from dashboards.plotly_charts.result_charts import failure_causes, heatmaps, transfers
from dashboards.plotly_charts.run_charts import setup_curves, sweep_speeds
from deploy.report_data.beside import beside, values_beside, variants_beside
from deploy.report_data.episode_sources import CombinedEpisodes, EpisodeSource
from deploy.report_data.recorded_episodes import RecordedEpisodes
from deploy.report_data.sweep_episodes import SweepEpisodes
from deploy.report_data.trainings import fingerprint_of, journal_rows, training_of
from learner.file_names import CELLS, JOURNAL, RESULTS, VALUES, VARIANTS
from learner.run_folder import RunFolder

EPISODES_NOTE = (
    "Episodes of the evaluation, played again by the policy from their seeds. Choose a setup and how the episode ended."
)


class _UnfinishedCell(NamedTuple):
    """A cell that is training or was interrupted: its name, env steps done and in total, newest success rate."""

    name: str
    env_steps: int
    total_env_steps: int
    success: float | None


class SweepSource:
    """A sweep, running or not, or its table of results alone.

    Args:
      folder: the sweep's folder; curves, speeds and episodes come from its cells, if there are any.
      table: its table of results; it may be missing while a sweep has no finished cell.
    """

    def __init__(self, folder: Path, table: Path) -> None:
        self.folder = folder
        self.title = f"Sweep {folder.absolute().name}"
        self._table = table
        self._cells = folder / CELLS
        self.episodes: EpisodeSource = CombinedEpisodes(SweepEpisodes(self._cells), RecordedEpisodes(folder))

    def fingerprint(self) -> object:
        """Changes with the table, what stands beside it, and with the tables and journals of the cells."""
        tables = [self._table, *(path for name in (VARIANTS, VALUES) for path in beside([self._table], name))]
        return fingerprint_of(
            [*tables, *self._cells.glob(f"*/{RESULTS}"), *self._cells.glob(f"*/{JOURNAL}")],
        )

    def contents(self) -> ReportContents:
        """The report's contents as of now."""
        rows = read_table(self._table) if self._table.is_file() else []
        presets = results_of(rows, variants_beside([self._table]), values_beside([self._table]))
        claims = {name: judge(results) for name, results in presets.items()}
        charts = [heatmaps(presets), transfers(presets), failure_causes(presets)] if presets else []
        unfinished = list(self._unfinished())
        facts = _coverage(presets)
        facts += [(f"claims, {name}", tally(judged)) for name, judged in claims.items()]
        facts += [("unfinished cells", str(len(unfinished)))] if unfinished else []
        return ReportContents(
            title=self.title,
            subtitle=_subtitle(rows, unfinished),
            made=f"Made by `shoal dashboard` from {self._table.name}. Rates with 95 % intervals.{self._missing()}",
            facts=facts,
            charts=[*charts, *self._training_charts()],
            claims=claims,
            tables=[*_comparisons(rows, presets), _unfinished_table(unfinished)],
            groups=self.episodes.groups(),
            episodes_note=EPISODES_NOTE,
        )

    def _missing(self) -> str:
        """A sentence about what a table alone cannot show."""
        is_alone = not self._cells.is_dir()
        return " Curves, throughput and episodes need the sweep’s folder with its cells." if is_alone else ""

    def _training_charts(self) -> list[Chart]:
        folders = [RunFolder(path.parent) for path in sorted(self._cells.glob(f"*/{JOURNAL}"))]
        trainings = [training for training in map(training_of, folders) if training.curve or training.speeds]
        charts = [setup_curves(trainings), sweep_speeds(trainings)]
        return [chart for chart in charts if chart.views]

    def _unfinished(self) -> Iterator[_UnfinishedCell]:
        for path in sorted(self._cells.glob(f"*/{JOURNAL}")):
            folder = RunFolder(path.parent)
            if not folder.results.is_file():
                config, rows = folder.config(), journal_rows(folder)
                rates = [row.metrics["eval/success_rate"] for row in rows if "eval/success_rate" in row.metrics]
                done = max((row.env_steps for row in rows), default=0)
                yield _UnfinishedCell(config.name, done, config.total_env_steps, rates[-1] if rates else None)


def _coverage(presets: dict[str, Results]) -> list[tuple[str, str]]:
    facts = []
    for name, results in presets.items():
        fixed = sum(len(results.fixed_present(method)) for method in results.methods())
        facts.append((f"cells, {name}", f"{fixed} of {CELLS_PER_METHOD * len(results.methods())}"))
    episodes = sum(cell.episodes for results in presets.values() for cell in results.cells())
    return [*facts, ("episodes counted", f"{episodes:,}")] if presets else facts


def _subtitle(rows: list[ResultRow], unfinished: list[_UnfinishedCell]) -> str:
    if not rows:
        return "No cell has finished yet." if unfinished else "The table of results is empty."
    seeds = len({(row.preset, row.seed) for row in rows})
    return (
        f"The dissertation’s setups, {seeds} training seed{'s' * (seeds > 1)}. "
        "Fixed: tested where trained. Extrapolation: tested elsewhere."
    )


def _comparisons(rows: list[ResultRow], presets: dict[str, Results]) -> list[TableSection]:
    """Presets side by side, and baselines beside the learned policies."""
    sections = []
    if len(presets) > 1:
        table = _table_of(*comparison_rows(presets))
        sections.append(TableSection("presets", "Presets side by side", "Mean Fixed success.", table))
    for name, results in presets.items():
        baselines = baselines_of([row for row in rows if row.preset == name])
        if baselines:
            title = f"Learned policies beside rules that learn nothing, preset {name}"
            table = _table_of(*rule_rows(results, baselines))
            sections.append(TableSection(f"rivals-{len(sections)}", title, BASELINES_NOTE, table))
    return sections


def _table_of(header: list[str], rows: list[list[str]]) -> Table:
    return Table(tuple(header), [tuple(row) for row in rows])


def _unfinished_table(cells: list[_UnfinishedCell]) -> TableSection:
    rows = [
        (
            cell.name,
            f"{cell.env_steps:,} of {cell.total_env_steps:,}",
            "–" if cell.success is None else f"{100 * cell.success:.1f} %",
        )
        for cell in cells
    ]
    header = ("cell", "env steps", "success, newest evaluation")
    return TableSection("running", "Unfinished cells", "Training, or interrupted.", Table(header, rows))
