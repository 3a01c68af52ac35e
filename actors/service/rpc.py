"""How the parts of the service call each other: the port that Ray or one process fills in.

Plain classes are written against `Calls`. `LocalCalls` runs each call at once, in the caller's process,
which makes a run deterministic; Ray's version lives at the one edge that knows Ray.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

Ref = Any
"""Reference to a result, perhaps not there yet."""
Node = Any
"""An object whose methods are called, perhaps in another process."""


class Calls(Protocol):
    """Starts calls, waits for them, and shares values by reference."""

    def start(self, node: Node, method: str, *args: Any) -> Ref:
        """Starts `node.method(*args)`; a reference among `args` (not inside one) arrives as its value."""
        ...

    def run(self, function: Callable[..., Any], *args: Any) -> Ref:
        """Starts `function(*args)`, anywhere, with references as in `start`."""
        ...

    def wait(self, refs: list[Ref], timeout_s: float) -> list[Ref]:
        """Blocks until one of `refs` is there or the time is over; returns those that are there, in the given order."""
        ...

    def get(self, ref: Ref) -> Any:
        """The result behind `ref`; raises what the call raised, or CallFailed if it could not be made."""
        ...

    def put(self, value: Any) -> Ref:
        """Shares a value."""
        ...


class Done:
    """A result that is there."""

    def __init__(self, value: Any) -> None:
        self.value = value


def _values(args: tuple[Any, ...]) -> list[Any]:
    return [arg.value if isinstance(arg, Done) else arg for arg in args]


class LocalCalls:
    """Calls within one process, each run to its end when it is started."""

    def start(self, node: Node, method: str, *args: Any) -> Ref:
        """Runs `node.method(*args)`."""
        return Done(getattr(node, method)(*_values(args)))

    def run(self, function: Callable[..., Any], *args: Any) -> Ref:
        """Runs `function(*args)`."""
        return Done(function(*_values(args)))

    def wait(self, refs: list[Ref], timeout_s: float) -> list[Ref]:
        """All of `refs`: every call has ended."""
        return list(refs)

    def get(self, ref: Ref) -> Any:
        """The result."""
        return ref.value

    def put(self, value: Any) -> Ref:
        """A reference to `value` itself."""
        return Done(value)
