"""Calls under way: what each is for, whose it is, and who is late."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import NamedTuple

from actors.service.fault_policy import CallFailed, Component, ComponentFailed, ComponentKind, Fault
from actors.service.rpc import Ref


class Pending(NamedTuple):
    """A call under way: its kind, the part that works on it, and what is needed to take its result."""

    kind: str
    component: Component
    incarnation: int
    amount: int

    def failed(self, failure: CallFailed) -> ComponentFailed:
        """The failure as one of the part."""
        return ComponentFailed(self.component, self.incarnation, failure.fault, failure.reason)


class UnderWay:
    """The calls that the training loop waits for, and the blocks that rollout workers have not reported.

    Args:
      workers: number of rollout workers.
      deadline_s: a part that owes an answer and is silent for so long is late.
      start_deadline_s: the same for a part that has not answered yet, for it may still be starting.
      clock: seconds.
    """

    def __init__(
        self, workers: int, deadline_s: float, start_deadline_s: float, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._deadline_s = deadline_s
        self._start_deadline_s = max(deadline_s, start_deadline_s)
        self._clock = clock
        self._calls: dict[Ref, Pending] = {}
        self._owing_since_s: dict[Component, float] = {}
        self._started: set[Component] = set()
        self.collects = [0] * workers
        self.blocks = [0] * workers

    def __len__(self) -> int:
        """Calls under way."""
        return len(self._calls)

    @property
    def refs(self) -> list[Ref]:
        """The calls' references, oldest first."""
        return list(self._calls)

    @property
    def blocks_in_flight(self) -> int:
        """Blocks ordered and not yet reported."""
        return sum(self.blocks)

    def count(self, kind: str) -> int:
        """Calls of a kind under way."""
        return sum(pending.kind == kind for pending in self._calls.values())

    def add(self, ref: Ref, pending: Pending) -> None:
        """Notes a call that was started."""
        self._calls[ref] = pending
        self._owing_since_s.setdefault(pending.component, self._clock())
        if pending.kind == "collect":
            self.collects[pending.component.number] += 1
            self.blocks[pending.component.number] += 1

    def take(self, ref: Ref) -> Pending | None:
        """The call behind `ref`, which has ended; None if it was forgotten with its part."""
        pending = self._calls.pop(ref, None)
        if pending is None:
            return None
        self.heard(pending.component)
        if pending.kind == "collect":
            self.collects[pending.component.number] -= 1
        if any(other.component == pending.component for other in self._calls.values()):
            self._owing_since_s[pending.component] = self._clock()
        else:
            del self._owing_since_s[pending.component]
        return pending

    def heard(self, part: Component) -> None:
        """Notes that a part has started: it has answered. Every evaluation starts anew."""
        if part.kind is not ComponentKind.EVALUATOR:
            self._started.add(part)

    def forget(self, part: Component) -> list[Ref]:
        """Drops all calls of a part that is being replaced, and the blocks that it owes; returns their references."""
        refs = [ref for ref, pending in self._calls.items() if pending.component == part]
        for ref in refs:
            del self._calls[ref]
        self._owing_since_s.pop(part, None)
        self._started.discard(part)
        if part.kind is ComponentKind.WORKER:
            self.collects[part.number] = self.blocks[part.number] = 0
        return refs

    def patience_s(self) -> float:
        """Seconds until the next part is late."""
        now_s = self._clock()
        ends_s = [since_s + self.patience_with(part) for part, since_s in self._owing_since_s.items()]
        return max(0.0, min(ends_s, default=now_s) - now_s)

    def patience_with(self, part: Component) -> float:
        """How long the part may be silent."""
        return self._deadline_s if part in self._started else self._start_deadline_s

    def late(self, ready: list[Ref]) -> list[ComponentFailed]:
        """The parts that are late, each with a call that it owes; none that has answered with one of `ready`."""
        now_s = self._clock()
        answered = {self._calls[ref].component for ref in ready}
        owing_s = {part: now_s - since_s for part, since_s in self._owing_since_s.items() if part not in answered}
        late = {part for part, seconds in owing_s.items() if seconds >= self.patience_with(part)}
        owed = {pending.component: pending for pending in self._calls.values() if pending.component in late}
        return [
            pending.failed(CallFailed(Fault.LATE, f"{pending.kind}: silent for {self.patience_with(part):.0f} s"))
            for part, pending in owed.items()
        ]
