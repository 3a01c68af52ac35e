"""Figure 2.2: FL-ORCA's state machine, with what its robots did in one simulated episode.

The states and their conditions are those of `sim_core.swarm.flocking`; shares and changes are counted, step by step.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from dashboards.figures.style import GRID, MUTED, TEXT, new_figure
from sim_core.config import WorldConfig
from sim_core.outcomes import Outcome
from sim_core.pilot import Pilot
from sim_core.swarm.flock_rules import FOLLOWER, SINGLE_GROUP, STATE_NAMES, TURN_RIGHT, VISION_FREE
from sim_core.worlds import WorldBatch

STATES = range(len(STATE_NAMES))
PLACES = {SINGLE_GROUP: (0.0, 1.0), VISION_FREE: (1.0, 1.0), FOLLOWER: (0.0, 0.0), TURN_RIGHT: (1.0, 0.0)}
CONDITIONS = {
    SINGLE_GROUP: "senses no other group:\nto the goal with its group",
    VISION_FREE: "senses another group,\nview of the goal free:\nto the goal",
    FOLLOWER: "view not free,\na mate is in a state above:\nfollows it",
    TURN_RIGHT: "none of the others:\nturns right around the congestion",
}
"""When a robot is in a state, and what it does (2.2.2)."""
SHORTEN = 0.3
"""Share of the way between two states that their arrow leaves free at each end."""


def recorded_states(world: WorldConfig, seed: int) -> NDArray[np.int8]:
    """The states `[simulator steps, robots]` int8 of all robots in one episode that FL-ORCA drives."""
    worlds = WorldBatch(dataclasses.replace(world, decision_interval_steps=1), 1)
    worlds.seed([seed])
    worlds.reset()
    rows, outcome = [], int(Outcome.RUNNING)
    while outcome == Outcome.RUNNING:
        outcome = int(worlds.step(Pilot.FREE).outcome[0])
        rows.append(worlds.state.machine[0].copy())
    return np.array(rows, np.int8)


def counted_changes(states: NDArray[np.int8]) -> NDArray[np.int64]:
    """How often robots went from one state to another `[4, 4]` int64; the diagonal counts those that stayed.

    Args:
      states: of all robots `[steps, robots]`.
    """
    counts = np.zeros((len(STATES), len(STATES)), np.int64)
    np.add.at(counts, (states[:-1].ravel(), states[1:].ravel()), 1)
    return counts


def diagram_2_2(world: WorldConfig, seed: int) -> Figure:
    """The states with their conditions and their shares of all robot steps, and how often robots change between them.

    Args:
      world: where FL-ORCA drives all robots.
      seed: of the episode.
    """
    states = recorded_states(world, seed)
    shares = np.bincount(states.ravel(), minlength=len(STATES)) / states.size
    per_minute = counted_changes(states) / (states.size * world.time_step_s) * 60
    figure = new_figure(9.0, 5.4, f"Figure 2.2  FL-ORCA's state machine, in an episode of {world.setup}")
    axes = figure.subplots()
    axes.set(xlim=(-0.45, 1.45), ylim=(-0.3, 1.3), xticks=[], yticks=[])
    axes.spines[:].set_visible(False)
    for state in STATES:
        _draw_state(axes, state, float(shares[state]))
    for before in STATES:
        for after in STATES:
            if before != after and per_minute[before, after] >= 0.05:
                _draw_change(axes, before, after, float(per_minute[before, after]))
    note = "Percent: share of all robot steps. Arrows: changes per robot and minute, 0.1 and more."
    axes.set_title(note, loc="left", fontsize=9, color=MUTED)
    return figure


def _draw_state(axes: Axes, state: int, share: float) -> None:
    text = f"{STATE_NAMES[state].title()}  {100 * share:.0f} %\n{CONDITIONS[state]}"
    box: dict[str, Any] = {"boxstyle": "round,pad=0.5", "fc": "#EEF1F4", "ec": GRID}
    axes.text(*PLACES[state], text, ha="center", va="center", fontsize=9, color=TEXT, bbox=box, zorder=3)


def _draw_change(axes: Axes, before: int, after: int, per_minute: float) -> None:
    """An arrow between two states, beside the one that goes back, and its number."""
    start, end = np.array(PLACES[before]), np.array(PLACES[after])
    way = end - start
    side = 0.035 * np.array([-way[1], way[0]]) / np.hypot(*way)
    tail, tip = start + SHORTEN * way + side, end - SHORTEN * way + side
    style: dict[str, Any] = {"arrowstyle": "-|>", "color": MUTED, "lw": 1.2, "mutation_scale": 12}
    axes.annotate("", xy=(tip[0], tip[1]), xytext=(tail[0], tail[1]), arrowprops=style)
    x, y = tail + 0.3 * (tip - tail) + 0.9 * side
    plate: dict[str, Any] = {"boxstyle": "round,pad=0.1", "fc": "white", "ec": "none"}
    axes.text(x, y, f"{per_minute:.1f}", ha="center", va="center", fontsize=8, color=TEXT, bbox=plate, zorder=4)
