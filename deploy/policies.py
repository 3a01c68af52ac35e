"""The newest policy of a run's folder."""

from __future__ import annotations

from rich.console import Console

from actors.network import WeightsSnapshot
from actors.vector_env import env_shape
from learner.checkpoint import newest_valid
from learner.config import RunConfig
from learner.policy_file import read_policy, read_saved_policy
from learner.run_folder import RunFolder


def newest_policy(folder: RunFolder, config: RunConfig) -> WeightsSnapshot:
    """The policy of a sweep's finished cell, or that of the newest usable checkpoint.

    Args:
      folder: the run.
      config: its config, or one of another setup that the policy fits.

    Raises:
      CheckpointError: there is none, or it does not fit.
    """
    shape = env_shape(config.env)
    is_swept = folder.results.is_file() or not folder.checkpoints.exists()
    if folder.policy.is_file() and is_swept:  # of a cell that is done, only the policy is kept
        return read_saved_policy(folder.policy, config, shape)
    checkpoint, skipped = newest_valid(folder.checkpoints)
    for reason in skipped:
        Console(stderr=True).print(f"skipped: {reason}", highlight=False)
    return read_policy(checkpoint, config, shape)
