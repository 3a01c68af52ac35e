"""A prioritised shard against a plain dict of priorities."""

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


def by_index(shard):
    """Priorities by insertion index, in a shard whose rows carry their insertion indices as actions."""
    return dict(zip(shard._rows["action"][: shard.size].tolist(), shard.priorities.tolist(), strict=True))


@given(
    capacity=st.integers(1, 12), steps=st.lists(st.integers(-6, 30), min_size=1, max_size=25), seed=st.integers(0, 99)
)
@settings(max_examples=100, deadline=None)
def test_priorities_stay_with_their_rows(capacity, steps, seed):
    """A step adds that many rows or, if it is negative, updates the priorities of an earlier sample."""
    shard, rng = make_shard(capacity, strata=3), np.random.default_rng(seed)
    oracle, largest, total, stale, drawn = {}, 1.0, 0, 0, []
    for sequence, step in enumerate(steps):
        if step >= 0:
            shard.add(make_block(range(total, total + step), sequence))
            oracle |= dict.fromkeys(range(total, total + step), largest)
            total += step
            oracle = {index: oracle[index] for index in sorted(oracle)[-capacity:]}
        elif drawn:
            indices = drawn[rng.integers(len(drawn))]
            errors = rng.normal(scale=3, size=len(indices)).astype(np.float32)
            shard.set_priorities(indices, errors)
            for index, error in zip(indices.tolist(), errors.tolist(), strict=True):
                stale += index not in oracle
                if index in oracle:
                    oracle[index] = (abs(error) + PRIORITY_EPSILON) ** ALPHA
                    largest = max(largest, oracle[index])
        if oracle:
            reply = shard.sample(5)
            np.testing.assert_array_equal(reply.draws.insertion_index, reply.columns["action"])
            shares = [oracle[index] / sum(oracle.values()) for index in reply.draws.insertion_index.tolist()]
            np.testing.assert_allclose(reply.draws.probability, shares, rtol=1e-12)
            assert reply.mass == pytest.approx(sum(oracle.values()), rel=1e-12)
            drawn.append(reply.draws.insertion_index)
        assert by_index(shard) == pytest.approx(oracle, rel=1e-14)
    state = shard.get_state()
    assert (state["stale"], state["inserted"]) == (stale, total)


@pytest.mark.parametrize("exponent", [0.0, 0.6, 1.0])
def test_rows_are_drawn_in_proportion_to_their_priorities(exponent):
    shard, errors = make_shard(50, exponent), np.geomspace(0.01, 10, 50).astype(np.float32)
    shard.add(make_block(range(70)))
    shard.set_priorities(np.arange(20, 70), errors * np.where(np.arange(50) % 2, 1, -1).astype(np.float32))
    drawn = shard.sample(200_000)
    shares = (errors.astype(np.float64) + PRIORITY_EPSILON) ** exponent
    shares /= shares.sum()
    expected = 200_000 * shares
    counts = np.bincount(drawn.columns["action"], minlength=70)
    assert not counts[:20].any()
    # Stratification reduces the variance, so that the statistic is below that of independent draws, never above.
    assert stats.chisquare(counts[20:], expected).pvalue > 1e-4
    np.testing.assert_allclose(drawn.draws.probability, shares[drawn.columns["action"] - 20], rtol=1e-5)


def test_one_draw_per_batch_gives_independent_draws():
    shard = make_shard(4, strata=1)
    shard.add(make_block(range(4)))
    shard.set_priorities(np.arange(4), np.array([0.1, 1, 2, 3], np.float32))
    drawn = shard.sample(40_000).columns["action"]
    shares = shard.priorities / shard.priorities.sum()
    pairs = np.bincount(4 * drawn[:-1:2] + drawn[1::2], minlength=16)
    assert stats.chisquare(pairs, 20_000 * np.outer(shares, shares).ravel()).pvalue > 1e-4


def test_new_rows_have_the_maximum_priority_so_far():
    shard = make_shard(10)
    shard.add(make_block(range(4), 0))
    shard.set_priorities(np.arange(4), np.array([0.5, -9, 0.25, 0], np.float32))
    shard.add(make_block([4, 5], 1))
    shard.set_priorities(np.array([1]), np.array([0.125], np.float32))
    shard.add(make_block([6], 2))
    largest = (9 + PRIORITY_EPSILON) ** ALPHA
    assert [by_index(shard)[index] for index in (4, 5, 6)] == pytest.approx([largest] * 3)
    assert by_index(shard)[1] == pytest.approx((0.125 + PRIORITY_EPSILON) ** ALPHA)


