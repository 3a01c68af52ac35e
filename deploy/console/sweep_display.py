"""Progress of a running sweep: in a terminal a table of all cells that is redrawn in place, elsewhere plain lines."""

from __future__ import annotations

import time
from types import TracebackType
from typing import Self

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.table import Table

from actors.evaluation.result_table import LEARNED, ResultRow
from deploy.console.terminal import PlainOutput, is_interactive
from learner.sweep.grid import Cell

REFRESHES_PER_S = 2.0
TRAINING_SHARE = 0.9
"""Share of a cell's work that its training is; evaluations are the rest."""


class SweepDisplay(PlainOutput):
    """The state of every cell, in plain lines. A context manager; events name cells by key.

    Args:
      console: where to print.
      cells: all cells.
      done: results of finished cells, by key.
    """

    def __init__(self, console: Console, cells: list[Cell], done: dict[str, list[ResultRow]]) -> None:
        self._console = console
        self._cells = {cell.key: cell for cell in cells}
        self._rates = {key: _success(rows) for key, rows in done.items()}
        self._steps: dict[str, int] = {}
        self._failures: dict[str, str] = {}
        self._start_s = time.monotonic()
        self._weight_before = self._weight_done()

    def started(self, key: str) -> None:
        """A cell has started to train."""
        self._steps[key] = 0
        self._failures.pop(key, None)

    def progressed(self, key: str, env_steps: int) -> None:
        """A cell has trained for `env_steps` so far."""
        self._steps[key] = env_steps

    def finished(self, key: str, rows: list[ResultRow]) -> None:
        """A cell has finished with these results."""
        self._steps.pop(key, None)
        self._rates[key] = _success(rows)
        self.print_line(f"{self._cells[key].name}: success {self._rates[key]:.1%}  {self.summary()}")

    def failed(self, key: str, reason: str) -> None:
        """A cell has failed and is not tried again."""
        self._steps.pop(key, None)
        self._failures[key] = reason
        self.print_line(f"{self._cells[key].name} failed: {reason}")

    def print_line(self, text: str) -> None:
        """Prints a line for a log."""
        self._console.print(text, soft_wrap=True)

    def failures(self) -> list[str]:
        """One line per failed cell."""
        return [f"{self._cells[key].name}: {reason}" for key, reason in self._failures.items()]

    def _share(self, key: str) -> float:
        """Share of a cell's work that is done, in [0, 1]."""
        if key in self._rates:
            return 1.0
        return TRAINING_SHARE * min(1.0, self._steps.get(key, 0) / self._cells[key].config.total_env_steps)

    def _weight_done(self) -> float:
        return sum(cell.weight * self._share(key) for key, cell in self._cells.items())

    def left_s(self) -> float | None:
        """Estimated seconds until the sweep is done, at its pace so far; None before anything is done."""
        done, total = self._weight_done(), sum(cell.weight for cell in self._cells.values())
        gained = done - self._weight_before
        return (total - done) * (time.monotonic() - self._start_s) / gained if gained > 0 else None

    def summary(self) -> str:
        """Numbers of finished, running and failed cells, and the time left."""
        left_s = self.left_s()
        left = "" if left_s is None else f", {left_s / 60:.0f} min left"
        failed = f", {len(self._failures)} failed" if self._failures else ""
        return f"[{len(self._rates)} of {len(self._cells)} cells, {len(self._steps)} running{failed}{left}]"

    def table(self) -> Table:
        """Success rates: a row per policy and robot count, a column per group count; means over finished seeds."""
        worlds = [cell.config.world for cell in self._cells.values()]
        groups, robots = sorted({world.groups for world in worlds}), sorted({world.robots for world in worlds})
        table = Table(title="success rate", title_justify="left")
        table.add_column("policy")
        table.add_column("robots", justify="right")
        for count in groups:
            table.add_column(f"{count} group{'s' if count > 1 else ''}", justify="right")
        for policy in dict.fromkeys(_policy_label(cell) for cell in self._cells.values()):
            for count in robots:
                table.add_row(policy, str(count), *(self._entry(policy, count, group_count) for group_count in groups))
            table.add_section()
        return table

    def _entry(self, policy: str, robots: int, groups: int) -> str:
        """Text of one entry of the table: mean success, and what is running, failed or missing."""
        wanted = (policy, robots, groups)
        keys = [
            key
            for key, cell in self._cells.items()
            if (_policy_label(cell), cell.config.world.robots, cell.config.world.groups) == wanted
        ]
        rates = [self._rates[key] for key in keys if key in self._rates]
        words = [f"{sum(rates) / len(rates):.1%}"] if rates else []
        words += [f"▸{self._share(key):.0%}" for key in keys if key in self._steps]
        words += ["failed" for key in keys if key in self._failures]
        missing = len(keys) - len(rates)
        if rates and missing:
            words.append(f"({len(rates)}/{len(keys)})")
        return " ".join(words) or "·"


class LiveSweepDisplay(SweepDisplay):
    """The same as a table that is redrawn in place."""

    def __init__(self, console: Console, cells: list[Cell], done: dict[str, list[ResultRow]]) -> None:
        super().__init__(console, cells, done)
        self._live = Live(
            get_renderable=self._render, console=console, refresh_per_second=REFRESHES_PER_S, transient=True
        )

    def __enter__(self) -> Self:
        """Starts drawing."""
        self._live.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stops drawing and removes the table."""
        self._live.stop()

    def print_line(self, text: str) -> None:
        """Prints nothing: the table shows the event."""

    def _render(self) -> RenderableType:
        return Group(self.table(), self.summary())


def _policy_label(cell: Cell) -> str:
    """Label of a cell's rows in the table: its method, or its baseline and the method of the world."""
    method = cell.config.world.method_name
    return method if cell.policy == LEARNED else f"{cell.policy}, {method}"


def _success(rows: list[ResultRow]) -> float:
    fixed = next(row for row in rows if row.is_fixed)
    return fixed.goal / fixed.episodes


def make_sweep_display(console: Console, cells: list[Cell], done: dict[str, list[ResultRow]]) -> SweepDisplay:
    """The display that suits the console."""
    return (LiveSweepDisplay if is_interactive(console) else SweepDisplay)(console, cells, done)
