"""What an update tells."""

from __future__ import annotations

from typing import NamedTuple


class UpdateStats(NamedTuple):
    """Means over the updates of one call: loss, action value, absolute TD error."""

    loss: float
    q_mean: float
    td_error: float
