"""The network that acts: against plain numpy; nothing that it says of an observation depends on the others."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from actors.policy.policy import Policy, WeightsSnapshot


def snapshot(sizes, seed=0):
    """A network with random weights of so many inputs, hidden units and actions."""
    rng, arrays = np.random.default_rng(seed), []
    for fan_in, fan_out in zip(sizes, sizes[1:], strict=False):
        arrays += [rng.normal(0, fan_in**-0.5, (fan_out, fan_in)), rng.normal(0, 0.3, fan_out)]
    return WeightsSnapshot(0, 0.0, tuple(array.astype(np.float32) for array in arrays))


def forward(weights, observations):
    """The action values in float64, by the definition."""
    values, arrays = observations.astype(np.float64), weights.arrays
    for i in range(0, len(arrays), 2):
        values = values @ arrays[i].T.astype(np.float64) + arrays[i + 1]
        values = np.maximum(values, 0) if i + 2 < len(arrays) else values
    return values


def counts(batch, size, seed=0):
    """Observations like M_sensor's `[batch, size]`: small numbers, most of them 0."""
    rng = np.random.default_rng(seed)
    return (rng.integers(-3, 4, (batch, size)) * (rng.random((batch, size)) < 0.4)).astype(np.int8)


@given(
    sizes=st.lists(st.integers(1, 150), min_size=2, max_size=4),
    batch=st.sampled_from([1, 2, 15, 16, 17, 40]),
    seed=st.integers(0, 1000),
)
@settings(max_examples=60, deadline=None)
def test_values_are_those_of_the_definition(sizes, batch, seed):
    weights, observations = snapshot(sizes, seed), counts(batch, sizes[0], seed)
    found = Policy(weights).values(observations)
    np.testing.assert_allclose(found, forward(weights, observations), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("sizes", [(16, 128, 128, 8), (5, 7, 3), (40, 64, 20)])
def test_what_is_said_of_an_observation_does_not_depend_on_the_batch(sizes):
    policy, observations = Policy(snapshot(sizes)), counts(100, sizes[0])
    together = policy.values(observations)
    for first, count in ((0, 1), (3, 16), (90, 10), (50, 33)):
        np.testing.assert_array_equal(
            policy.values(observations[first : first + count]), together[first : first + count]
        )


@given(seed=st.integers(0, 1000), repeats=st.floats(0.0, 1.0), with_mask=st.booleans())
@settings(max_examples=60, deadline=None)
def test_rows_whose_observation_stays_keep_their_action_and_value(seed, repeats, with_mask):
    rng, weights = np.random.default_rng(seed), snapshot((6, 20, 5), seed)
    policy, observations = Policy(weights), counts(30, 6, seed)
    for _ in range(5):
        decides = rng.random(30) < 0.7 if with_mask else None
        values = Policy(weights).values(observations)
        taken = np.ones(30, bool) if decides is None else decides
        np.testing.assert_array_equal(policy.greedy(observations, decides), np.where(taken, values.argmax(axis=1), 0))
        np.testing.assert_array_equal(policy.highest_values()[taken], values.max(axis=1)[taken])
        changes = rng.random(30) >= repeats
        observations[changes] = counts(30, 6, int(rng.integers(10_000)))[changes]


def test_a_row_that_did_not_decide_at_first_is_not_taken_for_known():
    weights, observations = snapshot((3, 8, 4), 1), np.zeros((2, 3), np.int8)
    policy, best = Policy(weights), Policy(weights).values(observations).argmax(axis=1)
    assert best[1] != 0  # else this would show nothing
    np.testing.assert_array_equal(policy.greedy(observations, np.array([True, False])), [best[0], 0])
    np.testing.assert_array_equal(policy.greedy(observations), best)


def test_batches_of_other_sizes_come_in_turn():
    weights = snapshot((4, 12, 3))
    policy = Policy(weights)
    for batch in (8, 3, 8, 1):
        observations = counts(batch, 4, batch)
        expected = Policy(weights).values(observations)
        np.testing.assert_array_equal(policy.greedy(observations), expected.argmax(axis=1))
        np.testing.assert_array_equal(policy.highest_values(), expected.max(axis=1))


def test_nan_in_an_observation_shows():
    policy = Policy(snapshot((4, 12, 3)))
    assert np.isnan(policy.values(np.array([[0.0, np.nan, 0.0, 1.0]], np.float32))).all()
