"""Calls in flight, and which components are late, by a clock that the tests move."""

import pytest

from actors.service.fault_policy import Component, ComponentKind, Fault
from learner.training.in_flight import InFlight, PendingCall

WORKERS = [Component(ComponentKind.WORKER, i) for i in range(2)]
LEARNER, EVALUATOR = Component(ComponentKind.LEARNER), Component(ComponentKind.EVALUATOR)


@pytest.fixture
def clock():
    return [100.0]


@pytest.fixture
def in_flight(clock):
    return InFlight(2, 10.0, 60.0, lambda: clock[0])


def collect(worker_id, ref, incarnation=0):
    return PendingCall("collect", WORKERS[worker_id], incarnation, ref, print)


def update(ref):
    return PendingCall("update", LEARNER, 0, ref, print)


def collects(in_flight):
    return [in_flight.count(worker) for worker in WORKERS]


def started(in_flight, *components):
    for component in components:
        in_flight.record_answer(component)


def test_collects_and_blocks_are_counted_per_worker(in_flight):
    for ref, worker_id in (("a", 0), ("b", 0), ("c", 1)):
        in_flight.add(collect(worker_id, ref))
    in_flight.add(update("u"))
    assert collects(in_flight) == [2, 1] and in_flight.blocks_in_flight == 3
    assert in_flight.count(LEARNER) == 1 and len(in_flight) == 4 and in_flight.most_of_one == 2
    assert in_flight.take("a") == collect(0, "a")
    assert collects(in_flight) == [1, 1] and in_flight.most_of_one == 1
    assert in_flight.blocks == [2, 1], "a block is in flight until it is reported"
    assert in_flight.refs == ["b", "c", "u"]


def test_a_replaced_worker_owes_nothing(in_flight):
    for ref, worker_id in (("a", 0), ("b", 0), ("c", 1)):
        in_flight.add(collect(worker_id, ref))
    assert in_flight.forget(WORKERS[0]) == ["a", "b"]
    assert (collects(in_flight), in_flight.blocks, in_flight.refs) == ([0, 1], [0, 1], ["c"])
    assert in_flight.take("a") is None
    assert (collects(in_flight), in_flight.blocks) == ([0, 1], [0, 1])


def test_no_component_is_late_before_the_deadline(in_flight, clock):
    started(in_flight, *WORKERS)
    in_flight.add(collect(0, "a"))
    assert in_flight.time_left_s() == 10.0
    clock[0] += 9.9
    assert in_flight.late([]) == [] and in_flight.time_left_s() == pytest.approx(0.1)
    clock[0] += 0.1
    (failure,) = in_flight.late([])
    assert (failure.component, failure.incarnation, failure.fault) == (WORKERS[0], 0, Fault.LATE)
    assert str(failure) == "rollout worker 0 late (collect: silent for 10 s)"
    assert in_flight.time_left_s() == 0.0


def test_an_answer_starts_the_deadline_again(in_flight, clock):
    started(in_flight, LEARNER)
    in_flight.add(update("u"))
    clock[0] += 6
    in_flight.add(update("v"))  # queued behind the first call: time in the queue does not count
    clock[0] += 3
    in_flight.take("u")
    clock[0] += 9
    assert in_flight.late([]) == []
    clock[0] += 1
    assert [failure.component for failure in in_flight.late([])] == [LEARNER]


def test_a_component_that_owes_no_answer_is_never_late(in_flight, clock):
    in_flight.add(collect(0, "a"))
    in_flight.take("a")
    clock[0] += 1e6
    assert in_flight.late([]) == []
    started(in_flight, WORKERS[1])
    in_flight.add(collect(1, "b"))
    assert in_flight.time_left_s() == 10.0


def test_an_answer_that_has_not_been_taken_yet_is_not_late(in_flight, clock):
    """The loop itself may have been busy for longer than the deadline."""
    started(in_flight, *WORKERS)
    in_flight.add(collect(0, "a"))
    in_flight.add(collect(1, "b"))
    clock[0] += 50
    assert [failure.component for failure in in_flight.late(["a"])] == [WORKERS[1]]


def test_a_starting_component_has_more_time_and_so_has_its_replacement(in_flight, clock):
    in_flight.add(collect(0, "a"))
    clock[0] += 59
    assert in_flight.late([]) == []
    in_flight.take("a")
    in_flight.add(collect(0, "b"))
    clock[0] += 10
    assert len(in_flight.late([])) == 1
    in_flight.forget(WORKERS[0])
    in_flight.add(collect(0, "c", 1))
    clock[0] += 59
    assert in_flight.late([]) == []
    clock[0] += 1
    assert [failure.incarnation for failure in in_flight.late([])] == [1]


def test_every_evaluation_has_the_time_of_a_start(in_flight, clock):
    for ref in ("a", "b"):
        in_flight.add(PendingCall("eval", EVALUATOR, 0, ref, print))
        clock[0] += 59
        assert in_flight.late([]) == []
        in_flight.take(ref)


def test_each_late_component_is_reported_once(in_flight, clock):
    for call in (collect(0, "a"), collect(0, "b"), collect(1, "c"), update("u"), update("v")):
        in_flight.add(call)
    clock[0] += 60
    assert {failure.component for failure in in_flight.late([])} == {*WORKERS, LEARNER}
    assert len(in_flight.late([])) == 3
