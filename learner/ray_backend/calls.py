"""Calls of Ray actors and tasks; translates Ray's errors into faults.

Every process of a run imports this module, and a rollout worker or a shard needs no torch: nor does this module.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any, TypeVar, TypeVarTuple

import ray
from ray.exceptions import (
    ActorUnavailableError,
    GetTimeoutError,
    NodeDiedError,
    ObjectLostError,
    OutOfMemoryError,
    RayActorError,
    RayError,
    RayTaskError,
    TaskCancelledError,
    WorkerCrashedError,
)

from actors.service.fault_policy import CallFailed, ComponentFailed, Fault, RunFailed, first_line
from actors.service.rpc import Handle, Ref
from sim_core.checks import ConfigError

N = TypeVar("N")
T = TypeVar("T")
Ts = TypeVarTuple("Ts")

FAULTS: tuple[tuple[tuple[type[Exception], ...], Fault], ...] = (
    ((ActorUnavailableError,), Fault.UNREACHABLE),
    ((RayActorError, WorkerCrashedError, NodeDiedError, OutOfMemoryError, TaskCancelledError), Fault.DIED),
    ((ObjectLostError,), Fault.OBJECT_LOST),
    ((GetTimeoutError,), Fault.LATE),
)
"""The fault that each error of Ray stands for; the first match counts."""


@lru_cache
def _task(function: Callable[..., Any]) -> Any:
    return ray.remote(num_cpus=0, max_retries=0)(function)


def _as_fault(error: Exception) -> Exception:
    """The fault that an error of Ray stands for; an error that our own code raised, unchanged."""
    if isinstance(error, RayTaskError):
        cause = getattr(error, "cause", None)
        if isinstance(cause, CallFailed | ComponentFailed | RunFailed | ConfigError):  # ConfigError: of a user's code
            return cause
        return _as_fault(cause) if isinstance(cause, RayError) else error
    for kinds, fault in FAULTS:
        if isinstance(error, kinds):
            return CallFailed(fault, first_line(error))
    return error


class RayCalls:
    """Calls of Ray actors; implements `actors.service.rpc.Calls`.

    Args:
      deadline_s: most time that `get` waits.
    """

    def __init__(self, deadline_s: float) -> None:
        self._deadline_s = deadline_s

    def start(self, node: Handle[N], method: Callable[[N, *Ts], T], *args: *Ts) -> Ref[T]:
        """Starts an actor's method."""
        ref: Ref[T] = getattr(node, method.__name__).remote(*args)
        return ref

    def run(self, function: Callable[[*Ts], T], *args: *Ts) -> Ref[T]:
        """Starts a function as a Ray task, which takes no CPU slot: the run's actors may hold them all."""
        ref: Ref[T] = _task(function).remote(*args)
        return ref

    def wait(self, refs: list[Ref[T]], timeout_s: float) -> list[Ref[T]]:
        """Blocks until one of `refs` is there or the time is over; returns those that are there, in the given order."""
        ray.wait(refs, num_returns=1, timeout=timeout_s, fetch_local=False)
        ready = set(ray.wait(refs, num_returns=len(refs), timeout=0, fetch_local=False)[0])
        return [ref for ref in refs if ref in ready]

    def get(self, ref: Ref[T]) -> T:
        """The result behind `ref`.

        Raises:
          CallFailed: the call could not be made, its result is gone, or the deadline passed.
        """
        try:
            result: T = ray.get(ref, timeout=self._deadline_s)
            return result
        except GetTimeoutError as error:
            raise CallFailed(Fault.LATE, f"no answer within {self._deadline_s:.0f} s") from error
        except RayError as error:
            fault = _as_fault(error)
            if fault is error:
                raise
            raise fault from error

    def put(self, value: T) -> Ref[T]:
        """Puts a value into the object store."""
        ref: Ref[T] = ray.put(value)
        return ref
