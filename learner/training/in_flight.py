"""Calls in flight: what each is for, which component makes it, and who is late."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable
from typing import Any, Generic, NamedTuple, TypeVar

from actors.service.fault_policy import CallFailed, Component, ComponentFailed, ComponentKind, Fault
from actors.service.rpc import Ref

T = TypeVar("T")


class PendingCall(NamedTuple, Generic[T]):
    """A call in flight.

    Attributes:
      method: name of what was called, for people.
      component, incarnation: who makes the call.
      ref: refers to its result.
      take: is called with the result.
      updates: how many are asked for, if any are.
    """

    method: str
    component: Component
    incarnation: int
    ref: Ref[T]
    take: Callable[[T], None]
    updates: int = 0


class InFlight:
    """The calls that the training loop waits for, and the blocks that rollout workers have not reported.

    Args:
      workers: number of rollout workers.
      deadline_s: a component is late once it owes an answer for so long.
      start_deadline_s: the same for a component that has never answered: it may still be starting.
      clock: seconds.
    """

    def __init__(
        self, workers: int, deadline_s: float, start_deadline_s: float, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._deadline_s = deadline_s
        self._start_deadline_s = max(deadline_s, start_deadline_s)
        self._clock = clock
        self._calls: dict[Ref[Any], PendingCall[Any]] = {}
        self._counts: Counter[Component] = Counter()
        self._owing_since_s: dict[Component, float] = {}
        self._started: set[Component] = set()
        self.blocks = [0] * workers
        """Blocks that each rollout worker was told to collect and has not reported."""

    def __len__(self) -> int:
        """Calls in flight."""
        return len(self._calls)

    @property
    def refs(self) -> list[Ref[Any]]:
        """References to the calls' results, oldest first."""
        return list(self._calls)

    @property
    def blocks_in_flight(self) -> int:
        """Blocks of all rollout workers together."""
        return sum(self.blocks)

    @property
    def most_of_one(self) -> int:
        """The highest number of calls that one component has in flight."""
        return max(self._counts.values(), default=0)

    def count(self, component: Component) -> int:
        """Calls of a component in flight; those of a rollout worker collect a block each."""
        return self._counts[component]

    def add(self, call: PendingCall[Any]) -> None:
        """Adds a call that was started."""
        self._calls[call.ref] = call
        self._counts[call.component] += 1
        self._owing_since_s.setdefault(call.component, self._clock())
        if call.component.kind is ComponentKind.WORKER:
            self.blocks[call.component.number] += 1

    def take(self, ref: Ref[Any]) -> PendingCall[Any] | None:
        """Removes and returns the call behind `ref`, which has ended; None if its component was forgotten."""
        call = self._calls.pop(ref, None)
        if call is None:
            return None
        self._counts[call.component] -= 1
        self.record_answer(call.component)
        if self._counts[call.component]:
            self._owing_since_s[call.component] = self._clock()
        else:
            del self._owing_since_s[call.component]
        return call

    def record_answer(self, component: Component) -> None:
        """Records that a component has started, since it has answered; each evaluation starts anew."""
        if component.kind is not ComponentKind.EVALUATOR:
            self._started.add(component)

    def forget(self, component: Component) -> list[Ref[Any]]:
        """Removes all calls of a component that is being replaced, and the blocks that it owes; returns the calls."""
        refs = [ref for ref, call in self._calls.items() if call.component == component]
        for ref in refs:
            del self._calls[ref]
        del self._counts[component]
        self._owing_since_s.pop(component, None)
        self._started.discard(component)
        if component.kind is ComponentKind.WORKER:
            self.blocks[component.number] = 0
        return refs

    def time_left_s(self) -> float:
        """Seconds until the next component is late."""
        now_s = self._clock()
        ends_s = [since_s + self.deadline_of(component) for component, since_s in self._owing_since_s.items()]
        return max(0.0, min(ends_s, default=now_s) - now_s)

    def deadline_of(self, component: Component) -> float:
        """Seconds for which the component may owe an answer."""
        return self._deadline_s if component in self._started else self._start_deadline_s

    def late(self, ready: list[Ref[Any]]) -> list[ComponentFailed]:
        """The failures of all components that are late, except those that have answered with one of `ready`."""
        now_s = self._clock()
        answered = {self._calls[ref].component for ref in ready}
        owing_s = {who: now_s - since_s for who, since_s in self._owing_since_s.items() if who not in answered}
        late = {who for who, seconds in owing_s.items() if seconds >= self.deadline_of(who)}
        owed = {call.component: call for call in self._calls.values() if call.component in late}
        return [
            CallFailed(Fault.LATE, f"silent for {self.deadline_of(who):.0f} s").of(who, call.incarnation, call.method)
            for who, call in owed.items()
        ]
