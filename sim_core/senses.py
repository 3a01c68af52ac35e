"""What the learning robot senses and how it drives: the stage between the world and the method, of this robot alone.

A method perceives, and takes velocities from, a sensed state: a WorldState in which positions and velocities of other
robots are as the learning robot knows them. NaN stands for a robot that it does not sense. Outcome and reward keep the
true state, and the robot's own position, velocity and goal are always true.

In every simulator step, another robot's position is late (a ring of past states), then known or not (dropped for the
episode, out of range or view, in a burst of loss, lost by itself), then noisy; last, some are mixed up with robots of
other groups. A burst is the bad state of a channel of two states, one channel a robot, which begins in its stationary
distribution (Gilbert 1960, "Capacity of a burst-noise channel"). A velocity command takes effect late, and is driven
with an error of speed and heading.

Every random number is a draw of a stream of its own, counted from the episode's start. So the swarm meets the same
noise under all conditions, and a position that is lost with a small probability is lost with a larger one, too.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sim_core.config import WorldConfig
from sim_core.jit import inlined, kernel
from sim_core.methods.progress import goal_offset
from sim_core.packed import packed
from sim_core.rng import add_normal, bits_at, uniform_at
from sim_core.state import WorldState, own_group

NOISE, LOSS, BURST, DELAY, DROPPED, RANGE, VIEW, MIX_UP, COMMAND_DELAY, SPEED, HEADING = range(11)
"""Columns of `Memory.conditions`."""
NUM_CONDITIONS = 11
STREAM = 2**32
"""The draw of a world's stream, far behind its others, that is the state of the senses' stream."""
DRAWS = 5
"""Draws of one robot in a step: loss, burst, noise, mix-up, with whom. The learning robot's driving takes two more."""
IS_DROPPED, IN_BURST = np.uint8(1), np.uint8(2)
"""Bits of `Memory.channel`."""
_PASSED = ("pos_x", "pos_y", "vel_x", "vel_y")
_NAN = np.float32(np.nan)


class SenseParams(NamedTuple):
    """The conditions as the settings give them, in the order of the columns, and what is alike in all episodes."""

    full: NDArray[np.float64]
    drawn: bool
    leave_burst: float
    ring: int
    command_ring: int


class Truth(NamedTuple):
    """The arrays of a WorldState that the stage reads; a kernel takes few arrays sooner than many."""

    pos_x: Any
    pos_y: Any
    vel_x: Any
    vel_y: Any
    goal_x: Any
    goal_y: Any
    learner: Any
    steps: Any
    group: Any
    group_begin: Any


class Memory(NamedTuple):
    """What the stage remembers of every world; a checkpoint holds it.

    Shapes: pos_*, vel_* `[num_worlds, num_robots]` float32, as the learning robot knows them (metres, m/s; NaN: not
    sensed); stream `[num_worlds]` uint64, the state of the episode's random stream; conditions
    `[num_worlds, 11]` float64, those of the episode (RANGE infinite without a limit; VIEW the cosine of half the angle,
    -2 all around; HEADING in radians); channel `[num_worlds, num_robots]` uint8, IS_DROPPED and IN_BURST; past
    `[num_worlds, delay + 1, 4, num_robots]` float32, the true positions and velocities of the simulator steps modulo
    delay + 1; commands `[num_worlds, delay + 1, 2]` float32, m/s.
    """

    pos_x: Any
    pos_y: Any
    vel_x: Any
    vel_y: Any
    stream: Any
    conditions: Any
    channel: Any
    past: Any
    commands: Any


def sense_params(config: WorldConfig) -> SenseParams:
    """The constants of `config`."""
    full = (
        config.position_noise_m,
        config.position_loss,
        config.burst_loss,
        config.position_delay_steps,
        config.dropped_mates,
        config.sensing_range_m,
        config.field_of_view_deg,
        config.group_mix_up,
        config.command_delay_steps,
        config.speed_error,
        math.radians(config.heading_error_deg),
    )
    return SenseParams(
        full=np.array(full, np.float64),
        drawn=config.conditions == "drawn",
        leave_burst=1.0 / config.burst_steps,
        ring=config.position_delay_steps + 1,
        command_ring=config.command_delay_steps + 1,
    )


