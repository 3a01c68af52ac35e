"""The episode player: one episode as one HTML file with a canvas, without network or framework.

The file works from disk and inside an iframe. Positions are stored compressed, as differences between successive
states in units of half a millimetre or more. Velocities are not stored: they are the same differences per time step.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from dashboards.pages.assets import OFFLINE, PLAYER_CSS, PLAYER_JS, assets, document, embedded, packed
from sim_core.config import WorldConfig
from sim_core.outcomes import OUTCOME_NAMES, Outcome
from sim_core.render import GROUP_COLOURS, view_half_m
from sim_core.scenes.base import GOAL_HALF_SIDE_M
from sim_core.swarm.flock_rules import STATE_NAMES

if TYPE_CHECKING:
    from actors.evaluation.trajectory import Episode

INT16_MAX = 32767
NOWHERE = -32768
"""In place of a position: the robot is not sensed."""
SMALLEST_UNIT_M = 0.0005
"""Smallest unit of positions; with it, velocities are exact to 0.01 m/s at a time step of 0.05 s."""
VERDICTS = {
    Outcome.RUNNING: "Cut: the recording stops before the episode ended",
    Outcome.GOAL: "Success: the group reached its goal",
    Outcome.LOST: "Failure, lost: no robot of its own group within R2",
    Outcome.CAPTURED: "Failure, captured: only robots of other groups within R2",
    Outcome.COLLISION: "Failure, collision: it touched another robot",
    Outcome.TIMEOUT: "Failure, timeout: the group did not reach its goal in time",
}
"""Each outcome as a sentence about the learning robot."""


def player_html(episode: Episode, config: WorldConfig, title: str) -> str:
    """The player of `episode`.

    Args:
      episode: T + 1 recorded states.
      config: the setup it was recorded in.
      title: plain text; it is escaped.

    Returns:
      An HTML document.

    Raises:
      ValueError: the positions are not finite, or not those of `config.num_robots` robots.
    """
    return player_page(title, player_data(episode, config), ["player_page.js"], OFFLINE)


def player_page(title: str, data: dict[str, Any], scripts: Sequence[str], policy: str) -> str:
    """A document with the player, and scripts that load the episodes to play.

    Args:
      title: plain text; it is escaped.
      data: JSON for the script, in the element `data`.
      scripts: names of their files in `dashboards/web`.
      policy: content security policy.
    """
    return document(
        title,
        policy,
        (*PLAYER_CSS, "player_page.css"),
        "player.html",
        stage=assets("stage.html"),
        data=embedded(data),
        js=assets(*PLAYER_JS, *scripts),
    )


def player_data(episode: Episode, config: WorldConfig) -> dict[str, Any]:
    """An episode as the player reads it, ready for JSON.

    Arrays are packed (`dashboards.pages.assets.packed`):

    - `positions` `[T + 1, num_robots, 2]` int16: differences from state to state, the first from 0, modulo 2^16, in
      units of `metres_per_unit`; all low bytes come before all high bytes.
    - `machine` `[T + 1, num_robots]` uint8: states of the FL-ORCA machine (`sim_core.swarm.flock_rules.STATE_NAMES`).
    - `actions` `[T + 1]` int16: the learning robot's actions.
    - `sensed`, as `positions`: where the learning robot senses the robots, -2^15 for nowhere; null if it senses well.
    - `asked` `[T + 1, 2]` int16: the velocity asked for before shield or unicycle, mm/s; null without.

    Raises:
      ValueError: the positions are not finite, or not those of `config.num_robots` robots.
    """
    position = np.asarray(episode.position, np.float64)
    if config.num_learners > 1 and config.ended_learners == "leave":  # out of sight
        position = np.where(np.isnan(position), 2 * view_half_m(config), position)
    if position.ndim != 3 or position.shape[1:] != (config.num_robots, 2) or not np.isfinite(position).all():
        raise ValueError(
            f"an episode of {config.setup} has finite positions [T + 1, {config.num_robots}, 2]; "
            f"these are {position.shape}, finite: {bool(np.isfinite(position).all())}"
        )
    outcome, steps = Outcome(episode.outcome), len(position) - 1
    sensed = np.asarray(episode.sensed, np.float64)
    farthest_m = max(float(np.abs(position).max()), float(np.nanmax(np.abs(sensed), initial=0.0)))
    metres_per_unit = max(farthest_m / INT16_MAX, SMALLEST_UNIT_M)
    units = np.where(np.isnan(sensed), NOWHERE, np.rint(sensed / metres_per_unit)).astype(np.int16)
    return {
        "setup": f"{config.setup}, seed {episode.seed}",
        "verdict": f"{VERDICTS[outcome]} (step {steps}, {steps * config.time_step_s:.2f} s).",
        "positions": packed(_byte_planes(np.rint(position / metres_per_unit).astype(np.int16))),
        "sensed": packed(_byte_planes(units)) if len(sensed) else None,
        "asked": packed(np.rint(1000 * episode.asked).astype("<i2").tobytes()) if len(episode.asked) else None,
        "metres_per_unit": metres_per_unit,
        "machine": packed(episode.machine.astype(np.uint8).tobytes()),
        "actions": packed(episode.action.astype("<i2").tobytes()),
        "piloted": episode.is_piloted,
        "goals": [[round(float(x), 4), round(float(y), 4)] for x, y in episode.goal],
        "learner": episode.learner,
        "steps": steps,
        "outcome": OUTCOME_NAMES[outcome],
        **_scene(config),
    }


def _scene(config: WorldConfig) -> dict[str, Any]:
    """The setup's settings that the player uses."""
    scale = math.sqrt(config.ellipse_chi_square)
    ellipse = {
        "full": config.ellipse_covariance == "full",
        "axis_scale": scale if config.ellipse_axes == "confidence" else scale / 2,
        "smallest_m": config.ellipse_smallest_half_axis_m,
        "counts_learner": config.ellipse_counts_learner,
    }
    return {
        "draws_sectors": "sectors" in config.method_class.draws,
        "group_sizes": list(config.group_sizes),
        "groups": config.groups,
        "sectors": config.sectors,
        "speed_levels": config.speed_levels,
        "sectors_face_goal": config.sector_frame == "goal",
        "time_step_s": config.time_step_s,
        "view_half_m": view_half_m(config),
        "arena_radius_m": config.arena_radius_m if config.scene_class.draws_circle else None,
        "robot_radius_m": config.robot_radius_m,
        "goal_half_m": GOAL_HALF_SIDE_M,
        "inner_radius_m": config.inner_radius_m,
        "outer_radius_m": config.outer_radius_m,
        "ellipse": ellipse if "ellipses" in config.method_class.draws else None,
        "orca": {
            "radius_m": config.orca_radius_m,
            "horizon_s": config.orca_horizon_s,
            "max_neighbours": config.max_neighbours,
            "range_m": config.neighbour_range_m,
            "max_speed_m_s": config.max_speed_m_s,
            "knows_learner": config.learner_is_known,
        },
        "colours": list(GROUP_COLOURS),
        "states": list(STATE_NAMES),
    }


def _byte_planes(units: NDArray[np.int16]) -> bytes:
    """Differences along the first axis, modulo 2^16; low bytes before high bytes, which compresses them to a third."""
    differences = np.diff(units, axis=0, prepend=np.zeros_like(units[:1])).astype("<i2")
    return differences.view(np.uint8).reshape(-1, 2).T.tobytes()
