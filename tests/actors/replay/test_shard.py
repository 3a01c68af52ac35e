"""The ring of a replay shard against a deque, and the blocks and files that it refuses."""

import json
from collections import deque

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from actors.replay import frame_ring
from actors.replay.shard import ReplayShard, Stored
from actors.rollout.worker import join_stats
from actors.service import packing
from actors.service.messages import SCHEMA_VERSION, BlockHeader, TransitionBlock, transition_dtype
from actors.storage.zarr_columns import save_rows
from tests.packed import as_rows, pack

DTYPE = transition_dtype(gym.spaces.Box(-127, 127, (2, 3), np.int8))


def make_block(numbers, sequence=0, worker_id=0, incarnation=0, schema=SCHEMA_VERSION, dtype=DTYPE):
    """A block of transitions that carry `numbers` in several columns; the next observation shows the next number.

    Two in three find it in the row of that number; the third and the last one have frames.
    """
    numbers = np.asarray(numbers, np.int64)
    rows = np.zeros(len(numbers), dtype)
    rows["reward"] = rows["action"] = numbers
    rows["observation"], rows["next_observation"] = seen(numbers), seen(numbers + 1)
    ahead = (numbers % 3 > 0) & (np.append(numbers[1:], -1) == numbers + 1)
    header = BlockHeader(schema, worker_id, incarnation, sequence, 0, 0.0, 0.0, len(numbers))
    return TransitionBlock(header, pack(rows, ahead), join_stats([]))


def seen(numbers):
    """Observations of the transitions with these numbers."""
    return (numbers % 100)[:, None, None]


def held(shard, draws=600):
    """Numbers in the shard. 600 draws miss one of 12 with probability 1e-22, 5,000 draws one of 100 with 1e-20."""
    rows = shard.sample(draws).columns
    np.testing.assert_array_equal(rows["reward"], rows["action"])
    for name, numbers in (("observation", rows["action"]), ("next_observation", rows["action"] + 1)):
        np.testing.assert_array_equal(rows[name], np.tile(seen(numbers), (1, 2, 3)), err_msg=name)
    return set(rows["action"].tolist())


def counters(shard):
    """(transitions inserted, transitions dropped) since the start."""
    state = shard.get_state()
    return state["inserted"], state["dropped"]


@given(capacity=st.integers(1, 12), lengths=st.lists(st.integers(0, 30), min_size=1, max_size=12))
@settings(max_examples=80, deadline=None)
def test_a_shard_holds_the_newest_rows_like_a_deque(capacity, lengths):
    shard, oracle, total = ReplayShard(DTYPE, capacity, 0), deque(maxlen=capacity), 0
    for sequence, length in enumerate(lengths):
        numbers = list(range(total, total + length))
        assert shard.add(make_block(numbers, sequence)) == Stored(length, False)
        oracle.extend(numbers)
        total += length
        assert (shard.size, *counters(shard)) == (len(oracle), total, 0)
        if oracle:
            assert held(shard) == set(oracle)


def test_an_empty_shard_cannot_be_sampled():
    with pytest.raises(ValueError, match="empty"):
        ReplayShard(DTYPE, 4, 0).sample(1)


@pytest.mark.parametrize(("incarnation", "sequence"), [(1, 5), (1, 4), (0, 6), (0, 99)])
def test_duplicate_and_outdated_blocks_are_dropped(incarnation, sequence):
    shard = ReplayShard(DTYPE, 100, 0)
    shard.add(make_block([1, 2], sequence=5, incarnation=1))
    again = make_block([3, 4, 5], sequence=sequence, incarnation=incarnation)
    assert shard.add(again) == Stored(0, True)
    assert (shard.size, *counters(shard)) == (2, 2, 3)
    assert held(shard) == {1, 2}


