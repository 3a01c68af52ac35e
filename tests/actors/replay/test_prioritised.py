"""A prioritised shard against a plain list of rows and their priorities."""

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from actors.replay.prioritised import PRIORITY_EPSILON, PrioritisedShard, PrioritySettings
from actors.replay.shard import ReplayShard
from tests.actors.replay.test_shard import DTYPE, make_block
from tests.packed import as_rows

ALPHA = 0.6


def make_shard(capacity=40, exponent=ALPHA, strata=16, seed=0):
    return PrioritisedShard(DTYPE, capacity, seed, PrioritySettings(exponent, strata))


def by_number(shard):
    """Priority of every number in the shard whose rows carry their numbers as actions."""
    return dict(zip(shard._rows["action"][: shard.size].tolist(), shard.priorities.tolist(), strict=True))


@given(
    capacity=st.integers(1, 12), steps=st.lists(st.integers(-6, 30), min_size=1, max_size=25), seed=st.integers(0, 99)
)
@settings(max_examples=100, deadline=None)
def test_priorities_stay_with_their_rows(capacity, steps, seed):
    """A step adds so many rows, or (negative) answers some draw made before, perhaps long ago."""
    shard, rng = make_shard(capacity, strata=3), np.random.default_rng(seed)
    oracle, largest, total, stale, drawn = {}, 1.0, 0, 0, []
    for sequence, step in enumerate(steps):
        if step >= 0:
            shard.add(make_block(range(total, total + step), sequence))
            oracle |= dict.fromkeys(range(total, total + step), largest)
            total += step
            oracle = {number: oracle[number] for number in sorted(oracle)[-capacity:]}
        elif drawn:
            numbers = drawn[rng.integers(len(drawn))]
            errors = rng.normal(scale=3, size=len(numbers)).astype(np.float32)
            shard.set_priorities(numbers, errors)
            for number, error in zip(numbers.tolist(), errors.tolist(), strict=True):
                stale += number not in oracle
                if number in oracle:
                    oracle[number] = (abs(error) + PRIORITY_EPSILON) ** ALPHA
                    largest = max(largest, oracle[number])
        if oracle:
            reply = shard.sample(5)
            np.testing.assert_array_equal(reply.draws.insertion_index, reply.columns["action"])
            shares = [oracle[number] / sum(oracle.values()) for number in reply.draws.insertion_index.tolist()]
            np.testing.assert_allclose(reply.draws.probability, shares, rtol=1e-12)
            assert reply.mass == pytest.approx(sum(oracle.values()), rel=1e-12)
            drawn.append(reply.draws.insertion_index)
        assert by_number(shard) == pytest.approx(oracle, rel=1e-14)
    state = shard.get_state()
    assert (state["stale"], state["inserted"]) == (stale, total)


@pytest.mark.parametrize("exponent", [0.0, 0.6, 1.0])
def test_rows_are_drawn_in_proportion_to_their_tds_power(exponent):
    shard, errors = make_shard(50, exponent), np.geomspace(0.01, 10, 50).astype(np.float32)
    shard.add(make_block(range(70)))
    shard.set_priorities(np.arange(20, 70), errors * np.where(np.arange(50) % 2, 1, -1).astype(np.float32))
    drawn = shard.sample(200_000)
    shares = (errors.astype(np.float64) + PRIORITY_EPSILON) ** exponent
    shares /= shares.sum()
    expected = 200_000 * shares
    counts = np.bincount(drawn.columns["action"], minlength=70)
    assert not counts[:20].any()
    # Strata take a part of chance away, so that the statistic is below that of independent draws, never above.
    assert stats.chisquare(counts[20:], expected).pvalue > 1e-4
    np.testing.assert_allclose(drawn.draws.probability, shares[drawn.columns["action"] - 20], rtol=1e-5)


def test_one_stratum_a_draw_is_independent_draws():
    shard = make_shard(4, strata=1)
    shard.add(make_block(range(4)))
    shard.set_priorities(np.arange(4), np.array([0.1, 1, 2, 3], np.float32))
    drawn = shard.sample(40_000).columns["action"]
    shares = shard.priorities / shard.priorities.sum()
    pairs = np.bincount(4 * drawn[:-1:2] + drawn[1::2], minlength=16)
    assert stats.chisquare(pairs, 20_000 * np.outer(shares, shares).ravel()).pvalue > 1e-4


def test_new_rows_have_the_largest_priority_so_far():
    shard = make_shard(10)
    shard.add(make_block(range(4), 0))
    shard.set_priorities(np.arange(4), np.array([0.5, -9, 0.25, 0], np.float32))
    shard.add(make_block([4, 5], 1))
    shard.set_priorities(np.array([1]), np.array([0.125], np.float32))
    shard.add(make_block([6], 2))
    largest = (9 + PRIORITY_EPSILON) ** ALPHA
    assert [by_number(shard)[number] for number in (4, 5, 6)] == pytest.approx([largest] * 3)
    assert by_number(shard)[1] == pytest.approx((0.125 + PRIORITY_EPSILON) ** ALPHA)


def test_a_row_without_error_is_still_drawn_some_day():
    shard = make_shard(2, exponent=1.0)
    shard.add(make_block([0, 1]))
    shard.set_priorities(np.array([0, 1]), np.array([0, 0], np.float32))
    assert set(shard.sample(200).columns["action"].tolist()) == {0, 1}


