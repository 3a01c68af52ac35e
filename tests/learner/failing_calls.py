"""Calls within one process that behave like calls between processes, with faults that the test chooses."""

import threading
from collections import defaultdict, deque

import numpy as np

from actors.service.fault_policy import CallFailed, Fault
from actors.service.rpc import Done, LocalCalls


class Later:
    """A call that runs when it reaches the head of its node's queue."""

    def __init__(self, node, method, args):
        self.call, self.result, self.error, self.ran = (node, method, args), None, None, False


class FailingCalls(LocalCalls):
    """Runs each node's calls in the order of their start, at the moment when somebody asks for a result.

    Threads take turns.

    Args:
      fault: is called with (node, method) before each call of a node; says what goes wrong, or None:
        "dies before", "dies after", "unreachable before", "unreachable after". After a death every call fails.
      seed: of the order in which results are there.
    """

    def __init__(self, fault, seed=0):
        self.fault = fault
        self.dead = []
        self.faults = 0
        self._queues = defaultdict(deque)
        self._rng = np.random.default_rng(seed)
        self._turn = threading.RLock()

    def start(self, node, method, *args):
        later = Later(node, method.__name__, args)
        with self._turn:
            self._queues[id(node)].append(later)
        return later

    def run(self, function, *args):
        try:
            return Done(function(*map(self._value, args)))
        except CallFailed as error:  # raised by a call whose result is an argument
            later = Later(None, function.__name__, args)
            later.ran, later.error = True, error
            return later

    def _value(self, arg):
        return self.get(arg) if isinstance(arg, Done | Later) else arg

    def wait(self, refs, timeout_s):
        """Some of `refs`, at least one; none before an earlier one of the same node."""
        if len(refs) == 1:
            return list(refs)
        held_back, ready = set(), []
        for ref in refs:
            node = id(ref.call[0]) if isinstance(ref, Later) else None
            if node not in held_back and self._rng.random() < 0.5:
                ready.append(ref)
            else:
                held_back.add(node)
        return ready or refs[:1]

    def get(self, ref):
        if isinstance(ref, Done):
            return ref.value
        with self._turn:
            while not ref.ran:
                self._run(self._queues[id(ref.call[0])].popleft())
        if ref.error is not None:
            raise ref.error
        return ref.result

    def _run(self, later):
        later.ran = True
        node, method, args = later.call
        fault = "dies before" if self.is_dead(node) else self.fault(node, method)
        if fault is not None:
            self.faults += not self.is_dead(node)
            kind = Fault.DIED if fault.startswith("dies") else Fault.UNREACHABLE
            later.error = CallFailed(kind, "simulated")
            if kind is Fault.DIED and not self.is_dead(node):
                self.dead.append(node)
            if fault.endswith("before"):
                return
        try:
            later.result = getattr(node, method)(*map(self._value, args))
        except Exception as error:
            later.error = later.error or error

    def is_dead(self, node):
        return any(node is other for other in self.dead)
