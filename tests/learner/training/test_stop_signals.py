"""Stop signals: the first requests a stop, a second Ctrl-C interrupts, and the old handlers are restored."""

import os
import signal

import pytest

from learner.training.stop_signals import stop_on_signals

NUMBERS = (signal.SIGINT, signal.SIGTERM)


@pytest.mark.parametrize("number", NUMBERS)
def test_a_signal_is_remembered(number):
    with stop_on_signals() as stop:
        assert not stop() and stop.signal is None
        os.kill(os.getpid(), number)
        assert stop() and stop.signal == number


@pytest.mark.parametrize("first", NUMBERS)
def test_a_second_interrupt_ends_the_run_at_once(first):
    with pytest.raises(KeyboardInterrupt), stop_on_signals():
        os.kill(os.getpid(), first)
        os.kill(os.getpid(), signal.SIGINT)


def test_a_second_sigterm_still_lets_the_run_save():
    with stop_on_signals() as stop:
        os.kill(os.getpid(), signal.SIGINT)
        os.kill(os.getpid(), signal.SIGTERM)
        assert stop()


@pytest.mark.parametrize("error", [None, RuntimeError, KeyboardInterrupt])
def test_the_old_handlers_are_restored(error):
    def mine(number, frame):
        raise AssertionError("not called")

    before = [signal.signal(number, mine) for number in NUMBERS]
    try:
        if error is None:
            with stop_on_signals():
                assert signal.getsignal(signal.SIGTERM) is not mine
        else:
            with pytest.raises(error), stop_on_signals():
                raise error
        assert [signal.getsignal(number) for number in NUMBERS] == [mine, mine]
    finally:
        for number, handler in zip(NUMBERS, before, strict=True):
            signal.signal(number, handler)
