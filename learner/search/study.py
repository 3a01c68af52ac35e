"""The trials of a search in an Optuna study, which a file in the search's folder holds: it survives any kill.

A trial that was asked for is RUNNING there until it is told. What a killed session leaves RUNNING, the next one runs
first, under the same number and with the same settings.
"""

from __future__ import annotations

import hashlib
import json
import logging
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import optuna
from optuna.importance import FanovaImportanceEvaluator, get_param_importances
from optuna.pruners import SuccessiveHalvingPruner
from optuna.samplers import TPESampler
from optuna.storages import RDBStorage
from optuna.study import StudyDirection
from optuna.trial import FrozenTrial, Trial, TrialState

from learner.file_names import STUDY
from learner.search.config import SearchConfig
from learner.search.space import Choices, Dimension, Value
from sim_core.checks import ConfigError, require

STUDY_NAME = "search"
IDENTITY, SOURCES, SPENT_S, REASON = "identity", "sources", "spent_s", "reason"
"""Attributes of the study, and of a failed trial."""
STATES = {
    TrialState.COMPLETE: "complete",
    TrialState.PRUNED: "pruned",
    TrialState.FAIL: "failed",
    TrialState.RUNNING: "running",
    TrialState.WAITING: "running",
}
LEAST_FOR_IMPORTANCES = 4
"""Complete trials below which nothing is said about the settings' importance."""


class TrialRecord(NamedTuple):
    """A trial: number, settings, state (complete, pruned, failed, running), values, reason of a failure, seconds."""

    number: int
    settings: dict[str, Value]
    state: str
    values: tuple[float, ...]
    reason: str
    seconds: float | None


class Ask(NamedTuple):
    """A trial that is to run: its number and settings."""

    number: int
    settings: dict[str, Value]


class StoredSearch:
    """A search as its folder holds it, to be read while it runs.

    Args:
      folder: the search's folder.

    Attributes:
      search: its settings, with a budget of the trials that it has.

    Raises:
      ConfigError: the folder holds no search, or one of another version.
    """

    def __init__(self, folder: Path) -> None:
        require((folder / STUDY).is_file(), f"{folder} holds no search")
        self._study, self._storage = _open(folder / STUDY, None)
        values: dict[str, Any] = {
            name: tuple(value) if isinstance(value, list) else value for name, value in self._identity().items()
        }
        values.pop(SOURCES, None)
        try:
            self.search = SearchConfig(**values)
        except TypeError as error:
            raise ConfigError(f"{folder} holds a search of another version ({error}); search anew") from error

    @property
    def minimised(self) -> list[bool]:
        """For each objective, whether less is better."""
        return [direction == StudyDirection.MINIMIZE for direction in self._study.directions]

    def _identity(self) -> dict[str, Any]:
        return dict(self._study.user_attrs.get(IDENTITY, {}))

    def _frozen(self) -> list[FrozenTrial]:
        return self._study.get_trials(deepcopy=False)

    def records(self) -> list[TrialRecord]:
        """All trials, by number."""
        return [_record(trial) for trial in self._frozen()]

    def front(self) -> list[int]:
        """Numbers of the trials that no other one betters in all objectives; with one objective, the best."""
        if not any(trial.state == TrialState.COMPLETE for trial in self._frozen()):
            return []
        return sorted(trial.number for trial in self._study.best_trials)

    def importances(self) -> list[dict[str, float]]:
        """For each objective, the share of its variance that each setting explains (fANOVA; Hutter et al. 2014).

        They are left out with fewer than LEAST_FOR_IMPORTANCES complete trials, or where an objective does not vary.
        """
        complete = [trial for trial in self._frozen() if trial.state == TrialState.COMPLETE]
        found = []
        for place in range(len(self.minimised)):
            values = {trial.values[place] for trial in complete}
            enough = len(complete) >= LEAST_FOR_IMPORTANCES and len(values) > 1
            found.append(self._importances_of(place) if enough else {})
        return found

    def _importances_of(self, place: int) -> dict[str, float]:
        evaluator = FanovaImportanceEvaluator(seed=self.search.sampler_seed)
        shares = get_param_importances(self._study, evaluator=evaluator, target=lambda trial: trial.values[place])
        return {name: float(share) for name, share in shares.items()}


