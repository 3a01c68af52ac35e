"""The report of one run."""

from __future__ import annotations

from dashboards.pages.report_page import ReportContents
from dashboards.plotly_charts.run_charts import run_curves, run_speeds
from deploy.report_data.episode_sources import CombinedEpisodes, EpisodeSource
from deploy.report_data.recorded_episodes import RecordedEpisodes
from deploy.report_data.run_episodes import RunEpisodes
from deploy.report_data.trainings import fingerprint_of, journal_rows, training_of
from deploy.runs.policy_lookup import policy_fingerprint
from learner.run_folder import RunFolder

EPISODES_NOTE = (
    "Greedy episodes of the newest policy on evaluation seeds, and recorded episodes. Choose how the episode ended."
)


class RunSource:
    """One run, training or finished.

    Args:
      folder: the run's folder.
    """

    def __init__(self, folder: RunFolder) -> None:
        self.folder = folder.path
        self.title = f"Run {folder.path.name}"
        self._run = folder
        played: list[EpisodeSource] = [RunEpisodes(folder)] if folder.config().env.is_swarm else []
        self.episodes: EpisodeSource = CombinedEpisodes(*played, RecordedEpisodes(folder.path, folder.artifacts))

    def fingerprint(self) -> object:
        """Changes with the journal and the newest policy."""
        return fingerprint_of([self._run.journal]), policy_fingerprint(self._run)

    def contents(self) -> ReportContents:
        """The report's contents as of now."""
        config, training, rows = self._run.config(), training_of(self._run), journal_rows(self._run)
        done = max((row.env_steps for row in rows), default=0)
        facts = [("env steps", f"{done:,} of {config.total_env_steps:,}")]
        if training.curve:
            newest = training.curve[-1]
            name = "success in the newest evaluation" if training.is_share else "mean return in the newest evaluation"
            value = f"{100 * newest.value:.1f} %" if training.is_share else f"{newest.value:.1f}"
            facts.append((name, value))
        charts = [run_curves(training), run_speeds(training)]
        return ReportContents(
            title=self.title,
            subtitle=f"{config.name}, {config.engine} engine",
            made="Made by `shoal dashboard` from the run’s journal and newest policy. Rates with 95 % intervals.",
            facts=facts,
            charts=[chart for chart in charts if chart.views],
            claims={},
            tables=[],
            groups=self.episodes.groups(),
            episodes_note=EPISODES_NOTE,
        )
