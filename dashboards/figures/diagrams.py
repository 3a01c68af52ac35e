"""The dissertation's diagrams, drawn from a simulated state: M_sensor's view, the groups' ellipses, M_OUT's velocity.

Every number comes from the code that trains: counts, ellipses, the potential field and velocities are those of
`sim_core.methods`. FL-ORCA drives all robots, and no network is asked. The heading in 3.1 is that of the sector with
the highest count, as in the dissertation's example. u_nn in 4.3 is the heading nearest to the direction of the own
group's centre.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from functools import partial
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Ellipse, Wedge
from numpy.typing import NDArray

from dashboards.analysis.aggregate import Setup
from dashboards.figures.state_machine import diagram_2_2
from dashboards.figures.style import GRID, MUTED, TEXT, new_figure
from sim_core.config import WorldConfig
from sim_core.methods.apf import field_of, field_params
from sim_core.methods.ellipse import ellipse_params, group_ellipse, left_out_of
from sim_core.methods.headings import heading_velocities
from sim_core.methods.m_sensor import sector_edges
from sim_core.outcomes import Outcome
from sim_core.pilot import Pilot
from sim_core.render import GROUP_COLOURS
from sim_core.worlds import WorldBatch

DRAWN_SETUP = Setup(10, 3)
"""Robots per group, and groups, of the drawn worlds."""
HEADING, FIELD, SUM = "#1C2024", "#D55E00", "#0072B2"
EPISODE_SEED = 3

RING, DISC = "#EEF1F4", "#D5DBE1"
_TITLE: dict[str, Any] = {"loc": "left", "fontsize": 10, "color": TEXT}
_PLATE: dict[str, Any] = {"boxstyle": "round,pad=0.15", "fc": "white", "ec": "none", "alpha": 0.85}

GroupEllipse = tuple[float, float, float, float, float]
"""a, b, x_c, y_c (metres) and theta (radians)."""
Vector = NDArray[np.float64]
Score = Callable[[WorldBatch], float]


def best_scene(config: WorldConfig, seed: int, score: Score) -> WorldBatch:
    """The state of an FL-ORCA episode with the highest score, as a batch of one world.

    Of equal scores, the first counts. All states count, from the start to the one with the outcome.
    """
    worlds = WorldBatch(config, 1)
    worlds.seed([seed])
    worlds.reset()
    best, saved = score(worlds), worlds.get_state()
    outcome = int(Outcome.RUNNING)
    while outcome == Outcome.RUNNING:
        outcome = int(worlds.step(Pilot.FREE).outcome[0])
        found = score(worlds)
        if found > best:
            best, saved = found, worlds.get_state()
    worlds.set_state(saved)
    return worlds


def robots_near(worlds: WorldBatch) -> float:
    """Number of robots within R2 of the learning robot of world 0."""
    offset = _offsets(worlds)
    return float(np.sum(np.hypot(*offset.T) < worlds.config.outer_radius_m) - 1)


def field_strength(worlds: WorldBatch) -> float:
    """Magnitude of u_apf of the learning robot of world 0, m/s."""
    return float(np.hypot(*potential_field(worlds)))


def potential_field(worlds: WorldBatch) -> Vector:
    """u_apf `[2]` of the learning robot of world 0, caused by all other robots, m/s."""
    state = worlds.state
    params = field_params(worlds.config)
    field = field_of(state.learner[0], 0, worlds.config.num_robots, state.pos_x[0], state.pos_y[0], params)
    return np.array(field, np.float64)


def perceived(worlds: WorldBatch) -> NDArray[np.int64]:
    """M_sensor's counts in world 0, `[kinds, 2, sectors]` int64; on the second axis the disc, then the ring.

    One kind, own minus other robots; or two, own and other robots, if the config's `sensor_counts` is `separate`.
    """
    seen = np.zeros((worlds.num_worlds, *worlds.method.observation_shape), worlds.method.observation_dtype)
    worlds.method.perceive(worlds.state, np.ones(worlds.num_worlds, np.bool_), seen)
    return np.array(seen[0].reshape(-1, 2, worlds.config.sectors), np.int64)


def net_counts(worlds: WorldBatch) -> NDArray[np.int64]:
    """Own minus other robots in world 0, `[2, sectors]` int64: the disc, then the ring."""
    counts = perceived(worlds)
    return np.array(counts[0] - counts[1:].sum(axis=0), np.int64)


def group_ellipses(worlds: WorldBatch, config: WorldConfig) -> list[GroupEllipse]:
    """The ellipse of each group of world 0, as M_IN and M_OUT compute them with the settings of `config`."""
    params, state = ellipse_params(config), worlds.state
    left_out = left_out_of(state.learner[0], params)
    pos_x, pos_y = state.pos_x[0], state.pos_y[0]
    return [group_ellipse(begin, end, pos_x, pos_y, left_out, params) for begin, end in pairwise(state.group_begin)]


def sector_frame(worlds: WorldBatch) -> Vector:
    """The rotation matrix `[2, 2]` from the frame of the sectors in world 0 to the world's frame."""
    if worlds.config.sector_frame == "world":
        return np.eye(2)
    own = int(worlds.state.group[worlds.state.learner[0]])
    x, y = np.array([worlds.state.goal_x[0, own], worlds.state.goal_y[0, own]], np.float64) - _learner_position(worlds)
    return np.array([[x, -y], [y, x]]) / math.hypot(x, y)


