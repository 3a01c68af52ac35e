"""How a run reacts to failures: a pure decision table, and a tracker of each component's consecutive failures.

The module knows nothing of Ray: failures come in as values, decisions go out as values (the design follows
dask.distributed's `worker_state_machine.py`). A call is retried if running it twice does no harm. Otherwise the
component is replaced by a new incarnation, since nobody can tell how far the old one got.
"""

from __future__ import annotations

from enum import StrEnum
from typing import NamedTuple

MAX_ATTEMPTS = 5
"""Consecutive failures that a run outlives; the next one ends it."""
MAX_RETRIES = 2
"""Consecutive failures after which an unreachable component is replaced instead of retried."""
STEADY_CALLS = 1_000
"""Calls that a component of a run with a foreign environment makes before its failures are forgotten: an environment
that ends its process after a while would else have it restarted for ever."""
GIVE_UP_S = 3_600.0
"""Seconds of failures without a successful call in between after which the run gives up on a component."""


class ComponentKind(StrEnum):
    """The kinds of component in a run."""

    WORKER = "rollout worker"
    SHARD = "replay shard"
    LEARNER = "learner"
    EVALUATOR = "evaluation"


class Fault(StrEnum):
    """How a call can fail although the code that it runs is correct."""

    DIED = "died"
    """The process is gone, alone or with its machine."""
    LATE = "late"
    """No answer within the deadline: the process hangs, is stopped, or was never scheduled."""
    UNREACHABLE = "unreachable"
    """The connection broke. The process may be alive and may have executed the call."""
    OBJECT_LOST = "object lost"
    """An argument or result of the call was lost with the process that held it."""


class Action(StrEnum):
    """The reaction to a failure."""

    RETRY = "retry"
    """Make the same call again."""
    RESTART = "restart"
    """Start a new incarnation: a worker with the current weights and fresh random streams, a shard empty."""
    REBUILD = "rebuild"
    """Start every component again, from the last checkpoint."""
    STOP = "stop"
    """End the run; `shoal resume` continues it once the cause is fixed."""


class Component(NamedTuple):
    """One component of a run; `number` counts the workers, or the shards, from 0."""

    kind: ComponentKind
    number: int = 0

    def __str__(self) -> str:
        """Name for people, such as `rollout worker 3`."""
        is_one_of_several = self.kind in (ComponentKind.WORKER, ComponentKind.SHARD)
        return f"{self.kind} {self.number}" if is_one_of_several else str(self.kind)


class CallFailed(Exception):
    """A call failed although the code that it runs is correct.

    Args:
      fault: how it failed.
      reason: one line for people.
    """

    def __init__(self, fault: Fault, reason: str) -> None:
        super().__init__(fault, reason)
        self.fault = fault
        self.reason = reason

    def of(self, component: Component, incarnation: int, method: str = "") -> ComponentFailed:
        """The failure of this call as one of the component that was called; the reason names `method`, if given."""
        reason = f"{method}: {self.reason}" if method else self.reason
        return ComponentFailed(component, incarnation, self.fault, reason)


def first_line(error: BaseException) -> str:
    """First line of an error's message; the name of its type if the message is empty."""
    return (str(error).strip().splitlines() or [type(error).__name__])[0]


class ComponentFailed(Exception):
    """A component of the run failed.

    Args:
      component: the component.
      incarnation: the incarnation that failed.
      fault: how it failed.
      reason: one line for people.
    """

    def __init__(self, component: Component, incarnation: int, fault: Fault, reason: str) -> None:
        super().__init__(component, incarnation, fault, reason)
        self.component = component
        self.incarnation = incarnation
        self.fault = fault
        self.reason = reason

    def __str__(self) -> str:
        """One sentence for people."""
        return f"{self.component} {self.fault} ({self.reason})"


class RunFailed(RuntimeError):
    """A component keeps failing and the run cannot continue; the message names the component and the fault."""


class Diverged(RunFailed):
    """Numbers of the learner are no longer finite; the message says which."""


_REPLACEMENT = {
    ComponentKind.WORKER: Action.RESTART,
    ComponentKind.SHARD: Action.RESTART,
    ComponentKind.LEARNER: Action.REBUILD,
    ComponentKind.EVALUATOR: Action.RETRY,
}
"""How each kind is replaced. The learner's state survives in checkpoints alone; an evaluation has no state."""

_IDEMPOTENT = {
    (ComponentKind.SHARD, Fault.UNREACHABLE),  # pushes carry incarnation and sequence number, draws change nothing
    (ComponentKind.SHARD, Fault.OBJECT_LOST),
}
"""Failures after which the same call may be made again without harm."""


def decide(kind: ComponentKind, fault: Fault, attempts: int, age_s: float) -> Action:
    """Looks up the reaction to a failure.

    Args:
      kind: kind of the component that failed.
      fault: how it failed.
      attempts: its consecutive failures, this one included.
      age_s: seconds since the first of them.
    """
    if attempts > MAX_ATTEMPTS or age_s > GIVE_UP_S:
        return Action.STOP
    if (kind, fault) in _IDEMPOTENT and attempts <= MAX_RETRIES:
        return Action.RETRY
    return _REPLACEMENT[kind]


class Decision(NamedTuple):
    """The reaction to a failure, and the number of consecutive failures that led to it."""

    action: Action
    attempts: int


class Recovered(NamedTuple):
    """A component works again.

    `fault` and `action` are those of its last failure, `attempts` counts its consecutive failures, and `seconds` is the
    time since the first of them.
    """

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
    calls: int = 0
    """Successful calls since the last failure."""


class FaultTracker:
    """Counts each component's consecutive failures and decides how to react to the next one.

    Args:
      steady_calls: successful calls in a row that end a streak of failures.
    """

    def __init__(self, steady_calls: int = 1) -> None:
        self._steady_calls = steady_calls
        self._streaks: dict[Component, _Streak] = {}

    def record_failure(self, failure: ComponentFailed, now_s: float) -> Decision:
        """Counts a failure at time `now_s` and decides about it."""
        before = self._streaks.get(failure.component)
        since_s = before.since_s if before and not before.calls else now_s
        attempts = before.attempts + 1 if before else 1
        action = decide(failure.component.kind, failure.fault, attempts, now_s - since_s)
        self._streaks[failure.component] = _Streak(since_s, attempts, failure.fault, action)
        return Decision(action, attempts)

    def record_success(self, component: Component, now_s: float) -> Recovered | None:
        """Counts a successful call at time `now_s`; returns None unless it is the first one after a failure."""
        streak = self._streaks.pop(component, None)
        if streak is None:
            return None
        if streak.calls + 1 < self._steady_calls:
            self._streaks[component] = streak._replace(calls=streak.calls + 1)
        if streak.calls:
            return None
        return Recovered(component, streak.fault, streak.action, streak.attempts, now_s - streak.since_s)
