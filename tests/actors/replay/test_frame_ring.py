"""The ring of frames against a deque."""

from collections import deque

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from actors.replay import frame_ring
from actors.replay.frame_ring import FrameRing
from actors.service import packing
from actors.storage.zarr_columns import load_rows, save_rows

OBSERVATION = np.dtype((np.int16, (2,)))


def frames_of(numbers):
    """Frames that show their numbers."""
    return (np.asarray(numbers, np.int64) % 30_000)[:, None].repeat(2, axis=1).astype(np.int16)


def held(ring):
    """The frames held, oldest first, looked up as for a row."""
    slots = [number % packing.FRAME_MODULUS % len(ring.slots) for number in ring.numbers]
    return ring.slots["observation"][np.array(slots, np.int64)]


@given(
    first=st.sampled_from([0, 7, packing.FRAME_MODULUS - 20, 3 * packing.FRAME_MODULUS - 1]),
    steps=st.lists(st.tuples(st.integers(0, 40), st.integers(0, 40)), max_size=20),
)
@settings(max_examples=150, deadline=None)
def test_a_ring_holds_the_unreleased_frames_like_a_deque(first, steps):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(frame_ring, "MIN_CAPACITY", 8)
        ring, oracle, number = FrameRing(OBSERVATION), deque(), first
        ring._first = ring._next = first
        most = 0
        for pushed, released in steps:
            numbers = range(number, number + pushed)
            assert ring.push(frames_of(numbers)) == number
            oracle.extend(numbers)
            number += pushed
            most = max(most, len(oracle))
            np.testing.assert_array_equal(held(ring), frames_of(list(oracle)))
            for _ in range(min(released, len(oracle))):
                oracle.popleft()
                ring.release(1)
        assert list(ring.numbers) == list(oracle)
        assert len(ring.slots) == max(8, 1 << max(0, most - 1).bit_length())


@pytest.mark.parametrize("capacity", [0, 8, 1_000, 1_025, 3_072])
def test_an_impossible_capacity_is_refused(tmp_path, capacity):
    ring = FrameRing(OBSERVATION)
    save_rows(tmp_path / "frames", np.zeros(capacity, ring.slots.dtype))
    with pytest.raises(ValueError, match="no ring of frames 0 to 0"):
        ring.load(tmp_path / "frames", [0, 0], at_most=10_000)


def test_a_ring_larger_than_its_shard_needs_is_refused(tmp_path):
    ring = FrameRing(OBSERVATION)
    ring.push(frames_of(range(1_025)))
    save_rows(tmp_path / "frames", ring.snapshot())
    assert len(load_rows(tmp_path / "frames", ring.slots.dtype)) == 2_048
    again = FrameRing(OBSERVATION)
    again.load(tmp_path / "frames", ring.get_state(), at_most=1_025)
    np.testing.assert_array_equal(held(again), held(ring))
    with pytest.raises(ValueError, match="at most 1024"):
        again.load(tmp_path / "frames", ring.get_state(), at_most=1_024)
