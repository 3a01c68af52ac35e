"""What a person sees of a running sweep: a table of all cells that stays in place, or plain lines in a log."""

from __future__ import annotations

import time
from types import TracebackType
from typing import Self

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.table import Table

from actors.evaluation.result_table import LEARNED, ResultRow
from learner.sweep.grid import Cell

REFRESHES_PER_S = 2.0


class SweepBoard:
    """The state of every cell. Use as a context; what happens is told by key.

    Args:
      console: where to show it.
      cells: all cells.
      done: results of those that are done, by key.
    """

    def __init__(self, console: Console, cells: list[Cell], done: dict[str, list[ResultRow]]) -> None:
        self._console = console
        self._cells = {cell.key: cell for cell in cells}
        self._rates = {key: _success(rows) for key, rows in done.items()}
        self._steps: dict[str, int] = {}
        self._failures: dict[str, str] = {}
        self._start_s = time.monotonic()
        self._weight_before = self._weight_done()

    def __enter__(self) -> Self:
        """Nothing to set up."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Nothing to put back."""

    def started(self, key: str) -> None:
        """A cell trains."""
        self._steps[key] = 0
        self._failures.pop(key, None)

    def progressed(self, key: str, env_steps: int) -> None:
        """A cell has trained on."""
        self._steps[key] = env_steps

    def finished(self, key: str, rows: list[ResultRow]) -> None:
        """A cell is done."""
        self._steps.pop(key, None)
        self._rates[key] = _success(rows)
        self.say(f"{self._cells[key].name}: success {self._rates[key]:.1%}  {self.summary()}")

    def failed(self, key: str, reason: str) -> None:
        """A cell has crashed for the last time."""
        self._steps.pop(key, None)
        self._failures[key] = reason
        self.say(f"{self._cells[key].name} failed: {reason}")

    def say(self, text: str) -> None:
        """A line for people who read a log."""
        self._console.print(text, markup=False, highlight=False, soft_wrap=True)

    def failures(self) -> list[str]:
        """One line for each cell that has failed."""
        return [f"{self._cells[key].name}: {reason}" for key, reason in self._failures.items()]

    def _share(self, key: str) -> float:
        """How much of a cell is done; training counts as nine tenths of it."""
        if key in self._rates:
            return 1.0
        return 0.9 * min(1.0, self._steps.get(key, 0) / self._cells[key].config.total_env_steps)

    def _weight_done(self) -> float:
        return sum(cell.weight * self._share(key) for key, cell in self._cells.items())

    def left_s(self) -> float | None:
        """Seconds that the rest will take at the pace so far; None before there is one."""
        done, total = self._weight_done(), sum(cell.weight for cell in self._cells.values())
        gained = done - self._weight_before
        return (total - done) * (time.monotonic() - self._start_s) / gained if gained > 0 else None

    def summary(self) -> str:
        """Cells done, running and failed, and the time left."""
        left_s = self.left_s()
        left = "" if left_s is None else f", {left_s / 60:.0f} min left"
        failed = f", {len(self._failures)} failed" if self._failures else ""
        return f"[{len(self._rates)} of {len(self._cells)} cells, {len(self._steps)} running{failed}{left}]"

    def table(self) -> Table:
        """Success rates, robots x policy down, groups across; mean over the seeds that are done."""
        worlds = [cell.config.world for cell in self._cells.values()]
        groups, robots = sorted({world.groups for world in worlds}), sorted({world.robots for world in worlds})
        table = Table(title="success rate", title_justify="left")
        table.add_column("policy")
        table.add_column("robots", justify="right")
        for count in groups:
            table.add_column(f"{count} group{'s' if count > 1 else ''}", justify="right")
        for kind in dict.fromkeys(_kind(cell) for cell in self._cells.values()):
            for count in robots:
                table.add_row(kind, str(count), *(self._cell_text(kind, count, groups_of) for groups_of in groups))
            table.add_section()
        return table

    def _cell_text(self, kind: str, robots: int, groups: int) -> str:
        place = (kind, robots, groups)
        keys = [
            key
            for key, cell in self._cells.items()
            if (_kind(cell), cell.config.world.robots, cell.config.world.groups) == place
        ]
        rates = [self._rates[key] for key in keys if key in self._rates]
        parts = [f"{sum(rates) / len(rates):.1%}"] if rates else []
        parts += [f"▸{self._share(key):.0%}" for key in keys if key in self._steps]
        parts += ["failed" for key in keys if key in self._failures]
        missing = len(keys) - len(rates)
        if rates and missing:
            parts.append(f"({len(rates)}/{len(keys)})")
        return " ".join(parts) or "·"


class LiveBoard(SweepBoard):
    """The table, drawn again as things happen."""

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
        """Stops drawing."""
        self._live.stop()

    def say(self, text: str) -> None:
        """The table says it."""

    def _render(self) -> RenderableType:
        return Group(self.table(), self.summary())


def _kind(cell: Cell) -> str:
    """What stands in a row of the table: a method, or a baseline in a method's world."""
    method = cell.config.world.method_name
    return method if cell.policy == LEARNED else f"{cell.policy}, {method}"


def _success(rows: list[ResultRow]) -> float:
    fixed = next(row for row in rows if row.is_fixed)
    return fixed.goal / fixed.episodes


def make_board(console: Console, cells: list[Cell], done: dict[str, list[ResultRow]]) -> SweepBoard:
    """The board that suits the console."""
    live = console.is_terminal and not console.is_dumb_terminal
    return (LiveBoard if live else SweepBoard)(console, cells, done)
