"""A snapshot of a ring holds the rows of its moment, whatever is inserted during reading."""

import threading

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from actors.replay.shard import ReplayShard
from actors.rollout.worker import join_stats
from actors.service.messages import SCHEMA_VERSION, BlockHeader, TransitionBlock, transition_dtype
from actors.service.packing import packed_dtype
from actors.storage import ring_snapshot
from tests.packed import pack

DTYPE = transition_dtype(gym.spaces.Box(-127, 127, (3,), np.int8))


def add(shard, numbers, sequence):
    rows = np.zeros(len(numbers), DTYPE)
    rows["action"] = numbers
    header = BlockHeader(SCHEMA_VERSION, 0, 0, sequence, 0, 0.0, 0.0, len(numbers))
    shard.add(TransitionBlock(header, pack(rows), join_stats([])))


@given(
    capacity=st.integers(1, 40),
    before=st.lists(st.integers(0, 50), max_size=5),
    after=st.lists(st.tuples(st.integers(0, 50), st.integers(0, 4)), max_size=12),
    pieces=st.integers(1, 4),
)
@settings(deadline=None)
def test_inserts_between_reads_change_nothing(capacity, before, after, pieces):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ring_snapshot, "PIECE_ROWS", 4)
        shard, total = ReplayShard(DTYPE, capacity, 0), 0
        for i, count in enumerate(before):
            add(shard, range(total, total + count), i)
            total += count
        expected = shard._rows[: shard.size].copy()
        snapshot = shard.snapshot().rows
        found, start, step = [], 0, 4 * pieces
        for i, (count, reads) in enumerate(after):
            add(shard, range(total, total + count), 100 + i)
            total += count
            for _ in range(reads):
                found.append(snapshot.read(start, min(len(snapshot), start + step)))
                start = min(start + step, -(-len(snapshot) // step) * step)
        for rest in range(start, len(snapshot), step):
            found.append(snapshot.read(rest, min(len(snapshot), rest + step)))
        rows = np.concatenate([np.zeros(0, packed_dtype(DTYPE)), *found])
        np.testing.assert_array_equal(rows, expected)


def test_a_thread_reads_the_snapshot_while_another_inserts():
    shard = ReplayShard(DTYPE, 40_000, 0)
    for i in range(5):
        add(shard, range(10_000 * i, 10_000 * (i + 1)), i)
    expected = shard._rows.copy()
    snapshot, found = shard.snapshot().rows, []

    def read():
        for start in range(0, 40_000, 8_192):
            found.append(snapshot.read(start, min(40_000, start + 8_192)))

    reader = threading.Thread(target=read)
    reader.start()
    for i in range(60):
        add(shard, range(1_000_000 + 3_000 * i, 1_000_000 + 3_000 * (i + 1)), 100 + i)
    reader.join()
    np.testing.assert_array_equal(np.concatenate(found), expected)
    assert not snapshot._saved, "copies are handed over"


def test_a_closed_snapshot_copies_nothing():
    shard = ReplayShard(DTYPE, 10_000, 0)
    add(shard, range(10_000), 0)
    snapshot = shard.snapshot().rows
    add(shard, range(5_000), 1)
    assert snapshot._saved
    snapshot.close()
    add(shard, range(9_000), 2)
    assert not snapshot._saved
