"""How the nodes of a run call each other: a port that one process or Ray fills in.

A node is an object that is placed in some process. Callers hold its `Handle` and name the method by its function, as in
`calls.start(learner, LearnerNode.update, 64, 1e-3)`; a type checker sees the method, its arguments and its result.

`LocalCalls` runs each call at once, in the caller's process, which makes a run deterministic. Ray's version lives in
the one package that knows Ray.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Generic, NamedTuple, Protocol, TypeVar, TypeVarTuple, cast

from actors.service.fault_policy import Component

N = TypeVar("N")
"""Class of a node, or a protocol that it implements."""
T = TypeVar("T")
"""Result of a call."""
Ts = TypeVarTuple("Ts")
"""Arguments of a call."""
N_co = TypeVar("N_co", covariant=True)
T_co = TypeVar("T_co", covariant=True)


class Ref(Generic[T_co]):
    """Reference to the result of a call, which may not be there yet."""


class Handle(Generic[N_co]):
    """Refers to a node of class N, perhaps in another process."""


class Placed(NamedTuple, Generic[N_co]):
    """A component of the run where it is placed now: which one, its incarnation, and its node."""

    component: Component
    incarnation: int
    node: Handle[N_co]


class Calls(Protocol):
    """Starts calls, waits for them, and shares values by reference."""

    def start(self, node: Handle[N], method: Callable[[N, *Ts], T], *args: *Ts) -> Ref[T]:
        """Starts the node's method; arguments that are references arrive as values (see `by_reference`)."""
        ...

    def run(self, function: Callable[[*Ts], T], *args: *Ts) -> Ref[T]:
        """Starts `function(*args)`, anywhere, with arguments as in `start`."""
        ...

    def wait(self, refs: list[Ref[T]], timeout_s: float) -> list[Ref[T]]:
        """Blocks until one of `refs` is there or the time is over; returns those that are there, in the given order."""
        ...

    def get(self, ref: Ref[T]) -> T:
        """The result behind `ref`; raises what the call raised, or CallFailed if it could not be made."""
        ...

    def put(self, value: T) -> Ref[T]:
        """Shares a value."""
        ...


def by_reference(ref: Ref[T]) -> T:
    """A reference as an argument of `start` or `run`, not inside another one: the call receives the value behind it."""
    return cast(T, ref)


class Done(Ref[T]):
    """A result that is there."""

    def __init__(self, value: T) -> None:
        self.value = value


def local_handle(node: N) -> Handle[N]:
    """The handle of a node of this process, for `LocalCalls`."""
    return cast(Handle[N], node)


def _values(args: tuple[Any, ...]) -> list[Any]:
    return [arg.value if isinstance(arg, Done) else arg for arg in args]


class LocalCalls:
    """Calls within one process, each run to its end when it is started."""

    def start(self, node: Handle[N], method: Callable[[N, *Ts], T], *args: *Ts) -> Ref[T]:
        """Runs the method."""
        return Done(getattr(node, method.__name__)(*_values(args)))

    def run(self, function: Callable[[*Ts], T], *args: *Ts) -> Ref[T]:
        """Runs `function(*args)`."""
        return Done(function(*_values(args)))

    def wait(self, refs: list[Ref[T]], timeout_s: float) -> list[Ref[T]]:
        """All of `refs`: every call has ended."""
        return list(refs)

    def get(self, ref: Ref[T]) -> T:
        """The result."""
        assert isinstance(ref, Done)
        value: T = ref.value
        return value

    def put(self, value: T) -> Ref[T]:
        """A reference to `value` itself."""
        return Done(value)
