"""Graceful stop: Ctrl-C, SIGTERM, or the loss of the terminal ends a run early, with time to write a checkpoint."""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

AGAIN_S = 0.1
"""Time after which a process is interrupted again where an interruption came to nothing."""


class Interrupted(KeyboardInterrupt):
    """A signal interrupts what has no way to stop gracefully, or not soon enough.

    Args:
      signal: its number.
    """

    def __init__(self, signal: int) -> None:
        super().__init__(signal)
        self.signal = signal


class StopRequest:
    """Remembers the first signal; a second signal that is Ctrl-C interrupts at once."""

    def __init__(self) -> None:
        self.signal: int | None = None
        self._is_at_once = False

    def __call__(self) -> bool:
        """Whether a signal has arrived."""
        return self.signal is not None

    def handle(self, number: int, frame: FrameType | None) -> None:
        """The signal handler."""
        is_second = self.signal is not None
        self.signal = self.signal or number
        if self._is_at_once or (is_second and number == signal.SIGINT):
            raise Interrupted(self.signal)

    def check(self) -> None:
        """Raises Interrupted if a signal has arrived."""
        if self.signal is not None:
            raise Interrupted(self.signal)

    @contextmanager
    def at_once(self, is_at_once: bool = True) -> Iterator[None]:
        """Lets every signal interrupt the `with` block, since nothing there asks for the request; False undoes this."""
        before, self._is_at_once = self._is_at_once, is_at_once
        try:
            yield
        finally:
            self._is_at_once = before

    def listen(self, numbers: tuple[int, ...]) -> None:
        """Sets the handlers; again where something else has replaced them, as Ray does when it starts.

        A hang-up that is ignored stays ignored, as `nohup` wants it. Python delivers signals to the main thread only:
        in another thread, such as a cell of a sweep, no request arrives.
        """
        if threading.current_thread() is threading.main_thread():
            for number in numbers:
                if number != signal.SIGHUP or signal.getsignal(number) != signal.SIG_IGN:
                    signal.signal(number, self.handle)


def _sends_again(before: Callable[[sys.UnraisableHookArgs], object]) -> Callable[[sys.UnraisableHookArgs], None]:
    """A `sys.unraisablehook` that interrupts again where a finaliser or a weak reference's callback was interrupted.

    Python ignores what is raised there, and the signal with it. The request remembers the first signal's number.
    """

    def hook(unraisable: sys.UnraisableHookArgs) -> None:
        if isinstance(unraisable.exc_value, Interrupted):
            again = threading.Timer(AGAIN_S, os.kill, (os.getpid(), signal.SIGINT))
            again.daemon = True
            again.start()
        else:
            before(unraisable)

    return hook


@contextmanager
def stop_on_signals(*numbers: int) -> Iterator[StopRequest]:
    """Turns signals, by default Ctrl-C and SIGTERM, into a StopRequest; restores the old handlers."""
    numbers = numbers or (signal.SIGINT, signal.SIGTERM)
    request = StopRequest()
    before = {number: signal.getsignal(number) for number in numbers}
    hook_before = sys.unraisablehook
    request.listen(numbers)
    sys.unraisablehook = _sends_again(hook_before)
    try:
        yield request
    finally:
        sys.unraisablehook = hook_before
        if threading.current_thread() is threading.main_thread():
            for number, handler in before.items():
                signal.signal(number, handler)
