"""How an episode ends: mutually exclusive outcomes, defined once for every method.

Spec of the task (3.1, 4.1): success is the mean distance of the learning robot's group to its goal
(Eq. 3.2; `group_distance`) below R2. Failures are told apart as lost and captured (Figure 3.3), collision and timeout.
Where two hold in one step, the first of collision, goal, lost or captured, timeout counts.

M_sensor fails as soon as the learning robot senses no own robot, M_IN and M_OUT once it has been outside its
group's ellipse for phi steps (with `lost_ends_episode`, at whichever of the two comes first). A robot that fails in
this way is captured if it senses, within R2, robots of other groups and none of its own; else it is lost. With
`captured_is = surrounded` those others must also stand around it.
`sim_core.episode_end` decides it.
"""

from __future__ import annotations

import enum


class Outcome(enum.IntEnum):
    """Why an episode ended; RUNNING while it has not."""

    RUNNING = 0
    GOAL = 1
    LOST = 2
    CAPTURED = 3
    COLLISION = 4
    TIMEOUT = 5


ENDED = tuple(outcome for outcome in Outcome if outcome is not Outcome.RUNNING)
OUTCOME_NAMES = tuple(outcome.name.lower() for outcome in Outcome)
