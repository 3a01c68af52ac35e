"""The world's settings: one flat frozen dataclass, checked when it is made.

Every quantity that the dissertation leaves open is a field here, so that no number is hidden in a
kernel. Field names carry their unit (`_m`, `_s`, `_m_s`, `_deg`, `_steps`).
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from sim_core.checks import check_fields, require
from sim_core.plugins import METHODS, SCENES, Kind, file_of, guarded, load, read_source, short_name

if TYPE_CHECKING:
    from sim_core.methods.base import Method
    from sim_core.scenes.base import Scene

MAX_HEADINGS = 64
MAX_SPEED_LEVELS = 4
MAX_HISTORY = 16
MAX_DELAY_STEPS = 10
MAX_TRACK_STEPS = 1_000
MAX_ROBOTS = 100_000
"""Most robots of one world."""
LARGEST = 1e6
"""Largest length, speed, time or weight: kernels square them in float32."""
LARGEST_REWARD = 1e38
"""Largest reward, which is stored as float32."""


ONE_LEARNER = "one"
"""`learners` of the dissertation: one robot of all groups."""
MAX_LEAVING_ROBOTS = 299
"""Most robots of a world that robots may leave: a larger one sorts its robots into a grid."""


@dataclass(frozen=True, kw_only=True)
class WorldConfig:
    """One setup (robots x groups x method) and the world it lives in.

    Raises:
      ConfigError: a value is out of range or two values contradict each other.
    """

    robots: int = 10
    """Robots per group, the 10 of 10r x 2g; the learning robot counts."""
    groups: int = 2
    """Number of groups, the 2 of 10r x 2g."""
    method: str = "sensor"
    """State representation of the learning robot: sensor (M_sensor, Chapter 3), in or out (M_IN, M_OUT, Chapter 4), or
    your own, FILE.py:CLASS."""
    scene: str = "circle"
    """Start positions and goals: circle (groups cross a circle, 3.1), or your own, FILE.py:CLASS."""
    learners: str = ONE_LEARNER
    """Learning robots: `one` of all (the text), or of every group a count (3) or a share (0.25; 1.0: all robots)."""
    ended_learners: Literal["fl-orca", "leave"] = "fl-orca"
    """A learning robot whose episode ends before those of others is driven by FL-ORCA, or leaves the world (ours)."""
    swarm_knows_learner: Literal["method", "yes", "no"] = "method"
    """Whether the swarm avoids the learning robot and counts it in its flock (the method's: M_sensor only)."""
    horizon_is: Literal["method", "cut", "failure"] = "method"
    """A timeout cuts and keeps the state's value, or fails with -tau (M_sensor: cuts; M_IN, M_OUT: Alg. 4.1, 4.2)."""
    captured_is: Literal["among", "surrounded"] = "among"
    """Captured, not lost: senses other groups' robots and no own one, or is also inside their convex hull (3.3)."""
    group_distance: Literal["mean", "centroid"] = "mean"
    """A group's distance to its goal (Eq. 3.2, which prints no norm): the mean of its robots', or its centroid's."""

    sectors: int = 8
    """q, the number of sectors per sensing region and of headings (not given in the text)."""
    sector_frame: Literal["world", "goal"] = "world"
    """`sensor`: angle 0 of sectors and headings is the world's +x axis (Eq. 3.3), or points to the own goal (ours)."""
    history: int = 1
    """Observations that the policy sees: the present one and those before the last decisions (ours; 1 in the text)."""
    speed_levels: int = 1
    """n, the number of speeds of every heading: 1/n, 2/n ... n/n of `learner_speed_m_s` (ours; 1 in the text)."""
    stop_action: bool = False
    """Adds an action that keeps the learning robot where it is (ours; the text has headings only)."""
    inner_radius_m: float = 0.5
    """R1, radius of the inner sensing disc (Table 3.2)."""
    outer_radius_m: float = 1.5
    """R2, radius of the outer sensing ring; also the goal distance that means success (Table 3.2)."""
    learner_speed_m_s: float = 1.0
    """v, the speed of the learning robot's headings (Table 3.2); the largest, where there are several."""
    horizon_steps: int = 500
    """eta, simulator steps after which an episode is cut (Table 3.2)."""
    decision_interval_steps: int = 1
    """Simulator steps of one decision, for which the learning robot keeps its action (1 in the text)."""
    reward_scale: float = 1.0
    """tau, the size of the terminal reward (Table 3.2)."""
    reward_clock: Literal["step", "horizon"] = "step"
    """What the step reward tau/eta divides by: the current step (3.2.3) or the horizon (Table 3.2)."""
    sensor_counts: Literal["difference", "separate"] = "difference"
    """`sensor`: own-group less other-group robots a cell (3.2.1), or both counts apart (ours)."""

    outside_limit_steps: int = 100
    """`in`, `out`: phi, simulator steps outside the own ellipse in a row that fail (not given in the text)."""
    lost_ends_episode: bool = False
    """`in`, `out`: whether an episode also ends once no own robot is within R2 (row "Lost" of Table 4.1)."""
    ellipse_covariance: Literal["diagonal", "full"] = "diagonal"
    """`in`, `out`: covariance of a group's positions, with sigma_xy = 0 (4.2.1) or with all of it."""
    ellipse_axes: Literal["confidence", "printed"] = "confidence"
    """`in`, `out`: half-axes sqrt(C lambda), the region that C stands for, or half of that as in Eq. 4.3 and 4.4."""
    ellipse_chi_square: float = 5.991
    """`in`, `out`: C, quantile of chi^2 with 2 degrees of freedom (Table 4.2; it is that of 95 %)."""
    ellipse_counts_learner: bool = False
    """`in`, `out`: whether the learning robot counts in its group's ellipse (open; see methods/ellipse.py)."""
    ellipse_smallest_half_axis_m: float = 0.01
    """`in`, `out`: no half-axis is shorter, so that robots in a line span an ellipse (not given in the text)."""
    group_order: Literal["fixed", "nearest"] = "fixed"
    """`in`, `out`: order of the other groups' rows, after the own one: around the circle, or by distance (open)."""
    group_rows: int = 0
    """`in`, `out`: rows of the state, of which those without a group are zeros; 0: one a group (4.2.1)."""
    ellipse_scale_per_m: float = 0.5
    """`in`, `out`: factor of half-axes and of centres relative to the learning robot (not given in the text)."""
    goal_scale_per_m: float = 0.15
    """`in`, `out`: factor of goals relative to the learning robot (not given in the text)."""
    apf_range_m: float = 0.5
    """`in`, `out`: range of the repulsive potential (Alg. 4.2: R1)."""
    apf_gain_m4_s: float = 0.15
    """`in`, `out`: gain of the repulsive potential (not given in the text)."""
    apf_limit_m_s: float = 4.0
    """`in`, `out`: largest u_apf, and largest part of one robot in it (not given in the text)."""
    apf_rows: Literal["group", "all"] = "group"
    """`in`: a row's u_apf comes from its own group's robots, as the subscripts say, or from all robots in every row."""
    learner_speed_limit_m_s: float = 1.0
    """`out`: largest speed of the sum u_nn + u_apf (not given in the text)."""
    ellipse_reward: Literal["inside", "progress"] = "inside"
    """`in`, `out`: a step's +tau/100 is for being inside (Table 4.1), or inside and closer to the goal (ours)."""

    time_step_s: float = 0.05
    """dt, simulated time of one simulator step."""
    arena_radius_m: float = 6.0
    """Radius of the circle on which group centres start; goals are antipodal."""
    start_spacing_m: float = 0.45
    """Edge of the square start grid of a group."""
    start_jitter_m: float = 0.05
    """Largest displacement of a start position from its grid point, per axis."""
    robot_radius_m: float = 0.1
    """Physical radius; centres closer than twice this are a collision."""
    max_speed_m_s: float = 1.0
    """Largest speed of a swarm robot."""

    orca_radius_m: float = 0.2
    """Radius that ORCA keeps free around a robot (at least the physical one)."""
    orca_horizon_s: float = 2.0
    """How far ahead ORCA avoids collisions."""
    max_neighbours: int = 10
    """Nearest robots that ORCA and flocking look at."""
    neighbour_range_m: float = 1.5
    """Robots farther away are no neighbours."""

    flocking: Literal["published", "uniform", "none"] = "published"
    """FL-ORCA weights: the published table per state, one weight per term in all states, or ORCA alone."""
    state_machine: Literal["published", "text"] = "published"
    """When a robot is in which state of Figure 2.2: as published, or as in the text: Single Group whenever it sees no
    other group, Follower of robots in the first two states alone."""
    separation_range_m: float = 0.395
    """`published`: other groups' robots within this range are separated from."""
    separation_angle_deg: float = 45.0
    """`published`: ... and within this angle of the goal direction."""
    separation_noise: float = 0.2
    """`published`: random gain of the separation term against mirror deadlock."""
    sight_range_m: float = 0.789
    """Range at which a robot of another group is seen (both rule sets)."""
    sight_angle_deg: float = 90.0
    """... and its largest angle from the goal direction (both rule sets)."""
    view_range_m: float = 2.63
    """`published`: a neighbour (so within neighbour_range_m too) this near can block the view of the goal."""
    view_angle_deg: float = 20.0
    """`published`: ... when within this angle of the goal direction."""
    cohesion_weight: float = 0.3
    """`uniform`: weight of the cohesion term."""
    separation_weight: float = 1.0
    """`uniform`: weight of the separation term."""
    alignment_weight: float = 0.3
    """`uniform`: weight of the alignment term."""
    uniform_separation_range_m: float = 0.7
    """`uniform`: any neighbour within this range is separated from."""
    uniform_view_corridor_m: float = 0.5
    """`uniform`: another group's robot this near the line to the goal blocks the view."""
    uniform_slow_radius_m: float = 0.25
    """`uniform`: robots slow down within this distance of the goal."""

    position_noise_m: float = 0.0
    """Standard deviation per axis of a sensed position. This and what follows are the learning robot's alone (ours)."""
    position_loss: float = 0.0
    """Probability that the position of another robot is lost in a simulator step."""
    burst_loss: float = 0.0
    """Share of the positions of another robot that are lost in bursts (a channel of two states, Gilbert 1960)."""
    burst_steps: float = 10.0
    """Mean length of a burst, simulator steps."""
    position_delay_steps: int = 0
    """Simulator steps by which positions of other robots are late; the own one is not."""
    dropped_mates: int = 0
    """Robots of the own group of which the learning robot senses nothing for the whole episode."""
    sensing_range_m: float = 0.0
    """Range of all sensing; 0: no limit."""
    field_of_view_deg: float = 360.0
    """Angle of all sensing around the direction of motion, at rest that of the goal."""
    group_mix_up: float = 0.0
    """Probability that in a step a robot is taken for one of another group, and that one for it."""
    track_steps: int = 0
    """Simulator steps for which a robot that is sensed no more is taken to go on with its last velocity; then it is not
    known any more."""
    command_delay_steps: int = 0
    """Simulator steps until a velocity command takes effect; the robot rests until the first one does."""
    speed_error: float = 0.0
    """Largest error of the driven speed, as a share of it; drawn uniformly in every simulator step."""
    heading_error_deg: float = 0.0
    """Largest error of the driven heading; drawn uniformly in every simulator step."""
    shield: Literal["none", "orca"] = "none"
    """Whether the learning robot's velocity is projected onto ORCA's half-planes of the robots it senses (ours)."""
    shield_margin_m: float = 0.02
    """What the shield keeps free around every robot, beyond robot_radius_m."""
    shield_horizon_s: float = 0.5
    """How far ahead the shield avoids collisions."""
    kinematics: Literal["holonomic", "unicycle"] = "holonomic"
    """The learning robot reaches any velocity at once, or drives where it faces, within the two limits below (ours)."""
    turn_rate_limit_deg_s: float = 180.0
    """`unicycle`: largest turn rate."""
    acceleration_limit_m_s2: float = 2.0
    """`unicycle`: largest change of speed."""
    conditions: Literal["fixed", "drawn"] = "fixed"
    """position_noise_m to heading_error_deg hold as they are, or each episode draws each between none and its value."""

    sources: tuple[tuple[str, str], ...] = ()
    """Path and text of each file that `method` or `scene` names; read when the settings are made, not to be given."""

    def __post_init__(self) -> None:
        learners: object = self.learners
        if isinstance(learners, int | float) and not isinstance(learners, bool):
            object.__setattr__(self, "learners", str(learners))
        check_fields(self)
        _take_sources(self)
        _check_counts(self)
        _check_group_sizes(self)
        _check_learners(self)
        _check_lengths(self)
        _check_conditions(self)
        self.scene_class.check(self)
        self.method_class.check(self)

    @property
    def num_robots(self) -> int:
        """Robots in one world, over all groups."""
        return sum(self.group_sizes)

    @property
    def group_sizes(self) -> tuple[int, ...]:
        """Robots of each group, as the scene has them."""
        return tuple(int(size) for size in self.scene_class.group_sizes(self))

    @property
    def learner_counts(self) -> tuple[int, ...]:
        """Learning robots of each group; empty where one robot of all groups learns."""
        if self.learners == ONE_LEARNER:
            return ()
        if self.learners.isdecimal():
            return (int(self.learners),) * self.groups
        share = float(self.learners)
        return tuple(max(1, math.floor(share * size + 0.5)) for size in self.group_sizes)

    @property
    def num_learners(self) -> int:
        """Learning robots of a world."""
        return sum(self.learner_counts) or 1

    def source(self, kind: Kind) -> str:
        """The text of the user's own file that a setting names; empty where it names none."""
        return dict(self.sources).get(file_of(kind, getattr(self, kind.setting)), "")

    @property
    def method_class(self) -> type[Method]:
        """The class of `method`."""
        return load(METHODS, self.method, self.source(METHODS))

    @property
    def scene_class(self) -> type[Scene]:
        """The class of `scene`."""
        return load(SCENES, self.scene, self.source(SCENES))

    @property
    def method_name(self) -> str:
        """What people call the method: `sensor`, or the class of a user's own."""
        return short_name(METHODS, self.method)

    @property
    def num_actions(self) -> int:
        """Headings, each with every speed, plus one if there is a stop action."""
        return self.sectors * self.speed_levels + int(self.stop_action)

    @property
    def decision_s(self) -> float:
        """Simulated time of one decision, seconds."""
        return self.decision_interval_steps * self.time_step_s

    @property
    def learner_is_known(self) -> bool:
        """Whether the swarm knows the learning robot, as `swarm_knows_learner` or the method has it."""
        by_method = self.swarm_knows_learner == "method"
        return self.method_class.swarm_knows_learner if by_method else self.swarm_knows_learner == "yes"

    @property
    def timeout_fails(self) -> bool:
        """Whether a timeout is a terminal failure, as `horizon_is` or the method has it."""
        return self.method_class.timeout_fails if self.horizon_is == "method" else self.horizon_is == "failure"

    @property
    def top_speed_m_s(self) -> float:
        """Largest speed of any robot, the learning robot's too."""
        return max(self.max_speed_m_s, self.method_class.top_speed_m_s(self) * (1 + self.speed_error))

    @property
    def senses_badly(self) -> bool:
        """Whether the learning robot senses other robots otherwise than they are."""
        return _differs(self, SENSE_CONDITIONS)

    @property
    def drives_badly(self) -> bool:
        """Whether the learning robot moves otherwise than its commands say."""
        return _differs(self, COMMAND_CONDITIONS)

    @property
    def corrects_commands(self) -> bool:
        """Whether the learning robot drives other velocities than it is asked for: its shield's, or a unicycle's."""
        return self.shield != "none" or self.kinematics != "holonomic"

    @property
    def setup(self) -> str:
        """The setup as the dissertation writes it, such as `10r×2g`; another scene's name stands before it."""
        sizes = self.group_sizes
        alike = f"{sizes[0]}r×{self.groups}g" if len(set(sizes)) == 1 else f"{'+'.join(map(str, sizes))}r"
        return alike if self.scene in SCENES.built_in else f"{short_name(SCENES, self.scene)} {alike}"


def _differs(config: WorldConfig, names: list[str]) -> bool:
    """Whether one of the fields `names` has another value than its default."""
    return any(getattr(config, name) != WorldConfig.__dataclass_fields__[name].default for name in names)


def _take_sources(config: WorldConfig) -> None:
    """Reads the files that settings name, unless their texts are there already; drops texts that none names."""
    given = tuple(map(tuple, config.sources)) if isinstance(config.sources, tuple | list) else None
    require(
        given is not None and all(len(pair) == 2 and all(isinstance(text, str) for text in pair) for pair in given),
        "sources must be pairs of a path and a text; leave them out, they are read",
    )
    known = {path: text for path, text in given or ()}
    used: dict[str, str] = {}
    for kind in (METHODS, SCENES):
        name = getattr(config, kind.setting)
        path = file_of(kind, name)
        if path:
            used[path] = known[path] if path in known else read_source(kind, name)
            object.__setattr__(config, kind.setting, f"{path}:{short_name(kind, name)}")
    object.__setattr__(config, "sources", tuple(sorted(used.items())))
    for kind in (METHODS, SCENES):
        load(kind, getattr(config, kind.setting), config.source(kind))


def _check_group_sizes(config: WorldConfig) -> None:
    require(
        config.robots * config.groups <= MAX_ROBOTS,
        f"robots × groups is {config.robots * config.groups}; at most {MAX_ROBOTS} robots fit one world: lower robots "
        "or groups",
    )
    scene = config.scene_class
    with guarded(scene, "group_sizes"):
        sizes = config.group_sizes
    require(
        len(sizes) == config.groups and min(sizes) >= 2 and sum(sizes) <= MAX_ROBOTS,
        f"scene {scene.__name__} must have groups ({config.groups}) sizes of at least 2 robots, not {sizes}",
    )


LEARNERS = re.compile(r"[1-9][0-9]*|0?\.[0-9]*[1-9][0-9]*|1\.0*")


def _check_learners(config: WorldConfig) -> None:
    require(
        config.learners == ONE_LEARNER or LEARNERS.fullmatch(config.learners) is not None,
        f"learners must be {ONE_LEARNER} (one robot of all), or of every group a count (3) or a share with a point "
        f"(0.25; 1.0: all robots), not {config.learners!r}",
    )
    smallest = min(config.group_sizes)
    require(
        max(config.learner_counts, default=1) <= smallest or not config.learners.isdecimal(),
        f"learners must be at most {smallest}, the robots of the smallest group, not {config.learners}; a share has a "
        "point, as in 0.5",
    )
    leaves = config.ended_learners == "leave" and config.num_learners > 1
    require(
        not leaves or config.num_robots <= MAX_LEAVING_ROBOTS,
        f"ended_learners must be fl-orca in worlds of more than {MAX_LEAVING_ROBOTS} robots, not leave: "
        f"{config.setup} has {config.num_robots}",
    )


def _check_counts(config: WorldConfig) -> None:
    require(
        config.robots >= 2,
        f"robots must be at least 2 per group (the learning robot needs one to follow), not {config.robots}",
    )
    require(
        config.group_rows == 0 or config.group_rows >= config.groups,
        f"group_rows must be 0 or at least groups ({config.groups}), not {config.group_rows}",
    )
    require(config.groups >= 1, f"groups must be at least 1, not {config.groups}")
    require(2 <= config.sectors <= MAX_HEADINGS, f"sectors must be between 2 and {MAX_HEADINGS}, not {config.sectors}")
    require(
        1 <= config.speed_levels <= MAX_SPEED_LEVELS,
        f"speed_levels must be between 1 and {MAX_SPEED_LEVELS}, not {config.speed_levels}",
    )
    require(config.horizon_steps >= 1, f"horizon_steps must be at least 1, not {config.horizon_steps}")
    require(
        1 <= config.decision_interval_steps <= config.horizon_steps,
        f"decision_interval_steps must be between 1 and horizon_steps ({config.horizon_steps}), not "
        f"{config.decision_interval_steps}",
    )
    require(1 <= config.history <= MAX_HISTORY, f"history must be between 1 and {MAX_HISTORY}, not {config.history}")
    require(
        config.outside_limit_steps >= 1, f"outside_limit_steps must be at least 1, not {config.outside_limit_steps}"
    )
    require(1 <= config.max_neighbours <= 64, f"max_neighbours must be between 1 and 64, not {config.max_neighbours}")


POSITIVE = (
    "inner_radius_m outer_radius_m learner_speed_m_s reward_scale time_step_s arena_radius_m start_spacing_m "
    "robot_radius_m max_speed_m_s orca_radius_m orca_horizon_s neighbour_range_m separation_range_m sight_range_m "
    "view_range_m uniform_separation_range_m uniform_view_corridor_m uniform_slow_radius_m ellipse_chi_square "
    "ellipse_smallest_half_axis_m ellipse_scale_per_m goal_scale_per_m apf_range_m apf_limit_m_s "
    "learner_speed_limit_m_s shield_horizon_s turn_rate_limit_deg_s acceleration_limit_m_s2"
).split()
NON_NEGATIVE = (
    "start_jitter_m separation_noise cohesion_weight separation_weight alignment_weight apf_gain_m4_s "
    "position_noise_m shield_margin_m"
).split()
SHARES = "position_loss group_mix_up speed_error".split()
SENSE_CONDITIONS = (
    "position_noise_m position_loss burst_loss position_delay_steps dropped_mates sensing_range_m field_of_view_deg "
    "group_mix_up"
).split()
COMMAND_CONDITIONS = "command_delay_steps speed_error heading_error_deg".split()
"""Conditions of sensing and driving; there is none where all have their defaults."""
ANGLES = "separation_angle_deg sight_angle_deg view_angle_deg".split()


def _check_lengths(config: WorldConfig) -> None:
    for name in POSITIVE:
        require(getattr(config, name) > 0, f"{name} must be greater than 0, not {getattr(config, name)}")
    for name in NON_NEGATIVE:
        require(getattr(config, name) >= 0, f"{name} must not be negative, not {getattr(config, name)}")
    for name in POSITIVE + NON_NEGATIVE:
        value, largest = getattr(config, name), LARGEST_REWARD if name == "reward_scale" else LARGEST
        require(value <= largest, f"{name} must be at most {largest:g}, not {value}")
    for name in ANGLES:
        require(0 < getattr(config, name) <= 180, f"{name} must be in (0, 180], not {getattr(config, name)}")
    require(
        config.inner_radius_m < config.outer_radius_m,
        f"inner_radius_m (R1 = {config.inner_radius_m}) must be smaller than "
        f"outer_radius_m (R2 = {config.outer_radius_m})",
    )
    require(
        config.orca_radius_m >= config.robot_radius_m,
        f"orca_radius_m ({config.orca_radius_m}) must be at least robot_radius_m ({config.robot_radius_m}), "
        "or ORCA steers into collisions",
    )
    require(
        config.neighbour_range_m > 2 * config.orca_radius_m,
        f"neighbour_range_m ({config.neighbour_range_m}) must be greater than 2 × orca_radius_m "
        f"({2 * config.orca_radius_m:.3g} m), or robots see each other only once they are too near",
    )
    require(
        config.orca_horizon_s >= config.time_step_s,
        f"orca_horizon_s ({config.orca_horizon_s}) must be at least time_step_s ({config.time_step_s}), or robots "
        "collide within the step that ORCA looks ahead",
    )
    step_m = config.time_step_s * config.top_speed_m_s
    require(
        step_m <= 2 * config.robot_radius_m,
        f"time_step_s ({config.time_step_s}) lets a robot jump {step_m:.3g} m in a step, past another robot: "
        f"keep time_step_s × speed at most 2 × robot_radius_m ({2 * config.robot_radius_m:.3g} m)",
    )


def _check_conditions(config: WorldConfig) -> None:
    for name in SHARES:
        require(0 <= getattr(config, name) <= 1, f"{name} must be between 0 and 1, not {getattr(config, name)}")
    for name in ("position_delay_steps", "command_delay_steps"):
        delay = getattr(config, name)
        require(0 <= delay <= MAX_DELAY_STEPS, f"{name} must be between 0 and {MAX_DELAY_STEPS}, not {delay}")
    require(
        0 <= config.track_steps <= MAX_TRACK_STEPS,
        f"track_steps must be between 0 and {MAX_TRACK_STEPS}, not {config.track_steps}",
    )
    require(
        1 <= config.burst_steps <= LARGEST, f"burst_steps must be between 1 and {LARGEST:.0e}, not {config.burst_steps}"
    )
    most = config.burst_steps / (1 + config.burst_steps)
    require(
        0 <= config.burst_loss <= most,
        f"burst_loss must be between 0 and {most:.3g}, which bursts of burst_steps ({config.burst_steps}) can reach, "
        f"not {config.burst_loss}",
    )
    mates = min(config.group_sizes) - 1
    require(
        0 <= config.dropped_mates <= mates,
        f"dropped_mates must be between 0 and {mates}, the other robots of the learning robot's group, not "
        f"{config.dropped_mates}",
    )
    contact_m = 2 * config.robot_radius_m
    require(
        config.sensing_range_m == 0 or contact_m <= config.sensing_range_m <= LARGEST,
        f"sensing_range_m must be 0 (no limit) or between 2 × robot_radius_m ({contact_m:.3g} m), where robots touch, "
        f"and {LARGEST:.0e}, not {config.sensing_range_m}",
    )
    require(
        0 < config.field_of_view_deg <= 360, f"field_of_view_deg must be in (0, 360], not {config.field_of_view_deg}"
    )
    require(
        0 <= config.heading_error_deg <= 180, f"heading_error_deg must be in [0, 180], not {config.heading_error_deg}"
    )
    require(
        config.shield_horizon_s >= config.time_step_s,
        f"shield_horizon_s ({config.shield_horizon_s}) must be at least time_step_s ({config.time_step_s}), or robots "
        "collide within the step that the shield looks ahead",
    )
    require(
        config.shield == "none" or config.kinematics == "holonomic",
        "shield = orca permits velocities to a robot that reaches them at once, which a unicycle does not; set "
        "kinematics = holonomic or shield = none",
    )
