"""What a search has found: its summary for pictures and pages, and its table of trials."""

from __future__ import annotations

import csv
from pathlib import Path

from actors.storage.atomic_write import replacing_file
from dashboards.analysis.searches import SearchedTrial, SearchSummary
from learner.search.space import Range
from learner.search.study import StoredSearch

TABLE, PICTURE, PAGE = "trials.csv", "search.png", "dashboard.html"
"""In a search's folder: its table, its picture, and its page."""


def summary_of(stored: StoredSearch) -> SearchSummary:
    """The search so far."""
    search = stored.search
    return SearchSummary(
        objectives=list(search.labels),
        minimised=stored.minimised,
        trials=[
            SearchedTrial(each.number, each.settings, each.state, each.values, each.reason, each.seconds)
            for each in stored.records()
        ],
        front=stored.front(),
        importances=stored.importances(),
        logarithmic=frozenset(one.name for one in search.dimensions if isinstance(one, Range) and one.log),
    )


def write_trials(folder: Path, stored: StoredSearch) -> None:
    """Writes all trials as a CSV file; an older one is replaced once the new one is complete."""
    names, objectives = [one.name for one in stored.search.dimensions], stored.search.labels
    with replacing_file(folder / TABLE, sync_first=True) as partial:
        with partial.open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(("number", "state", *objectives, *names, "seconds", "reason"))
            for each in stored.records():
                values = each.values or [""] * len(objectives)
                settings = [each.settings.get(name, "") for name in names]
                seconds = "" if each.seconds is None else round(each.seconds, 1)
                writer.writerow((each.number, each.state, *values, *settings, seconds, each.reason))