class SearchStudy(StoredSearch):
    """The study of a search, opened or begun, by the one process that runs it.

    Args:
      folder: the search's folder, which exists.
      search: the search.
      minimised: for each objective, whether less is better.
      sources: texts of the user's files that decide the objectives.

    Raises:
      ConfigError: the folder holds another search, or its file cannot be read.
    """

    def __init__(self, folder: Path, search: SearchConfig, minimised: Sequence[bool], sources: Sequence[str]) -> None:
        self._study, self._storage = _open(folder / STUDY, minimised)
        self.search = search
        self._begin_s = time.monotonic()
        self._check_identity(folder, sources)
        self._spent_before_s = float(self._study.user_attrs.get(SPENT_S, 0.0))
        self._waiting = [trial.number for trial in self._frozen() if not trial.state.is_finished()]
        self._live: dict[int, Trial] = {}

    def _check_identity(self, folder: Path, sources: Sequence[str]) -> None:
        digests = [hashlib.sha256(text.encode()).hexdigest()[:16] for text in sources]
        mine = json.loads(json.dumps({**self.search.identity(), SOURCES: digests}))
        held = self._identity()
        if not held:
            self._study.set_user_attr(IDENTITY, mine)
        elif held != mine:
            other = next(name for name in sorted({*held, *mine}) if held.get(name) != mine.get(name))
            raise ConfigError(
                f"{folder} holds a search with another {other}: give this search another --name, or remove the folder"
            )

    def spent_s(self) -> float:
        """Seconds that all sessions have searched."""
        return self._spent_before_s + time.monotonic() - self._begin_s

    def has_more(self) -> bool:
        """Whether a trial is left to run."""
        trials, hours = self.search.trials, self.search.hours
        is_spent = (trials is not None and len(self._frozen()) >= trials) or (
            hours is not None and self.spent_s() >= 3600 * hours
        )
        return bool(self._waiting) or not is_spent

    def ask(self) -> Ask | None:
        """The next trial to run: one that a killed session left, or a new one; None where the budget is spent."""
        if not self.has_more():
            return None
        if self._waiting:
            return self._taken(self._trial(self._waiting.pop(0)))
        self._study.sampler = self._sampler(len(self._frozen()))
        return self._taken(self._study.ask())

    def _sampler(self, number: int) -> TPESampler:
        """The sampler of one trial: a session that goes on draws as one that was not killed."""
        seed = int(np.random.SeedSequence([self.search.sampler_seed, number]).generate_state(1)[0])
        return TPESampler(multivariate=True, seed=seed)

    def _trial(self, number: int) -> Trial:
        """The trial of this number, which an earlier session asked for."""
        self._study.sampler = self._sampler(number)
        study_id = self._storage.get_study_id_from_name(STUDY_NAME)
        return Trial(self._study, self._storage.get_trial_id_from_study_id_trial_number(study_id, number))

    def _taken(self, trial: Trial) -> Ask:
        self._live[trial.number] = trial
        return Ask(trial.number, {one.name: _suggested(trial, one) for one in self.search.dimensions})

    def must_end(self, number: int, part: int, success: float) -> bool:
        """Whether a trial ends early, whose success after this part of its trainings is `success`."""
        trial = self._live[number]
        known = self._study.get_trials(deepcopy=False)[number].intermediate_values
        if part not in known:  # a resumed trial passes a part again
            trial.report(-success if self.minimised[0] else success, part)
        return bool(trial.should_prune())

    def complete(self, number: int, values: Sequence[float]) -> None:
        """Stores a trial's objectives."""
        self._tell(number, TrialState.COMPLETE, list(values))

    def pruned(self, number: int) -> None:
        """Stores that a trial was ended early."""
        self._tell(number, TrialState.PRUNED, None)

    def fail(self, number: int, reason: str) -> None:
        """Stores that a trial has no objectives, and why."""
        self._live[number].set_user_attr(REASON, reason)
        self._tell(number, TrialState.FAIL, None)

    def _tell(self, number: int, state: TrialState, values: list[float] | None) -> None:
        self._study.tell(number, values, state)
        self._study.set_user_attr(SPENT_S, self.spent_s())
        self._live.pop(number, None)


def _open(file: Path, minimised: Sequence[bool] | None) -> tuple[optuna.Study, RDBStorage]:
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    logging.getLogger("alembic").setLevel(logging.ERROR)
    try:
        storage = RDBStorage(f"sqlite:///{file}")
        if minimised is None:
            return optuna.load_study(study_name=STUDY_NAME, storage=storage), storage
        study = optuna.create_study(
            storage=storage,
            study_name=STUDY_NAME,
            directions=["minimize" if less else "maximize" for less in minimised],
            pruner=SuccessiveHalvingPruner(min_resource=1, reduction_factor=2),
            load_if_exists=True,
        )
        return study, storage
    except Exception as error:  # Optuna passes on what SQLAlchemy, alembic and sqlite raise
        raise ConfigError(
            f"{file} is no study that can be read ({error}); remove it, or name another --name"
        ) from error


def _suggested(trial: Trial, dimension: Dimension) -> Value:
    """The trial's value of a setting; the stored one, where an earlier session has drawn it."""
    if isinstance(dimension, Choices):
        return str(trial.suggest_categorical(dimension.name, dimension.values))
    if dimension.whole:
        return trial.suggest_int(dimension.name, int(dimension.low), int(dimension.high), log=dimension.log)
    return trial.suggest_float(dimension.name, dimension.low, dimension.high, log=dimension.log)


def _record(trial: FrozenTrial) -> TrialRecord:
    seconds = trial.duration.total_seconds() if trial.duration is not None else None
    values = tuple(trial.values) if trial.state == TrialState.COMPLETE else ()
    return TrialRecord(
        trial.number, dict(trial.params), STATES[trial.state], values, trial.user_attrs.get(REASON, ""), seconds
    )
