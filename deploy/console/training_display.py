"""Progress of a running training: in a terminal a progress bar with the newest metrics, elsewhere plain lines."""

from __future__ import annotations

import math
import time
from types import TracebackType
from typing import Self

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from deploy.console.terminal import PlainOutput, is_interactive
from learner.tracking.journal import Row

PLAIN_INTERVAL_S = 5.0
"""Minimum time between two plain lines."""


class LatestMetrics:
    """The newest value of every metric; a row holds only the metrics measured since the last one."""

    def __init__(self) -> None:
        self._values: dict[str, float] = {}

    def update(self, row: Row) -> None:
        """Takes in a row's values."""
        self._values |= row.metrics

    def text(self) -> str:
        """One line: success rate or return in evaluation and in training, env steps/s and updates/s."""
        parts = [self._score("eval"), self._score("train")]
        parts += [
            f"{self._values.get('speed/env_steps_per_s', 0):,.0f} env steps/s",
            f"{self._values.get('speed/updates_per_s', 0):,.0f} updates/s",
        ]
        return "  ".join(part for part in parts if part)

    def _score(self, prefix: str) -> str:
        success = self._values.get(f"{prefix}/success_rate")
        if success is not None:
            return f"{prefix} success {100 * success:.0f}%"
        value = self._values.get(f"{prefix}/return")
        return "" if value is None else f"{prefix} return {value:.1f}"


class PlainDisplay(PlainOutput):
    """Plain lines for logs, at most one per `PLAIN_INTERVAL_S`.

    Args:
      console: where to print.
      total_env_steps: env steps of the whole run.
    """

    def __init__(self, console: Console, total_env_steps: int) -> None:
        self._console = console
        self._total = total_env_steps
        self._latest = LatestMetrics()
        self._first: tuple[float, int] | None = None
        self._last_s = -math.inf

    def row(self, row: Row) -> None:
        """Takes in a row; prints the newest metrics if enough time has passed."""
        self._latest.update(row)
        now_s = time.monotonic()
        self._first = self._first or (now_s, row.env_steps)
        if now_s - self._last_s < PLAIN_INTERVAL_S:
            return
        self._last_s = now_s
        share = row.env_steps / self._total
        line = f"{row.env_steps:,} env steps ({share:.0%})  {self._latest.text()}{self._left(now_s, row.env_steps)}"
        self._console.print(line, soft_wrap=True)

    def _left(self, now_s: float, env_steps: int) -> str:
        start_s, start_steps = self._first or (now_s, env_steps)
        if env_steps <= start_steps:
            return ""
        left_s = (self._total - env_steps) * (now_s - start_s) / (env_steps - start_steps)
        return f"  {max(0.0, left_s):.0f} s left"

    def message(self, text: str) -> None:
        """Prints a line."""
        self._console.print(text, soft_wrap=True)


class LiveDisplay:
    """A progress bar with the newest metrics, redrawn in place.

    Args:
      console: the terminal.
      total_env_steps: env steps of the whole run.
    """

    def __init__(self, console: Console, total_env_steps: int) -> None:
        self._latest = LatestMetrics()
        self._progress = Progress(
            BarColumn(bar_width=24),
            TaskProgressColumn(),
            TimeElapsedColumn(),
            TextColumn("left", markup=False),
            TimeRemainingColumn(),
            TextColumn("{task.fields[metrics]}", markup=False),
            console=console,
        )
        self._task = self._progress.add_task("training", total=total_env_steps, metrics="starting")

    def __enter__(self) -> Self:
        """Starts drawing."""
        self._progress.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stops drawing; the last state stays on the screen."""
        self._progress.stop()

    def row(self, row: Row) -> None:
        """Takes in a row and advances the bar."""
        self._latest.update(row)
        done = max(row.env_steps, self._progress.tasks[0].completed)
        self._progress.update(self._task, completed=done, metrics=self._latest.text())

    def message(self, text: str) -> None:
        """Prints a line above the bar."""
        self._progress.console.print(text)


def make_display(console: Console, total_env_steps: int) -> LiveDisplay | PlainDisplay:
    """The display that suits the console."""
    return (LiveDisplay if is_interactive(console) else PlainDisplay)(console, total_env_steps)
