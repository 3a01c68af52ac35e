"""The model of the service, against cases that can be counted by hand."""

import pytest

from tests.benchmarks.service_model import (
    CORES,
    DRIVER,
    LEARNER,
    SHARDS,
    WORKERS,
    Costs,
    Work,
    bounds,
    messages,
    network_bytes,
    of_several_learners,
    saturation,
    seconds_per_env_step,
)

FREE = Costs(*[0.0] * len(Costs._fields))
WORK = Work(
    block_env_steps=100,
    samples_per_insert=2.0,
    batch_size=50,
    updates_per_call=4,
    row_bytes=40,
    weights_bytes=3_000,
)


def test_a_free_network_leaves_env_steps_and_updates():
    costs = FREE._replace(env_step=3.0, update=200.0)
    assert seconds_per_env_step(costs, WORK, False) == {
        WORKERS: 3.0,
        LEARNER: 8.0,
        DRIVER: 0.0,
    }  # 2 samples, 50 a batch
    assert saturation(costs._replace(ask=1e-9), WORK, False)[LEARNER] == pytest.approx(3 / 8)


def test_calls_and_blocks_are_shared_by_their_env_steps():
    costs = FREE._replace(do=1.0, push=10.0, store=1000.0, publish=1e4, ask=1e5)
    calls = 1 / 100  # of updates: 4 x 50 samples are 100 env steps' share
    assert seconds_per_env_step(costs, WORK, False) == pytest.approx(
        {WORKERS: 0.11, LEARNER: calls * 10_001 + 10.0, DRIVER: (1 / 100 + calls) * 1e5}
    )


def test_shards_of_their_own_take_over_storing_and_drawing():
    costs = FREE._replace(store=100.0, give=5.0, take=7.0, draw=1e9)
    apart = seconds_per_env_step(costs, WORK, True)
    assert apart[SHARDS] == pytest.approx(1.0 + 10.0) and apart[LEARNER] == pytest.approx(14.0)


def test_the_tightest_bound_comes_first():
    costs = FREE._replace(env_step=1.0, update=100.0, ask=1e-6)
    assert bounds(costs, WORK, 1)[0] == (LEARNER, pytest.approx(0.25))
    cheap = costs._replace(update=2.5)
    assert bounds(cheap, WORK, 1)[0] == (WORKERS, pytest.approx(1.0))
    assert bounds(cheap, WORK, 50)[0] == (LEARNER, pytest.approx(10.0))
    assert bounds(cheap, WORK, 50, cores=2)[0] == (CORES, pytest.approx(2 / 1.1, rel=1e-6))
    stored = FREE._replace(env_step=1.0, store=1000.0, ask=1e-6)
    assert [bounds(stored, WORK, 30, shards)[0].env_steps_per_s for shards in (1, 2)] == pytest.approx([0.1, 0.2])


def test_one_of_several_learners_is_the_learner():
    costs = Costs(*[float(i + 1) for i in range(len(Costs._fields))])
    alone = of_several_learners(costs, WORK, 1, costs.update, 1e9)
    assert 1 / alone == pytest.approx(seconds_per_env_step(costs, WORK, False)[LEARNER])


def test_several_learners_share_the_rows_and_pay_for_every_step_of_the_ring():
    costs = FREE._replace(store=100.0, draw=3.0, publish=7.0)
    seconds = 1 / of_several_learners(costs, WORK, 4, update_s=10.0, sum_s=5.0)
    calls, updates = 1 / 100, 2 / 50
    assert seconds == pytest.approx((1.0 + 2 * 3.0) / 4 + calls * 7.0 + updates * (10.0 + 3 * 5.0))


def test_bytes_and_messages():
    assert network_bytes(WORK, False) == 40 + 30
    assert network_bytes(WORK, True) == 3 * 40 + 30
    assert messages(WORK, 0) == pytest.approx(2 / 100 + 1 / 100)
    assert messages(WORK, 3) == pytest.approx(2 / 100 + 7 / 100)
