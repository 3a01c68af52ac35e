"""FL-ORCA as the driver of the learning robot."""

from __future__ import annotations

import enum


class Pilot(enum.Enum):
    """FL-ORCA in the learning robot's place, for which it knows its goal and its neighbours' velocities."""

    FREE = enum.auto()
    """It moves with FL-ORCA's velocity."""
    SNAPPED = enum.auto()
    """It takes the action whose velocity is nearest to FL-ORCA's."""
