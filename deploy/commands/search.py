"""`shoal search`: looks for settings with Optuna; after a kill, the same command goes on."""

from __future__ import annotations

import functools
import importlib.util
import sys
from pathlib import Path

from rich.console import Console
from rich.table import Table

from dashboards.analysis.searches import SearchSummary, setting_text, value_text
from dashboards.figures.search_figure import search_figure
from dashboards.figures.style import save_png
from deploy.console.terminal import plain_console
from deploy.options.training import Search
from deploy.runs.folders import check_outlasts_job, check_plain_name, locked, make_folder
from deploy.runs.objectives import Objective, find_objectives
from deploy.runs.search_driver import SearchDriver, SearchPlace, work
from deploy.runs.search_results import PAGE, PICTURE, TABLE, summary_of, write_trials
from learner.file_names import SEARCHES
from learner.search.config import SearchConfig, check_search
from learner.search.study import SearchStudy, TrialRecord
from learner.sweep.tune import run_trials
from learner.tracking.mlflow_run import Tracker

SHOWN = 10
"""The best trials that the last table shows at most."""


def run(command: Search) -> int:
    """Runs a search's missing trials, draws what it has found, and writes its page; returns the exit code.

    Raises:
      ConfigError: an objective, a range, the name or the folder cannot be used, or another command runs the search.
    """
    search, launch = command.search, command.launch
    check_outlasts_job(launch.runs_dir)
    name = launch.name or search.name
    check_plain_name(name)
    objectives = find_objectives(search)
    check_search(search)
    console = plain_console(file=sys.stdout)  # explicitly: sys.stdout is replaced while Tune runs, to drop its output
    if command.dry_run:
        return _estimate(console, command)
    folder = (launch.runs_dir / SEARCHES / name).absolute()
    make_folder(folder, "--runs-dir")
    console.print(f"search {folder}", soft_wrap=True)
    with locked(folder, "search"):
        minimised = [objective.minimised for objective in objectives]
        study = SearchStudy(folder, search, minimised, [objective.source for objective in objectives])
        place = SearchPlace(folder, launch.tracking(), launch.experiment_of("search", name))
        _run_missing(command, objectives, study, place, console)
        return _finish(console, study, place)


class _Listener:
    """Prints a line for every trial, and keeps the table; implements `deploy.runs.search_driver.TrialListener`."""

    def __init__(self, console: Console, study: SearchStudy, folder: Path, at_once: int) -> None:
        self._console = console
        self._study = study
        self._folder = folder
        self._at_once = at_once

    def started(self, number: int) -> None:
        write_trials(self._folder, self._study)

    def ended(self, number: int) -> None:
        write_trials(self._folder, self._study)
        records = self._study.records()
        self.message(f"{_line(self._study.search, records[number])}  {self._summary(records)}")

    def message(self, text: str) -> None:
        self._console.print(text, soft_wrap=True)

    def _summary(self, records: list[TrialRecord]) -> str:
        search, ended = self._study.search, [each for each in records if each.state != "running"]
        if search.hours is not None:
            return f"[{len(ended)} trials, {self._study.spent_s() / 3600:.2f} of {search.hours:g} hours]"
        left = (search.trials or 0) - len(ended)
        seconds = [each.seconds for each in ended if each.seconds]
        time_left = sum(seconds) / len(seconds) * left / min(self._at_once, max(left, 1)) if seconds else 0.0
        return f"[{len(ended)} of {search.trials} trials, {time_left / 60:.0f} min left]"


def _line(search: SearchConfig, record: TrialRecord) -> str:
    settings = ", ".join(f"{name} {setting_text(value)}" for name, value in record.settings.items())
    pairs = zip(search.labels, record.values, strict=False)
    values = ", ".join(f"{name} {value_text(name, value)}" for name, value in pairs)
    return f"trial {record.number}: {settings}: {values or record.reason or record.state}"


