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
    shards_needed,
)

FREE = Costs(*[0.0] * len(Costs._fields))
WORK = Work(
    block_env_steps=100,
    samples_per_insert=2.0,
    batch_size=50,
    updates_per_call=4,
    packed_bytes=30.0,
    row_bytes=40,
    weights_bytes=3_000,
)


def test_a_free_network_leaves_env_steps_and_updates():
    costs = FREE._replace(env_step=3.0, update=200.0)
    assert seconds_per_env_step(costs, WORK, 0) == {
        WORKERS: 3.0,
        LEARNER: 8.0,
        DRIVER: 0.0,
    }  # 2 samples, 50 a batch
    assert saturation(costs._replace(ask=1e-9), WORK, 0)[LEARNER] == pytest.approx(3 / 8)


def test_calls_and_blocks_are_shared_by_their_env_steps():
    costs = FREE._replace(do=1.0, push=10.0, store=1000.0, publish=1e4, ask=1e5)
    calls = 1 / 100  # of updates: 4 x 50 samples are 100 env steps' share
    assert seconds_per_env_step(costs, WORK, 0) == pytest.approx(
        {WORKERS: 0.11, LEARNER: calls * 10_001 + 10.0, DRIVER: (1 / 100 + calls) * 1e5}
    )


def test_shards_of_their_own_take_over_storing_and_drawing():
    costs = FREE._replace(store=100.0, give=5.0, take=7.0, draw=1e9)
    apart = seconds_per_env_step(costs, WORK, 1)
    assert apart[SHARDS] == pytest.approx(1.0 + 10.0) and apart[LEARNER] == pytest.approx(14.0)


def test_every_shard_of_its_own_is_asked_and_told():
    calls, costs = 1 / 100, FREE._replace(ask=1.0, do=10.0, send=100.0, receive=1000.0)
    apart = seconds_per_env_step(costs, WORK, 3)
    assert apart[LEARNER] == pytest.approx(calls * (10.0 + 3 * 101.0))
    assert apart[SHARDS] == pytest.approx(calls * 3 * 1010.0)


def test_shards_are_enough_once_something_else_is_full():
    costs = FREE._replace(env_step=1e-9, ask=1e-9, update=50.0, give=7.0)  # learner: 2 s an env step, shards: 14
    assert shards_needed(costs, WORK) == 7
    assert shards_needed(costs._replace(give=7.1), WORK) == 8


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
    assert 1 / alone == pytest.approx(seconds_per_env_step(costs, WORK, 0)[LEARNER])


def test_several_learners_share_the_rows_and_pay_for_every_step_of_the_ring():
    costs = FREE._replace(store=100.0, draw=3.0, publish=7.0)
    seconds = 1 / of_several_learners(costs, WORK, 4, update_s=10.0, sum_s=5.0)
    calls, updates = 1 / 100, 2 / 50
    assert seconds == pytest.approx((1.0 + 2 * 3.0) / 4 + calls * 7.0 + updates * (10.0 + 3 * 5.0))


def test_bytes_and_messages():
    versions = 1 / 100  # as many as blocks
    assert network_bytes(WORK, 9, 0) == 30 + versions * 3_000
    assert network_bytes(WORK, 9, 4) == pytest.approx(30 + 2 * 40 + 5 * versions * 3_000)
    seldom = WORK._replace(samples_per_insert=0.2)
    assert network_bytes(seldom, 3, 0) == pytest.approx(30 + 0.3 * versions * 3_000)
    assert messages(WORK, 0) == pytest.approx(2 / 100 + 1 / 100)
    assert messages(WORK, 3) == pytest.approx(2 / 100 + 7 / 100)
