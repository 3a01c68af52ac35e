"""The report of a search."""

from __future__ import annotations

from pathlib import Path

from dashboards.analysis.searches import value_text
from dashboards.pages.report_page import ReportContents
from dashboards.plotly_charts.search_charts import front_chart, importances_chart, progress_chart, slices_chart
from deploy.report_data.episode_sources import CombinedEpisodes, EpisodeSource
from deploy.report_data.trainings import fingerprint_of
from deploy.runs.search_results import summary_of
from learner.file_names import STUDY
from learner.search.study import StoredSearch


class SearchSource:
    """A search, running or not.

    Args:
      folder: the search's folder.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.title = f"Search {folder.absolute().name}"
        self.episodes: EpisodeSource = CombinedEpisodes()

    def fingerprint(self) -> object:
        """Changes with the study."""
        return fingerprint_of([self.folder / STUDY])

    def contents(self) -> ReportContents:
        """The report's contents as of now."""
        stored = StoredSearch(self.folder)
        search, found = stored.search, summary_of(stored)
        states = [trial.state for trial in found.trials]
        counts = {state: states.count(state) for state in ("complete", "pruned", "failed", "running")}
        facts = [("trials", str(len(states))), *((state, str(count)) for state, count in counts.items() if count)]
        for place, name in enumerate(found.objectives):
            facts += [(f"best {name}", value_text(name, found.best_so_far(place)[-1][1]))] if found.complete else []
        charts = [progress_chart(found), front_chart(found), importances_chart(found), slices_chart(found)]
        setups = ", ".join(f"{r}r×{g}g" for r in search.robots for g in search.groups)
        return ReportContents(
            title=self.title,
            subtitle=f"{', '.join(search.space)} for {', '.join(search.labels)}; "
            f"preset {search.preset}, {', '.join(search.methods)}, {setups}, seeds {', '.join(map(str, search.seeds))}",
            made=f"Made by `shoal dashboard` from {STUDY}.",
            facts=facts,
            charts=[chart for chart in charts if chart.views],
            claims={},
            tables=[],
            groups=[],
            episodes_note="",
        )