def empty_memory(config: WorldConfig, num_worlds: int) -> Memory:
    """Zeroed memory of `num_worlds` worlds."""
    robots = config.num_robots
    pos_x, pos_y, vel_x, vel_y = np.zeros((4, num_worlds, robots), np.float32)
    return Memory(
        pos_x=pos_x,
        pos_y=pos_y,
        vel_x=vel_x,
        vel_y=vel_y,
        stream=np.zeros(num_worlds, np.uint64),
        conditions=np.zeros((num_worlds, NUM_CONDITIONS)),
        channel=np.zeros((num_worlds, robots), np.uint8),
        past=np.zeros((num_worlds, config.position_delay_steps + 1, 4, robots), np.float32),
        commands=np.zeros((num_worlds, config.command_delay_steps + 1, 2), np.float32),
    )


@inlined
def _condition(column, full, strength):
    """A condition of `full` strength, weakened to a share in [0, 1] of it."""
    if column == DELAY or column == DROPPED or column == COMMAND_DELAY:
        return float(min(int(strength * (full + 1.0)), int(full)))
    if column == RANGE:
        return full / strength if full > 0.0 else np.inf
    if column == VIEW:
        angle_deg = 360.0 - strength * (360.0 - full)
        return math.cos(math.radians(0.5 * angle_deg)) if angle_deg < 360.0 else -2.0
    return full * strength


@inlined
def _open_channels(world, truth, memory, first_draw):
    """Drops as many robots of the own group as the condition says, all alike (Knuth 1969, Algorithm S); begins bursts.

    The first draws decide whom to drop, the next ones who is in a burst, one a robot each.
    """
    num_robots, learner, stream = truth.pos_x.shape[1], truth.learner[world], memory.stream[world]
    _, begin, end = own_group(truth, world)
    left, wanted = end - begin - 1, memory.conditions[world, DROPPED]
    for robot in range(num_robots):
        bits = np.uint8(0)
        if begin <= robot < end and robot != learner:
            if uniform_at(stream, first_draw + robot) * left < wanted:
                bits |= IS_DROPPED
                wanted -= 1.0
            left -= 1
        if uniform_at(stream, first_draw + num_robots + robot) < memory.conditions[world, BURST]:
            bits |= IN_BURST
        memory.channel[world, robot] = bits


@inlined
def _first_draw(step, num_robots):
    """The draw before the first one of a simulator step."""
    return NUM_CONDITIONS + 2 * num_robots + step * (DRAWS * num_robots + 2)


@kernel
def _begin(rng, truth, mask, memory, params):
    p = params[0]
    for world in range(mask.shape[0]):
        if not mask[world]:
            continue
        stream = bits_at(rng[world], STREAM)
        memory.stream[world] = stream
        for column in range(NUM_CONDITIONS):
            strength = uniform_at(stream, column + 1) if p.drawn else 1.0
            memory.conditions[world, column] = _condition(column, p.full[column], strength)
        _open_channels(world, truth, memory, NUM_CONDITIONS + 1)
        for place in range(memory.past.shape[1]):
            _remember(world, truth, memory.past[world, place])
        memory.commands[world, :] = np.float32(0)


@inlined
def _copy(row, out):
    for robot in range(row.shape[0]):
        out[robot] = row[robot]


@inlined
def _remember(world, truth, past):
    """Copies the true positions and velocities to `past` `[4, num_robots]`."""
    _copy(truth.pos_x[world], past[0])
    _copy(truth.pos_y[world], past[1])
    _copy(truth.vel_x[world], past[2])
    _copy(truth.vel_y[world], past[3])


