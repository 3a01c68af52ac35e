"""Pacing under any order of events: it never deadlocks, never leaves its band, and converges to its ratio."""

import math
import random
from typing import NamedTuple

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from learner.config import RunConfig
from learner.training.pacing import Pacer, PacingState, make_pacer


class Setup(NamedTuple):
    """Arguments of Pacer."""

    samples_per_insert: float
    min_replay: int
    batch_size: int
    updates_per_call: int
    block_rows: int
    blocks_in_flight: int


setups = st.builds(
    Setup,
    samples_per_insert=st.sampled_from([0.01, 0.3, 1.0, 4.0, 33.3]),
    min_replay=st.sampled_from([1, 50, 1000]),
    batch_size=st.sampled_from([1, 32, 256]),
    updates_per_call=st.sampled_from([1, 8, 64]),
    block_rows=st.sampled_from([1, 16, 700]),
    blocks_in_flight=st.integers(1, 9),
)


def band(setup):
    """(lowest, highest) of inserted x samples_per_insert - sampled, once sampling has begun."""
    call = setup.batch_size * setup.updates_per_call
    start = setup.min_replay * setup.samples_per_insert
    return start - call, start + 2 * call + setup.blocks_in_flight * setup.block_rows * setup.samples_per_insert


def start_all(pacer, setup, in_flight, calls):
    """Starts whatever the pacer allows, as the training loop does."""
    while in_flight.count("block") < setup.blocks_in_flight and pacer.may_collect(in_flight.count("block")):
        in_flight.append("block")
    while in_flight.count("update") < calls and (updates := pacer.updates_due()):
        assert updates == setup.updates_per_call
        assert pacer.state.inserted >= setup.min_replay
        pacer.record_sample(updates)
        in_flight.append("update")


def simulate(setup, calls, seed, events, short=True, loss=0.0):
    """Ends one random call in flight at a time; returns the pacer after `events` of them.

    With probability `loss` an event also loses a random share of the replay, and updates then fail.
    """
    pacer, rng, in_flight = Pacer(*setup), random.Random(seed), []
    lowest, highest = band(setup)
    for _ in range(events):
        start_all(pacer, setup, in_flight, calls)
        assert in_flight, "deadlock"
        kind = in_flight.pop(rng.randrange(len(in_flight)))
        if kind == "block":  # the first blocks hold fewer rows (n-step), a duplicate none
            pacer.record_insert(rng.choice([setup.block_rows, setup.block_rows - 1, 0]) if short else setup.block_rows)
        if rng.random() < loss:
            before = pacer.state
            pacer.write_off(rng.choice([0.1, 0.5, 1.0]))
            assert pacer.state.written_off >= before.written_off
            if "update" in in_flight:
                in_flight.remove("update")
                pacer.undo_sample(setup.updates_per_call)
        ahead = pacer.state.inserted * setup.samples_per_insert - pacer.state.sampled - pacer.state.written_off
        assert ahead <= highest + (calls * setup.batch_size * setup.updates_per_call if loss else 0) + 1e-6
        assert loss or ahead >= lowest - 1e-6 or not pacer.state.sampled
        assert not pacer.state.sampled or pacer.state.inserted >= setup.min_replay
    return pacer


@given(setup=setups, calls=st.integers(1, 3), seed=st.integers(0, 999))
@settings(max_examples=100, deadline=None)
def test_losses_do_not_deadlock(setup, calls, seed):
    simulate(setup, calls, seed, 300, loss=0.1)


def test_after_the_loss_of_the_whole_replay_it_fills_up_as_at_the_start():
    pacer = Pacer(*Setup(2.0, 100, 10, 5, 20, 2))
    for _ in range(9):
        pacer.record_insert(20)
    while pacer.updates_due():
        pacer.record_sample(5)
    pacer.write_off(1.0)
    held = 0
    while not pacer.updates_due():
        assert pacer.may_collect(0)
        pacer.record_insert(20)
        held += 20
    assert held == 100  # min_replay


def test_new_transitions_are_sampled_at_the_ratio_whatever_was_lost():
    """Transitions inserted after a loss get samples_per_insert samples each, and none in place of lost ones."""
    pacer = Pacer(*Setup(2.0, 100, 10, 1, 20, 1))
    lost_at = {40: 1.0, 80: 0.5}
    sampled = {}
    for i in range(2_000):
        if i in lost_at:
            pacer.write_off(lost_at[i])
        pacer.record_insert(20)
        while pacer.updates_due():
            pacer.record_sample(1)
        sampled[i] = pacer.state.sampled
    assert (sampled[1_999] - sampled[999]) / (1_000 * 20) == pytest.approx(2.0, rel=1e-3)
    assert pacer.ratio() < 2.0


def test_the_samples_of_failed_updates_are_taken_back():
    pacer = Pacer(*Setup(4.0, 1, 8, 1, 8, 1))
    pacer.record_insert(8)
    before = pacer.state
    pacer.record_sample(3)
    pacer.undo_sample(3)
    assert pacer.state == before