def executed_velocity(worlds: WorldBatch, action: int) -> Vector:
    """The velocity `[2]` that the learning robot of world 0 executes for `action`, m/s."""
    out_x, out_y = np.zeros(worlds.num_worlds, np.float32), np.zeros(worlds.num_worlds, np.float32)
    worlds.method.velocity(worlds.state, np.full(worlds.num_worlds, action), out_x, out_y)
    return np.array([out_x[0], out_y[0]], np.float64)


def diagram_3_1(world: WorldConfig) -> Figure:
    """M_sensor's regions with the robots in them, and the resulting state with the heading of the highest count."""
    worlds = best_scene(world, EPISODE_SEED, robots_near)
    counts = perceived(worlds)
    figure = new_figure(9.0, 5.0, f"Figure 3.1  What M_sensor perceives (step {int(worlds.state.steps[0])})")
    left, right = figure.subplots(1, 2)
    config = worlds.config
    _draw_robots(left, worlds, reach_m=config.outer_radius_m + 0.25)
    _draw_regions(left, config)
    left.set_title("(a) disc R1 and ring R1 … R2; black: the learning robot", **_TITLE)
    _draw_robots(right, worlds, reach_m=config.outer_radius_m + 0.25, opacity=0.25)
    frame = sector_frame(worlds)
    _draw_regions(right, config, frame)
    _draw_counts(right, config, counts, frame)
    action = int(np.argmax(net_counts(worlds).sum(axis=0)))
    _arrow(right, executed_velocity(worlds, action) * 0.9 * config.outer_radius_m, HEADING)
    state = "own less other" if len(counts) == 1 else "own | other"
    right.set_title(f"(b) {state} robots per sector; heading {action}", **_TITLE)
    return figure


def diagram_4_1(world: WorldConfig) -> Figure:
    """The groups' ellipses with a, b and theta: without the covariance of x and y as in the text, and with it."""
    worlds = best_scene(world, EPISODE_SEED, robots_near)
    counted = "counted" if worlds.config.ellipse_counts_learner else "not counted"
    steps = int(worlds.state.steps[0])
    title = f"Figures 4.1 and 4.2  Groups as ellipses, the learning robot (black) {counted} (step {steps})"
    figure = new_figure(9.0, 5.2, title)
    ways = (
        (dataclasses.replace(worlds.config, ellipse_covariance="diagonal"), "(a) σxy taken as 0; dashed a, solid b"),
        (dataclasses.replace(worlds.config, ellipse_covariance="full"), "(b) the whole covariance"),
    )
    for axes, (config, title) in zip(figure.subplots(1, 2, sharex=True, sharey=True), ways, strict=True):
        _draw_robots(axes, worlds, reach_m=2.75)
        for group, ellipse in enumerate(group_ellipses(worlds, config)):
            _draw_ellipse(axes, ellipse, _learner_position(worlds), group)
        axes.set_title(title, **_TITLE)
        axes.legend(loc="lower left", fontsize=8, framealpha=0.9, edgecolor=GRID)
    return figure