@pytest.mark.parametrize(
    "header",
    [
        {"incarnation": 1, "sequence": 6},
        {"incarnation": 1, "sequence": 9},  # the blocks in between went to other shards
        {"incarnation": 2, "sequence": 0},  # a new incarnation counts from 0
        {"incarnation": 0, "sequence": 0, "worker_id": 7},
    ],
)
def test_new_blocks_are_stored(header):
    shard = ReplayShard(DTYPE, 100, 0)
    shard.add(make_block([1, 2], sequence=5, incarnation=1))
    assert shard.add(make_block([3], **header)) == Stored(1, False)
    assert held(shard) == {1, 2, 3} and counters(shard) == (3, 0)


@pytest.mark.parametrize(
    "other",
    [
        {"schema": SCHEMA_VERSION + 1},
        {"schema": SCHEMA_VERSION - 1},
        {"dtype": transition_dtype(gym.spaces.Box(-127, 127, (3, 2), np.int8))},
        {"dtype": transition_dtype(gym.spaces.Box(-127, 127, (2, 3), np.float32))},
    ],
)
def test_a_block_of_another_schema_is_refused_and_may_be_sent_again(other):
    shard = ReplayShard(DTYPE, 10, 0)
    with pytest.raises(ValueError, match="schema"):
        shard.add(make_block([1], **other))
    assert (shard.size, *counters(shard)) == (0, 0, 0)
    assert shard.add(make_block([1])) == Stored(1, False)


@pytest.mark.parametrize("inserted", [20, 40, 55])
def test_every_row_is_drawn_equally_often(inserted):
    shard = ReplayShard(DTYPE, 40, 3)
    shard.add(make_block(range(inserted)))
    counts = np.bincount(shard.sample(40_000).columns["action"], minlength=inserted)
    oldest = max(0, inserted - 40)
    assert not counts[:oldest].any()
    assert stats.chisquare(counts[oldest:]).pvalue > 1e-4


def test_draws_are_independent_and_with_replacement():
    shard = ReplayShard(DTYPE, 4, 1)
    shard.add(make_block(range(4)))
    drawn = shard.sample(20_000).columns["action"]
    pairs = np.bincount(4 * drawn[:-1:2] + drawn[1::2], minlength=16)
    assert stats.chisquare(pairs).pvalue > 1e-4


def test_samples_are_copies():
    shard = ReplayShard(DTYPE, 4, 1)
    shard.add(make_block([7, 7, 7, 7]))
    reply = shard.sample(8)
    assert reply.mass == 4 and reply.draws is None
    reply.columns["action"] = 0
    reply.columns["reward"] = 0
    assert held(shard) == {7}


def saved(shard, tmp_path):
    """Saves a shard and returns its state."""
    shard.snapshot().save(tmp_path / "shard.zarr")
    return json.loads(json.dumps(shard.get_state()))


def filled(tmp_path, capacity=16):
    """A shard after a wrap-around, a dropped block and a sample, and its saved state."""
    shard = ReplayShard(DTYPE, capacity, 11)
    shard.add(make_block(range(21), sequence=3, worker_id=2))
    shard.add(make_block(range(100, 103), sequence=0, worker_id=5, incarnation=4))
    shard.add(make_block(range(8), sequence=3, worker_id=2))
    shard.sample(5)
    return shard, saved(shard, tmp_path)


def test_a_restored_shard_continues_identically(tmp_path):
    shard, state = filled(tmp_path)
    resumed = ReplayShard(DTYPE, 16, 999)
    resumed.add(make_block(range(500, 516)))
    resumed.load(tmp_path / "shard.zarr", state)
    assert (resumed.size, *counters(resumed)) == (16, 24, 8)
    np.testing.assert_array_equal(as_rows(resumed.sample(50).columns), as_rows(shard.sample(50).columns))
    for copy in (shard, resumed):
        assert copy.add(make_block([1], sequence=3, worker_id=2)).duplicate
        assert not copy.add(make_block(range(200, 205), sequence=4, worker_id=2)).duplicate
    np.testing.assert_array_equal(as_rows(resumed.sample(50).columns), as_rows(shard.sample(50).columns))
    assert held(resumed) == held(shard) == {*range(13, 21), *range(100, 103), *range(200, 205)}


