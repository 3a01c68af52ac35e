"""Prefetching: the rows of the next call of updates are drawn while the learner makes those of this one."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from typing import Generic, TypeVar

Drawn = TypeVar("Drawn")


class Prefetch(Generic[Drawn]):
    """Draws one super-batch ahead, in a thread.

    The learner then waits neither for the replies of shards that are nodes of their own, nor for draws from those that
    it embeds: updates and draws leave Python's lock to each other. Prioritised shards cannot be prefetched from: the
    next draw needs the priorities that this call of updates sets. In one process nothing is drawn ahead, so that runs
    are reproducible.

    Rows that are stored during one call of updates can be drawn in the call after the next. No draw runs outside
    `begin` ... `settle`, so whoever stores or saves at another time has exclusive access to the shards.

    Args:
      draw: draws a given number of rows.
    """

    def __init__(self, draw: Callable[[int], Drawn]) -> None:
        self._draw = draw
        self._thread = ThreadPoolExecutor(1, "shoal-draw")
        self._next: tuple[int, Future[Drawn]] | None = None

    def begin(self, count: int) -> None:
        """Starts to draw `count` rows for the next `take`."""
        self._next = count, self._thread.submit(self._draw, count)

    def settle(self) -> None:
        """Waits until the draw has ended, with or without an error."""
        if self._next is not None:
            wait([self._next[1]])

    def take(self, count: int) -> Drawn:
        """The prefetched rows if they are `count`, else `count` rows drawn now; raises what drawing them raised."""
        drawn, self._next = self._next, None
        return drawn[1].result() if drawn is not None and drawn[0] == count else self._draw(count)

    def drop(self) -> None:
        """Forgets the prefetched rows, or the error of drawing them: the shards have changed."""
        self._next = None


class NoPrefetch(Generic[Drawn]):
    """Draws when rows are wanted, from all that is stored by then: deterministic, whatever the threads do.

    Args:
      draw: draws a given number of rows.
    """

    def __init__(self, draw: Callable[[int], Drawn]) -> None:
        self.take = draw

    def begin(self, count: int) -> None:
        """Draws nothing."""

    def settle(self) -> None:
        """Waits for nothing."""

    def drop(self) -> None:
        """Forgets nothing."""