def test_a_row_without_td_error_is_still_drawn():
    shard = make_shard(2, exponent=1.0)
    shard.add(make_block([0, 1]))
    shard.set_priorities(np.array([0, 1]), np.array([0, 0], np.float32))
    assert set(shard.sample(200).columns["action"].tolist()) == {0, 1}


def test_stale_priority_updates_are_ignored_and_counted():
    shard = make_shard(10)
    shard.add(make_block(range(8), 0))
    drawn = np.arange(8)
    shard.add(make_block(range(8, 15), 1))  # overwrites 0 to 4
    shard.set_priorities(drawn, np.full(8, 2.0, np.float32))
    changed = (2 + PRIORITY_EPSILON) ** ALPHA
    assert by_index(shard) == pytest.approx({**{n: changed for n in (5, 6, 7)}, **{n: 1.0 for n in range(8, 15)}})
    assert shard.get_state()["stale"] == 5
    shard.set_priorities(np.array([-1, 15, 99]), np.full(3, 5.0, np.float32))  # from a shard with more insertions
    assert shard.get_state()["stale"] == 8 and max(by_index(shard).values()) == pytest.approx(changed)


def test_the_last_update_of_a_row_counts():
    shard = make_shard(4)
    shard.add(make_block(range(4)))
    shard.set_priorities(np.array([2, 1, 2, 2]), np.array([9, 4, 7, 0.5], np.float32))
    assert by_index(shard)[2] == pytest.approx((0.5 + PRIORITY_EPSILON) ** ALPHA)


@pytest.mark.parametrize("error", [np.nan, np.inf, -np.inf])
def test_a_td_error_that_is_not_finite_is_refused_and_changes_nothing(error):
    shard = make_shard(4)
    shard.add(make_block(range(4)))
    with pytest.raises(ValueError, match="diverged"):
        shard.set_priorities(np.array([0, 1]), np.array([2.0, error], np.float32))
    assert set(by_index(shard).values()) == {1.0} and shard.mass == 4


def test_an_empty_shard_cannot_be_sampled():
    with pytest.raises(ValueError, match="empty"):
        make_shard().sample(1)


def test_duplicate_blocks_change_no_priorities():
    shard = make_shard(10)
    shard.add(make_block(range(5), 3))
    shard.set_priorities(np.arange(5), np.full(5, 0.5, np.float32))
    assert shard.add(make_block(range(5), 3)).duplicate
    assert shard.mass == pytest.approx(5 * (0.5 + PRIORITY_EPSILON) ** ALPHA)


def filled(tmp_path, inserted=(21, 3)):
    """A shard after samples, priority updates and (with 24 rows) a wrap-around, and its saved state."""
    shard = make_shard(16, seed=11)
    first, second = inserted
    shard.add(make_block(range(first), sequence=3, worker_id=2))
    shard.set_priorities(shard.sample(9).draws.insertion_index, np.linspace(-4, 9, 9, dtype=np.float32))
    shard.add(make_block(range(first, first + second), sequence=4, worker_id=2))
    shard.set_priorities(np.array([0, first]), np.array([1.5, 3.5], np.float32))
    shard.snapshot().save(tmp_path / "shard.zarr")
    return shard, json.loads(json.dumps(shard.get_state()))


@pytest.mark.parametrize("inserted", [(21, 3), (5, 2), (9, 7)])
def test_a_restored_shard_continues_bit_by_bit(tmp_path, inserted):
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


def test_later_changes_are_not_in_a_snapshot(tmp_path):
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


def test_a_saved_shard_that_does_not_fit_is_refused(tmp_path):
    _, state = filled(tmp_path)
    with pytest.raises(ValueError, match="another capacity than 17"):
        make_shard(17).load(tmp_path / "shard.zarr", state)
    with pytest.raises(ValueError, match="16 priorities for 15"):
        make_shard(16).load(tmp_path / "shard.zarr", {**state, "size": 15})
    (tmp_path / "shard.zarr" / "priorities" / "priority" / "c" / "0").unlink()
    with pytest.raises(ValueError, match="damaged"):
        make_shard(16).load(tmp_path / "shard.zarr", state)


def test_a_saved_shard_without_priorities_is_refused(tmp_path):
    shard = ReplayShard(DTYPE, 16, 0)
    shard.snapshot().save(tmp_path / "shard.zarr")
    state = shard.get_state()
    with pytest.raises(ValueError, match="without priorities"):
        make_shard(16).load(tmp_path / "shard.zarr", state)
