"""What the learning robot senses and how it drives: the stage between the world and the method, of this robot alone.

A method perceives, and takes velocities from, a sensed state: a WorldState in which positions and velocities of other
robots are as the learning robot knows them. NaN stands for a robot that it does not sense. Outcome and reward keep the
true state, and the robot's own position, velocity and goal are always true.

In every simulator step, another robot's position is late (a ring of past states), then known or not (dropped for the
episode, out of range or view, in a burst of loss, lost by itself), then noisy; some are mixed up with robots of
other groups. Last, a robot that is not sensed any more may be tracked (`track_steps`): for so many steps it is taken to
go on with its last velocity. A burst is the bad state of a channel of two states, one channel a robot, which begins in
its stationary distribution (Gilbert 1960, "Capacity of a burst-noise channel"). A velocity command takes effect late,
and is driven with an error of speed and heading.

Every random number is a draw of a stream of its own, counted from the episode's start. So the swarm meets the same
noise under all conditions, and a position that is lost with a small probability is lost with a larger one, too.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sim_core.config import WorldConfig
from sim_core.jit import StateKernel, inlined, kernel
from sim_core.lanes import LANES, any_lane, convert, extract_lane, load_some, select, splat, sqrt, store_some
from sim_core.packed import packed
from sim_core.rng import add_normal, bits_at, uniform_at, uniforms_at
from sim_core.state import WorldState

NOISE, LOSS, BURST, DELAY, DROPPED, RANGE, VIEW, MIX_UP, COMMAND_DELAY, SPEED, HEADING = range(11)
"""Columns of `Memory.conditions`."""
NUM_CONDITIONS = 11
STREAM = 2**32
"""The draw of a world's stream, far behind its others, that is the state of the senses' stream."""
DRAWS = 5
"""Draws of one robot in a step: loss, burst, noise, mix-up, with whom. The learning robot's driving takes two more."""
IS_DROPPED, IN_BURST = np.uint8(1), np.uint8(2)
"""Bits of `Memory.channel`."""
POS_X, POS_Y, VEL_X, VEL_Y = range(4)
"""Rows of what is known of robots."""
AGE = 4
"""Row of `Memory.tracked` below those."""
_PASSED = ("pos_x", "pos_y", "vel_x", "vel_y")
_NAN, _NO_BITS = np.float32(np.nan), np.uint8(0)
_NO_AGE, _ONE_STEP = np.float32(0), np.float32(1)


class SenseParams(NamedTuple):
    """The conditions as the settings give them, in the order of the columns, and what is alike in all episodes.

    `group` and `group_begin` are those of WorldState.
    """

    full: NDArray[np.float64]
    group: NDArray[np.int32]
    group_begin: NDArray[np.int32]
    drawn: bool
    leave_burst: float
    track_steps: Any
    time_step_s: Any


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


class Memory(NamedTuple):
    """What the stage remembers of what robots sense in every world; a checkpoint holds it.

    Shapes: known `[4, num_worlds, num_robots]` float32, positions and velocities as the learning robot knows them
    (metres, m/s; NaN: not sensed); stream `[num_worlds]` uint64, the state of the episode's random stream; conditions
    `[num_worlds, 11]` float64, those of the episode (RANGE infinite without a limit; VIEW the cosine of half the angle,
    -2 all around; HEADING in radians); channel `[num_worlds, num_robots]` uint8, IS_DROPPED and IN_BURST; past
    `[num_worlds, delay + 1, 4, num_robots]` float32, the true positions and velocities of the simulator steps modulo
    delay + 1; tracked `[num_worlds, 5, num_robots]` float32, where each robot was sensed last or its last velocity has
    taken it since, that velocity, and the simulator steps since; empty where nothing is tracked.
    """

    known: Any
    stream: Any
    conditions: Any
    channel: Any
    past: Any
    tracked: Any


def sense_params(config: WorldConfig, state: WorldState) -> SenseParams:
    """The constants of `config` and of the worlds' groups."""
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
        group=state.group,
        group_begin=state.group_begin,
        drawn=config.conditions == "drawn",
        leave_burst=1.0 / config.burst_steps,
        track_steps=np.float32(config.track_steps),
        time_step_s=np.float32(config.time_step_s),
    )


