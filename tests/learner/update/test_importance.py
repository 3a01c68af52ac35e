"""Importance weights against numbers computed by hand and the paper's formula."""

import numpy as np
import pytest

from learner.update.importance import importance_weights


def test_importance_weights_by_hand():
    """Four stored transitions, minibatches of two: 1 / (4 P) to the power of beta, scaled to a greatest of 1."""
    weights = importance_weights(np.array([0.5, 0.25, 0.125, 0.125]), 2, 0.5)
    assert weights.dtype == np.float32
    assert weights.tolist() == pytest.approx([2**-0.5, 1, 1, 1])
    np.testing.assert_array_equal(importance_weights(np.array([0.5, 0.25]), 2, 0.0), [1, 1])


def test_importance_weights_equal_the_formula_of_the_paper():
    rng = np.random.default_rng(0)
    stored = rng.uniform(0.01, 1.0, 1000)
    stored /= stored.sum()
    for exponent in (0.4, 1.0):
        drawn = rng.choice(stored, size=(5, 32))
        expected = (1 / len(stored) / drawn) ** exponent
        expected /= expected.max(axis=1, keepdims=True)
        np.testing.assert_allclose(importance_weights(drawn.ravel(), 32, exponent).reshape(5, 32), expected, rtol=1e-6)


def test_importance_weights_with_beta_1_remove_all_of_the_bias():
    """beta = 1: the weighted mean over prioritised draws is the plain mean over all that is stored."""
    rng = np.random.default_rng(1)
    values = rng.normal(size=50)
    shares = (values.max() - values + 0.2) / (values.max() - values + 0.2).sum()
    drawn = rng.choice(50, p=shares, size=200_000)
    weights = importance_weights(shares[drawn], 200_000, 1.0).astype(float)
    spread = values[drawn] * weights
    error = 4 * spread.std() / np.sqrt(200_000) / weights.mean()
    assert spread.mean() / weights.mean() == pytest.approx(values.mean(), abs=error)
    assert abs(values[drawn].mean() - values.mean()) > 5 * error  # else nothing would be tested
