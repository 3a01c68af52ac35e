"""Calls under way, and who is late, by a clock that the tests move."""

import pytest

from actors.service.fault_policy import CallFailed, Component, ComponentKind, Fault
from learner.training.in_flight import Pending, UnderWay

WORKERS = [Component(ComponentKind.WORKER, i) for i in range(2)]
LEARNER, EVALUATOR = Component(ComponentKind.LEARNER), Component(ComponentKind.EVALUATOR)


@pytest.fixture
def clock():
    return [100.0]


@pytest.fixture
def under_way(clock):
    return UnderWay(2, 10.0, 60.0, lambda: clock[0])


def collect(worker_id, incarnation=0):
    return Pending("collect", WORKERS[worker_id], incarnation, 0)


def update(amount=4):
    return Pending("update", LEARNER, 0, amount)


def started(under_way, *parts):
    for part in parts:
        under_way.heard(part)


def test_collects_and_blocks_are_counted_per_worker(under_way):
    for ref, worker_id in (("a", 0), ("b", 0), ("c", 1)):
        under_way.add(ref, collect(worker_id))
    under_way.add("u", update())
    assert (under_way.collects, under_way.blocks_in_flight, under_way.count("update"), len(under_way)) == (
        [2, 1],
        3,
        1,
        4,
    )
    assert under_way.take("a") == collect(0)
    assert (under_way.collects, under_way.blocks) == ([1, 1], [2, 1])  # a block is in flight until it is reported
    assert under_way.refs == ["b", "c", "u"]


def test_a_replaced_worker_owes_nothing(under_way):
    for ref, worker_id in (("a", 0), ("b", 0), ("c", 1)):
        under_way.add(ref, collect(worker_id))
    assert under_way.forget(WORKERS[0]) == ["a", "b"]
    assert (under_way.collects, under_way.blocks, under_way.refs) == ([0, 1], [0, 1], ["c"])
    assert under_way.take("a") is None
    assert (under_way.collects, under_way.blocks) == ([0, 1], [0, 1])


def test_nobody_is_late_before_the_deadline(under_way, clock):
    started(under_way, *WORKERS)
    under_way.add("a", collect(0))
    assert under_way.patience_s() == 10.0
    clock[0] += 9.9
    assert under_way.late([]) == [] and under_way.patience_s() == pytest.approx(0.1)
    clock[0] += 0.1
    (failure,) = under_way.late([])
    assert (failure.component, failure.incarnation, failure.fault) == (WORKERS[0], 0, Fault.LATE)
    assert str(failure) == "rollout worker 0 late (collect: silent for 10 s)"
    assert under_way.patience_s() == 0.0


def test_who_answers_is_given_the_whole_deadline_again(under_way, clock):
    started(under_way, LEARNER)
    under_way.add("u", update())
    clock[0] += 6
    under_way.add("v", update())  # queued behind the first: the time of waiting in line does not count
    clock[0] += 3
    under_way.take("u")
    clock[0] += 9
    assert under_way.late([]) == []
    clock[0] += 1
    assert [failure.component for failure in under_way.late([])] == [LEARNER]


def test_who_owes_nothing_is_never_late(under_way, clock):
    under_way.add("a", collect(0))
    under_way.take("a")
    clock[0] += 1e6
    assert under_way.late([]) == []
    started(under_way, WORKERS[1])
    under_way.add("b", collect(1))
    assert under_way.patience_s() == 10.0


def test_an_answer_that_waits_to_be_taken_is_not_late(under_way, clock):
    """The loop itself may have been busy for longer than the deadline."""
    started(under_way, *WORKERS)
    under_way.add("a", collect(0))
    under_way.add("b", collect(1))
    clock[0] += 50
    assert [failure.component for failure in under_way.late(["a"])] == [WORKERS[1]]


def test_a_part_that_starts_has_more_time_and_so_has_its_replacement(under_way, clock):
    under_way.add("a", collect(0))
    clock[0] += 59
    assert under_way.late([]) == []
    under_way.take("a")
    under_way.add("b", collect(0))
    clock[0] += 10
    assert len(under_way.late([])) == 1
    under_way.forget(WORKERS[0])
    under_way.add("c", collect(0, 1))
    clock[0] += 59
    assert under_way.late([]) == []
    clock[0] += 1
    assert [failure.incarnation for failure in under_way.late([])] == [1]


def test_every_evaluation_starts_anew(under_way, clock):
    for ref in ("a", "b"):
        under_way.add(ref, Pending("eval", EVALUATOR, 0, 1000))
        clock[0] += 59
        assert under_way.late([]) == []
        under_way.take(ref)


def test_each_late_part_is_named_once(under_way, clock):
    for ref, pending in (("a", collect(0)), ("b", collect(0)), ("c", collect(1)), ("u", update()), ("v", update())):
        under_way.add(ref, pending)
    clock[0] += 60
    assert {failure.component for failure in under_way.late([])} == {*WORKERS, LEARNER}
    assert len(under_way.late([])) == 3


def test_a_failed_call_names_its_part():
    failure = collect(1, 7).failed(CallFailed(Fault.OBJECT_LOST, "gone"))
    assert (failure.component, failure.incarnation, failure.fault, failure.reason) == (
        WORKERS[1],
        7,
        Fault.OBJECT_LOST,
        "gone",
    )
