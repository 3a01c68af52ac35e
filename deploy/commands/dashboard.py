"""`shoal dashboard`: a sweep or a run as one HTML file, or as a page on 127.0.0.1 that follows it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console

from dashboards.pages.report_page import report_data, report_page
from dashboards.pages.server import PageServer
from deploy.live import episode_number, serve_until_interrupted
from deploy.report_data.episode_sources import samples
from deploy.report_data.sources import Source, find_source
from deploy.runs.folders import make_folder, write_text

if TYPE_CHECKING:
    from deploy.options.results import Dashboard

MEGABYTE = 1_000_000
FILE_NAME = "dashboard.html"


def dashboard(command: Dashboard) -> int:
    """Writes or serves the report; returns the exit code.

    Raises:
      ConfigError: there is no such sweep or run, it cannot be read, or the file or the port cannot be used.
    """
    source = find_source(command.source, command.runs_dir)
    if command.serve:
        return serve_until_interrupted(report_server(source, command.port))
    path = command.out or source.folder / FILE_NAME
    make_folder(path.parent, "--out")
    write_report(source, path, command.episodes, command.episodes_mb)
    Console().print(str(path), highlight=False, soft_wrap=True)
    return 0


def write_report(source: Source, path: Path, episodes: int, episodes_mb: float) -> None:
    """Writes the report as a file that opens from disk.

    Args:
      source: what it is made of.
      path: the file; replaced if it exists, once the new one is whole.
      episodes: episodes of each policy and outcome that it takes with it.
      episodes_mb: megabytes that all of them may take.
    """
    contents = source.contents()
    with Console(stderr=True).status("playing the episodes that the file takes with it"):
        chosen = samples(source.shelf, contents.groups, episodes, episodes_mb * MEGABYTE)
    there = {key.split("|")[0] for key in chosen}
    note = f"{contents.episodes_note} This file holds {len(chosen)}; `shoal dashboard --serve` plays all."
    kept = contents._replace(groups=[group for group in contents.groups if group.key in there], episodes_note=note)
    write_text(path, report_page(contents.title, report_data(kept), chosen, live=False))


class LiveReport:
    """What the served page asks for; made anew when the source has changed.

    Args:
      source: what it is made of.
    """

    def __init__(self, source: Source) -> None:
        self._source = source
        self._state: Any = None
        self._data: dict[str, Any] = {}

    def page(self, query: Mapping[str, str]) -> str:
        """The page."""
        return report_page(self._source.title, self.data(query), {}, live=True)

    def data(self, query: Mapping[str, str]) -> dict[str, Any]:
        """The report's data as things are now."""
        state = self._source.state()
        if state != self._state:
            self._data = report_data(self._source.contents())
            self._state = state
        return self._data

    def episode(self, query: Mapping[str, str]) -> dict[str, Any]:
        """One episode.

        Raises:
          LookupError: there is none such.
        """
        return self._source.shelf.episode(query.get("key", ""), query.get("outcome", ""), episode_number(query))


def report_server(source: Source, port: int) -> PageServer:
    """The server of a report that follows its source.

    Raises:
      ConfigError: the source cannot be read, or the port is taken.
    """
    report = LiveReport(source)
    report.data({})  # refuses at the start what cannot be read
    return PageServer({"/": report.page, "/data.json": report.data, "/episode.json": report.episode}, port)