def diagram_4_3(world: WorldConfig) -> Figure:
    """M_OUT's velocity as the sum of the network's velocity and the potential field's."""
    worlds = best_scene(world, EPISODE_SEED, field_strength)
    config = worlds.config
    action = _heading_to_group(worlds)
    network, field = heading_velocities(config, np.float64)[action], potential_field(worlds)
    moved = executed_velocity(worlds, action)
    figure = new_figure(6.4, 5.4, f"Figure 4.3  u_l = u_nn + u_apf (step {int(worlds.state.steps[0])})")
    axes = figure.subplots()
    farthest = max(float(np.abs(tip).max()) for tip in (network, field, network + field))
    _draw_robots(axes, worlds, reach_m=max(1.25, farthest + 0.15))
    axes.add_patch(Circle((0, 0), config.apf_range_m, fill=False, ls=":", ec=MUTED))
    for tail, tip in ((network, network + field), (field, network + field)):
        axes.plot(*zip(tail, tip, strict=True), color=MUTED, ls="--", lw=1)
    arrows = ((network, HEADING, "u_nn"), (field, FIELD, "u_apf"), (moved, SUM, "u_l"))
    for vector, colour, name in arrows:
        _arrow(axes, vector, colour)
        axes.plot([], [], color=colour, lw=3, label=f"{name}  {np.hypot(*vector):.2f} m/s")
    axes.plot([], [], color=MUTED, ls=":", label=f"range of the field, {config.apf_range_m:g} m")
    axes.plot([], [], color=MUTED, ls="--", label=f"sum, cut to {config.learner_speed_limit_m_s:g} m/s")
    axes.set_title("1 m of arrow is 1 m/s", **_TITLE)
    figure.legend(loc="outside lower left", ncols=3, frameon=False, fontsize=9)
    return figure


def _learner_position(worlds: WorldBatch) -> Vector:
    return np.array(worlds.positions()[0, worlds.state.learner[0]], np.float64)


def _offsets(worlds: WorldBatch) -> Vector:
    """Positions `[num_robots, 2]` of world 0 relative to the learning robot, metres."""
    return np.array(worlds.positions()[0] - _learner_position(worlds), np.float64)


def _heading_to_group(worlds: WorldBatch) -> int:
    """The action whose heading is nearest to the direction of the own group's centre."""
    own = int(worlds.state.group[worlds.state.learner[0]])
    _, _, x_c, y_c, _ = group_ellipses(worlds, worlds.config)[own]
    towards = np.array([x_c, y_c]) - _learner_position(worlds)
    return int(np.argmax(heading_velocities(worlds.config, np.float64)[: worlds.config.sectors] @ towards))


def _draw_robots(axes: Axes, worlds: WorldBatch, reach_m: float, opacity: float = 1.0) -> None:
    """Draws all robots to scale with their group's number; the learning robot is black and in the origin."""
    config, learner = worlds.config, int(worlds.state.learner[0])
    for robot, place in enumerate(_offsets(worlds)):
        group = int(worlds.state.group[robot])
        face, ink = ("black", "white") if robot == learner else (GROUP_COLOURS[group % len(GROUP_COLOURS)], "black")
        faded = 1.0 if robot == learner else opacity
        axes.add_patch(Circle((place[0], place[1]), config.robot_radius_m, fc=face, ec=TEXT, lw=0.6, alpha=faded))
        number: dict[str, Any] = {"ha": "center", "va": "center_baseline", "fontsize": 7, "color": ink, "alpha": faded}
        axes.text(place[0], place[1], str(group + 1), clip_on=True, **number)
    axes.set(xlim=(-reach_m, reach_m), ylim=(-reach_m, reach_m), aspect="equal", xticks=[], yticks=[])
    axes.spines[:].set_color(GRID)


def _draw_regions(axes: Axes, config: WorldConfig, frame: Vector | None = None) -> None:
    """Draws disc R1 and ring R1 … R2: with their radii, or divided into the sectors of `frame`."""
    inner, outer = config.inner_radius_m, config.outer_radius_m
    if frame is None:
        axes.add_patch(Wedge((0, 0), outer, 0, 360, width=outer - inner, fc=RING, ec="none", zorder=0))
        axes.add_patch(Circle((0, 0), inner, fc=DISC, ec="none", zorder=0))
        for radius, name, down in ((inner, "R1", -0.75), (outer, "R2", -1.15)):
            tip = radius * np.array([math.cos(down), math.sin(down)])
            _arrow(axes, tip, TEXT, width=1.0)
            label = f"{name} = {radius:g} m"
            axes.text(0.75 * tip[0], 0.75 * tip[1], label, bbox=_PLATE, ha="center", fontsize=8, color=TEXT, zorder=6)
    else:
        for edge in sector_edges(config.sectors) @ frame.T:
            axes.plot(*zip((0, 0), outer * edge, strict=True), color=MUTED, lw=0.8, zorder=0)
    for radius in (inner, outer):
        axes.add_patch(Circle((0, 0), radius, fill=False, ec=MUTED, lw=1.0, zorder=0))


