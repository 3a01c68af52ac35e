"""Importance weights of prioritised samples."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def importance_weights(probability: NDArray[np.float64], batch_size: int, exponent: float) -> NDArray[np.float32]:
    """(1 / (N P(i))) ** beta, divided by the greatest weight of the minibatch, so that updates are only scaled down.

    Schaul et al. (2016), Section 3.4. N, the number of stored transitions, cancels.

    Args:
      probability: with which each transition was drawn, `[count]`, minibatch after minibatch.
      batch_size: transitions of a minibatch; divides count.
      exponent: beta.

    Returns:
      Weights `[count]` in (0, 1].
    """
    minibatches = probability.reshape(-1, batch_size)
    weights: NDArray[np.float64] = (minibatches.min(axis=1, keepdims=True) / minibatches) ** exponent
    return weights.ravel().astype(np.float32)