def _run_missing(
    command: Search, objectives: list[Objective], study: SearchStudy, place: SearchPlace, console: Console
) -> None:
    root = command.launch.artifact_root()
    for experiment in (place.experiment, place.cells_experiment):  # here, before several processes open them
        Tracker(place.tracking_uri, experiment, root)
    at_once = command.at_once or _cpus()
    listener = _Listener(console, study, place.folder, at_once)
    driver = SearchDriver(command.search, objectives, study, place, listener)
    if study.has_more():
        task = functools.partial(work, command.search, place)
        run_trials(task, driver, command.launch.ray_address(), command.at_once)


def _finish(console: Console, study: SearchStudy, place: SearchPlace) -> int:
    write_trials(place.folder, study)
    found = summary_of(study)
    save_png(search_figure(found, f"Search {place.folder.name}"), place.folder / PICTURE)
    console.print(_best_table(found))
    failed = [trial for trial in found.trials if trial.state == "failed"]
    for trial in failed[:SHOWN]:
        console.print(f"trial {trial.number} failed: {trial.reason}", soft_wrap=True)
    for name in (TABLE, PICTURE):
        console.print(str(place.folder / name), soft_wrap=True)
    _write_page(console, place.folder)
    console.print(f"MLflow experiment {place.experiment!r}", soft_wrap=True)
    return 0 if found.complete else 1


def _write_page(console: Console, folder: Path) -> None:
    """Writes the page, if its charting library is installed."""
    if importlib.util.find_spec("plotly") is None:
        console.print("its page needs the package plotly: pip install 'shoal[dashboard]', then shoal dashboard")
        return
    from deploy.commands.dashboard import write_report
    from deploy.report_data.search_source import SearchSource

    write_report(SearchSource(folder), folder / PAGE, 0, 0.0)
    console.print(str(folder / PAGE), soft_wrap=True)


def _best_table(found: SearchSummary) -> Table:
    """The front, or with one objective the best trials."""
    several = len(found.objectives) > 1
    table = Table(title="front" if several else "best trials", title_justify="left")
    for heading in ("trial", *found.objectives, *found.names):
        table.add_column(heading, justify="right")
    sign = 1.0 if found.minimised[0] else -1.0
    best = sorted(found.complete, key=lambda trial: sign * trial.values[0])
    best = [trial for trial in best if trial.number in found.front or not several]
    for trial in best[:SHOWN]:
        values = [value_text(*pair) for pair in zip(found.objectives, trial.values, strict=True)]
        table.add_row(str(trial.number), *values, *(setting_text(value) for value in trial.settings.values()))
    return table


def _estimate(console: Console, command: Search) -> int:
    """Measures how long a trial takes, and says what that makes of the budget."""
    from learner.search.rates import trial_seconds

    search, at_once = command.search, command.at_once or _cpus()
    with plain_console(stderr=True).status("measuring rates"):
        seconds = sorted(trial_seconds(search))
    span = _minutes(seconds[0]) if len(seconds) == 1 else f"{_minutes(seconds[0])} to {_minutes(seconds[-1])}"
    console.print(f"a trial takes {span} in a process of its own, {at_once} at once", soft_wrap=True)
    mean_s = sum(seconds) / len(seconds)
    if search.trials is not None:
        rounds = -(-search.trials // at_once)
        console.print(f"{search.trials} trials take about {_minutes(rounds * mean_s)}", soft_wrap=True)
    else:
        trials = 3600 * (search.hours or 0.0) * at_once / mean_s
        console.print(f"{search.hours:g} hours suffice for about {trials:.0f} trials", soft_wrap=True)
    return 0


def _minutes(seconds: float) -> str:
    return (
        f"{seconds:.0f} s"
        if seconds < 100
        else f"{seconds / 60:.0f} min"
        if seconds < 6000
        else f"{seconds / 3600:.1f} h"
    )


def _cpus() -> int:
    """CPUs of this machine, on which trials run at once."""
    import psutil

    return len(psutil.Process().cpu_affinity() or [0])
