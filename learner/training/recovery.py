"""Recovery of failed components: carries out what the decision table says, which is retry, restart, rebuild or stop.

A dead replay shard, step by step. By default shards live in the learner's process and die with it: then the run is
rebuilt from the last checkpoint. A shard with a process of its own (`replay_placement = actors`) is noticed when the
learner's call of it fails, or when a worker's push fails: the worker drops that block and reports the shard, and
`check_push` makes a `ComponentFailed` of it. `actors.service.fault_policy.decide` answers RESTART.
`Supervisor.recover` places an empty shard under a new incarnation, subtracts the samples that the lost transitions were
still due, and announces the shard to the learner and to all rollout workers.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Protocol, TypeVar, TypeVarTuple

from actors.policy.policy import WeightsSnapshot
from actors.replay.node import ShardNode
from actors.rollout.node import PushTarget, RolloutNode
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
from actors.service.rpc import Placed, Ref, by_reference
from learner.training.cluster import Cluster
from learner.training.in_flight import InFlight
from learner.training.ledger import Ledger
from learner.training.pacing import Pacer
from learner.update.learner_node import LearnerNode

A = TypeVar("A")
N = TypeVar("N")
T = TypeVar("T")
Ts = TypeVarTuple("Ts")

SLOW = ("load",)
"""Methods that read a component's whole state; they may take as long as a start."""


class RunLost(Exception):
    """A component is gone that only a checkpoint can bring back.

    Args:
      failure: which and how.
      incarnation: the highest that the run has used.
    """

    def __init__(self, failure: ComponentFailed, incarnation: int) -> None:
        super().__init__(str(failure))
        self.incarnation = incarnation


class FaultObserver(Protocol):
    """Hears of failures."""

    def failed(self, failure: ComponentFailed, decision: Decision) -> None:
        """A component failed; `decision` says what is done about it."""
        ...

    def recovered(self, recovered: Recovered) -> None:
        """A component that had failed works again."""
        ...