@inlined
def _report(world, step, truth, memory, p):
    """Writes the positions and velocities that are reported in this step: the true ones, or older ones."""
    pos_x, pos_y, vel_x, vel_y = truth.pos_x[world], truth.pos_y[world], truth.vel_x[world], truth.vel_y[world]
    if p.ring > 1:
        _remember(world, truth, memory.past[world, step % p.ring])
        past = memory.past[world, (step + p.ring - int(memory.conditions[world, DELAY])) % p.ring]
        pos_x, pos_y, vel_x, vel_y = past[0], past[1], past[2], past[3]
    _copy(pos_x, memory.pos_x[world])
    _copy(pos_y, memory.pos_y[world])
    _copy(vel_x, memory.vel_x[world])
    _copy(vel_y, memory.vel_y[world])


@inlined
def _hide(world, robot, memory):
    memory.pos_x[world, robot] = memory.pos_y[world, robot] = _NAN
    memory.vel_x[world, robot] = memory.vel_y[world, robot] = _NAN


@inlined
def _facing(world, truth):
    """Unit vector (x, y) to where the learning robot moves; at rest, to its goal."""
    learner = truth.learner[world]
    x, y = float(truth.vel_x[world, learner]), float(truth.vel_y[world, learner])
    if x == 0.0 and y == 0.0:
        dx, dy = goal_offset(truth, world)
        x, y = float(dx), float(dy)
    length = max(math.sqrt(x * x + y * y), 1e-30)
    return x / length, y / length


@inlined
def _hide_unseen(world, truth, memory):
    """Hides the robots that are out of the learning robot's range or view."""
    learner = truth.learner[world]
    x, y = truth.pos_x[world, learner], truth.pos_y[world, learner]
    facing_x, facing_y = _facing(world, truth)
    range_m, least_cos = memory.conditions[world, RANGE], memory.conditions[world, VIEW]
    for robot in range(truth.pos_x.shape[1]):
        dx, dy = memory.pos_x[world, robot] - x, memory.pos_y[world, robot] - y
        distance_m = math.sqrt(dx * dx + dy * dy)
        if distance_m > range_m or dx * facing_x + dy * facing_y < least_cos * distance_m:
            _hide(world, robot, memory)


@inlined
def _hide_lost(world, draw, memory, p):
    """Moves every robot's channel by a step; hides the robots that are dropped, in a burst, or lost by themselves."""
    stream, loss, share = memory.stream[world], memory.conditions[world, LOSS], memory.conditions[world, BURST]
    enter_burst = p.leave_burst * share / (1.0 - share)
    for robot in range(memory.channel.shape[1]):
        bits = memory.channel[world, robot]
        if share > 0.0:
            chance = uniform_at(stream, draw + DRAWS * robot + 2)
            in_burst = chance >= p.leave_burst if bits & IN_BURST else chance < enter_burst
            bits = bits & IS_DROPPED | (IN_BURST if in_burst else np.uint8(0))
            memory.channel[world, robot] = bits
        if bits or uniform_at(stream, draw + DRAWS * robot + 1) < loss:
            _hide(world, robot, memory)


@inlined
def _another(robot, chance, truth, world):
    """A robot of another group than `robot`'s and not the learning robot, all alike; -1 if there is none.

    `chance` is in [0, 1).
    """
    learner, group = truth.learner[world], truth.group[robot]
    begin, end = truth.group_begin[group], truth.group_begin[group + 1]
    learner_counts = not begin <= learner < end
    others = truth.group.shape[0] - (end - begin) - learner_counts
    if others < 1:
        return -1
    other = int(chance * others)  # counted without this group and the learning robot
    if learner_counts and learner < begin and other >= learner:
        other += 1
    if other >= begin:
        other += end - begin
    if learner_counts and learner >= end and other >= learner:
        other += 1
    return other


@inlined
def _mix_up(world, draw, truth, memory):
    """Exchanges robots with robots of other groups, one after the other."""
    stream = memory.stream[world]
    for robot in range(truth.pos_x.shape[1]):
        at = draw + DRAWS * robot
        if robot == truth.learner[world] or not uniform_at(stream, at + 4) < memory.conditions[world, MIX_UP]:
            continue
        other = _another(robot, uniform_at(stream, at + 5), truth, world)
        if other >= 0:
            for row in (memory.pos_x[world], memory.pos_y[world], memory.vel_x[world], memory.vel_y[world]):
                row[robot], row[other] = row[other], row[robot]


