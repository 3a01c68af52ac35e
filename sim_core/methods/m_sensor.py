"""M_sensor: counts of robots in sectors around the learning robot (Chapter 3).

Two sensing regions, the disc of radius R1 and the ring from R1 to R2, are cut into q sectors
(Figure 3.1). The state is, per region and sector, the number of own-group robots less the number of
other-group robots (3.2.1). Sectors and headings are in the world frame. Of ours are `sensor_counts =
separate`, which puts the two counts apart, and `sector_frame = goal`, which turns sectors and headings so
that angle 0 is the direction of the own goal.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sim_core.checks import require
from sim_core.config import WorldConfig
from sim_core.jit import StateKernel, inlined, kernel
from sim_core.lanes import LANES, convert, gather, lane_numbers, load_some, select, splat, store_numbers, store_some
from sim_core.methods.base import Method, Preset, Rule
from sim_core.methods.progress import goal_offset
from sim_core.packed import packed
from sim_core.state import WorldState, own_group, world_of

COUNT_LIMIT = 127
"""Counts saturate here, so that they fit int8."""
WORLD: dict[str, Any] = {"max_neighbours": 16, "orca_radius_m": 0.18, "robot_radius_m": 0.06}
"""The world of the presets (see `learner.presets`)."""
BEST_WORLD: dict[str, Any] = {
    **WORLD,
    "sensor_counts": "separate",
    "decision_interval_steps": 4,
    "horizon_is": "failure",
}
BEST = Preset({"discount": 0.985, "policy_average_updates": 1_000, "random_turns": True}, BEST_WORLD)
GENERALIST = Preset(
    {
        **BEST.training,
        "discount": 0.99,
        "n_step": 6,
        "network": "dueling",
        "hidden_sizes": (256, 256),
        "policy_average_updates": 5_000,
        "total_env_steps": 800_000,
        "learning_rate_decay_env_steps": 800_000,
    },
    BEST_WORLD,
)


class SensorParams(NamedTuple):
    """Constants of M_sensor."""

    sectors: int
    separate: bool
    faces_goal: bool
    inner_sq: Any
    outer_sq: Any


def sector_edges(sectors: int) -> NDArray[np.float64]:
    """Unit vectors `[sectors, 2]` at the angles where the sectors begin, from -pi on."""
    angle = np.arange(sectors) * (2 * math.pi / sectors) - math.pi
    return np.round(np.stack([np.cos(angle), np.sin(angle)], axis=1), 15)  # so that 45 and 90 degrees are exact


@kernel
def sector_of(dx, dy, edges):
    """Sector 0..sectors-1 of the direction (dx, dy); sector 0 begins at angle -pi. `edges` as of `sector_edges`."""
    sectors = edges.shape[0]
    half = (sectors + 1) // 2  # the first edge at or above angle 0
    first, last = (half, sectors) if dy >= 0.0 else (1, half)
    sector = first - 1
    for edge in range(first, last):  # no angle is needed to see on which side of an edge a direction lies
        sector += 1 if edges[edge, 0] * dy - edges[edge, 1] * dx >= 0.0 else 0
    return sector


@kernel
def _goal_direction(state, row):
    """Unit vector from a row's learning robot to its goal; +x where it stands on it."""
    dx, dy = goal_offset(state, row)
    length = np.sqrt(dx * dx + dy * dy)
    if length == 0.0:
        return np.cos(dx), dy  # (1, 0) of the positions' dtype
    return dx / length, dy / length


@kernel
def _turn_to_goal(state, out_x, out_y):
    for row in range(out_x.shape[0]):
        cos, sin = _goal_direction(state, row)
        x, y = out_x[row], out_y[row]
        out_x[row], out_y[row] = cos * x - sin * y, sin * x + cos * y


@inlined
def _sectors_of(dx, dy, edges):
    """The sectors of the directions in the lanes of (dx, dy), as `sector_of` finds them: a vector of int32."""
    x, y, half = convert(dx, np.float64), convert(dy, np.float64), (edges.shape[0] + 1) // 2
    upper = y >= 0.0
    sector = select(upper, half - 1, splat(0))
    for edge in range(1, edges.shape[0]):
        passed = edges[edge, 0] * y - edges[edge, 1] * x >= 0.0
        same_half = upper if edge >= half else ~upper
        sector = sector + select(passed & same_half, splat(1), splat(0))
    return sector


@inlined
def _find_sensed(learner, pos_x, pos_y, found, p):
    """Writes the numbers of the robots within the outer radius, the learning robot not counted; returns how many."""
    count, num_robots = 0, pos_x.shape[0]
    for first in range(0, num_robots, LANES):
        number, left = lane_numbers() + first, num_robots - first
        dx = load_some(pos_x, first, left) - pos_x[learner]
        dy = load_some(pos_y, first, left) - pos_y[learner]
        near = dx * dx + dy * dy < p.outer_sq  # robots that are not sensed are at NaN
        count += store_numbers(found, count, near & (number != learner) & (number < num_robots), first)
    for i in range(LANES):
        found[count + i] = learner
    return count