def test_an_empty_shard_can_be_saved(tmp_path):
    state = saved(ReplayShard(DTYPE, 8, 0), tmp_path)
    resumed = ReplayShard(DTYPE, 8, 0)
    resumed.load(tmp_path / "shard.zarr", state)
    assert resumed.size == 0


@pytest.mark.parametrize("capacity", [15, 17, 64])
def test_a_full_ring_of_another_capacity_is_refused(tmp_path, capacity):
    _, state = filled(tmp_path)
    with pytest.raises(ValueError, match="shard.zarr"):
        ReplayShard(DTYPE, capacity, 0).load(tmp_path / "shard.zarr", state)


def test_the_state_of_another_shard_is_refused(tmp_path):
    _, state = filled(tmp_path)
    with pytest.raises(ValueError, match="16 transitions"):
        ReplayShard(DTYPE, 16, 0).load(tmp_path / "shard.zarr", {**state, "size": 15})


def test_later_frames_are_not_in_a_snapshot(tmp_path):
    """The ring of frames is overwritten, and grows, before the snapshot is saved."""
    shard = ReplayShard(DTYPE, 6_000, 11)
    for sequence in range(9):
        shard.add(make_block(range(1_000 * sequence, 1_000 * (sequence + 1)), sequence))
    before = saved(shard, tmp_path)
    snapshot = shard.snapshot()
    for sequence in range(9, 40):
        numbers = np.arange(1_000 * sequence, 1_000 * (sequence + 1))
        # If every second number is missing, all rows have frames.
        shard.add(make_block(numbers[:: 1 + sequence % 2], sequence))
    snapshot.save(tmp_path / "later.zarr")
    one, two = ReplayShard(DTYPE, 6_000, 0), ReplayShard(DTYPE, 6_000, 0)
    one.load(tmp_path / "shard.zarr", before)
    two.load(tmp_path / "later.zarr", before)
    for shard in (one, two):
        assert set(shard.sample(200_000).columns["action"].tolist()) == set(range(3_000, 9_000))
    np.testing.assert_array_equal(as_rows(one.sample(5_000).columns), as_rows(two.sample(5_000).columns))
    held(two)


def test_frames_are_released_with_their_rows():
    shard = ReplayShard(DTYPE, 100, 0)
    for sequence in range(60):
        shard.add(make_block(range(70 * sequence, 70 * (sequence + 1)), sequence))
        inserted = 70 * (sequence + 1)
        numbers = range(max(0, inserted - 100), inserted)
        with_frames = sum(number % 3 == 0 or number % 70 == 69 for number in numbers)
        assert len(shard._frames.numbers) == with_frames
    assert len(shard._frames.slots) == frame_ring.MIN_CAPACITY


@pytest.mark.parametrize(
    ("slot", "next_row"), [(4, 12), (13, 3), (3, 12), (15, 1), (4, -(2**31)), (5, 2**31 - 1), (6, 0), (7, -1), (12, -5)]
)
def test_rows_with_invalid_links_are_refused(tmp_path, slot, next_row):
    """The file was changed together with its checksums."""
    shard = ReplayShard(DTYPE, 16, 0)
    shard.add(make_block(range(16)))
    state = saved(shard, tmp_path)
    shard._rows["next_row"][slot] = next_row
    save_rows(tmp_path / "shard.zarr", shard._rows)
    save_rows(tmp_path / "shard.zarr" / "frames", shard._frames.snapshot())
    with pytest.raises(ValueError, match=r"shard\.zarr has rows whose next observations are missing"):
        ReplayShard(DTYPE, 16, 0).load(tmp_path / "shard.zarr", state)


