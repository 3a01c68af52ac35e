"""Which checkpoints stay: the newest, and those that did best in the evaluations during training. Pure."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

from learner.tracking.journal import Row


class Score(NamedTuple):
    """An evaluation during training: the env steps of its weights, and its success rate (else its mean return)."""

    env_steps: int
    score: float


def scores_of(rows: Iterable[Row]) -> list[Score]:
    """The evaluations among rows of metrics."""
    found = []
    for row in rows:
        score = row.metrics.get("eval/success_rate", row.metrics.get("eval/return"))
        if score is not None:
            found.append(Score(row.env_steps, score))
    return found


def score_at(env_steps: int, scores: list[Score]) -> float | None:
    """Score of a checkpoint: the last evaluation of weights that are no newer; None before the first.

    Where evaluations and checkpoints fall due at the same env steps, that is one of the checkpoint's own weights.
    """
    before = [scored for scored in scores if scored.env_steps <= env_steps]
    return max(before, key=lambda scored: scored.env_steps).score if before else None


def best_first(checkpoints: list[tuple[str, int]], scores: list[Score]) -> list[str]:
    """Names of the checkpoints that have a score, from the best to the worst; of two alike the newer first."""
    scored = [(score_at(env_steps, scores), env_steps, name) for name, env_steps in checkpoints]
    known = [(score, env_steps, name) for score, env_steps, name in scored if score is not None]
    return [name for _, _, name in sorted(known, reverse=True)]


def names_to_keep(checkpoints: list[tuple[str, int]], newest: int, best: int, scores: list[Score]) -> set[str]:
    """The checkpoints to keep.

    Args:
      checkpoints: name and env steps of each, newest first.
      newest: how many of the newest stay.
      best: how many of the best stay, which may be among the newest.
      scores: evaluations so far.
    """
    return {name for name, _ in checkpoints[:newest]} | set(best_first(checkpoints, scores)[:best])
