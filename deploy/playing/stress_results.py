"""What `shoal stress` has played: one zarr store for each player, setup and condition; tables and curves of them."""

from __future__ import annotations

import csv
import hashlib
import json
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from actors.evaluation.conditions import Axis, Condition, along, check_effects, world_under
from actors.evaluation.evaluation_store import StoredEvaluation, entry_seeds, load_evaluation, save_evaluation
from actors.evaluation.statistics import Estimate, success_rate
from actors.policy.policy import WeightsSnapshot
from actors.rollout.env_spec import EnvSpec
from actors.service.messages import EpisodeStats
from actors.storage.atomic_write import replacing_file
from dashboards.figures.stress_curves import Panel
from deploy.playing.players import Target
from learner.config import RunConfig, identity_dict
from sim_core.checks import ConfigError
from sim_core.config import WorldConfig
from sim_core.outcomes import ENDED, Outcome

TABLE, CURVES = "results.csv", "curves.png"
COUNTS = tuple(outcome.name.lower() for outcome in ENDED)


class StressCell(NamedTuple):
    """One player in one setup under one condition."""

    target: Target
    spec: EnvSpec
    setup: str
    condition: Condition


class StressResults:
    """The results of a grid in a folder.

    Args:
      folder: the folder; cells lie in it, named by all that decides their episodes.
      targets: the players, in the order of the tables.
      axes: the grid's axes.
      conditions: the grid's conditions.
      seeds: seeds of the episodes.

    Raises:
      ConfigError: a condition cannot be in a player's world, or an axis changes nothing in any of them.
    """

    def __init__(
        self,
        folder: Path,
        targets: Sequence[Target],
        axes: Sequence[Axis],
        conditions: Sequence[Condition],
        seeds: list[int],
    ) -> None:
        self._folder, self._targets, self._axes = folder, targets, axes
        self._conditions, self._seeds = conditions, seeds
        self._setups = len(targets[0].spec.worlds)
        self._cells = {
            (player, setup, condition): self._cell(target, setup, values)
            for condition, values in enumerate(conditions)
            for setup in range(self._setups)
            for player, target in enumerate(targets)
        }
        check_effects(axes, [cell.spec.world for cell in self._cells.values()])
        self._paths = {at: folder / f"{self._key(cell)}.zarr" for at, cell in self._cells.items()}

    def _cell(self, target: Target, setup: int, condition: Condition) -> StressCell:
        world = target.spec.worlds[setup]
        return StressCell(target, target.spec.of_setup(world_under(world, condition)), world.setup, condition)

    def _key(self, cell: StressCell) -> str:
        """The cell's file, named by a hash of the world, the policy and the seeds."""
        digest = hashlib.sha256(_identity(cell.spec.world).encode())
        digest.update(json.dumps([cell.target.name, self._seeds[0], len(self._seeds)]).encode())
        if isinstance(cell.target.candidate, WeightsSnapshot):
            for array in cell.target.candidate.arrays:
                digest.update(np.ascontiguousarray(array).tobytes())
        name = re.sub(r"[^\w.+=-]+", "-", f"{cell.target.name}-{cell.setup.replace('×', '')}")
        return f"{name}-{digest.hexdigest()[:12]}"

    def __len__(self) -> int:
        """Cells of the grid."""
        return len(self._cells)

    def missing(self) -> list[StressCell]:
        """The cells that have not been played, in the order of the conditions."""
        return [cell for at, cell in self._cells.items() if not self._paths[at].exists()]

    def save(self, cell: StressCell, stats: EpisodeStats) -> None:
        """Stores a cell's episodes, which appear once they are complete."""
        seed = entry_seeds(self._seeds, stats)
        stored = StoredEvaluation(cell.spec, cell.target.name, cell.target.updates, seed, stats)
        save_evaluation(self._folder / f"{self._key(cell)}.zarr", stored)

    def stats(self, player: int, setup: int, condition: int) -> EpisodeStats:
        """The episodes of a cell.

        Raises:
          ConfigError: its store is damaged.
        """
        path = self._paths[player, setup, condition]
        try:
            return load_evaluation(path).stats
        except ValueError as error:
            raise ConfigError(f"{error}; remove {path} and give the same command again") from error

    def goals(self, player: int, setup: int, condition: int) -> NDArray[np.bool_]:
        """Successes `[worlds, learners]` of a cell."""
        outcome = self.stats(player, setup, condition).outcome
        return np.equal(outcome, int(Outcome.GOAL)).reshape(len(self._seeds), -1)

    def setups(self) -> list[str]:
        """The setups' names."""
        return [world.setup for world in self._targets[0].spec.worlds]

    def write_table(self) -> Path:
        """Writes all counts as CSV, a row a cell, with the sum of the episodes' simulator steps; returns its path."""
        path = self._folder / TABLE
        with replacing_file(path, sync_first=True) as partial, partial.open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(["setup", "player", *(axis.name for axis in self._axes), "episodes", *COUNTS, "steps"])
            writer.writerows(self._rows())
        return path

    def _rows(self) -> Iterator[list[object]]:
        for (player, setup, condition), cell in self._cells.items():
            stats = self.stats(player, setup, condition)
            counts = [int((stats.outcome == outcome).sum()) for outcome in ENDED]
            row: list[object] = [cell.setup, cell.target.name, *cell.condition.values(), len(stats.outcome)]
            yield [*row, *counts, int(stats.length_steps.sum())]

    def panels(self) -> list[Panel]:
        """The curves of every player along each axis that has several values, a panel for every setup."""
        return [
            Panel(f"{axis.name}, {name}", axis.values, self._curves(axis, setup))
            for setup, name in enumerate(self.setups())
            for axis in self._axes
            if len(axis.values) > 1
        ]

    def _curves(self, axis: Axis, setup: int) -> dict[str, list[Estimate]]:
        conditions = [list(self._conditions).index(condition) for condition in along(axis, self._axes)]
        return {
            target.name: [success_rate(self.goals(player, setup, condition)) for condition in conditions]
            for player, target in enumerate(self._targets)
        }


def _identity(world: WorldConfig) -> str:
    """All that decides a world's episodes, in a form that does not depend on where a user's files lie."""
    return json.dumps(identity_dict(RunConfig(world=world))["world"], sort_keys=True)
