"""Finds a policy in a run's folder, once or for as long as the run trains."""

from __future__ import annotations

from actors.policy.policy import WeightsSnapshot
from actors.rollout.vector_env import env_shape
from deploy.console.terminal import plain_console
from learner.checkpoints.checkpoint import Checkpoint, best_valid, finished_names, newest_valid, valid_named
from learner.checkpoints.retention import scores_of
from learner.config import RunConfig
from learner.export.saved_policy import read_saved_policy
from learner.run_folder import RunFolder
from learner.tracking.journal import read_rows
from sim_core.checks import ConfigError

NEWEST, BEST = "newest", "best"
"""Selections of a checkpoint; any other value is a checkpoint's name."""


def find_policy(folder: RunFolder, config: RunConfig, which: str = NEWEST) -> WeightsSnapshot:
    """The policy of a sweep's finished cell, or of a usable checkpoint.

    Args:
      folder: the run.
      config: its config, or that of another setup that the policy fits.
      which: `newest`, `best` by the evaluations during training, or a checkpoint's name.

    Raises:
      CheckpointError: there is no such policy, or it does not fit.
    """
    shape = env_shape(config.env)
    is_swept = folder.results.is_file() or not (folder.checkpoints.exists() or folder.storage().checkpoint_url)
    is_named = which not in (NEWEST, BEST)
    if folder.policy.is_file() and is_swept and not is_named:  # a finished cell keeps its policy alone
        return read_saved_policy(folder.policy, config, shape)
    from learner.export.policy_file import read_policy  # here, since it imports torch

    return read_policy(_checkpoint(folder, which), config, shape)


def _checkpoint(folder: RunFolder, which: str) -> Checkpoint:
    root = folder.checkpoint_location()
    if which not in (NEWEST, BEST):
        return valid_named(root, which)
    scores = scores_of(read_rows(folder.journal)) if which == BEST else None
    checkpoint, skipped = newest_valid(root) if scores is None else best_valid(root, scores)
    for reason in skipped:
        plain_console(stderr=True).print(f"skipped: {reason}", soft_wrap=True)
    return checkpoint


class NewestPolicy:
    """The newest policy of a run; it is read again when there is a newer one.

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
        try:
            fingerprint = policy_fingerprint(self._folder)
            if fingerprint != self._seen:
                self._weights, self._seen = find_policy(self._folder, self._config), fingerprint
        except ConfigError:
            if self._weights is None:
                raise  # otherwise a checkpoint was just removed or the storage is down; the next call tries again
        assert self._weights is not None
        return self._weights


def policy_fingerprint(folder: RunFolder) -> tuple[str, ...]:
    """A value that changes when the run has a newer policy."""
    names = finished_names(folder.checkpoint_location())[:1]
    return (*names, str(folder.policy.stat().st_mtime_ns)) if folder.policy.is_file() else tuple(names)