@pytest.mark.parametrize(
    "numbers",
    [[0, 5], [1, 7], [7, 1], [0, 5_000], [-6, 0], [2**70, 2**70 + 6], [False, 6], [0.0, 6.0], ["0", "6"], [0], 6, None],
)
def test_frames_of_another_snapshot_are_refused(tmp_path, numbers):
    shard = ReplayShard(DTYPE, 16, 0)
    shard.add(make_block(range(16)))
    state = saved(shard, tmp_path)
    assert state["frames"] == [0, 6]
    other = ReplayShard(DTYPE, 16, 0)
    other.add(make_block(range(100, 116)))
    with pytest.raises(ValueError, match="next observations are missing|no ring of frames|two whole numbers"):
        other.load(tmp_path / "shard.zarr", {**state, "frames": numbers})
    assert held(other) == set(range(100, 116))


@pytest.mark.parametrize(
    "change",
    [
        lambda packed: packed._replace(frames=packed.frames[:-1]),
        lambda packed: packed._replace(frames=np.concatenate([packed.frames, packed.frames[:1]])),
        lambda packed: packed._replace(frames=packed.frames.astype(np.float32)),
        lambda packed: packed._replace(frames=packed.frames.reshape(-1, 3, 2)),
        lambda packed: packed._replace(frames=packed.frames[:, :1]),
        lambda packed: with_next_row(packed, 4, 12),
        lambda packed: with_next_row(packed, 0, -1),
        lambda packed: with_next_row(packed, 5, 0),
    ],
)
def test_a_block_whose_frames_do_not_match_is_refused_and_may_be_sent_again(change):
    shard, block = ReplayShard(DTYPE, 100, 0), make_block(range(16))
    with pytest.raises(ValueError, match="and the frames that they refer to"):
        shard.add(block._replace(packed=change(block.packed)))
    assert (shard.size, *counters(shard)) == (0, 0, 0)
    assert shard.add(block) == Stored(16, False) and held(shard) == set(range(16))


def with_next_row(packed, slot, next_row):
    """A copy with another `next_row` in one slot."""
    rows = packed.rows.copy()
    rows["next_row"][slot] = next_row
    return packed._replace(rows=rows)


def test_frame_numbers_wrap_around(tmp_path):
    shard = ReplayShard(DTYPE, 100, 0)
    shard._frames._first = shard._frames._next = packing.FRAME_MODULUS - 20
    for sequence in range(8):
        shard.add(make_block(range(30 * sequence, 30 * (sequence + 1)), sequence))
        inserted = 30 * (sequence + 1)
        assert held(shard, 5_000) == set(range(max(0, inserted - 100), inserted))
        again = ReplayShard(DTYPE, 100, 0)
        again.load(tmp_path / "shard.zarr", saved(shard, tmp_path))
        assert held(again, 5_000) == held(shard, 5_000)
    assert shard._frames.numbers.stop > packing.FRAME_MODULUS


@pytest.mark.parametrize(
    "observation", [gym.spaces.Box(-1, 1, (), np.float32), gym.spaces.Box(-1, 1, (3,), np.float64)]
)
def test_observations_of_any_shape(observation):
    rows = np.zeros(9, transition_dtype(observation))
    rows["observation"] = np.arange(9).reshape(9, *[1] * len(observation.shape))
    rows["next_observation"] = rows["observation"] + 1
    header = BlockHeader(SCHEMA_VERSION, 0, 0, 0, 0, 0.0, 0.0, 9)
    shard = ReplayShard(rows.dtype, 9, 0)
    shard.add(TransitionBlock(header, pack(rows, [1, 0, 1, 1, 1, 0, 1, 1, 0]), join_stats([])))
    drawn = as_rows(shard.sample(200).columns)
    assert drawn.dtype == rows.dtype and len({row.tobytes() for row in drawn}) == 9
    np.testing.assert_array_equal(drawn["next_observation"], drawn["observation"] + 1)
