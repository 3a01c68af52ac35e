"""Summaries of finished episodes, and their metrics."""

import numpy as np
import pytest

from actors.evaluation.statistics import rate
from actors.service.messages import NO_OUTCOME, EpisodeStats
from learner.training.evaluation_summary import as_metrics, outcome_label, score, summarise
from sim_core.outcomes import ENDED, Outcome


def episodes(outcomes):
    count = len(outcomes)
    return EpisodeStats(np.array(outcomes, np.int8), np.arange(1, count + 1, dtype=np.int32), np.arange(count) / 2)


def test_every_outcome_has_its_rate_and_they_sum_to_one():
    evaluation = summarise(episodes([1, 1, 1, 2, 4, 4, 5, 1]))
    shares = {kind: estimate.value for kind, estimate in evaluation.rates.items()}
    assert shares == {
        Outcome.GOAL: 0.5,
        Outcome.LOST: 0.125,
        Outcome.CAPTURED: 0.0,
        Outcome.COLLISION: 0.25,
        Outcome.TIMEOUT: 0.125,
    }
    assert sum(shares.values()) == 1 and tuple(shares) == ENDED and evaluation.episodes == 8
    assert evaluation.episode_length.value == 4.5 and evaluation.episode_return.value == 1.75


def test_metrics_of_our_environment():
    metrics = as_metrics(summarise(episodes([1, 1, 2, 5])))
    names = ["success_rate", "lost_rate", "captured_rate", "collision_rate", "timeout_rate"]
    assert [outcome_label(kind) for kind in ENDED] == names
    bounds = {f"{name}{end}" for name in names for end in ("", "_low", "_high")}
    assert metrics.keys() == bounds | {"return", "episode_length"}
    assert metrics["success_rate"] == 0.5 and metrics["success_rate_low"] == rate(2, 4).low


@pytest.mark.parametrize("outcomes", [[NO_OUTCOME] * 4, [NO_OUTCOME, 1, 1, 1]])
def test_metrics_of_an_environment_without_outcomes(outcomes):
    evaluation = summarise(episodes(outcomes))
    assert evaluation.rates == {}
    metrics = as_metrics(evaluation)
    assert metrics.keys() == {"return", "return_low", "return_high", "episode_length"}
    assert metrics["return_low"] < metrics["return"] == 0.75 < metrics["return_high"]


def test_no_episodes_are_refused():
    with pytest.raises(ValueError, match="no episodes"):
        summarise(episodes([]))


def test_policies_are_compared_by_success_and_without_outcomes_by_return():
    assert score(summarise(episodes([1, 1, 2, 5]))) == 0.5
    assert score(summarise(episodes([NO_OUTCOME] * 4))) == 0.75
