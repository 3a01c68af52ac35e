"""How far a run has come: the driver's counters, accounts and sums, which a checkpoint holds."""

from __future__ import annotations

from typing import Any

from actors.service.messages import BlockReport
from learner.config import RunConfig
from learner.tracking.journal import ACCOUNT
from learner.training.ledger import Ledger
from learner.training.meters import Meters
from learner.training.pacing import Pacer, PacingState
from learner.update.learner_node import UPDATES, UpdateReport


class Progress:
    """Everything that the driver of a run counts.

    Args:
      config: the run.
      pacer: its pacing.
      ledger: its accounts.

    Attributes:
      env_steps, updates: so far.
      update_s: seconds that the learner took for an update, by its last report; 0 before the first.
    """

    def __init__(self, config: RunConfig, pacer: Pacer, ledger: Ledger) -> None:
        self.env_steps = 0
        self.updates = 0
        self.update_s = 0.0
        self.pacer = pacer
        self.ledger = ledger
        self.meters = Meters()
        self._every = {
            "log": config.log_every_env_steps,
            "eval": config.eval_every_env_steps,
            "checkpoint": config.checkpoint_every_env_steps,
        }
        self._due = dict(self._every)

    def record_block(self, report: BlockReport) -> None:
        """Counts a block that a rollout worker reports."""
        self.pacer.record_insert(self.ledger.record_block(report))
        self.meters.record_block(report)
        self.env_steps += report.header.env_steps

    def record_updates(self, report: UpdateReport) -> None:
        """Counts a call of updates."""
        made, self.updates = report.version - self.updates, report.version
        self.meters.record_updates(report, made)
        self.update_s = report.seconds.get(UPDATES, 0.0) / max(made, 1)

    def take_due(self, event: str) -> bool:
        """True once per interval of `event` ("log", "eval" or "checkpoint"); advances its deadline."""
        if self.env_steps < self._due[event]:
            return False
        self._due[event] = (self.env_steps // self._every[event] + 1) * self._every[event]
        return True

    def row(self) -> dict[str, float]:
        """The training metrics since the last row, and the accounts."""
        row = self.meters.row(self.ledger.replay_size, self.pacer.ratio()) | self.ledger.row()
        pacing = self.pacer.state
        counts = {
            "sampled": pacing.sampled,
            "updates": self.updates,
            "waits_to_insert": pacing.waits_to_insert,
            "waits_to_sample": pacing.waits_to_sample,
        }
        return row | {f"{ACCOUNT}{name}": float(count) for name, count in counts.items()}

    def get_state(self) -> dict[str, Any]:
        """A copy of all of it, for JSON."""
        return {
            "env_steps": self.env_steps,
            "updates": self.updates,
            "pacing": self.pacer.state._asdict(),
            "meters": self.meters.get_state(),
            "ledger": self.ledger.get_state(),
            "due": dict(self._due),
        }

    def set_state(self, state: dict[str, Any]) -> None:
        """Restores what `get_state` returned."""
        self.env_steps, self.updates = state["env_steps"], state["updates"]
        self.pacer.state = PacingState(**state["pacing"])
        self.meters.set_state(state["meters"])
        self.ledger.set_state(state["ledger"])
        self._due = {event: int(state["due"][event]) for event in self._due}
