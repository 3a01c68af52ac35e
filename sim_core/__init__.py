"""The world: scenarios, FL-ORCA, the methods and their Gymnasium environments.

Importing the package registers `shoal/SegregatedSwarm-v0` with Gymnasium.
"""

import gymnasium

from sim_core.checks import ConfigError
from sim_core.config import WorldConfig
from sim_core.outcomes import Outcome

ENV_ID = "shoal/SegregatedSwarm-v0"

gymnasium.register(
    id=ENV_ID,
    entry_point="sim_core.envs:SwarmEnv",
    vector_entry_point="sim_core.envs:SwarmVectorEnv",
)

__all__ = ["ENV_ID", "ConfigError", "Outcome", "WorldConfig"]
