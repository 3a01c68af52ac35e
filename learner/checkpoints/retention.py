"""Which checkpoints to keep: the newest, and those with the best scores. Pure functions."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

from learner.tracking.journal import Row


class Score(NamedTuple):
    """Score of an evaluation during training: env steps of its weights, and success rate (or mean return)."""

    env_steps: int
    score: float


def scores_of(rows: Iterable[Row]) -> list[Score]:
    """The scores of the evaluations among rows of metrics."""
    scores = []
    for row in rows:
        score = row.metrics.get("eval/success_rate", row.metrics.get("eval/return"))
        if score is not None:
            scores.append(Score(row.env_steps, score))
    return scores


def score_at(env_steps: int, scores: list[Score]) -> float | None:
    """Score of the checkpoint at `env_steps`: that of the last evaluation at or before it; None before the first.

    Where evaluations and checkpoints are due at the same env steps, the evaluation is of the checkpoint's own weights.
    """
    before = [score for score in scores if score.env_steps <= env_steps]
    return max(before, key=lambda score: score.env_steps).score if before else None


def best_first(checkpoints: list[tuple[str, int]], scores: list[Score]) -> list[str]:
    """Names of the checkpoints that have a score, best first; of equal scores the newer first.

    Args:
      checkpoints: (name, env steps) of each.
      scores: evaluations so far.
    """
    all_scores = [(score_at(env_steps, scores), env_steps, name) for name, env_steps in checkpoints]
    known = [(score, env_steps, name) for score, env_steps, name in all_scores if score is not None]
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
