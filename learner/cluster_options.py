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
    """The Ray cluster to join, and how it looks after components.

    `address` None starts a Ray on this machine. `spares` are kept of the rollout workers, and of shards with actors of
    their own.
    """

    address: str | None = None
    deadline_s: float = DEADLINE_S
    start_deadline_s: float = START_DEADLINE_S
    spares: int = 0
