"""Where a run's components are placed, and when one of them counts as late; imports nothing heavy.

The command line reads its defaults here, so that `shoal --help` need not import torch or Ray.
"""

from __future__ import annotations

from typing import NamedTuple

DEADLINE_S = 300.0
"""A component that owes an answer for this long is late, unless another deadline is given."""
START_DEADLINE_S = 300.0
"""The same while it starts or is restored: it loads libraries, or waits for a free CPU."""


class Place(NamedTuple):
    """A Ray cluster's address (None: a Ray of its own on this machine) and the deadlines of components placed there."""

    address: str | None = None
    deadline_s: float = DEADLINE_S
    start_deadline_s: float = START_DEADLINE_S
