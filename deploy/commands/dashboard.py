"""`shoal dashboard`: a sweep or a run as one HTML file, or as a page on 127.0.0.1 that follows it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from dashboards.pages.report_page import report_data, report_page
from dashboards.pages.server import PageServer, episode_number
from deploy.console.serving import serve_until_interrupted
from deploy.console.terminal import plain_console
from deploy.options.results import Dashboard
from deploy.report_data.episode_sources import embedded_episodes
from deploy.report_data.sources import ReportSource, find_report_source
from deploy.runs.folders import make_folder, write_text

MEGABYTE = 1_000_000
FILE_NAME = "dashboard.html"


def run(command: Dashboard) -> int:
    """Writes or serves the report; returns the exit code.

    Raises:
      ConfigError: there is no such sweep or run, it cannot be read, or the file or the port cannot be used.
    """
    source = find_report_source(command.source, command.runs_dir)
    if command.serve:
        return serve_until_interrupted(report_server(source, command.port))
    path = command.out or source.folder / FILE_NAME
    make_folder(path.parent, "--out")
    write_report(source, path, command.episodes, command.episodes_mb)
    plain_console().print(str(path), soft_wrap=True)
    return 0


def write_report(source: ReportSource, path: Path, episodes: int, episodes_mb: float) -> None:
    """Writes the report as a file that opens from disk.

    Args:
      source: what the report is about.
      path: the file; an existing one is replaced atomically.
      episodes: embedded episodes of each policy and outcome.
      episodes_mb: largest size of all embedded episodes, in megabytes.
    """
    contents = source.contents()
    with plain_console(stderr=True).status("playing the episodes that the file embeds"):
        chosen = embedded_episodes(source.episodes, contents.groups, episodes, episodes_mb * MEGABYTE)
    embedded = {key.split("|")[0] for key in chosen}
    note = f"{contents.episodes_note} This file holds {len(chosen)}; `shoal dashboard --serve` plays all."
    groups = [group for group in contents.groups if group.key in embedded]
    data = report_data(contents._replace(groups=groups, episodes_note=note))
    write_text(path, report_page(contents.title, data, chosen, live=False))


class LiveReport:
    """The answers to a served page's requests; the contents are read again when the source has changed.

    Args:
      source: what the report is about.
    """

    def __init__(self, source: ReportSource) -> None:
        self._source = source
        self._fingerprint: object = None
        self._data: dict[str, Any] = {}

    def page(self, query: Mapping[str, str]) -> str:
        """The page."""
        return report_page(self._source.title, self.data(query), {}, live=True)

    def data(self, query: Mapping[str, str]) -> dict[str, Any]:
        """The report's data as of now."""
        fingerprint = self._source.fingerprint()
        if fingerprint != self._fingerprint:
            self._data = report_data(self._source.contents())
            self._fingerprint = fingerprint
        return self._data

    def episode(self, query: Mapping[str, str]) -> dict[str, Any]:
        """The episode with the query's `key`, `outcome` and `number`; see `EpisodeSource.episode` for errors."""
        return self._source.episodes.episode(query.get("key", ""), query.get("outcome", ""), episode_number(query))


def report_server(source: ReportSource, port: int) -> PageServer:
    """The server of a report that follows its source.

    Raises:
      ConfigError: the source cannot be read, or the port is taken.
    """
    report = LiveReport(source)
    report.data({})  # raises before the server starts if the source cannot be read
    return PageServer({"/": report.page, "/data.json": report.data, "/episode.json": report.episode}, port)
