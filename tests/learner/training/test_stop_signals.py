"""Stop signals: the first requests a stop, a second Ctrl-C interrupts, and the old handlers are restored."""

import os
import signal
import time
import weakref

import pytest

from learner.own_processes import STOPPING
from learner.training.stop_signals import Interrupted, stop_on_signals

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


class Referred:
    """May be referred to weakly."""


@pytest.mark.parametrize("at_once", [False, True])
def test_a_signal_in_a_callback_whose_errors_python_ignores_interrupts_all_the_same(at_once):
    with pytest.raises(Interrupted) as caught, stop_on_signals() as stop, stop.at_once(at_once):
        if not at_once:
            os.kill(os.getpid(), signal.SIGTERM)  # a second one interrupts if it is Ctrl-C
        referred, called = Referred(), []

        def callback(reference):
            called.append(reference)
            os.kill(os.getpid(), signal.SIGTERM if at_once else signal.SIGINT)

        reference = weakref.ref(referred, callback)
        del referred
        assert called == [reference]
        time.sleep(60)
    assert caught.value.signal == signal.SIGTERM


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


def test_a_lost_terminal_stops_a_run_as_ctrl_c_does_unless_it_is_ignored_as_nohup_does():
    with stop_on_signals(*STOPPING) as stop:
        os.kill(os.getpid(), signal.SIGHUP)
        assert stop() and stop.signal == signal.SIGHUP
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with stop_on_signals(*STOPPING) as stop:
            os.kill(os.getpid(), signal.SIGHUP)
            assert not stop()
    finally:
        signal.signal(signal.SIGHUP, before)


@pytest.mark.parametrize("number", STOPPING)
def test_where_nobody_asks_for_the_request_a_signal_interrupts(number):
    with stop_on_signals(*STOPPING) as stop:
        with pytest.raises(Interrupted) as caught, stop.at_once():
            with stop.at_once(False):
                assert not stop()
            os.kill(os.getpid(), number)
        assert caught.value.signal == stop.signal == number
        with pytest.raises(Interrupted):
            stop.check()


def test_handlers_that_something_else_has_set_are_set_again():
    with stop_on_signals(*STOPPING) as stop:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)  # as Ray sets its own
        stop.listen(STOPPING)
        os.kill(os.getpid(), signal.SIGTERM)
        assert stop()