def test_overwritten_rows_are_left_out_and_counted():
    shard = make_shard(10)
    shard.add(make_block(range(8), 0))
    drawn = np.arange(8)
    shard.add(make_block(range(8, 15), 1))  # in the place of 0 to 4
    shard.set_priorities(drawn, np.full(8, 2.0, np.float32))
    changed = (2 + PRIORITY_EPSILON) ** ALPHA
    assert by_number(shard) == pytest.approx({**{n: changed for n in (5, 6, 7)}, **{n: 1.0 for n in range(8, 15)}})
    assert shard.get_state()["stale"] == 5
    shard.set_priorities(np.array([-1, 15, 99]), np.full(3, 5.0, np.float32))  # of a shard that lived longer
    assert shard.get_state()["stale"] == 8 and max(by_number(shard).values()) == pytest.approx(changed)


def test_the_last_answer_of_a_row_counts():
    shard = make_shard(4)
    shard.add(make_block(range(4)))
    shard.set_priorities(np.array([2, 1, 2, 2]), np.array([9, 4, 7, 0.5], np.float32))
    assert by_number(shard)[2] == pytest.approx((0.5 + PRIORITY_EPSILON) ** ALPHA)


@pytest.mark.parametrize("error", [np.nan, np.inf, -np.inf])
def test_what_is_no_number_is_refused_and_changes_nothing(error):
    shard = make_shard(4)
    shard.add(make_block(range(4)))
    with pytest.raises(ValueError, match="diverged"):
        shard.set_priorities(np.array([0, 1]), np.array([2.0, error], np.float32))
    assert set(by_number(shard).values()) == {1.0} and shard.mass == 4


def test_an_empty_shard_cannot_be_sampled():
    with pytest.raises(ValueError, match="empty"):
        make_shard().sample(1)


def test_repeated_blocks_change_no_priorities():
    shard = make_shard(10)
    shard.add(make_block(range(5), 3))
    shard.set_priorities(np.arange(5), np.full(5, 0.5, np.float32))
    assert shard.add(make_block(range(5), 3)).duplicate
    assert shard.mass == pytest.approx(5 * (0.5 + PRIORITY_EPSILON) ** ALPHA)


def filled(tmp_path, inserted=(21, 3)):
    """A shard that has sampled, been answered and (with 24 rows) wrapped; and its save."""
    shard = make_shard(16, seed=11)
    first, second = inserted
    shard.add(make_block(range(first), sequence=3, worker_id=2))
    shard.set_priorities(shard.sample(9).draws.insertion_index, np.linspace(-4, 9, 9, dtype=np.float32))
    shard.add(make_block(range(first, first + second), sequence=4, worker_id=2))
    shard.set_priorities(np.array([0, first]), np.array([1.5, 3.5], np.float32))
    shard.snapshot().save(tmp_path / "shard.zarr")
    return shard, json.loads(json.dumps(shard.get_state()))


@pytest.mark.parametrize("inserted", [(21, 3), (5, 2), (9, 7)])
def test_a_saved_shard_goes_on_bit_by_bit(tmp_path, inserted):
    shard, state = filled(tmp_path, inserted)
    resumed = make_shard(16, seed=99)
    resumed.add(make_block(range(500, 516)))
    resumed.set_priorities(resumed.sample(16).draws.insertion_index, np.full(16, 77, np.float32))
    resumed.load(tmp_path / "shard.zarr", state)
    assert resumed.get_state() == shard.get_state() and resumed.mass == shard.mass
    assert resumed.get_state()["stale"] == (1 if sum(inserted) > 16 else 0)
    for copy in (shard, resumed):
        for sequence in (5, 6):
            drawn = copy.sample(50)
            copy.add(make_block(range(200, 205), sequence, worker_id=2))
            copy.set_priorities(drawn.draws.insertion_index, drawn.columns["reward"] / 7)
    one, two = shard.sample(50), resumed.sample(50)
    np.testing.assert_array_equal(as_rows(one.columns), as_rows(two.columns))
    np.testing.assert_array_equal(one.draws, two.draws)
    assert one.mass == two.mass
    np.testing.assert_array_equal(shard.priorities, resumed.priorities)


def test_what_comes_after_the_snapshot_is_not_in_it(tmp_path):
    shard, state = filled(tmp_path)
    snapshot, before = shard.snapshot(), shard.priorities.copy()
    shard.add(make_block(range(300, 309), sequence=5, worker_id=2))
    shard.set_priorities(shard.sample(16).draws.insertion_index, np.linspace(0.1, 90, 16, dtype=np.float32))
    snapshot.save(tmp_path / "later.zarr")
    resumed, expected = make_shard(16), make_shard(16)
    resumed.load(tmp_path / "later.zarr", state)
    expected.load(tmp_path / "shard.zarr", state)
    np.testing.assert_array_equal(resumed.priorities, before)
    np.testing.assert_array_equal(as_rows(resumed.sample(50).columns), as_rows(expected.sample(50).columns))


def test_a_save_that_does_not_fit_is_refused(tmp_path):
    _, state = filled(tmp_path)
    with pytest.raises(ValueError, match="another capacity than 17"):
        make_shard(17).load(tmp_path / "shard.zarr", state)
    with pytest.raises(ValueError, match="16 priorities for 15"):
        make_shard(16).load(tmp_path / "shard.zarr", {**state, "size": 15})
    (tmp_path / "shard.zarr" / "priorities" / "priority" / "c" / "0").unlink()
    with pytest.raises(ValueError, match="damaged"):
        make_shard(16).load(tmp_path / "shard.zarr", state)


def test_a_save_without_priorities_is_refused(tmp_path):
    shard = ReplayShard(DTYPE, 16, 0)
    shard.snapshot().save(tmp_path / "shard.zarr")
    state = shard.get_state()
    with pytest.raises(ValueError, match="without priorities"):
        make_shard(16).load(tmp_path / "shard.zarr", state)
