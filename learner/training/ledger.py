"""The run's accounts: every transition that was produced is stored, or dropped for a reason.

Produced transitions are counted by the rollout workers, stored ones by the shards' replies, dropped ones by the reports
of blocks. The three sources are independent, so produced = stored + dropped holds only if no hop loses or doubles one.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from actors.service.messages import BlockReport, Delivered, Dropped
from learner.tracking.journal import ACCOUNT

ROWS, ENV_STEPS, EPISODES = range(3)


class Ledger:
    """Counts transitions from their production to their storage.

    Args:
      workers: number of rollout workers.
      capacities: transitions that each target of their pushes can hold.

    Attributes:
      produced, stored: transitions so far.
      dropped: transitions so far, by the reason (see `Dropped`).
      episodes: ended episodes so far.
    """

    def __init__(self, workers: int, capacities: list[int]) -> None:
        self.produced = 0
        self.stored = 0
        self.episodes = 0
        self.dropped: dict[str, int] = {reason.value: 0 for reason in Dropped}
        self._capacities = capacities
        self._held = [0] * len(capacities)  # stored by the target's present incarnation, overwritten ones included
        self._shard_incarnations = [0] * len(capacities)
        self._made = [0] * workers  # by the worker's present incarnation, as far as is known
        self._reported = np.zeros((workers, len(capacities), 3), np.int64)  # ROWS, ENV_STEPS, EPISODES by present ones

    @property
    def replay_size(self) -> int:
        """Transitions that the replay holds."""
        return sum(self._sizes())

    def _sizes(self) -> list[int]:
        return [min(held, capacity) for held, capacity in zip(self._held, self._capacities, strict=True)]

    def record_block(self, report: BlockReport) -> int:
        """Books a block; returns how many of its transitions count as stored: none if their shard has been replaced."""
        worker_id = report.header.worker_id
        self._record_made(worker_id, report.header.made)
        self.episodes += len(report.episodes.outcome)
        if report.dropped is not None:
            self.dropped[report.dropped] += report.rows
            return 0
        if report.shard_incarnation < self._shard_incarnations[report.shard]:
            self.dropped[Dropped.SHARD_LOST] += report.rows
            return 0
        self.stored += report.stored
        self._held[report.shard] += report.stored
        booked = (report.stored, report.header.env_steps, len(report.episodes.outcome))
        self._reported[worker_id, report.shard] += booked
        return report.stored

    def _record_made(self, worker_id: int, made: int) -> int:
        """Books that a worker's present incarnation has made `made` transitions in all; returns how many are new."""
        new = max(0, made - self._made[worker_id])
        self._made[worker_id] += new
        self.produced += new
        return new

    def write_off_worker(self, worker_id: int, delivered: list[Delivered]) -> Delivered:
        """Closes the books of a lost worker.

        Args:
          worker_id: which.
          delivered: what each target has stored of it.

        Returns:
          What it had delivered without a report.
        """
        unreported = np.array([each[:3] for each in delivered]) - self._reported[worker_id]
        rows, env_steps, episodes = (int(total) for total in unreported.sum(axis=0))
        new = self._record_made(worker_id, max(each.made for each in delivered))
        self.stored += rows
        self.episodes += episodes
        self.dropped[Dropped.WORKER_LOST] += new - rows
        for shard, count in enumerate(unreported[:, ROWS].tolist()):
            self._held[shard] += count
        self._reported[worker_id] = 0
        self._made[worker_id] = 0
        return Delivered(rows, env_steps, episodes, 0)

    def write_off_shard(self, shard: int, incarnation: int) -> float:
        """Books that a shard is empty, under its new incarnation; returns the share of the replay that is lost."""
        sizes = self._sizes()
        self._held[shard] = 0
        self._shard_incarnations[shard] = incarnation
        self._reported[:, shard] = 0
        return sizes[shard] / sum(sizes) if sum(sizes) else 0.0

    def row(self) -> dict[str, float]:
        """The accounts as metrics."""
        return {
            f"{ACCOUNT}produced": float(self.produced),
            f"{ACCOUNT}stored": float(self.stored),
            f"{ACCOUNT}dropped": float(sum(self.dropped.values())),
            f"{ACCOUNT}episodes": float(self.episodes),
        }

    def get_state(self) -> dict[str, Any]:
        """The sums, for JSON; the counts by incarnation start anew on resume."""
        return {
            "produced": self.produced,
            "stored": self.stored,
            "episodes": self.episodes,
            "dropped": dict(self.dropped),
            "held": list(self._held),
        }

    def set_state(self, state: dict[str, Any]) -> None:
        """Restores what `get_state` returned."""
        self.produced, self.stored, self.episodes = state["produced"], state["stored"], state["episodes"]
        self.dropped |= state["dropped"]
        self._held = list(state["held"])
