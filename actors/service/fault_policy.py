"""What may fail while a run goes on, and what is done about it: a pure decision table and its memory.

Nothing here knows Ray: failures come in as values, decisions go out as values (the idea is that of
dask.distributed's `worker_state_machine.py`). Calls that may be made twice without harm are tried again; for
all others the part is replaced by a new incarnation, for nobody can say how far the old one came.
"""

from __future__ import annotations

from enum import StrEnum
from typing import NamedTuple

MAX_ATTEMPTS = 5
"""Failures in a row, with nothing done in between, after which a part is given up."""
MAX_RETRIES = 2
"""Failures in a row after which a part that is hard to reach is replaced."""
GIVE_UP_S = 3_600.0
"""Time without a single call done after which a part is given up."""


class ComponentKind(StrEnum):
    """What a run consists of."""

    WORKER = "rollout worker"
    SHARD = "replay shard"
    LEARNER = "learner"
    EVALUATOR = "evaluation"


class Fault(StrEnum):
    """How a call can fail through no fault of the code that it runs."""

    DIED = "died"
    """The process is gone, with its node or alone."""
    LATE = "late"
    """No answer within the deadline: it hangs, is stopped, or was never placed."""
    UNREACHABLE = "unreachable"
    """The connection broke; the process may live and may have done the call."""
    OBJECT_LOST = "object lost"
    """A value that the call needed or gave is gone with the process that held it."""


class Action(StrEnum):
    """What is done about a failure."""

    RETRY = "retry"
    """The same call again."""
    RESTART = "restart"
    """A new incarnation of the part: a worker with the current weights and fresh streams, a shard empty."""
    REBUILD = "rebuild"
    """All parts anew, from the last checkpoint."""
    STOP = "stop"
    """The run ends; `shoal resume` goes on once the cause is mended."""


class Component(NamedTuple):
    """One part of a run."""

    kind: ComponentKind
    number: int = 0

    def __str__(self) -> str:
        """What people call it."""
        return (
            f"{self.kind} {self.number}" if self.kind in (ComponentKind.WORKER, ComponentKind.SHARD) else str(self.kind)
        )


class CallFailed(Exception):
    """A call failed though its code is sound.

    Args:
      fault: how.
      reason: one line for people.
    """

    def __init__(self, fault: Fault, reason: str) -> None:
        super().__init__(fault, reason)
        self.fault = fault
        self.reason = reason


def first_line(error: BaseException) -> str:
    """What an error says, in one line; its kind where it says nothing."""
    return (str(error).strip().splitlines() or [type(error).__name__])[0]


class ComponentFailed(Exception):
    """A part of the run failed.

    Args:
      component: which.
      incarnation: of which of its starts the failure tells.
      fault: how.
      reason: one line for people.
    """

    def __init__(self, component: Component, incarnation: int, fault: Fault, reason: str) -> None:
        super().__init__(component, incarnation, fault, reason)
        self.component = component
        self.incarnation = incarnation
        self.fault = fault
        self.reason = reason

    def __str__(self) -> str:
        """A sentence for people."""
        return f"{self.component} {self.fault} ({self.reason})"


class RunFailed(RuntimeError):
    """A part fails again and again and the run cannot go on; the message says which and how."""


_REPLACE = {
    ComponentKind.WORKER: Action.RESTART,
    ComponentKind.SHARD: Action.RESTART,
    ComponentKind.LEARNER: Action.REBUILD,
    ComponentKind.EVALUATOR: Action.RETRY,
}
"""How a part is replaced. What the learner knows is in checkpoints alone; an evaluation holds nothing."""

_HARMLESS_TWICE = {
    (ComponentKind.SHARD, Fault.UNREACHABLE),  # pushes carry incarnation and sequence number, draws change nothing
    (ComponentKind.SHARD, Fault.OBJECT_LOST),
}


def decide(kind: ComponentKind, fault: Fault, attempts: int, age_s: float) -> Action:
    """What to do about a failure.

    Args:
      kind: the part that failed.
      fault: how.
      attempts: its failures in a row, this one included, since it last did anything.
      age_s: seconds since the first of them.
    """
    if attempts > MAX_ATTEMPTS or age_s > GIVE_UP_S:
        return Action.STOP
    if (kind, fault) in _HARMLESS_TWICE and attempts <= MAX_RETRIES:
        return Action.RETRY
    return _REPLACE[kind]


class Decision(NamedTuple):
    """A decision and the attempts that it rests on."""

    action: Action
    attempts: int


class Recovered(NamedTuple):
    """A part works again: its failures in a row, the last one and its action, and how long it was out."""

    component: Component
    fault: Fault
    action: Action
    attempts: int
    seconds: float


class _Streak(NamedTuple):
    since_s: float
    attempts: int
    fault: Fault
    action: Action


class FaultTracker:
    """Remembers each part's failures in a row, and decides about the next one."""

    def __init__(self) -> None:
        self._streaks: dict[Component, _Streak] = {}

    def failed(self, failure: ComponentFailed, now_s: float) -> Decision:
        """Decides about a failure at `now_s`."""
        before = self._streaks.get(failure.component)
        since_s, attempts = (before.since_s, before.attempts + 1) if before else (now_s, 1)
        action = decide(failure.component.kind, failure.fault, attempts, now_s - since_s)
        self._streaks[failure.component] = _Streak(since_s, attempts, failure.fault, action)
        return Decision(action, attempts)

    def worked(self, component: Component, now_s: float) -> Recovered | None:
        """Notes that `component` has done a call; tells if it had failed before."""
        streak = self._streaks.pop(component, None)
        if streak is None:
            return None
        return Recovered(component, streak.fault, streak.action, streak.attempts, now_s - streak.since_s)
