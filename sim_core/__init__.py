"""The world: scenarios, FL-ORCA, the methods and their Gymnasium environments.

Importing the package registers `shoal/SegregatedSwarm-v0` with Gymnasium.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import gymnasium

from sim_core.checks import ConfigError, require_packages
from sim_core.config import WorldConfig
from sim_core.outcomes import Outcome

if TYPE_CHECKING:
    from sim_core.pettingzoo_env import SwarmParallelEnv

ENV_ID = "shoal/SegregatedSwarm-v0"

gymnasium.register(
    id=ENV_ID,
    entry_point="sim_core.envs:SwarmEnv",
    vector_entry_point="sim_core.envs:SwarmVectorEnv",
)


def parallel_env(learners: str | float = "1.0", render_mode: str | None = None, **settings: Any) -> SwarmParallelEnv:
    """The learning robots of one world as agents of a PettingZoo `ParallelEnv` (see `sim_core.pettingzoo_env`).

    Args:
      learners: which robots learn, as in WorldConfig; all of them by default.
      render_mode: None or `rgb_array`.
      **settings: other fields of WorldConfig.

    Raises:
      ConfigError: PettingZoo is missing, or a setting is unknown or cannot work.
    """
    require_packages("sim_core.parallel_env", "dev", "pettingzoo")
    from sim_core.pettingzoo_env import SwarmParallelEnv

    return SwarmParallelEnv(render_mode, {"learners": learners, **settings})


__all__ = ["ENV_ID", "ConfigError", "Outcome", "WorldConfig", "parallel_env"]
