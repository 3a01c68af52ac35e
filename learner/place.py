"""Where a run's parts go, and how patient they are with each other; no part of what it learns."""

from __future__ import annotations

from typing import NamedTuple

DEADLINE_S = 300.0
"""A part that owes an answer and is silent for so long is late, unless another deadline is given."""
START_DEADLINE_S = 300.0
"""A part that is being started or restored may take so long to answer: it loads libraries, or waits for a free CPU."""


class Place(NamedTuple):
    """Where Ray puts a run's parts, the cluster's address or None for this machine, and when one of them is late."""

    address: str | None = None
    deadline_s: float = DEADLINE_S
    start_deadline_s: float = START_DEADLINE_S
