"""Calls within this process."""

import pytest

from actors.service.rpc import LocalCalls


class Adder:
    def __init__(self):
        self.total = 0

    def add(self, number, other=0):
        self.total += number + other
        return self.total

    def first(self, numbers):
        return numbers[0]


def test_calls_run_at_once_and_in_order():
    calls, node = LocalCalls(), Adder()
    refs = [calls.start(node, Adder.add, number) for number in (1, 2, 4)]
    assert node.total == 7
    assert calls.wait(refs, 1.0) == refs
    assert [calls.get(ref) for ref in refs] == [1, 3, 7]


def test_references_arrive_as_values_unless_they_are_inside_an_argument():
    calls, node = LocalCalls(), Adder()
    shared = calls.put(5)
    assert calls.get(calls.start(node, Adder.add, shared, calls.start(node, Adder.add, 1))) == 7
    assert calls.get(calls.run(max, shared, 3)) == 5
    inside = calls.get(calls.start(node, Adder.first, [shared]))
    assert inside is shared and calls.get(inside) == 5


def test_errors_are_raised():
    calls = LocalCalls()
    with pytest.raises(ZeroDivisionError):
        calls.get(calls.run(lambda: 1 // 0))
