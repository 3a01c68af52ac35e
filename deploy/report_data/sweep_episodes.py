"""The evaluated episodes of a sweep's cells."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from actors.evaluation.result_table import LEARNED, ResultRow, read_table
from actors.policy.baselines import Baseline
from dashboards.analysis.aggregate import Setup
from dashboards.analysis.methods import in_order
from dashboards.pages.report_page import EpisodeGroup
from deploy.report_data.episode_sources import lookup
from learner.file_names import RESULTS
from learner.run_folder import RunFolder
from sim_core.outcomes import ENDED


class Evaluation(NamedTuple):
    """A row of results, and the folder of the cell that evaluated it."""

    folder: RunFolder
    row: ResultRow


class SweepEpisodes:
    """The evaluated episodes of a sweep's cells. Their seeds are stored; the same seed plays the same episode.

    Args:
      cells: the folder of the cells; it may be missing.
    """

    def __init__(self, cells: Path) -> None:
        self._cells = cells
        self._evaluations: dict[str, Evaluation] = {}

    def groups(self) -> list[EpisodeGroup]:
        """One group per policy and setup: learned policies first, in the order of methods and setups."""
        self._evaluations = dict(sorted(self._found(), key=lambda item: _order(item[1].row)))
        return [_group(key, evaluation.row) for key, evaluation in self._evaluations.items()]

    def _found(self) -> Iterator[tuple[str, Evaluation]]:
        for table in sorted(self._cells.glob(f"*/{RESULTS}")):
            folder = RunFolder(table.parent)
            for row in read_table(table):
                if row.policy in list(Baseline) or folder.policy.is_file():
                    yield f"{folder.path.name}/{row.robots}r{row.groups}g", Evaluation(folder, row)

    def episode(self, key: str, outcome: str, number: int) -> dict[str, Any]:
        """Plays the episode again."""
        from deploy.report_data.replay import replay  # imports torch

        evaluation = lookup(self._evaluations, key)
        return replay(evaluation.folder, evaluation.row, outcome, number)


def _order(row: ResultRow) -> tuple[object, ...]:
    trained, played = (row.trained_robots, row.trained_groups), (row.robots, row.groups)
    method = in_order([row.method]).index(row.method), row.method
    return row.preset, row.policy != LEARNED, row.policy, method, trained, row.seed, trained != played, played


def _group(key: str, row: ResultRow) -> EpisodeGroup:
    return EpisodeGroup(
        key=key,
        preset=row.preset,
        policy=row.policy,
        method=row.method,
        trained=str(Setup(row.trained_robots, row.trained_groups)),
        seed=str(row.seed),
        played=str(Setup(row.robots, row.groups)),
        counts={outcome.name.lower(): row.count(outcome) for outcome in ENDED},
    )
