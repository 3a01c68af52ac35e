"""The newest policy of a run's folder, once or for as long as the run goes on."""

from __future__ import annotations

from rich.console import Console

from actors.network import WeightsSnapshot
from actors.vector_env import env_shape
from learner.checkpoint import finished_folders, newest_valid
from learner.config import RunConfig
from learner.policy_file import read_policy, read_saved_policy
from learner.run_folder import RunFolder
from sim_core.checks import ConfigError


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


class NewestPolicy:
    """The newest policy of a run, read again when there is a newer one.

    Args:
      folder: the run.
      config: its config.
    """

    def __init__(self, folder: RunFolder, config: RunConfig) -> None:
        self._folder = folder
        self._config = config
        self._seen: object = None
        self._weights: WeightsSnapshot | None = None

    def get(self) -> WeightsSnapshot:
        """The policy.

        Raises:
          ConfigError: the run has none yet.
        """
        signature = policy_signature(self._folder)
        if signature != self._seen:
            try:
                self._weights, self._seen = newest_policy(self._folder, self._config), signature
            except ConfigError:
                if self._weights is None:
                    raise  # else a checkpoint was being removed: the next call looks again
        assert self._weights is not None
        return self._weights


def policy_signature(folder: RunFolder) -> tuple[str, ...]:
    """Changes when a run has another newest policy."""
    names = [path.name for path in finished_folders(folder.checkpoints)[:1]]
    return (*names, str(folder.policy.stat().st_mtime_ns)) if folder.policy.is_file() else tuple(names)
