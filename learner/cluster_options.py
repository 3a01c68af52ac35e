"""Options of a run's cluster: its address, and when a component counts as late; imports nothing heavy.

The command line reads its defaults here, so that `shoal --help` need not import torch or Ray.
"""

from __future__ import annotations

from typing import NamedTuple

DEADLINE_S = 300.0
"""Default time after which a component that owes an answer is late."""
START_DEADLINE_S = 300.0
"""The same for a component that is starting or restored: it loads libraries, or waits for a free CPU."""


class ClusterOptions(NamedTuple):
    """Address of the Ray cluster to join (None starts a Ray on this machine), and the deadlines of its components."""

    address: str | None = None
    deadline_s: float = DEADLINE_S
    start_deadline_s: float = START_DEADLINE_S
