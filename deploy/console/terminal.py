"""The terminal: a console that shows text as it is, and what displays of progress share."""

from __future__ import annotations

from types import TracebackType
from typing import Any, Self

from rich.console import Console


def plain_console(**options: Any) -> Console:
    """A console that shows text as it is: a path or a name may look like rich's markup or codes of emoji.

    Args:
      **options: those of rich's Console, such as `stderr` or `file`.
    """
    return Console(markup=False, emoji=False, highlight=False, **options)


def is_interactive(console: Console) -> bool:
    """Whether the console is a terminal in which text can be redrawn in place."""
    return console.is_terminal and not console.is_dumb_terminal


class PlainOutput:
    """A display that only prints lines: a context manager that sets up nothing."""

    def __enter__(self) -> Self:
        """Nothing to set up."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Nothing to tear down."""