def empty_memory(config: WorldConfig, num_worlds: int) -> Memory:
    """Zeroed memory of `num_worlds` worlds."""
    robots = config.num_robots
    return Memory(
        known=np.zeros((4, num_worlds, robots), np.float32),
        stream=np.zeros(num_worlds, np.uint64),
        conditions=np.zeros((num_worlds, NUM_CONDITIONS)),
        channel=np.zeros((num_worlds, robots), np.uint8),
        past=np.zeros((num_worlds, config.position_delay_steps + 1, 4, robots), np.float32),
        tracked=np.zeros((num_worlds, AGE + 1, robots if config.track_steps else 0), np.float32),
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
def _open_channels(world, truth, memory, first_draw, p):
    """Drops as many robots of the own group as the condition says, all alike (Knuth 1969, Algorithm S); begins bursts.

    The first draws decide whom to drop, the next ones who is in a burst, one a robot each.
    """
    num_robots, learner, stream = truth.pos_x.shape[1], truth.learner[world], memory.stream[world]
    group = p.group[learner]
    begin, end = p.group_begin[group], p.group_begin[group + 1]
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
def _begin(rng, truth, mask, memory, commands, params):
    p = params[0]
    for world in range(mask.shape[0]):
        if not mask[world]:
            continue
        stream = bits_at(rng[world], STREAM)
        memory.stream[world] = stream
        for column in range(NUM_CONDITIONS):
            strength = uniform_at(stream, column + 1) if p.drawn else 1.0
            memory.conditions[world, column] = _condition(column, p.full[column], strength)
        _open_channels(world, truth, memory, NUM_CONDITIONS + 1, p)
        for place in range(memory.past.shape[1]):
            _remember(world, truth, memory.past[world, place])
        memory.tracked[world, AGE, :] = p.track_steps
        commands[world, :] = np.float32(0)


@inlined
def _copy(row, out):
    for robot in range(row.shape[0]):
        out[robot] = row[robot]


@inlined
def _remember(world, truth, past):
    """Copies the true positions and velocities to `past` `[4, num_robots]`."""
    _copy(truth.pos_x[world], past[POS_X])
    _copy(truth.pos_y[world], past[POS_Y])
    _copy(truth.vel_x[world], past[VEL_X])
    _copy(truth.vel_y[world], past[VEL_Y])


@inlined
def _places(step, ring, delay):
    """Places in a ring of the last steps: that of `step`, and that of `delay` steps before, which is shorter."""
    now = step % ring
    then = now - int(delay)
    return now, then + ring if then < 0 else then


@inlined
def _load_rows(array, first, size, count):
    """Elements from `first` on of four rows of `size` elements, as vectors; `_store_rows` writes such."""
    return (
        load_some(array, first, count),
        load_some(array, first + size, count),
        load_some(array, first + 2 * size, count),
        load_some(array, first + 3 * size, count),
    )


@inlined
def _store_rows(array, first, size, count, x, y, vx, vy):
    store_some(array, first, count, x)
    store_some(array, first + size, count, y)
    store_some(array, first + 2 * size, count, vx)
    store_some(array, first + 3 * size, count, vy)


@inlined
def _reported(world, i, now, then, truth, memory):
    """What is reported of robots i to i + 7 in this step, vectors (x, y, vx, vy): the truth, or that of an older step.

    Places `now` and `then` of the ring are this step's and the one of which it is told.
    """
    num_robots, ring = truth.pos_x.shape[1], memory.past.shape[1]
    count, at = num_robots - i, world * num_robots + i
    x, y = load_some(truth.pos_x, at, count), load_some(truth.pos_y, at, count)
    vx, vy = load_some(truth.vel_x, at, count), load_some(truth.vel_y, at, count)
    if ring == 1:
        return x, y, vx, vy
    begin, size = world * ring, 4 * num_robots
    _store_rows(memory.past, (begin + now) * size + i, num_robots, count, x, y, vx, vy)
    return _load_rows(memory.past, (begin + then) * size + i, num_robots, count)


@inlined
def _facing(world, truth, p):
    """Unit vector (x, y) to where the learning robot moves; at rest, to its goal."""
    learner = truth.learner[world]
    x, y = float(truth.vel_x[world, learner]), float(truth.vel_y[world, learner])
    if x == 0.0 and y == 0.0:
        group = p.group[learner]
        x = float(truth.goal_x[world, group] - truth.pos_x[world, learner])
        y = float(truth.goal_y[world, group] - truth.pos_y[world, learner])
    length = max(math.sqrt(x * x + y * y), 1e-30)
    return x / length, y / length


@inlined
def _out_of_sight(x, y, own_x, own_y, facing_x, facing_y, conditions):
    """Which of the robots at vectors (x, y) are out of the learning robot's range or view."""
    dx, dy = x - own_x, y - own_y
    distance_m = convert(sqrt(dx * dx + dy * dy), np.float64)
    ahead_m = convert(dx, np.float64) * facing_x + convert(dy, np.float64) * facing_y
    return (distance_m > conditions[RANGE]) | (ahead_m < conditions[VIEW] * distance_m)


@inlined
def _lost(world, i, draw, memory, p):
    """Which of robots i to i + 7 are dropped, in a burst, or lost by themselves; moves their channels by a step."""
    stream, loss, share = memory.stream[world], memory.conditions[world, LOSS], memory.conditions[world, BURST]
    num_robots, at = memory.channel.shape[1], draw + DRAWS * i
    count, first = num_robots - i, world * num_robots + i
    bits = load_some(memory.channel, first, count)
    if share > 0.0:
        chance, dropped, was_in_burst = uniforms_at(stream, at + 2, DRAWS), bits & IS_DROPPED, bits >= IN_BURST
        enters = chance < p.leave_burst * share / (1.0 - share)
        stays = ~(chance < p.leave_burst)
        bits = select((was_in_burst & stays) | (~was_in_burst & enters), dropped | IN_BURST, dropped)
        store_some(memory.channel, first, count, bits)
    return (bits != _NO_BITS) | (uniforms_at(stream, at + 1, DRAWS) < loss)


@inlined
def _know(world, truth, memory, p):
    """Writes what is reported of the robots that are sensed, NaN for the others."""
    conditions, learner, step = memory.conditions[world], truth.learner[world], truth.steps[world]
    now, then = _places(step, memory.past.shape[1], conditions[DELAY])
    own_x, own_y = truth.pos_x[world, learner], truth.pos_y[world, learner]
    has_horizon = conditions[RANGE] < np.inf or conditions[VIEW] > -2.0
    facing_x, facing_y = _facing(world, truth, p) if conditions[VIEW] > -2.0 else (0.0, 0.0)
    loses = conditions[LOSS] > 0.0 or conditions[BURST] > 0.0 or conditions[DROPPED] > 0.0
    num_robots = truth.pos_x.shape[1]
    draw = _first_draw(step, num_robots)
    for i in range(0, num_robots, LANES):
        x, y, vx, vy = _reported(world, i, now, then, truth, memory)
        hidden = splat(False)
        if has_horizon:
            hidden = _out_of_sight(x, y, own_x, own_y, facing_x, facing_y, conditions)
        if loses:
            hidden = hidden | _lost(world, i, draw, memory, p)
        x, y = select(hidden, _NAN, x), select(hidden, _NAN, y)
        vx, vy = select(hidden, _NAN, vx), select(hidden, _NAN, vy)
        first, size = world * num_robots + i, truth.pos_x.size
        _store_rows(memory.known, first, size, num_robots - i, x, y, vx, vy)


@inlined
def _another(robot, chance, learner, p):
    """A robot of another group than `robot`'s and not the learning robot, all alike; -1 if there is none.

    `chance` is in [0, 1).
    """
    group = p.group[robot]
    begin, end = p.group_begin[group], p.group_begin[group + 1]
    learner_counts = not begin <= learner < end
    others = p.group.shape[0] - (end - begin) - learner_counts
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
def _mix_up(world, truth, memory, p):
    """Exchanges robots with robots of other groups, one after the other."""
    stream, chance, learner = memory.stream[world], memory.conditions[world, MIX_UP], truth.learner[world]
    num_robots = memory.channel.shape[1]
    draw = _first_draw(truth.steps[world], num_robots)
    for first in range(0, num_robots, LANES):
        drawn = uniforms_at(stream, draw + DRAWS * first + 4, DRAWS)
        if not any_lane(drawn < chance):
            continue
        for robot in range(first, min(first + LANES, num_robots)):
            if robot == learner or not extract_lane(drawn, robot - first) < chance:
                continue
            other = _another(robot, uniform_at(stream, draw + DRAWS * robot + 5), learner, p)
            if other >= 0:
                for row in range(4):
                    known = memory.known[row, world]
                    known[robot], known[other] = known[other], known[robot]


@inlined
def _track(world, memory, p):
    """Writes where the robots that are not sensed any more have gone with their last velocities, for `track_steps`."""
    num_robots, step_s = memory.tracked.shape[2], p.time_step_s
    size = memory.known.shape[1] * num_robots
    for i in range(0, num_robots, LANES):
        count, at, kept = num_robots - i, world * num_robots + i, world * (AGE + 1) * num_robots + i
        x, y, vx, vy = _load_rows(memory.known, at, size, count)
        last_x, last_y, last_vx, last_vy = _load_rows(memory.tracked, kept, num_robots, count)
        age = load_some(memory.tracked, kept + AGE * num_robots, count)
        sensed, is_tracked = x == x, age < p.track_steps
        last_x, last_y = select(sensed, x, last_x + last_vx * step_s), select(sensed, y, last_y + last_vy * step_s)
        last_vx, last_vy = select(sensed, vx, last_vx), select(sensed, vy, last_vy)
        age = select(sensed, _NO_AGE, select(is_tracked, age + _ONE_STEP, age))
        _store_rows(memory.tracked, kept, num_robots, count, last_x, last_y, last_vx, last_vy)
        store_some(memory.tracked, kept + AGE * num_robots, count, age)
        known = sensed | is_tracked
        x, y = select(known, last_x, _NAN), select(known, last_y, _NAN)
        _store_rows(memory.known, at, size, count, x, y, select(known, last_vx, _NAN), select(known, last_vy, _NAN))


@inlined
def _know_itself(world, truth, memory):
    """Writes the learning robot's own position and velocity, which it always knows."""
    learner, known = truth.learner[world], memory.known
    known[POS_X, world, learner] = truth.pos_x[world, learner]
    known[POS_Y, world, learner] = truth.pos_y[world, learner]
    known[VEL_X, world, learner] = truth.vel_x[world, learner]
    known[VEL_Y, world, learner] = truth.vel_y[world, learner]


@kernel
def _sense(truth, mask, memory, params):
    p = params[0]
    num_robots, conditions = truth.pos_x.shape[1], memory.conditions
    for world in range(mask.shape[0]):
        if mask[world]:
            _know(world, truth, memory, p)
    for world in range(mask.shape[0]):
        if mask[world] and conditions[world, NOISE] > 0.0:
            draw, scale = _first_draw(truth.steps[world], num_robots) + 3, np.float32(conditions[world, NOISE])
            add_normal(memory.stream[world], draw, DRAWS, scale, memory.known[POS_X, world], memory.known[POS_Y, world])
    for world in range(mask.shape[0]):
        if mask[world]:
            if conditions[world, MIX_UP] > 0.0:
                _mix_up(world, truth, memory, p)
            if p.track_steps > 0.0:
                _track(world, memory, p)
            _know_itself(world, truth, memory)


@kernel
def _drive(truth, mask, command_x, command_y, stream, conditions, commands, params):
    p = params[0]
    num_robots = p.group.shape[0]
    for world in range(mask.shape[0]):
        if not mask[world]:
            continue
        c, step, late = conditions[world], truth.steps[world], commands[world]
        now, then = _places(step, late.shape[0], c[COMMAND_DELAY])
        late[now, 0], late[now, 1] = command_x[world], command_y[world]
        x, y = late[then, 0], late[then, 1]
        draw = _first_draw(step, num_robots) + DRAWS * num_robots
        speed = 1.0 + c[SPEED] * (2.0 * uniform_at(stream[world], draw + 1) - 1.0)
        turn = c[HEADING] * (2.0 * uniform_at(stream[world], draw + 2) - 1.0)
        cos, sin = speed * math.cos(turn), speed * math.sin(turn)
        command_x[world], command_y[world] = cos * x - sin * y, sin * x + cos * y


class Senses:
    """The stage of a batch of worlds.

    It also keeps the velocity commands `[num_worlds, delay + 1, 2]` (m/s) of the last simulator steps.

    Args:
      config: the world.
      state: the true state of the worlds, which the stage reads.

    Attributes:
      sensed: the WorldState that the learning robots know: `state`, but for positions and velocities.
    """

    def __init__(self, config: WorldConfig, state: WorldState) -> None:
        self._truth = Truth(*(getattr(state, name) for name in Truth._fields))
        self._memory = memory = empty_memory(config, len(state.learner))
        self._commands = np.zeros((len(state.learner), config.command_delay_steps + 1, 2), np.float32)
        self._params = packed(sense_params(config, state))
        self._rng = state.rng
        self._known = dict(zip(_PASSED, memory.known, strict=True))
        self._senses_badly, self._drives_badly = config.senses_badly, config.drives_badly
        self.sensed: WorldState = state._replace(**self._known) if self._senses_badly else state
        self._sense, self._drive = StateKernel(_sense), StateKernel(_drive)

    def begin(self, mask: NDArray[np.bool_]) -> None:
        """Begins the episodes that have just been set up where `mask` `[num_worlds]` is set, and senses."""
        _begin(self._rng, self._truth, mask, self._memory, self._commands, self._params)
        self.sense(mask)

    def sense(self, mask: NDArray[np.bool_]) -> None:
        """Writes the sensed state of the worlds where `mask` is set; after every simulator step."""
        if self._senses_badly:
            self._sense(self._truth, mask, self._memory, self._params)

    def drive(self, mask: NDArray[np.bool_], command_x: NDArray[np.float32], command_y: NDArray[np.float32]) -> None:
        """Changes commands `[num_worlds]` (m/s) to what the robots drive, where `mask` is set; before every step."""
        if self._drives_badly:
            driven_with = self._memory.stream, self._memory.conditions, self._commands, self._params
            self._drive(self._truth, mask, command_x, command_y, *driven_with)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """The arrays that steps change, by name, each with the worlds along its first axis."""
        arrays = self._known | self._memory._asdict() | {"commands": self._commands}
        return {f"senses_{name}": array for name, array in arrays.items() if name != "known" and array.size}
