"""What a report is made of: a sweep's folder or table, or a run's folder."""

from __future__ import annotations

import functools
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple, Protocol

from actors.evaluation.result_table import ResultRow, read_table
from actors.evaluation.statistics import rate
from dashboards.analysis.aggregate import CELLS_PER_METHOD, Results, Setup
from dashboards.analysis.claim_text import tally
from dashboards.analysis.claims import judge
from dashboards.analysis.trainings import CurvePoint
from dashboards.pages.report_page import Contents, TablePart
from dashboards.plotly_charts.chart import FAILURES, Chart, Table
from dashboards.plotly_charts.result_charts import NAMED, failure_causes, heatmaps, transfers
from dashboards.plotly_charts.run_charts import Speed, Training, run_curves, run_speeds, setup_curves, sweep_speeds
from dashboards.report import BASELINES_NOTE, baselines_of, comparison_rows, presets_of
from deploy.report_data.episode_sources import RecordedShelf, RunShelf, Shelf, Shelves, SweepShelf
from deploy.runs.artifacts import curve_points
from deploy.runs.policy_lookup import policy_signature
from learner import file_names
from learner.config import RunConfig
from learner.run_folder import RunFolder, find_run
from learner.tracking.journal import Row, read_rows
from sim_core.checks import ConfigError, require

State = tuple[tuple[str, int, int], ...]
"""Names, times and sizes of the files that a report is made of."""
SWEEP_EPISODES = (
    "Episodes of the evaluation, played again by the policy from their seeds. Choose a setup and how the episode ended."
)
RUN_EPISODES_NOTE = (
    "Greedy episodes of the newest policy, on seeds of their own, and episodes that were recorded. "
    "Choose how the episode ended."
)


class Source(Protocol):
    """One report's source."""

    title: str
    folder: Path
    shelf: Shelf

    def state(self) -> State:
        """Changes when the report does."""
        ...

    def contents(self) -> Contents:
        """The report, as things are now."""
        ...


def find_source(name: str, runs_dir: Path) -> Source:
    """The sweep or run that a user names: a table of results, a folder, or a name under `runs_dir`.

    Raises:
      ConfigError: there is none.
    """
    path = Path(name)
    if path.is_file():
        return SweepSource(path.parent, path)
    for folder in (path, runs_dir / file_names.SWEEPS / name):
        if not (folder / file_names.CONFIG).is_file() and (
            (folder / file_names.CELLS).is_dir() or (folder / file_names.RESULTS).is_file()
        ):
            return SweepSource(folder, folder / file_names.RESULTS)
    require(path.suffix != ".csv", f"there is no table of results {name}; name a sweep, its results.csv, or a run")
    try:
        return RunSource(find_run(name, runs_dir))
    except ConfigError as error:
        known = sorted(folder.name for folder in runs_dir.glob(f"{file_names.SWEEPS}/*"))
        hint = f"; sweeps there: {', '.join(known[-5:])}" if known else ""
        raise ConfigError(f"{error}{hint}") from error


class _Unfinished(NamedTuple):
    """A cell that trains or was left: its name, env steps done and in all, and the newest success rate."""

    name: str
    env_steps: int
    total_env_steps: int
    success: float | None


