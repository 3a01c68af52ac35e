"""What is written down of an env step, against numpy."""

import numpy as np
import pytest

from actors.rollout.step_kernels import StepLog, record_step

STEPS, ENVS = 6, 5


@pytest.mark.parametrize("share", [0.0, 0.2, 1.0])
def test_every_step_is_written_and_every_episode_counted_from_its_start(share):
    rng = np.random.default_rng(3)
    types = np.int64, np.float64, np.bool_, np.bool_, np.bool_, np.int32, np.float64
    log = StepLog(*(np.full((STEPS, ENVS), 77).astype(dtype) for dtype in types))
    length, total = np.array([0, 3, 0, 9, 1], np.int32), np.array([0.0, 1.5, 0.0, -2.0, 0.25])
    for step in range(STEPS):
        action, reward = rng.integers(8, size=ENVS), rng.normal(size=ENVS)
        terminated, truncated = rng.random((2, ENVS)) < share
        decided = log.decided[step] = rng.random(ENVS) < 0.7
        done, expected_length, expected_total = terminated | truncated, length + decided, total + reward
        ended = record_step(log, step, action, reward, terminated, truncated, length, total)
        assert ended == done.sum()
        for found, expected in zip(
            log, (action, reward, terminated, done, decided, expected_length, expected_total), strict=True
        ):
            np.testing.assert_array_equal(found[step], expected)
        np.testing.assert_array_equal(length, np.where(done, 0, expected_length))
        np.testing.assert_array_equal(total, np.where(done, 0.0, expected_total))
