"""The end of a run, once all env steps are done: a list of steps whose progress is on disk, so that any kill loses one.

The folder `end` holds what the steps work from: the policy; `state.json`, which says that all env steps are done and
names the steps that are made; and the episodes of the final evaluation, a store per setup. A step that was cut short is
made again, which does no harm. The session that trained and one that resumes make the same steps from the same files.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import NamedTuple

from actors.evaluation.evaluation_store import find_evaluation, stored_or_played
from actors.policy.policy import WeightsSnapshot
from actors.rollout.env_spec import EnvSpec
from actors.rollout.vector_env import env_shape
from actors.rollout.worker import join_stats
from actors.service.messages import EpisodeStats
from learner.config import RunConfig
from learner.export.saved_policy import read_saved_policy, save_policy
from learner.file_names import END_STATE, POLICY
from learner.run_folder import write_json

SHOWN = "shown"
"""The last step: the user has seen the summary."""


class EndState(NamedTuple):
    """Where a run's training ended, and which steps of its end are made.

    `journal_bytes` is the journal's length, and `checkpoint` the name of the checkpoint of these env steps, None if it
    could not be written.
    """

    env_steps: int
    updates: int
    journal_bytes: int
    checkpoint: str | None
    made: list[str]


def discard_end(folder: Path) -> None:
    """Removes the folder `end` of a run that trains on; its state first, so that a kill leaves no half of an end."""
    (folder / END_STATE).unlink(missing_ok=True)
    shutil.rmtree(folder, ignore_errors=True)


def final_seeds(config: RunConfig) -> list[int]:
    """Seeds of the final episodes in each setup."""
    return list(range(config.final_eval_first_seed, config.final_eval_first_seed + config.final_eval_episodes))


class RunEnd:
    """The end of one run.

    Args:
      folder: the run's folder `end`.
      config: the run.
      state: where the training ended.
      weights: the policy that the run has learned.
    """

    def __init__(self, folder: Path, config: RunConfig, state: EndState, weights: WeightsSnapshot) -> None:
        self._folder = folder
        self._config = config
        self.state = state
        self.weights = weights

    @classmethod
    def begin(cls, folder: Path, config: RunConfig, state: EndState, weights: WeightsSnapshot) -> RunEnd:
        """Stores what the end works from; from then on no env step is made again."""
        discard_end(folder)
        folder.mkdir()
        save_policy(folder / POLICY, weights)
        end = cls(folder, config, state, weights)
        end._save(state)
        return end

    @classmethod
    def open(cls, folder: Path, config: RunConfig) -> RunEnd | None:
        """The end that an earlier session began; None where env steps are missing, or a file cannot be read."""
        try:
            state = EndState(**json.loads((folder / END_STATE).read_text()))
            if state.env_steps < config.total_env_steps:
                return None
            return cls(folder, config, state, read_saved_policy(folder / POLICY, config, env_shape(config.env)))
        except (OSError, ValueError, TypeError):
            return None

    @property
    def is_complete(self) -> bool:
        """Whether every step is made."""
        return SHOWN in self.state.made

    def _save(self, state: EndState) -> None:
        write_json(self._folder / END_STATE, state._asdict())
        self.state = state

    def make(self, step: str, call: Callable[[], None]) -> None:
        """Makes a step unless it is made, and remembers it."""
        if step not in self.state.made:
            call()
            self._save(self.state._replace(made=[*self.state.made, step]))

    def evaluate(self, play: Callable[[EnvSpec, WeightsSnapshot], EpisodeStats]) -> None:
        """Plays and stores the final episodes of every setup that has none yet.

        Args:
          play: plays those of one setup.
        """
        name, version, seeds = self._config.name, self.weights.version, final_seeds(self._config)
        for path, spec in self._setups():
            stored_or_played(path, spec, name, version, seeds, partial(play, spec, self.weights))

    def episodes(self) -> EpisodeStats | None:
        """The final episodes, one setup after the other; None where some are missing."""
        version, seeds = self.weights.version, final_seeds(self._config)
        found = [find_evaluation(path, spec, version, seeds) for path, spec in self._setups()]
        played = [stats for stats in found if stats is not None]
        return join_stats(played) if len(played) == len(found) else None

    def _setups(self) -> list[tuple[Path, EnvSpec]]:
        specs = [self._config.env.of_setup(world) for world in self._config.env.worlds]
        return [(self._folder / f"episodes-{i}.zarr", spec) for i, spec in enumerate(specs)]
