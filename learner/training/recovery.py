"""Carries out what the decision table says about a failed part: retry, restart, rebuild or stop."""

from __future__ import annotations

import time
from typing import Any, Protocol

from actors.service.fault_policy import (
    Action,
    CallFailed,
    Component,
    ComponentFailed,
    ComponentKind,
    Decision,
    Fault,
    FaultTracker,
    Recovered,
    RunFailed,
)
from actors.service.messages import BlockReport, Delivered
from actors.service.rpc import Node, Ref
from learner.training.cluster import Cluster
from learner.training.in_flight import UnderWay
from learner.training.ledger import Ledger
from learner.training.pacing import Pacer

SLOW = ("load",)
"""Calls that read the whole of a part."""


class RunLost(Exception):
    """A part is gone that only a checkpoint can bring back.

    Args:
      failure: which and how.
      incarnation: the highest that the run has used.
    """

    def __init__(self, failure: ComponentFailed, incarnation: int) -> None:
        super().__init__(str(failure))
        self.incarnation = incarnation


class FaultObserver(Protocol):
    """What is told of failures."""

    def failed(self, failure: ComponentFailed, decision: Decision) -> None:
        """A part failed, and this will be done about it."""
        ...

    def mended(self, mended: Recovered) -> None:
        """A part that had failed works again."""
        ...


