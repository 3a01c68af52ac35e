"""What the soak calls flat."""

import numpy as np
import pytest
from rich.console import Console

from tests.benchmarks.soak import Usage, report

QUARTER = 100


def series(kind="learner", processes=lambda i: 1, megabytes=lambda i: 300.0, handles=lambda i: 40, threads=lambda i: 9):
    """One look every 18 s, two hours long."""
    noise = np.random.default_rng(0).normal(0, 1, 4 * QUARTER)
    return [
        Usage(18.0 * i, kind, processes(i), megabytes(i) + noise[i], handles(i), threads(i)) for i in range(4 * QUARTER)
    ]


def is_flat(samples):
    return report(samples, Console(quiet=True))


def test_noise_and_what_comes_before_the_second_quarter_are_flat():
    assert is_flat(series(megabytes=lambda i: min(300.0, 3.0 * i), handles=lambda i: 40 + (i % 7 == 0)))


def test_a_count_that_goes_up_and_down_is_flat_however_its_quarters_compare():
    looks = np.random.default_rng(3).integers(4, 24, 4 * QUARTER)
    looks[QUARTER : 2 * QUARTER : 2], looks[3 * QUARTER :: 2] = 10, 14
    assert is_flat(series("objects in the store", processes=lambda i: int(looks[i])))


def test_a_pool_of_threads_that_was_larger_for_a_while_is_flat():
    assert is_flat(series("gcs_server", threads=lambda i: 29 + 2 * (i > 3.4 * QUARTER)))


def test_a_connection_that_was_open_for_half_an_hour_is_flat():
    assert is_flat(series(handles=lambda i: 43 + (3 * QUARTER - 1 < i < 4 * QUARTER - 1)))


@pytest.mark.parametrize(
    "leak",
    [
        {"megabytes": lambda i: 300.0 + 6.0 * i / (2 * QUARTER)},  # 6 MB an hour
        {"handles": lambda i: 40 + i // QUARTER},
        {"handles": lambda i: 40 + (i > 3.2 * QUARTER)},  # a single one that stays
        {"threads": lambda i: 9 + i // QUARTER},
        {"processes": lambda i: 1 + i // QUARTER},
    ],
)
def test_a_leak_in_one_kind_of_process_is_not(leak):
    assert not is_flat(series() + series("rollout worker", **leak))
