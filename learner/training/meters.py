"""Running sums between two rows of training metrics, as state that a checkpoint holds."""

from __future__ import annotations

import time
from typing import Any

import psutil

from actors.service.messages import ACTS, NO_OUTCOME, STORES, WAITS, BlockReport
from learner.update.learner_node import PUBLISHES, SAMPLES, UPDATES, UpdateReport
from sim_core.outcomes import Outcome

HOPS = {"worker": (ACTS, STORES, WAITS), "learner": (UPDATES, SAMPLES, PUBLISHES, STORES, WAITS)}
"""How a component's time is split; the shares sum to 1, for all rollout workers together and for the learner."""


class Meters:
    """Sums up what has happened since the last row."""

    def __init__(self) -> None:
        self._sums: dict[str, float] = {}
        self._epsilon = 0.0
        self._start_s = time.perf_counter()
        self._measured = {"env_steps": 0.0, "updates": 0.0}

    def start_clock(self) -> None:
        """Starts the interval over which the next row's speeds are measured."""
        self._start_s = time.perf_counter()

    def _add(self, **values: float) -> None:
        for name, value in values.items():
            self._sums[name] = self._sums.get(name, 0.0) + value

    def record_block(self, report: BlockReport) -> None:
        """Counts a stored block."""
        self._epsilon = report.header.epsilon
        episodes = report.episodes
        self._add(blocks=1, staleness_updates=report.staleness_updates, staleness_s=report.staleness_s)
        self._add(
            episodes=len(episodes.outcome),
            episode_return=float(episodes.episode_return.sum()),
            episode_length=float(episodes.length_steps.sum()),
            named=float((episodes.outcome != NO_OUTCOME).sum()),
            successes=float((episodes.outcome == Outcome.GOAL).sum()),
        )
        self._measured["env_steps"] += report.header.env_steps
        self._add_seconds("worker", report.seconds)

    def record_updates(self, report: UpdateReport, updates: int) -> None:
        """Counts a call of `updates` updates."""
        stats = report.stats
        self._add(calls=1, loss=stats.loss, q_mean=stats.q_mean, td_error=stats.td_error)
        self._measured["updates"] += updates
        self._add_seconds("learner", report.seconds)

    def _add_seconds(self, component: str, seconds: dict[str, float]) -> None:
        self._add(**{f"{component}_{hop}": value for hop, value in seconds.items()})

    def row(self, replay_size: int, samples_per_insert: float) -> dict[str, float]:
        """The metrics since the last row; resets the sums."""
        metrics = {"train/epsilon": self._epsilon, "replay/size": float(replay_size)}
        metrics["replay/samples_per_insert"] = samples_per_insert
        metrics |= self._means("train/", "episodes", {"return": "episode_return", "episode_length": "episode_length"})
        metrics |= self._means("train/", "named", {"success_rate": "successes"})
        metrics |= self._means("train/", "calls", {"loss": "loss", "q_mean": "q_mean", "td_error": "td_error"})
        staleness = {"staleness_updates": "staleness_updates", "staleness_s": "staleness_s"}
        metrics |= self._means("policy/", "blocks", staleness)
        metrics |= self._shares() | self._speeds()
        self._sums = {}
        return metrics

    def _means(self, prefix: str, count: str, names: dict[str, str]) -> dict[str, float]:
        total = self._sums.get(count, 0.0)
        return {prefix + key: self._sums[name] / total for key, name in names.items()} if total else {}

    def _shares(self) -> dict[str, float]:
        shares: dict[str, float] = {}
        for component, hops in HOPS.items():
            seconds = {f"time/{component}_{hop}": self._sums.get(f"{component}_{hop}", 0.0) for hop in hops}
            total = sum(seconds.values())
            shares |= {name: value / total for name, value in seconds.items()} if total else {}
        return shares

    def _speeds(self) -> dict[str, float]:
        now_s = time.perf_counter()
        elapsed_s = max(now_s - self._start_s, 1e-9)
        speeds = {f"speed/{name}_per_s": count / elapsed_s for name, count in self._measured.items()}
        self._start_s, self._measured = now_s, dict.fromkeys(self._measured, 0.0)
        return speeds | {
            "system/cpu_utilization_percentage": psutil.cpu_percent(),
            "system/system_memory_usage_percentage": psutil.virtual_memory().percent,
        }

    def get_state(self) -> dict[str, Any]:
        """The sums, for JSON; the clock starts anew on resume."""
        return {"sums": dict(self._sums), "epsilon": self._epsilon}

    def set_state(self, state: dict[str, Any]) -> None:
        """Restores what `get_state` returned."""
        self._sums, self._epsilon = dict(state["sums"]), state["epsilon"]
