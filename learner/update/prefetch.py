"""Draws the rows of the next call of updates while the learner makes those of this one."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from typing import Generic, TypeVar

Drawn = TypeVar("Drawn")


class DrawAhead(Generic[Drawn]):
    """Draws in a thread, one super-batch ahead.

    Worth its while where shards are processes of their own: the learner need not wait for their answers. One that the
    learner holds itself draws no faster so, as the threads share caches and memory. Priorities must be known before the
    next draw, which therefore cannot be made ahead.

    Rows that are stored during a call of updates can be drawn in the call after the next. Nothing is drawn but between
    `begin` and `settle`, so that whoever stores or saves at another time has the shards for himself.

    Args:
      draw: draws so many rows.
    """

    def __init__(self, draw: Callable[[int], Drawn]) -> None:
        self._draw = draw
        self._thread = ThreadPoolExecutor(1, "shoal-draw")
        self._next: tuple[int, Future[Drawn]] | None = None

    def begin(self, count: int) -> None:
        """Begins to draw `count` rows for the next `take`."""
        self._next = count, self._thread.submit(self._draw, count)

    def settle(self) -> None:
        """Waits until what was begun is drawn, or cannot be."""
        if self._next is not None:
            wait([self._next[1]])

    def take(self, count: int) -> Drawn:
        """`count` rows, drawn ahead if as many were; raises what drawing raised."""
        drawn, self._next = self._next, None
        return drawn[1].result() if drawn is not None and drawn[0] == count else self._draw(count)

    def drop(self) -> None:
        """Forgets what was drawn, or why it could not be: the shards are others now."""
        self._next = None


class DrawWhenAsked(Generic[Drawn]):
    """Draws only when rows are wanted, of all that is stored by then: the same rows whatever the threads do.

    Args:
      draw: draws so many rows.
    """

    def __init__(self, draw: Callable[[int], Drawn]) -> None:
        self.take = draw

    def begin(self, count: int) -> None:
        """Draws nothing."""

    def settle(self) -> None:
        """There is nothing to wait for."""

    def drop(self) -> None:
        """There is nothing to forget."""
