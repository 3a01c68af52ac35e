"""What a signal does once Ray has started, which sets a handler of its own."""

import os
import signal
import sys
import time

import pytest

from learner.ray_backend.cluster import _own_handler
from learner.training.stop_signals import Interrupted

NUMBER = signal.SIGTERM


@pytest.fixture(autouse=True)
def restored():
    before = signal.getsignal(NUMBER)
    yield
    signal.signal(NUMBER, before)


def after_start(handler):
    """The handler after a start of Ray, where it was `handler` before."""
    signal.signal(NUMBER, handler)
    with _own_handler(NUMBER):
        signal.signal(NUMBER, lambda number, frame: sys.exit(number))  # as Ray does
    return signal.getsignal(NUMBER)


def test_a_handler_of_our_own_and_a_signal_that_is_ignored_stay():
    def mine(number, frame):
        pass

    assert after_start(mine) is mine
    assert after_start(signal.SIG_IGN) == signal.SIG_IGN


def test_a_signal_that_would_end_the_process_at_once_lets_it_close_what_is_open():
    after_start(signal.SIG_DFL)
    with pytest.raises(Interrupted) as caught:
        os.kill(os.getpid(), NUMBER)
        time.sleep(10)
    assert caught.value.signal == NUMBER