class Supervisor:
    """Calls the components of a run, knows their incarnations, and replaces those that fail.

    Args:
      cluster: the run's nodes; its lists are kept up to date.
      faults: decides.
      in_flight: the loop's calls; those of a failed component are forgotten.
      pacer, ledger: are told of what was lost.
      observer: hears of failures.
    """

    def __init__(
        self,
        cluster: Cluster,
        faults: FaultTracker,
        in_flight: InFlight,
        pacer: Pacer,
        ledger: Ledger,
        observer: FaultObserver,
    ) -> None:
        self._cluster = cluster
        self._calls = cluster.calls
        self._faults = faults
        self._in_flight = in_flight
        self._pacer = pacer
        self._ledger = ledger
        self._observer = observer
        self._incarnations: dict[Component, int] = {}
        self.highest = cluster.incarnation
        """The highest incarnation so far; whichever component is restarted next gets the one after it."""

    def incarnation(self, component: Component) -> int:
        """The component's present incarnation; the first shards of a session have 0."""
        first = 0 if component.kind is ComponentKind.SHARD else self._cluster.incarnation
        return self._incarnations.get(component, first)

    @property
    def learner(self) -> Placed[LearnerNode]:
        """The learner."""
        return Placed(Component(ComponentKind.LEARNER), self._cluster.incarnation, self._cluster.learner)

    @property
    def workers(self) -> list[Placed[RolloutNode]]:
        """The rollout workers."""
        return [self._worker(worker_id) for worker_id in range(len(self._cluster.workers))]

    def _worker(self, worker_id: int) -> Placed[RolloutNode]:
        component = Component(ComponentKind.WORKER, worker_id)
        return Placed(component, self.incarnation(component), self._cluster.workers[worker_id])

    def _shard(self, index: int) -> Placed[ShardNode]:
        component = Component(ComponentKind.SHARD, index)
        return Placed(component, self.incarnation(component), self._cluster.shards[index])

    def _target(self, index: int) -> Placed[PushTarget]:
        """What rollout workers push to under this index."""
        return self._shard(index) if self._cluster.shards else self.learner

    def ask(self, placed: Placed[N], method: Callable[[N, *Ts], T], *args: *Ts) -> T:
        """Calls a component and waits for the answer.

        Raises:
          ComponentFailed: there is none.
        """
        return self._answer(placed, method.__name__, self._calls.start(placed.node, method, *args))

    def ask_all(self, method: Callable[[N, A], T], arguments: Sequence[tuple[Placed[N], A]]) -> list[T]:
        """Calls several components at once, each with its own argument, and waits for their answers, in order.

        Raises:
          ComponentFailed: one is missing.
        """
        started = [(placed, self._calls.start(placed.node, method, argument)) for placed, argument in arguments]
        return [self._answer(placed, method.__name__, ref) for placed, ref in started]

    def _answer(self, placed: Placed[N], method: str, ref: Ref[T]) -> T:
        component, incarnation, _ = placed
        limits = self._cluster.limits
        deadline_s = limits.start_deadline_s if method in SLOW else self._in_flight.deadline_of(component)
        try:
            if not self._calls.wait([ref], deadline_s):
                raise CallFailed(Fault.LATE, f"silent for {deadline_s:.0f} s")
            answer = self._calls.get(ref)
        except CallFailed as failure:
            raise failure.of(component, incarnation, method) from failure
        self._in_flight.record_answer(component)
        return answer

    def weights_ref(self) -> Ref[WeightsSnapshot]:
        """A reference to the learner's weights, which may not be there yet."""
        return self._calls.start(self._cluster.learner, LearnerNode.weights)

    def check_push(self, report: BlockReport) -> ComponentFailed | None:
        """The failure of the target that a block was pushed to, or None.

        A worker that pushed to a shard that has been replaced is told of the new one.
        """
        target, pushed_to = self._target(report.shard), report.shard_incarnation
        if target.component.kind is ComponentKind.LEARNER:
            pushed_to = target.incarnation
        elif pushed_to < target.incarnation:
            self._announce_shard(self._worker(report.header.worker_id), target)
            return None
        if report.fault is None:
            self.record_success(target.component)
            return None
        return ComponentFailed(target.component, pushed_to, report.fault, "a push to it failed")

    def _announce_shard(self, worker: Placed[RolloutNode], shard: Placed[PushTarget]) -> None:
        """Gives a worker the present incarnation of a shard."""
        index = shard.component.number
        self._calls.start(worker.node, RolloutNode.replace_shard, index, shard.node, shard.incarnation)

    def record_success(self, component: Component) -> None:
        """Records that a component has done a call."""
        recovered = self._faults.record_success(component, time.monotonic())
        if recovered is not None:
            self._observer.recovered(recovered)

    def decide(self, failure: ComponentFailed) -> Action:
        """Asks the decision table what to do about a failure, and tells the observer.

        Returns:
          RETRY or RESTART.

        Raises:
          RunLost: the run must go on from its last checkpoint.
          RunFailed: it cannot go on.
        """
        decision = self._faults.record_failure(failure, time.monotonic())
        self._observer.failed(failure, decision)
        if decision.action is Action.STOP:
            suspect = self._suspect(failure.component)
            times = f"{decision.attempts} times in a row"
            raise RunFailed(f"{failure}, {times}{suspect}; fix the cause, then go on with resume")
        if decision.action is Action.REBUILD:
            raise RunLost(failure, self.highest)
        return decision.action

    def _suspect(self, component: Component) -> str:
        """Names the environment where it is a user's own and runs in the component's process."""
        env = self._cluster.config.env
        plays = component.kind in (ComponentKind.WORKER, ComponentKind.EVALUATOR)
        return f"; env_id {env.env_id!r} may end its process, or not come back" if plays and not env.is_swarm else ""

    def recover(self, failure: ComponentFailed) -> Delivered:
        """Retries or restarts the failed component; does nothing if it has been replaced since.

        Returns:
          What a lost worker had stored without a report.

        Raises:
          RunLost: see `decide`.
          RunFailed: see `decide`.
        """
        component = failure.component
        if failure.incarnation < self.incarnation(component):
            return Delivered()
        if self.decide(failure) is Action.RETRY:
            for ref in self._in_flight.forget(component):
                self._cluster.cancel(ref)  # it may only be late
            return Delivered()
        while True:
            try:
                if component.kind is ComponentKind.WORKER:
                    return self._restart_worker(component.number)
                return self._restart_shard(component.number)
            except ComponentFailed as another:
                if another.component == component:
                    return self.recover(another)
                self.recover(another)

    def _next_incarnation(self) -> int:
        self.highest += 1
        return self.highest

    def _restart_worker(self, worker_id: int) -> Delivered:
        """Fences the lost worker off, and starts a new one with the current weights."""
        cluster, lost, incarnation = self._cluster, self._worker(worker_id), self._next_incarnation()
        cluster.discard(lost.node)
        targets = [self._target(index) for index in range(len(cluster.targets))]
        delivered = [self.ask(target, PushTarget.fence, worker_id, lost.incarnation, incarnation) for target in targets]
        self._incarnations[lost.component] = incarnation
        unreported = self._ledger.write_off_worker(worker_id, delivered)
        self._pacer.record_insert(unreported.rows)
        self._in_flight.forget(lost.component)
        cluster.workers[worker_id] = cluster.place_worker(worker_id, incarnation)
        worker = self._worker(worker_id)
        for target in targets:
            if target.component in self._incarnations:
                self._announce_shard(worker, target)
        self._calls.start(worker.node, RolloutNode.set_weights, by_reference(self.weights_ref()))
        return unreported

    def _restart_shard(self, index: int) -> Delivered:
        """Starts an empty shard, writes the lost transitions off, and announces the shard to learner and workers."""
        cluster, lost = self._cluster, self._shard(index)
        cluster.discard(lost.node)
        self._in_flight.forget(lost.component)
        incarnation = self._incarnations[lost.component] = self._next_incarnation()
        cluster.shards[index] = cluster.place_shard(index, incarnation)
        shard = self._shard(index)
        self.ask(shard, ShardNode.size)  # waits for its start, so that nobody else has to
        self._pacer.write_off(self._ledger.write_off_shard(index, incarnation))
        self.ask(self.learner, LearnerNode.replace_shard, index, shard.node, incarnation)
        for worker in self.workers:
            self._announce_shard(worker, shard)
        return Delivered()