def _draw_counts(axes: Axes, config: WorldConfig, counts: NDArray[np.int64], frame: Vector) -> None:
    """Writes the counts `[kinds, 2, sectors]` into the regions of the sectors, two kinds as `own|other`."""
    middle_m = (0.62 * config.inner_radius_m, 0.5 * (config.inner_radius_m + config.outer_radius_m))
    centres = heading_velocities(config, np.float64)[: config.sectors] @ frame.T / config.learner_speed_m_s
    for region, radius_m in enumerate(middle_m):
        for centre, count in zip(centres, counts[:, region].T, strict=True):
            weight, colour = ("bold", TEXT) if np.any(count) else ("normal", MUTED)
            style: dict[str, Any] = {"ha": "center", "va": "center", "fontsize": 9, "fontweight": weight, "zorder": 7}
            x, y = radius_m * centre
            axes.text(x, y, _count_text(count), color=colour, bbox=_PLATE, **style)


def _count_text(count: NDArray[np.int64]) -> str:
    if len(count) > 1:
        return f"{count[0]}|{count[1]}"
    return f"{count[0]:+d}".replace("-", "−") if count[0] else "0"


def _draw_ellipse(axes: Axes, found: GroupEllipse, learner: Vector, group: int) -> None:
    """Draws an ellipse with its half-axes: a dashed, b solid."""
    a, b, x_c, y_c, theta = found
    colour = GROUP_COLOURS[group % len(GROUP_COLOURS)]
    centre = np.array([x_c, y_c]) - learner
    turned = math.degrees(theta)
    axes.add_patch(Ellipse((centre[0], centre[1]), 2 * b, 2 * a, angle=turned, fc=colour, alpha=0.15, zorder=0))
    axes.add_patch(Ellipse((centre[0], centre[1]), 2 * b, 2 * a, angle=turned, fill=False, ec=colour, lw=2))
    along, across = np.array([math.cos(theta), math.sin(theta)]), np.array([-math.sin(theta), math.cos(theta)])
    for half, line in ((b * along, "-"), (a * across, "--")):
        axes.plot(*zip(centre, centre + half, strict=True), color=TEXT, ls=line, lw=1.3, zorder=4)
    label = f"{group + 1}: a {a:.2f} m, b {b:.2f} m, θ {turned:.0f}°"
    axes.plot([], [], color=colour, lw=3, label=label)


def _arrow(axes: Axes, tip: Vector, colour: str, width: float = 2.5) -> None:
    """Draws an arrow from the learning robot, which is in the origin."""
    style: dict[str, Any] = {
        "arrowstyle": "-|>",
        "color": colour,
        "lw": width,
        "shrinkA": 0,
        "shrinkB": 0,
        "mutation_scale": 14,
    }
    axes.annotate("", xy=(tip[0], tip[1]), xytext=(0, 0), arrowprops=style, zorder=5)


class Diagram(NamedTuple):
    """A diagram: its file name, its description, the method and setup of its world, and the function that draws it."""

    file: str
    alt: str
    method: str
    setup: Setup
    draw: Callable[[WorldConfig], Figure]


DIAGRAMS = (
    Diagram(
        "diagram-2-2.png",
        "Figure 2.2: FL-ORCA's state machine, and how long and often its robots are in its states",
        "sensor",
        DRAWN_SETUP,
        partial(diagram_2_2, seed=EPISODE_SEED),
    ),
    Diagram("diagram-3-1.png", "Figure 3.1: what M_sensor's robot perceives", "sensor", DRAWN_SETUP, diagram_3_1),
    Diagram("diagram-4-1.png", "Figures 4.1 and 4.2: the groups as ellipses", "out", DRAWN_SETUP, diagram_4_1),
    Diagram("diagram-4-3.png", "Figure 4.3: the velocity of M_OUT as a sum of two", "out", DRAWN_SETUP, diagram_4_3),
)
