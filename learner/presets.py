"""Named settings of a training: `thesis`, the reading closest to the dissertation's text, and `best`, ours."""

from __future__ import annotations

from typing import Any, Literal

from learner.config import RunConfig
from sim_core.config import WorldConfig

PresetName = Literal["thesis", "best"]

_TRAINING: dict[str, Any] = {
    "total_env_steps": 1_000_000,
    "learning_rate_decay_env_steps": 1_000_000,
    "epsilon_decay_env_steps": 200_000,
    "replay_capacity": 250_000,
    "eval_every_env_steps": 250_000,
    "checkpoint_every_env_steps": 250_000,
    "keep_checkpoints": 1,
}
_ELLIPSES: dict[str, Any] = {"ellipse_counts_learner": True}


def preset_config(name: PresetName, method: Literal["sensor", "in", "out"], robots: int, groups: int) -> RunConfig:
    """The settings that a preset gives one method in one setup.

    Raises:
      ConfigError: the setup is not possible.
    """
    world = WorldConfig(method=method, robots=robots, groups=groups, **({} if method == "sensor" else _ELLIPSES))
    return RunConfig(world=world, **_TRAINING)