class SweepSource:
    """A sweep, running or not, or its table of results alone.

    Args:
      folder: the sweep's folder; curves, speeds and episodes come from its cells, where there are any.
      table: its table of results; of a sweep that has just begun it may be missing.
    """

    def __init__(self, folder: Path, table: Path) -> None:
        self.folder = folder
        self.title = f"Sweep {folder.absolute().name}"
        self._table = table
        self._cells = folder / file_names.CELLS
        self.shelf: Shelf = Shelves(SweepShelf(self._cells), RecordedShelf(folder))

    def state(self) -> State:
        """The table's and the cells' files."""
        paths = [
            self._table,
            *self._cells.glob(f"*/{file_names.RESULTS}"),
            *self._cells.glob(f"*/{file_names.JOURNAL}"),
        ]
        return _state_of(paths)

    def contents(self) -> Contents:
        """The report."""
        rows = read_table(self._table) if self._table.is_file() else []
        presets = {name: Results(row for row in rows if row.preset == name) for name in presets_of(rows)}
        claims = {name: judge(results) for name, results in presets.items()}
        charts = [heatmaps(presets), transfers(presets), failure_causes(presets)] if presets else []
        running = list(self._unfinished())
        tables = [*_rivals(rows, presets), _running_table(running)]
        facts = _coverage(presets)
        facts += [(f"claims, {name}", tally(judged)) for name, judged in claims.items()]
        facts += [("cells under way", str(len(running)))] if running else []
        return Contents(
            title=self.title,
            subtitle=_sentence(rows, running),
            made=f"Made by `shoal dashboard` from {self._table.name}. Rates with 95 % intervals.{self._lacking()}",
            facts=facts,
            charts=[*charts, *self._training_charts()],
            claims=claims,
            tables=tables,
            groups=self.shelf.groups(),
            episodes_note=SWEEP_EPISODES,
        )

    def _lacking(self) -> str:
        is_alone = not self._cells.is_dir()
        return " Curves, throughput and episodes need the sweep’s folder with its cells." if is_alone else ""

    def _training_charts(self) -> list[Chart]:
        folders = [RunFolder(path.parent) for path in sorted(self._cells.glob(f"*/{file_names.JOURNAL}"))]
        trainings = [training for training in map(_training, folders) if training.curve or training.speeds]
        charts = [setup_curves(trainings), sweep_speeds(trainings)]
        return [chart for chart in charts if chart.views]

    def _unfinished(self) -> Iterator[_Unfinished]:
        for path in sorted(self._cells.glob(f"*/{file_names.JOURNAL}")):
            folder = RunFolder(path.parent)
            if not folder.results.is_file():
                config, rows = folder.config(), _rows(folder)
                measured = [row.metrics["eval/success_rate"] for row in rows if "eval/success_rate" in row.metrics]
                done = max((row.env_steps for row in rows), default=0)
                yield _Unfinished(config.name, done, config.total_env_steps, measured[-1] if measured else None)


class RunSource:
    """One run, training or done.

    Args:
      folder: the run's folder.
    """

    def __init__(self, folder: RunFolder) -> None:
        self.folder = folder.path
        self.title = f"Run {folder.path.name}"
        self._run = folder
        self._is_swarm = folder.config().env.is_swarm
        shelves: list[Shelf] = [RunShelf(folder)] if self._is_swarm else []
        self.shelf: Shelf = Shelves(*shelves, RecordedShelf(folder.path, folder.artifacts))

    def state(self) -> State:
        """The journal, and the name of the newest policy."""
        return (*_state_of([self._run.journal]), *((name, 0, 0) for name in policy_signature(self._run)))

    def contents(self) -> Contents:
        """The report."""
        config, training, rows = self._run.config(), _training(self._run), _rows(self._run)
        done = max((row.env_steps for row in rows), default=0)
        facts = [("env steps", f"{done:,} of {config.total_env_steps:,}")]
        if training.curve:
            newest = training.curve[-1]
            what = "success in the newest evaluation" if training.is_share else "mean return in the newest evaluation"
            value = f"{100 * newest.value:.1f} %" if training.is_share else f"{newest.value:.1f}"
            facts.append((what, value))
        charts = [run_curves(training), run_speeds(training)]
        return Contents(
            title=self.title,
            subtitle=f"{config.name}, {config.engine} engine",
            made="Made by `shoal dashboard` from the run’s journal and newest policy. Rates with 95 % intervals.",
            facts=facts,
            charts=[chart for chart in charts if chart.views],
            claims={},
            tables=[],
            groups=self.shelf.groups(),
            episodes_note=RUN_EPISODES_NOTE,
        )


