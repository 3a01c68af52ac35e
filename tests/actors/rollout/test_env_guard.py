"""Environments that hang or leave, in this process."""

import os
import signal
import threading
import time

import gymnasium as gym
import numpy as np
import pytest

from actors.rollout.env_guard import SIGNAL, env_guard
from actors.rollout.foreign_env import EnvError, ForeignVectorEnv
from tests.odd_envs import Plain

LIMIT_S = 0.2


def play(name, steps=40):
    env = ForeignVectorEnv(f"tests.odd_envs:{name}-v0", 2)
    env.reset(seed=[0, 1])
    for _ in range(steps):
        env.step(np.zeros(2, np.int64))


@pytest.fixture
def restored():
    """Checks that a guard leaves everything as it was."""
    before = signal.getsignal(SIGNAL), os._exit, threading.active_count()
    yield
    assert (signal.getsignal(SIGNAL), os._exit, threading.active_count()) == before


def test_a_step_that_does_not_come_back_is_named(restored):
    with env_guard(LIMIT_S), pytest.raises(EnvError, match=r"at its step 30: step\(\) has not come back .* 0.2 s") as e:
        play("Sleeps")
    assert "odd_envs.py" in str(e.value) and "time.sleep" in e.value.trace


class Busy(Plain):
    def bad(self):
        while True:
            try:
                while True:
                    pass
            except Exception:
                pass


def test_one_that_computes_and_catches_errors_is_named_too(restored):
    gym.register("Busy-v0", entry_point=Busy)
    try:
        with env_guard(LIMIT_S), pytest.raises(EnvError, match="not come back"):
            env = ForeignVectorEnv("Busy-v0", 1)
            env.reset(seed=[0])
            for _ in range(40):
                env.step(np.zeros(1, np.int64))
    finally:
        gym.registry.pop("Busy-v0")


def test_an_environment_that_leaves_the_process_is_named(restored):
    with env_guard(60), pytest.raises(EnvError, match=r"at its step 30: step\(\) ended the process with exit code 1"):
        play("Leaves")


def test_slow_steps_that_come_back_and_waits_elsewhere_are_left_alone(restored):
    with env_guard(LIMIT_S):
        play("Plain")
        time.sleep(2 * LIMIT_S)


def test_a_child_process_may_leave(restored):
    with env_guard(60):
        child = os.fork()
        if not child:
            os._exit(7)
        assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 7


def test_a_guard_in_another_thread_does_nothing(restored):
    found = []

    def work():
        with env_guard(LIMIT_S):
            found.append(os._exit)

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert found == [os._exit]