class Mender:
    """Knows every part's incarnation, and replaces parts in a running cluster.

    Args:
      cluster: the run's parts; its lists of nodes are kept up to date.
      recovery: decides.
      under_way: the loop's calls.
      pacer: its counters are reconciled with what was lost.
      ledger: its accounts are as well.
      observer: is told.
    """

    def __init__(
        self,
        cluster: Cluster,
        recovery: FaultTracker,
        under_way: UnderWay,
        pacer: Pacer,
        ledger: Ledger,
        observer: FaultObserver,
    ) -> None:
        self._cluster = cluster
        self._recovery = recovery
        self._under_way = under_way
        self._pacer = pacer
        self._ledger = ledger
        self._observer = observer
        self._incarnations: dict[Component, int] = {}
        self.highest = cluster.incarnation
        """The highest incarnation so far; the next restart, of whichever part, gets the one after."""

    def incarnation(self, part: Component) -> int:
        """The part's present incarnation: of a shard, 0 for its first in this sitting."""
        return self._incarnations.get(part, 0 if part.kind is ComponentKind.SHARD else self._cluster.incarnation)

    def node(self, part: Component) -> Node:
        """Where the part is."""
        if part.kind is ComponentKind.LEARNER:
            return self._cluster.learner
        return (self._cluster.workers if part.kind is ComponentKind.WORKER else self._cluster.targets)[part.number]

    @property
    def workers(self) -> list[Component]:
        """The rollout workers."""
        return [Component(ComponentKind.WORKER, worker_id) for worker_id in range(len(self._cluster.workers))]

    def ask(self, part: Component, method: str, *args: Any) -> Any:
        """Calls a part and waits for the answer.

        Raises:
          ComponentFailed: there is none.
        """
        return self.ask_all(method, {part: args})[0]

    def ask_all(self, method: str, args: dict[Component, tuple[Any, ...]]) -> list[Any]:
        """Calls several parts at once, each with its own arguments, and waits for their answers, in order.

        Raises:
          ComponentFailed: one is missing.
        """
        refs = {part: self._cluster.calls.start(self.node(part), method, *given) for part, given in args.items()}
        return [self._answer(part, method, ref) for part, ref in refs.items()]

    def _answer(self, part: Component, method: str, ref: Ref) -> Any:
        calls = self._cluster.calls
        patience_s = self._cluster.start_deadline_s if method in SLOW else self._under_way.patience_with(part)
        try:
            if not calls.wait([ref], patience_s):
                raise CallFailed(Fault.LATE, f"silent for {patience_s:.0f} s")
            answer = calls.get(ref)
        except CallFailed as failure:
            reason = f"{method}: {failure.reason}"
            raise ComponentFailed(part, self.incarnation(part), failure.fault, reason) from failure
        self._under_way.heard(part)
        return answer

    def weights_ref(self) -> Ref:
        """A reference to the learner's weights, which may not be there yet."""
        return self._cluster.calls.start(self._cluster.learner, "weights")

    def target(self, index: int) -> Component:
        """What workers push to under this index."""
        return (
            Component(ComponentKind.SHARD, index)
            if self._cluster.shards_are_parts
            else Component(ComponentKind.LEARNER)
        )

    def check_push(self, report: BlockReport) -> ComponentFailed | None:
        """What a worker's push says of where it went; one that went to a replaced shard is told of the new one."""
        target, pushed_to = self.target(report.shard), report.shard_incarnation
        if target.kind is ComponentKind.LEARNER:
            pushed_to = self._cluster.incarnation
        elif pushed_to < self.incarnation(target):
            self._tell(report.header.worker_id, target)
            return None
        if report.fault is None:
            self.worked(target)
            return None
        return ComponentFailed(target, pushed_to, report.fault, "a push to it failed")

    def _tell(self, worker_id: int, shard: Component) -> None:
        """Names a worker the present incarnation of a shard."""
        node, incarnation = self.node(shard), self.incarnation(shard)
        self._cluster.calls.start(self._cluster.workers[worker_id], "replace_shard", shard.number, node, incarnation)

    def worked(self, part: Component) -> None:
        """Notes that a part has done a call."""
        mended = self._recovery.record_success(part, time.monotonic())
        if mended is not None:
            self._observer.mended(mended)

    def decide(self, failure: ComponentFailed) -> Action:
        """Asks the decision table, and tells the observer.

        Returns:
          RETRY or RESTART.

        Raises:
          RunLost: the run must go on from its last checkpoint.
          RunFailed: it cannot go on.
        """
        decision = self._recovery.record_failure(failure, time.monotonic())
        self._observer.failed(failure, decision)
        if decision.action is Action.STOP:
            raise RunFailed(f"{failure}, {decision.attempts} times in a row; mend the cause, then go on with resume")
        if decision.action is Action.REBUILD:
            raise RunLost(failure, self.highest)
        return decision.action

    def mend(self, failure: ComponentFailed) -> Delivered:
        """Does what there is to do about a failure; nothing if the part has been replaced since.

        Args:
          failure: which part, and how.

        Returns:
          What a lost worker had stored without a report.

        Raises:
          RunLost: see `decide`.
          RunFailed: see `decide`.
        """
        if failure.incarnation < self.incarnation(failure.component):
            return Delivered()
        if self.decide(failure) is Action.RETRY:
            for ref in self._under_way.forget(failure.component):
                self._cluster.discard(ref)  # it may only be late
            return Delivered()
        while True:
            try:
                if failure.component.kind is ComponentKind.WORKER:
                    return self._restart_worker(failure.component)
                return self._restart_shard(failure.component)
            except ComponentFailed as another:
                if another.component == failure.component:
                    return self.mend(another)
                self.mend(another)

    def _next_incarnation(self) -> int:
        self.highest += 1
        return self.highest

    def _restart_worker(self, part: Component) -> Delivered:
        cluster, index = self._cluster, part.number
        cluster.discard(cluster.workers[index])
        closed, incarnation = self.incarnation(part), self._next_incarnation()
        targets = [self.target(i) for i in range(len(cluster.targets))]
        delivered = [self.ask(target, "fence", index, closed, incarnation) for target in targets]
        self._incarnations[part] = incarnation
        unreported = self._ledger.worker_lost(index, delivered)
        self._pacer.inserted(unreported.rows)
        self._under_way.forget(part)
        worker = cluster.workers[index] = cluster.place_worker(index, incarnation)
        for target in targets:
            if target in self._incarnations:
                self._tell(index, target)
        cluster.calls.start(worker, "set_weights", self.weights_ref())
        return unreported

    def _restart_shard(self, part: Component) -> Delivered:
        cluster, index = self._cluster, part.number
        cluster.discard(cluster.targets[index])
        self._under_way.forget(part)
        incarnation = self._incarnations[part] = self._next_incarnation()
        shard = cluster.targets[index] = cluster.place_shard(index, incarnation)
        self.ask(part, "size")  # others must not wait for it while it starts
        self._pacer.lost(self._ledger.shard_lost(index, incarnation))
        self.ask(Component(ComponentKind.LEARNER), "replace_shard", index, shard, incarnation)
        for worker_id in range(len(cluster.workers)):
            self._tell(worker_id, part)
        return Delivered()
