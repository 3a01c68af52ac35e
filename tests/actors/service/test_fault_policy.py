"""Every entry of the decision table, and the tracker of consecutive failures."""

import itertools
import pickle

import pytest

from actors.service.fault_policy import (
    GIVE_UP_S,
    MAX_ATTEMPTS,
    MAX_RETRIES,
    Action,
    CallFailed,
    Component,
    ComponentFailed,
    ComponentKind,
    Fault,
    FaultTracker,
    Recovered,
    decide,
)

ATTEMPTS = range(1, MAX_ATTEMPTS + 4)
AGES_S = (0.0, 1.0, GIVE_UP_S, GIVE_UP_S + 0.1, 1e9)
WORKER, SHARD = Component(ComponentKind.WORKER, 1), Component(ComponentKind.SHARD, 0)
LEARNER, EVALUATOR = Component(ComponentKind.LEARNER), Component(ComponentKind.EVALUATOR)

FIRST = """
                died     late     unreachable  object lost
rollout worker  restart  restart  restart      restart
replay shard    restart  restart  retry        retry
learner         rebuild  rebuild  rebuild      rebuild
evaluation      retry    retry    retry        retry
"""
"""The reaction to a first failure, as a person would write it down."""


def written_down():
    lines = [line for line in FIRST.splitlines() if line]
    for line in lines[1:]:
        kind = next(kind for kind in ComponentKind if line.startswith(kind))
        for fault, action in zip(Fault, line.removeprefix(kind).split(), strict=True):
            yield kind, fault, Action(action)


def test_the_table_is_the_one_written_down():
    table = list(written_down())
    assert len(table) == len(ComponentKind) * len(Fault)
    for kind, fault, action in table:
        assert decide(kind, fault, 1, 0.0) is action, (kind, fault)


@pytest.mark.parametrize(("kind", "fault"), list(itertools.product(ComponentKind, Fault)))
def test_every_component_is_given_up_at_the_limits_and_not_before(kind, fault):
    for attempts, age_s in itertools.product(ATTEMPTS, AGES_S):
        stops = decide(kind, fault, attempts, age_s) is Action.STOP
        assert stops == (attempts > MAX_ATTEMPTS or age_s > GIVE_UP_S)


@pytest.mark.parametrize(("kind", "fault"), list(itertools.product(ComponentKind, Fault)))
def test_a_component_is_replaced_after_too_many_retries(kind, fault):
    first = decide(kind, fault, 1, 0.0)
    for attempts in range(1, MAX_ATTEMPTS + 1):
        action = decide(kind, fault, attempts, 0.0)
        if first is Action.RETRY and kind is ComponentKind.SHARD:
            assert action is (Action.RETRY if attempts <= MAX_RETRIES else Action.RESTART)
        else:
            assert action is first


def test_only_idempotent_calls_are_retried():
    for kind, fault, attempts in itertools.product(ComponentKind, Fault, ATTEMPTS):
        if decide(kind, fault, attempts, 0.0) is Action.RETRY:
            assert kind in (ComponentKind.SHARD, ComponentKind.EVALUATOR)


def failure(component, fault=Fault.DIED):
    return ComponentFailed(component, 0, fault, "test")


def test_consecutive_failures_count_until_a_success():
    tracker = FaultTracker()
    assert [tracker.record_failure(failure(WORKER), i).attempts for i in range(3)] == [1, 2, 3]
    assert tracker.record_success(WORKER, 10.0) == Recovered(WORKER, Fault.DIED, Action.RESTART, 3, 10.0)
    assert tracker.record_success(WORKER, 11.0) is None
    assert tracker.record_failure(failure(WORKER), 12.0).attempts == 1


def test_with_steady_calls_failures_are_forgotten_only_after_as_many():
    tracker = FaultTracker(steady_calls=3)
    for attempt in range(1, MAX_ATTEMPTS + 1):
        assert tracker.record_failure(failure(WORKER), 10.0 * attempt).attempts == attempt
        recovered = tracker.record_success(WORKER, 10.0 * attempt + 1)
        assert recovered is not None and (recovered.attempts, recovered.seconds) == (attempt, 1.0)
        assert tracker.record_success(WORKER, 10.0 * attempt + 2) is None
    assert tracker.record_failure(failure(WORKER), 90.0).action is Action.STOP
    tracker = FaultTracker(steady_calls=3)
    tracker.record_failure(failure(WORKER), 0.0)
    for second in range(3):
        tracker.record_success(WORKER, second)
    assert tracker.record_failure(failure(WORKER), 9.0).attempts == 1


def test_a_success_restarts_the_clock_of_failures():
    tracker = FaultTracker(steady_calls=10)
    tracker.record_failure(failure(WORKER), 0.0)
    tracker.record_success(WORKER, 1.0)
    assert tracker.record_failure(failure(WORKER), 2 * GIVE_UP_S).action is Action.RESTART


def test_failures_are_counted_per_component():
    tracker = FaultTracker()
    for _ in range(MAX_ATTEMPTS):
        tracker.record_failure(failure(WORKER), 0.0)
    for component in (Component(ComponentKind.WORKER, 2), SHARD, LEARNER, EVALUATOR):
        assert tracker.record_failure(failure(component), 0.0).attempts == 1
    assert tracker.record_failure(failure(WORKER), 0.0).action is Action.STOP


def test_the_age_counts_from_the_first_consecutive_failure():
    tracker = FaultTracker()
    tracker.record_failure(failure(LEARNER), 100.0)
    assert tracker.record_failure(failure(LEARNER), 100.0 + GIVE_UP_S).action is Action.REBUILD
    assert tracker.record_failure(failure(LEARNER), 100.1 + GIVE_UP_S).action is Action.STOP


def test_a_component_that_became_unreachable_and_then_died_is_replaced():
    tracker = FaultTracker()
    assert tracker.record_failure(failure(SHARD, Fault.UNREACHABLE), 0.0).action is Action.RETRY
    assert tracker.record_failure(failure(SHARD, Fault.DIED), 0.0).action is Action.RESTART


def test_failures_name_the_component_and_can_be_pickled():
    for error in (ComponentFailed(WORKER, 3, Fault.LATE, "collect: silent for 9 s"), CallFailed(Fault.DIED, "gone")):
        again = pickle.loads(pickle.dumps(error))
        assert type(again) is type(error) and vars(again) == vars(error)
    assert str(ComponentFailed(WORKER, 3, Fault.LATE, "silent")) == "rollout worker 1 late (silent)"
    assert [str(component) for component in (SHARD, LEARNER, EVALUATOR)] == ["replay shard 0", "learner", "evaluation"]


def test_a_failed_call_is_a_failure_of_the_component_that_was_called():
    failure = CallFailed(Fault.OBJECT_LOST, "gone").of(WORKER, 7)
    assert vars(failure) == {"component": WORKER, "incarnation": 7, "fault": Fault.OBJECT_LOST, "reason": "gone"}
    assert CallFailed(Fault.OBJECT_LOST, "gone").of(WORKER, 7, "save").reason == "save: gone"
