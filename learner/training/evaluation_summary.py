"""Summary of finished episodes: rates and means with confidence intervals, and their metrics."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from actors.evaluation.statistics import Estimate, mean, rate, rate_of_worlds
from actors.service.messages import NO_OUTCOME, VALUE_DTYPE, EpisodeStats
from sim_core.outcomes import ENDED, Outcome


class TeamSummary(NamedTuple):
    """Summary of evaluated worlds in which several robots learn.

    Fields: worlds; share of them in which every learning robot reaches its goal; simulator steps until the last one
    does, None if they all do nowhere; share of the pairs of groups that are segregated along the way (Eq. 3.1); share
    of the learning robots that end in a collision with another one.
    """

    worlds: int
    all_arrive: Estimate
    last_arrival_steps: Estimate | None
    segregation: Estimate
    learner_collisions: Estimate


class Evaluation(NamedTuple):
    """Summary of evaluated episodes.

    `rates` is empty if the environment reports no outcomes, `team` None unless several robots of a world learn. Their
    episodes are not independent, so intervals are then those of worlds. `values` has the means of VALUE_DTYPE's fields,
    or is empty.
    """

    episodes: int
    rates: dict[Outcome, Estimate]
    episode_return: Estimate
    episode_length: Estimate
    team: TeamSummary | None
    values: dict[str, float]


def summarise(stats: EpisodeStats) -> Evaluation:
    """Summarises statistics with one entry per episode.

    Raises:
      ValueError: there are no episodes.
    """
    total = len(stats.outcome)
    if total == 0:
        raise ValueError("no episodes to summarise")
    if len(stats.team):
        return _summarise_worlds(stats)
    named = bool((stats.outcome != NO_OUTCOME).all())
    rates: dict[Outcome, Estimate] = {}
    if named:
        rates = {kind: rate(int((stats.outcome == kind).sum()), total) for kind in ENDED}
    return Evaluation(total, rates, mean(stats.episode_return), mean(stats.length_steps), None, _values(stats))


def _values(stats: EpisodeStats) -> dict[str, float]:
    """Means over the episodes, where they tell what the policy expected."""
    names = (VALUE_DTYPE.names or ()) if len(stats.values) else ()
    return {name: float(np.mean(stats.values[name])) for name in names}


def _summarise_worlds(stats: EpisodeStats) -> Evaluation:
    """Summarises episodes of worlds in which several robots learn."""
    learners = stats.team["learners"].astype(np.int64)
    begins = [0]
    while begins[-1] + learners[begins[-1]] < len(learners):
        begins.append(begins[-1] + int(learners[begins[-1]]))
    sizes = learners[begins]

    def by_world(values: NDArray[Any]) -> NDArray[np.float64]:
        return np.add.reduceat(values.astype(np.float64), begins)

    def share(happened: NDArray[np.bool_]) -> Estimate:
        return rate_of_worlds(list(zip(by_world(happened).astype(int).tolist(), sizes.tolist(), strict=True)))

    arrived = stats.outcome == int(Outcome.GOAL)
    everyone = by_world(arrived) == sizes
    last = np.maximum.reduceat(stats.length_steps, begins)[everyone]
    team = TeamSummary(
        worlds=len(begins),
        all_arrive=rate(int(everyone.sum()), len(begins)),
        last_arrival_steps=mean(last) if len(last) else None,
        segregation=mean(stats.team["segregation"][begins]),
        learner_collisions=share(stats.team["hit_learner"]),
    )
    return Evaluation(
        episodes=len(learners),
        rates={kind: share(stats.outcome == kind) for kind in ENDED},
        episode_return=mean(by_world(stats.episode_return) / sizes),
        episode_length=mean(by_world(stats.length_steps) / sizes),
        team=team,
        values=_values(stats),
    )


def score(evaluation: Evaluation) -> float:
    """The score by which policies of one setup are compared: success rate or, without outcomes, mean return."""
    return evaluation.rates.get(Outcome.GOAL, evaluation.episode_return).value


def outcome_label(outcome: Outcome) -> str:
    """Metric name of the rate of an outcome."""
    return "success_rate" if outcome is Outcome.GOAL else f"{outcome.name.lower()}_rate"


def as_metrics(evaluation: Evaluation) -> dict[str, float]:
    """Flat metrics: means, each rate or, without outcomes, the return with its interval, and those of teams."""
    metrics = {"return": evaluation.episode_return.value, "episode_length": evaluation.episode_length.value}
    metrics |= evaluation.values
    estimates = {outcome_label(kind): estimate for kind, estimate in evaluation.rates.items()}
    if not estimates:
        estimates = {"return": evaluation.episode_return}
    if evaluation.team is not None:
        team = evaluation.team
        estimates |= {"all_arrive_rate": team.all_arrive, "learner_collision_rate": team.learner_collisions}
        metrics["segregation"] = team.segregation.value
        metrics["last_arrival_steps"] = team.last_arrival_steps.value if team.last_arrival_steps else math.nan
    for name, estimate in estimates.items():
        metrics |= {name: estimate.value, f"{name}_low": estimate.low, f"{name}_high": estimate.high}
    return {name: value for name, value in metrics.items() if math.isfinite(value)}
