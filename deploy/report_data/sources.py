"""Finds what a report is about: a sweep, a search, a table of results, or a run."""

from __future__ import annotations

from pathlib import Path
from typing import Protocol

from dashboards.pages.report_page import ReportContents
from deploy.report_data.episode_sources import EpisodeSource
from deploy.report_data.sweep_source import SweepSource
from learner import file_names
from learner.run_folder import find_run
from sim_core.checks import ConfigError, require


class ReportSource(Protocol):
    """What a report is about."""

    title: str
    folder: Path
    episodes: EpisodeSource

    def fingerprint(self) -> object:
        """A value that changes when the contents do."""
        ...

    def contents(self) -> ReportContents:
        """The report's contents as of now."""
        ...


def find_report_source(name: str, runs_dir: Path) -> ReportSource:
    """The sweep, search or run that a user names: by a table of results, a folder, or a name under `runs_dir`.

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
    for folder in (path, runs_dir / file_names.SEARCHES / name):
        if (folder / file_names.STUDY).is_file():
            from deploy.report_data.search_source import SearchSource  # imports Optuna

            return SearchSource(folder)
    require(path.suffix != ".csv", f"there is no table of results {name}; name a sweep, its results.csv, or a run")
    try:
        run = find_run(name, runs_dir)
    except ConfigError as error:
        known = sorted(folder.name for folder in runs_dir.glob(f"{file_names.SWEEPS}/*"))
        hint = f"; sweeps there: {', '.join(known[-5:])}" if known else ""
        raise ConfigError(f"{error}{hint}") from error
    from deploy.report_data.run_source import RunSource  # imports torch

    return RunSource(run)