def _state_of(paths: list[Path]) -> State:
    found = []
    for path in sorted(paths):
        try:
            status = path.stat()
        except FileNotFoundError:
            continue
        found.append((str(path), status.st_mtime_ns, status.st_size))
    return tuple(found)


def _rows(folder: RunFolder) -> list[Row]:
    return _rows_of(folder.journal, _state_of([folder.journal]))


@functools.lru_cache(maxsize=1024)
def _rows_of(journal: Path, state: State) -> list[Row]:
    """A journal's rows, read again when its state has changed."""
    return read_rows(journal)


def _training(folder: RunFolder) -> Training:
    config, rows = folder.config(), _rows(folder)
    curve = [*curve_points(rows), *_final_point(folder, config)]
    speeds = [
        Speed(row.env_steps, row.metrics["speed/env_steps_per_s"], row.metrics["speed/updates_per_s"])
        for row in rows
        if "speed/env_steps_per_s" in row.metrics
    ]
    world = config.world
    setup = Setup(world.robots, world.groups) if config.env.is_swarm else None
    is_share = all(point.failures is not None for point in curve)
    method = world.method_name if config.env.is_swarm else ""
    return Training(config.name, method, setup, config.seed, curve, speeds, is_share)


def _final_point(folder: RunFolder, config: RunConfig) -> list[CurvePoint]:
    """The evaluation at the end of a sweep's cell, which its table of results has."""
    rows = read_table(folder.results) if folder.results.is_file() else []
    fixed = [row for row in rows if row.is_fixed]
    return [
        CurvePoint(
            config.total_env_steps,
            *rate(row.goal, row.episodes),
            {name: row.count(outcome) / row.episodes for name, outcome in NAMED.items() if name in FAILURES},
        )
        for row in fixed
    ]


def _coverage(presets: dict[str, Results]) -> list[tuple[str, str]]:
    facts = []
    for name, results in presets.items():
        fixed = sum(len(results.fixed_present(method)) for method in results.methods())
        facts.append((f"cells, {name}", f"{fixed} of {CELLS_PER_METHOD * len(results.methods())}"))
    episodes = sum(cell.episodes for results in presets.values() for cell in results.cells())
    return [*facts, ("episodes counted", f"{episodes:,}")] if presets else facts


def _sentence(rows: list[ResultRow], running: list[_Unfinished]) -> str:
    if not rows:
        return "No cell is done yet." if running else "The table of results is empty."
    seeds = len({(row.preset, row.seed) for row in rows})
    kinds = f"{seeds} training seed{'s' * (seeds > 1)}"
    return f"The dissertation’s setups, {kinds}. Fixed: tested where trained. Extrapolation: tested elsewhere."


def _rivals(rows: list[ResultRow], presets: dict[str, Results]) -> list[TablePart]:
    """Presets beside each other, and baselines beside the learned policies."""
    parts = []
    if len(presets) > 1:
        header, lines = comparison_rows(presets)
        table = Table(tuple(header), [tuple(line) for line in lines])
        parts.append(TablePart("presets", "Presets side by side", "Mean Fixed success.", table))
    for name, results in presets.items():
        baselines = baselines_of([row for row in rows if row.preset == name])
        if baselines:
            header, lines = comparison_rows({"learned": results, **baselines})
            table = Table(tuple(header), [tuple(line) for line in lines])
            title = "Learned policies beside rules that learn nothing"
            parts.append(TablePart(f"rivals-{len(parts)}", f"{title}, preset {name}", BASELINES_NOTE, table))
    return parts


def _running_table(running: list[_Unfinished]) -> TablePart:
    lines = [
        (
            cell.name,
            f"{cell.env_steps:,} of {cell.total_env_steps:,}",
            "–" if cell.success is None else f"{100 * cell.success:.1f} %",
        )
        for cell in running
    ]
    header = ("cell", "env steps", "success, newest evaluation")
    return TablePart("running", "Cells under way", "Begun and not done yet.", Table(header, lines))
