"""Summary of finished episodes: rates and means with confidence intervals, and their metrics."""

from __future__ import annotations

import math
from typing import NamedTuple

from actors.evaluation.statistics import Estimate, mean, rate
from actors.service.messages import NO_OUTCOME, EpisodeStats
from sim_core.outcomes import ENDED, Outcome


class Evaluation(NamedTuple):
    """Summary of evaluated episodes; `rates` is empty if the environment reports no outcomes."""

    episodes: int
    rates: dict[Outcome, Estimate]
    episode_return: Estimate
    episode_length: Estimate


def summarise(stats: EpisodeStats) -> Evaluation:
    """Summarises statistics with one entry per episode.

    Raises:
      ValueError: there are no episodes.
    """
    total = len(stats.outcome)
    if total == 0:
        raise ValueError("no episodes to summarise")
    named = bool((stats.outcome != NO_OUTCOME).all())
    rates: dict[Outcome, Estimate] = {}
    if named:
        rates = {kind: rate(int((stats.outcome == kind).sum()), total) for kind in ENDED}
    return Evaluation(total, rates, mean(stats.episode_return), mean(stats.length_steps))


def score(evaluation: Evaluation) -> float:
    """The score by which policies of one setup are compared: success rate or, without outcomes, mean return."""
    return evaluation.rates.get(Outcome.GOAL, evaluation.episode_return).value


def outcome_label(outcome: Outcome) -> str:
    """Metric name of the rate of an outcome."""
    return "success_rate" if outcome is Outcome.GOAL else f"{outcome.name.lower()}_rate"


def as_metrics(evaluation: Evaluation) -> dict[str, float]:
    """Flat metrics: mean return and length, and each rate or, without outcomes, the return with its interval."""
    metrics = {"return": evaluation.episode_return.value, "episode_length": evaluation.episode_length.value}
    estimates = {outcome_label(kind): estimate for kind, estimate in evaluation.rates.items()}
    if not estimates:
        estimates = {"return": evaluation.episode_return}
    for name, estimate in estimates.items():
        metrics |= {name: estimate.value, f"{name}_low": estimate.low, f"{name}_high": estimate.high}
    return {name: value for name, value in metrics.items() if math.isfinite(value)}
