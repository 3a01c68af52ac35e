"""Keeps an environment that hangs, or that ends the process, from taking the run with it without a word.

Only for environments of this process; over Ray, a process that is gone or silent is a component that has failed.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any, NoReturn

from actors.rollout.entry_point_env import EntryPointVectorEnv
from actors.rollout.foreign_env import CheckedVectorEnv, EnvInterrupted, ForeignVectorEnv

SIGNAL = signal.SIGUSR1
"""Ends a call of an environment, also one that sleeps or waits."""
CALLERS = ("_make", "_spaces_of", "_first_observation", "step", "render", "close_extras")
KINDS = (ForeignVectorEnv, EntryPointVectorEnv)
CALLS = {vars(kind)[name].__code__ for kind in (CheckedVectorEnv, *KINDS) for name in CALLERS if name in vars(kind)}
"""Code of the methods that call an environment."""


@contextmanager
def env_guard(limit_s: float) -> Iterator[None]:
    """Within the `with` block, a foreign environment that takes too long or calls `os._exit` raises an EnvError.

    Does nothing outside the main thread, where Python takes no signals. A step costs nothing: another thread looks at
    the stack now and then.

    Args:
      limit_s: longest time that one call of an environment may take.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def interrupt(number: int, frame: FrameType | None) -> None:
        if _present_call(frame) is not None:  # else it has just come back
            raise EnvInterrupted(f"{limit_s:g} s")

    ended, before, leave = threading.Event(), signal.signal(SIGNAL, interrupt), os._exit
    watch = threading.Thread(target=_watch, args=(threading.get_ident(), limit_s, ended), daemon=True)
    os._exit = _stay(leave)
    watch.start()
    try:
        yield
    finally:
        ended.set()
        watch.join()
        os._exit = leave
        signal.signal(SIGNAL, before)


def _stay(leave: Any) -> Any:
    """What `os._exit` is within a guard: SystemExit where this thread of this process calls it, else as ever."""
    owner = os.getpid(), threading.get_ident()

    def exit_with(code: int) -> NoReturn:
        if (os.getpid(), threading.get_ident()) == owner:
            raise SystemExit(code)
        leave(code)
        raise AssertionError("os._exit never comes back")

    return exit_with


def _watch(thread: int, limit_s: float, ended: threading.Event) -> None:
    """Interrupts calls of an environment in which `thread` is for longer than `limit_s`, until `ended`."""
    known, since_s = None, time.monotonic()
    while not ended.wait(min(1.0, limit_s / 4)):
        now_s, call = time.monotonic(), _present_call(sys._current_frames().get(thread))
        if call is None or call != known:
            known, since_s = call, now_s
        elif now_s - since_s > limit_s:
            signal.pthread_kill(thread, SIGNAL)
            since_s = now_s


def _present_call(frame: FrameType | None) -> tuple[Any, ...] | None:
    """Which call of an environment a stack is in; None if it is in none."""
    while frame is not None:
        if frame.f_code in CALLS:
            env, i = frame.f_locals["self"], frame.f_locals.get("i")
            return id(env), frame.f_code.co_name, len(env.envs), env.steps, i
        frame = frame.f_back
    return None
