"""One episode as one HTML file: a canvas player that needs no network and no framework.

The file works from disk and inside an iframe. Positions travel as int16 of the largest coordinate, base64; a
velocity is the step between two positions, so none is stored.
"""

from __future__ import annotations

import base64
import html
import json
import re
from importlib import resources
from typing import Any

import numpy as np

from actors.trajectory import Episode
from sim_core.config import WorldConfig
from sim_core.flock_rules import STATE_NAMES
from sim_core.outcomes import OUTCOME_NAMES, Outcome
from sim_core.render import GOAL_HALF_SIDE_M, GROUP_COLOURS, view_half_m

INT16_MAX = 32767
VERDICTS = {
    Outcome.RUNNING: "Cut: the recording stops before the episode ended",
    Outcome.GOAL: "Success: the group reached its goal",
    Outcome.LOST: "Failure, lost: no robot of its own group within R2",
    Outcome.CAPTURED: "Failure, captured: only robots of other groups within R2",
    Outcome.COLLISION: "Failure, collision: it touched another robot",
    Outcome.TIMEOUT: "Failure, timeout: the group did not reach its goal in time",
}
"""What an outcome means for the learning robot, in words."""


def player_html(episode: Episode, config: WorldConfig, title: str) -> str:
    """The player of `episode`.

    Args:
      episode: T + 1 recorded states.
      config: the setup it was recorded in.
      title: plain text; it is escaped.

    Returns:
      A whole HTML document.

    Raises:
      ValueError: the positions are not finite, or are not of `config.num_robots` robots.
    """
    outcome = Outcome(episode.outcome)
    steps = len(episode.position) - 1
    fields = {
        "title": html.escape(title),
        "setup": html.escape(f"{config.setup}, seed {episode.seed}"),
        "verdict": html.escape(f"{VERDICTS[outcome]} (step {steps}, {steps * config.time_step_s:.2f} s)."),
        "verdict-class": "success" if outcome == Outcome.GOAL else "failure",
        "css": _packaged("player.css"),
        "js": _packaged("player.js"),
        "data": json.dumps(player_data(episode, config), separators=(",", ":")).replace("<", "\\u003c"),
    }
    return re.sub(r"\{\{([a-z-]+)\}\}", lambda match: fields[match[1]], _packaged("player.html"))


def player_data(episode: Episode, config: WorldConfig) -> dict[str, Any]:
    """What the player draws, ready for JSON.

    `positions` holds `[T + 1, num_robots, 2]` little-endian int16 in units of `metres_per_unit`, `machine`
    `[T + 1, num_robots]` uint8 (sim_core.flock_rules.STATE_NAMES), both base64.

    Raises:
      ValueError: the positions are not finite, or are not of `config.num_robots` robots.
    """
    position = np.asarray(episode.position, np.float64)
    if position.ndim != 3 or position.shape[1:] != (config.num_robots, 2) or not np.isfinite(position).all():
        raise ValueError(
            f"an episode of {config.setup} has finite positions [T + 1, {config.num_robots}, 2]; "
            f"these are {position.shape}, finite: {bool(np.isfinite(position).all())}"
        )
    metres_per_unit = max(float(np.abs(position).max()), view_half_m(config)) / INT16_MAX
    units = np.rint(position / metres_per_unit).astype("<i2")
    return {
        "positions": _base64(units.tobytes()),
        "metres_per_unit": metres_per_unit,
        "machine": _base64(episode.machine.astype(np.uint8).tobytes()),
        "piloted": bool((episode.action[:-1] >= 0).any()),
        "goals": [[round(float(x), 4), round(float(y), 4)] for x, y in episode.goal],
        "learner": episode.learner,
        "robots_per_group": config.robots,
        "groups": config.groups,
        "steps": len(position) - 1,
        "time_step_s": config.time_step_s,
        "view_half_m": view_half_m(config),
        "arena_radius_m": config.arena_radius_m,
        "robot_radius_m": config.robot_radius_m,
        "goal_half_m": GOAL_HALF_SIDE_M,
        "inner_radius_m": config.inner_radius_m,
        "outer_radius_m": config.outer_radius_m,
        "outcome": OUTCOME_NAMES[episode.outcome],
        "colours": list(GROUP_COLOURS),
        "states": list(STATE_NAMES),
    }


def _packaged(name: str) -> str:
    return resources.files("dashboards").joinpath(name).read_text("utf-8")


def _base64(data: bytes) -> str:
    return base64.b64encode(data).decode("ascii")
