"""What is refused before a run begins."""

from __future__ import annotations

from actors.rollout.env_guard import env_guard
from actors.rollout.vector_env import env_shape
from learner.config import RunConfig
from learner.run_folder import RunFolder


def check_device(config: RunConfig, address: str | None) -> None:
    """Raises ConfigError if this machine lacks the config's device; a cluster's is checked once Ray has joined it."""
    if config.device == "cuda" and (config.engine == "process" or address is None):
        from learner.update.learner import learning_device  # here, since the driver needs no torch otherwise

        learning_device(config.device)


def check_environment(folder: RunFolder, config: RunConfig, deadline_s: float) -> None:
    """Rehearses the run's environment, so that nothing starts if it does what it must not.

    Raises:
      ConfigError: see `env_shape`; a user's own traceback is kept in the run's folder.
    """
    with folder.traceback_kept(), env_guard(deadline_s):
        env_shape(config.env)
