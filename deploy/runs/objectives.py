"""The objectives of a search: by name, or a user's own function from a Python file."""

from __future__ import annotations

import importlib.util
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

from actors.evaluation.result_table import LEARNED
from dashboards.analysis.aggregate import Results
from dashboards.analysis.claim_checks import distance
from dashboards.analysis.claims import judge
from learner.search.config import SearchConfig
from learner.search.trial import TrialResult
from sim_core.checks import ConfigError, require
from sim_core.plugins import blame

NAMES = "success, worst, steps_to=SUCCESS, claims, FILE.py:FUNCTION or min:FILE.py:FUNCTION"
STEPS_TO, LEAST = "steps_to=", "min:"
NEVER = 2
"""`steps_to` of a training that never gets there: so many times its length."""


class ObjectiveError(Exception):
    """An objective that gave no number for a trial; the message is a sentence."""


class Objective(NamedTuple):
    """What a search optimises.

    Fields: its name, as `SearchConfig.labels` has it; whether less is better; whether it is about success, so that a
    trial with less success after a part of its training can be ended; the function; the text of the user's file, empty
    for one of ours.
    """

    name: str
    minimised: bool
    is_of_success: bool
    function: Callable[[TrialResult], float]
    source: str = ""


def find_objectives(search: SearchConfig) -> list[Objective]:
    """The objectives that a search names.

    Raises:
      ConfigError: a name is unknown, a user's file cannot be run or lacks the function, or the search prunes by what is
        no objective of success, or of several.
    """
    found = [_find(name)._replace(name=label) for name, label in zip(search.objective, search.labels, strict=True)]
    if search.prune:
        able = len(found) == 1 and found[0].is_of_success
        require(able, f"prune needs one objective of success, worst or steps_to, not {', '.join(search.objective)}")
    return found


def values_of(objectives: Sequence[Objective], result: TrialResult) -> list[float]:
    """The values of all objectives for a finished trial.

    Raises:
      ObjectiveError: one raises, or gives what is no finite number.
    """
    return [_value(objective, result) for objective in objectives]


def _value(objective: Objective, result: TrialResult) -> float:
    try:
        value = objective.function(result)
    except ObjectiveError:
        raise
    except Exception as error:  # whatever a user's function raises
        where = blame(error, Path(getattr(objective.function, "__code__", _value.__code__).co_filename))
        raise ObjectiveError(
            f"objective {objective.name} raised {type(error).__name__} ({error}) in {where}"
        ) from error
    try:
        number = float(value)
    except (TypeError, ValueError):
        number = math.nan
    if not math.isfinite(number):
        raise ObjectiveError(f"objective {objective.name} gave {value!r}, which is no finite number")
    return number


def _find(name: str) -> Objective:
    if name in ("success", "worst"):
        return Objective(name, False, True, _success if name == "success" else _worst)
    if name == "claims":
        return Objective(name, True, False, _claims)
    if name.startswith(STEPS_TO):
        return _steps_to(name)
    return _from_file(name)


def _fixed_success(result: TrialResult) -> list[float]:
    return [row.goal / row.episodes for row in result.rows if row.is_fixed]


def _success(result: TrialResult) -> float:
    rates = _fixed_success(result)
    return sum(rates) / len(rates)


def _worst(result: TrialResult) -> float:
    return min(_fixed_success(result))


def _claims(result: TrialResult) -> float:
    """The sum over the dissertation's claims of how far they are outside their ranges, with the cells of the trial."""
    found = distance(judge(Results(row._replace(policy=LEARNED) for row in result.rows)))
    if found is None:
        raise ObjectiveError("objective claims: no claim is about the cells of this search; add --robots and --groups")
    return found


def _steps_to(name: str) -> Objective:
    text = name.removeprefix(STEPS_TO)
    try:
        threshold = float(text)
    except ValueError:
        threshold = math.nan
    require(0 < threshold <= 1, f"objective {name!r}: its success must be in (0, 1], as in {STEPS_TO}0.9")

    def steps_to(result: TrialResult) -> float:
        steps = [_first_at(curve, threshold) for curve in result.curves if curve]
        if not steps:
            raise ObjectiveError(f"objective {name}: the trial has no evaluation during training")
        return sum(steps) / len(steps)

    return Objective(name, True, True, steps_to)


def _first_at(curve: Sequence[tuple[int, float]], threshold: float) -> float:
    return float(next((steps for steps, success in curve if success >= threshold), NEVER * curve[-1][0]))


def _from_file(name: str) -> Objective:
    file, _, function = name.removeprefix(LEAST).rpartition(":")
    known = file.endswith(".py") and function.isidentifier()
    require(known, f"objective must be among {NAMES}, not {name!r}")
    path = Path(file).absolute()
    try:
        text = path.read_text("utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"objective {name!r}: {file} cannot be read: {error}") from error
    found = getattr(_module(name, path), function, None)
    require(callable(found), f"objective {name!r}: {path.name} has no function {function}")
    assert found is not None
    return Objective(name, name.startswith(LEAST), False, found, text)


def _module(name: str, path: Path) -> object:
    spec = importlib.util.spec_from_file_location(f"shoal_objective_{path.stem}", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except Exception as error:  # whatever a user's file raises
        raise ConfigError(f"objective {name!r}: {blame(error, path)}: {type(error).__name__}: {error}") from error
    return module