@kernel
def _perceive(state, mask, out, edges, scratch, params):
    p = params[0]
    found, cells = scratch[0], scratch[1]
    for row in range(mask.shape[0]):
        if not mask[row]:
            continue
        world, learner = world_of(state, row), state.learner[row]
        pos_x, pos_y = state.pos_x[world], state.pos_y[world]
        _, group_begin, group_end = own_group(state, row)
        cos, sin = _goal_direction(state, row)
        out[row, :] = 0
        count = _find_sensed(learner, pos_x, pos_y, found, p)
        for i in range(0, count, LANES):
            others = load_some(found, i, LANES)
            dx, dy = gather(pos_x, others) - pos_x[learner], gather(pos_y, others) - pos_y[learner]
            is_inner = dx * dx + dy * dy < p.inner_sq
            if p.faces_goal:
                dx, dy = cos * dx + sin * dy, cos * dy - sin * dx
            store_some(cells, i, LANES, _sectors_of(dx, dy, edges) + select(is_inner, splat(0), p.sectors))
        for i in range(count):
            cell, step = cells[i], 1
            if not group_begin <= found[i] < group_end:
                cell, step = (cell + 2 * p.sectors, 1) if p.separate else (cell, -1)
            out[row, cell] = min(max(out[row, cell] + step, -COUNT_LIMIT), COUNT_LIMIT)


@kernel
def _turn(observation, parts, sectors, scratch):
    for i in range(observation.shape[0]):
        for begin in range(0, observation.shape[1], sectors):
            for sector in range(sectors):
                scratch[sector] = observation[i, begin + sector]
            for sector in range(sectors):
                observation[i, begin + (sector + parts[i]) % sectors] = scratch[sector]


class SensorMethod(Method):
    """M_sensor: counts by sectors, velocity u_nn, Table 3.1's reward, lost or collision as failures."""

    label = "M_sensor"
    swarm_knows_learner = True
    fits_any_groups = True
    draws = frozenset({"sectors"})
    presets = {
        "thesis": Preset({"samples_per_insert": 1.5}, {**WORLD, "captured_is": "surrounded"}),
        "best": BEST,
        "generalist": GENERALIST,
    }
    robot_module = "learner.export.m_sensor:SensorRobot"

    observation_dtype = np.int8
    observation_limit = COUNT_LIMIT

    def __init__(self, config: WorldConfig) -> None:
        super().__init__(config)
        self._faces_goal = config.sector_frame == "goal"
        self._perceive, self._turn_to_goal = StateKernel(_perceive), StateKernel(_turn_to_goal)
        self._edges = sector_edges(config.sectors)
        self._scratch = np.zeros((2, config.num_robots + LANES), np.int32)
        real = np.float32
        self._params = packed(
            SensorParams(
                sectors=config.sectors,
                separate=config.sensor_counts == "separate",
                faces_goal=self._faces_goal,
                inner_sq=real(config.inner_radius_m) ** 2,
                outer_sq=real(config.outer_radius_m) ** 2,
            )
        )

    @classmethod
    def observation_names(cls, config: WorldConfig) -> tuple[str, ...]:
        """A count per region and sector; of the own group, then of others, where they are separate."""
        kinds = ("own", "others") if config.sensor_counts == "separate" else ("own less others",)
        regions = ("disc", "ring")
        return tuple(
            f"{kind}, {region}, sector {sector}"
            for kind in kinds
            for region in regions
            for sector in range(config.sectors)
        )

    @classmethod
    def check(cls, config: WorldConfig) -> None:
        """Raises ConfigError where the inner disc holds none but colliding robots; every frame of sectors works."""
        require(
            config.inner_radius_m > 2 * config.robot_radius_m,
            f"inner_radius_m (R1 = {config.inner_radius_m}) must be greater than 2 × robot_radius_m "
            f"({2 * config.robot_radius_m:.3g} m), within which robots have collided",
        )

    @classmethod
    def rules(cls, config: WorldConfig) -> dict[str, Rule]:
        """`greedy` heads into the sector with the most own robots less other robots, over both sensing regions.

        Among equal sectors, the one with the most in the outer ring: its robots are those that are about to be lost.
        Among these, the lowest index, as a learned policy does.
        """
        cells, separate = 2 * config.sectors, config.sensor_counts == "separate"

        def act(observation: NDArray[Any]) -> NDArray[np.int64]:
            counts = observation.astype(np.int64)
            own, others = counts[:, :cells], counts[:, cells:]
            inner, ring = np.split(own - others if separate else own, 2, axis=1)
            size = 2 * np.abs(ring).max(initial=0) + 1  # more than two rings can differ by
            return np.asarray(np.argmax(size * (inner + ring) + ring, axis=1), np.int64)

        return {"greedy": act}

    @classmethod
    def turns(cls, config: WorldConfig) -> int:
        """A sector at a time; sectors that face the goal turn with the world anyway."""
        return 1 if config.sector_frame == "goal" else config.sectors

    def turn(self, observation: NDArray[Any], parts: NDArray[np.int64]) -> None:
        """Shifts the counts of every region by `parts` sectors."""
        _turn(observation, parts, self.config.sectors, np.zeros(self.config.sectors, observation.dtype))

    def velocity(self, state: WorldState, action: NDArray[np.int64], out_x: Any, out_y: Any) -> None:
        """Eq. 3.4: the speed of the action, towards the chosen sector's centre, in the frame of the sectors.

        Raises:
          ValueError: there is not one action a row, or one is none of the actions.
        """
        super().velocity(state, action, out_x, out_y)
        if self._faces_goal:
            self._turn_to_goal(state, out_x, out_y)

    def perceive(self, state: WorldState, mask: NDArray[np.bool_], out: NDArray[np.int8]) -> None:
        """3.2.1: `[num_rows, 2q]` counts, the inner disc's q first; apart, 2q of the own group, then 2q of others."""
        self._perceive(state, mask, out, self._edges, self._scratch, self._params)