@kernel
def _sense(truth, mask, memory, params):
    p = params[0]
    num_robots = truth.pos_x.shape[1]
    for world in range(mask.shape[0]):
        if not mask[world]:
            continue
        c, step, learner = memory.conditions[world], truth.steps[world], truth.learner[world]
        draw = _first_draw(step, num_robots)
        _report(world, step, truth, memory, p)
        if c[RANGE] < np.inf or c[VIEW] > -2.0:
            _hide_unseen(world, truth, memory)
        if c[LOSS] > 0.0 or c[BURST] > 0.0 or c[DROPPED] > 0.0:
            _hide_lost(world, draw, memory, p)
        if c[NOISE] > 0.0:
            add_normal(memory.stream[world], draw + 3, DRAWS, c[NOISE], memory.pos_x[world], memory.pos_y[world])
        if c[MIX_UP] > 0.0:
            _mix_up(world, draw, truth, memory)
        memory.pos_x[world, learner] = truth.pos_x[world, learner]
        memory.pos_y[world, learner] = truth.pos_y[world, learner]
        memory.vel_x[world, learner] = truth.vel_x[world, learner]
        memory.vel_y[world, learner] = truth.vel_y[world, learner]


@kernel
def _drive(steps, mask, command_x, command_y, memory, params):
    p = params[0]
    num_robots = memory.channel.shape[1]
    for world in range(mask.shape[0]):
        if not mask[world]:
            continue
        c, step, commands = memory.conditions[world], steps[world], memory.commands[world]
        commands[step % p.command_ring, 0] = command_x[world]
        commands[step % p.command_ring, 1] = command_y[world]
        place = (step + p.command_ring - int(c[COMMAND_DELAY])) % p.command_ring
        x, y = commands[place, 0], commands[place, 1]
        draw = _first_draw(step, num_robots) + DRAWS * num_robots
        speed = 1.0 + c[SPEED] * (2.0 * uniform_at(memory.stream[world], draw + 1) - 1.0)
        turn = c[HEADING] * (2.0 * uniform_at(memory.stream[world], draw + 2) - 1.0)
        cos, sin = speed * math.cos(turn), speed * math.sin(turn)
        command_x[world], command_y[world] = cos * x - sin * y, sin * x + cos * y


class Senses:
    """The stage of a batch of worlds.

    Args:
      config: the world.
      state: the true state of the worlds, which the stage reads.

    Attributes:
      sensed: the WorldState that the learning robots know: `state`, but for positions and velocities.
    """

    def __init__(self, config: WorldConfig, state: WorldState) -> None:
        self._rng = state.rng
        self._truth = Truth(*(getattr(state, name) for name in Truth._fields))
        self._memory = empty_memory(config, len(state.learner))
        self._params = packed(sense_params(config))
        self._senses_badly, self._drives_badly = config.senses_badly, config.drives_badly
        passed = {name: getattr(self._memory, name) for name in _PASSED}
        self.sensed: WorldState = state._replace(**passed) if self._senses_badly else state

    def begin(self, mask: NDArray[np.bool_]) -> None:
        """Begins the episodes that have just been set up where `mask` `[num_worlds]` is set, and senses."""
        _begin(self._rng, self._truth, mask, self._memory, self._params)
        self.sense(mask)

    def sense(self, mask: NDArray[np.bool_]) -> None:
        """Writes the sensed state of the worlds where `mask` is set; after every simulator step."""
        if self._senses_badly:
            _sense(self._truth, mask, self._memory, self._params)

    def drive(self, mask: NDArray[np.bool_], command_x: NDArray[np.float32], command_y: NDArray[np.float32]) -> None:
        """Changes commands `[num_worlds]` (m/s) to what the robots drive, where `mask` is set; before every step."""
        if self._drives_badly:
            _drive(self._truth.steps, mask, command_x, command_y, self._memory, self._params)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """The arrays that steps change, by name."""
        return {f"senses_{name}": array for name, array in self._memory._asdict().items()}