@given(setup=setups, calls=st.integers(1, 3), seed=st.integers(0, 999))
@settings(max_examples=150, deadline=None)
def test_never_deadlocks_nor_leaves_its_band(setup, calls, seed):
    simulate(setup, calls, seed, 300)


@given(calls=st.integers(1, 2), seed=st.integers(0, 99), ratio=st.sampled_from([0.3, 1.0, 4.0]))
@settings(max_examples=30, deadline=None)
def test_the_ratio_converges_within_the_band(calls, seed, ratio):
    setup = Setup(ratio, 100, 32, 4, 64, 3)
    pacer = simulate(setup, calls, seed, 3000)
    lowest, highest = band(setup)
    state = pacer.state
    assert state.sampled > 20 * max(abs(lowest), highest)  # both sides made progress
    assert ratio - highest / state.inserted - 1e-9 <= pacer.ratio() <= ratio - lowest / state.inserted + 1e-9
    assert pacer.ratio() == pytest.approx(ratio, rel=0.06)


def test_a_stalled_learner_stops_the_workers_and_the_other_way_round():
    setup = Setup(2.0, 100, 10, 5, 20, 2)
    pacer = Pacer(*setup)
    while pacer.may_collect(0):
        pacer.record_insert(20)
    # 2 x inserted must stay within 200 + 2 x 50 + 2 x 20 x 2 = 380.
    assert pacer.state.inserted == 180
    calls = 0
    while pacer.updates_due():
        pacer.record_sample(5)
        calls += 1
    assert calls == 4 and pacer.state.sampled == 200  # 360 - 200 = 160 is below 200


@given(setup=setups, seed=st.integers(0, 99), most=st.integers(1, 9))
@settings(max_examples=60, deadline=None)
def test_calls_that_start_together_are_those_that_may_start_one_after_the_other(setup, seed, most):
    pacer, alone = simulate(setup, 1, seed, 60), Pacer(*setup)
    pacer.record_insert(7 * setup.block_rows)
    alone.state, started = pacer.state, 0
    while started < most and alone.updates_due():
        alone.record_sample(alone.updates_due())
        started += 1
    assert pacer.updates_due(most) == started * setup.updates_per_call


def test_nothing_is_sampled_before_min_replay():
    pacer = Pacer(*Setup(4.0, 100, 1, 1, 1, 1))
    pacer.record_insert(99)
    assert pacer.updates_due() == 0
    pacer.record_insert(1)
    assert pacer.updates_due() == 1


def test_blocks_in_flight_count_as_inserted():
    pacer = Pacer(*Setup(1.0, 10, 1, 1, 10, 3))  # at most 10 + 2 + 30 = 42
    assert [pacer.may_collect(in_flight) for in_flight in range(5)] == [True, True, True, True, False]
    pacer.record_insert(10)
    assert [pacer.may_collect(in_flight) for in_flight in range(4)] == [True, True, True, False]


@given(setup=setups, seed=st.integers(0, 99))
@settings(max_examples=30, deadline=None)
def test_a_restored_state_decides_the_same(setup, seed):
    pacer = simulate(setup, 1, seed, 60)
    pacer.record_wait(to_insert=True)
    pacer.record_wait(to_insert=False)
    pacer.record_wait(to_insert=False)
    resumed = Pacer(*setup)
    resumed.state = PacingState(**pacer.state._asdict())
    assert resumed.state == pacer.state and pacer.state[2:4] == (1, 2)
    for _ in range(30):
        assert resumed.updates_due() == pacer.updates_due()
        assert [resumed.may_collect(i) for i in range(4)] == [pacer.may_collect(i) for i in range(4)]
        for one in (pacer, resumed):
            one.record_sample(one.updates_due())
            one.record_insert(setup.block_rows)


def test_the_ratio_is_unknown_before_the_first_insert():
    pacer = Pacer(*Setup(4.0, 1, 8, 1, 8, 1))
    assert math.isnan(pacer.ratio())
    pacer.record_insert(8)
    pacer.record_sample(3)
    assert pacer.ratio() == 3.0


@pytest.mark.parametrize("name", Setup._fields)
@pytest.mark.parametrize("value", [0, -1])
def test_numbers_that_would_deadlock_are_refused(name, value):
    with pytest.raises(ValueError, match="positive"):
        Pacer(*Setup(4.0, 100, 32, 4, 64, 3)._replace(**{name: value}))


def test_the_pacer_of_a_run():
    config = RunConfig(envs_per_worker=4, steps_per_block=5, min_replay=40, batch_size=8, updates_per_call=3)
    pacer, same = make_pacer(config, 2), Pacer(config.samples_per_insert, 40, 8, 3, 20, 2)
    assert vars(pacer) == vars(same)
