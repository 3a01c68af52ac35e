"""Summaries of finished episodes, and their metrics."""

import numpy as np
import pytest

from actors.evaluation.statistics import rate
from actors.service.messages import NO_OUTCOME, TEAM_DTYPE, EpisodeStats
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


def team_episodes(outcomes, learners, segregation, hit):
    """Episodes of worlds whose robots stand together; `learners` and `segregation` an entry a world."""
    stats = episodes(outcomes)
    team = np.zeros(len(outcomes), TEAM_DTYPE)
    team["learners"] = np.repeat(learners, learners)
    team["segregation"] = np.repeat(np.float32(segregation), learners)
    team["hit_learner"] = hit
    return stats._replace(team=team)


def test_worlds_in_which_several_robots_learn():
    stats = team_episodes([1, 1, 1, 2, 1, 1, 1, 4, 4], [2, 2, 3, 2], [1.0, 0.5, 0.75, 0.25], [False] * 7 + [True] * 2)
    evaluation = summarise(stats)
    assert evaluation.episodes == 9 and evaluation.rates[Outcome.GOAL].value == pytest.approx(6 / 9)
    team = evaluation.team
    assert team.worlds == 4 and team.all_arrive.value == 0.5 and team.last_arrival_steps.value == (2 + 7) / 2
    assert team.segregation.value == 0.625 and team.learner_collisions.value == pytest.approx(2 / 9)
    assert evaluation.episode_length.value == (1.5 + 3.5 + 6 + 8.5) / 4
    metrics = as_metrics(evaluation)
    assert metrics["all_arrive_rate"] == 0.5 and metrics["segregation"] == 0.625
    assert metrics["last_arrival_steps"] == 4.5 and metrics["learner_collision_rate"] == pytest.approx(2 / 9)


def test_robots_that_share_their_fate_tell_less_than_robots_that_do_not():
    """100 worlds of 10 robots that end alike are 100 episodes, not 1,000; where each ends by itself, they are 1,000."""
    rng = np.random.default_rng(0)
    shared, own = np.repeat(rng.permutation(np.repeat([1, 2], 50)), 10), rng.permutation(np.repeat([1, 2], 500))
    widths = []
    for outcomes in (shared, own):
        found = summarise(team_episodes(outcomes, [10] * 100, [1.0] * 100, False)).rates[Outcome.GOAL]
        assert found.value == 0.5
        widths.append(found.high - found.low)
    alone = [rate(count // 2, count) for count in (100, 1000)]
    assert widths[0] == pytest.approx(alone[0].high - alone[0].low, rel=0.1)
    assert widths[1] == pytest.approx(alone[1].high - alone[1].low, rel=0.15)


def test_where_never_all_arrive_there_is_no_last_arrival():
    evaluation = summarise(team_episodes([1, 2, 5, 1], [2, 2], [1.0, 1.0], False))
    assert evaluation.team.last_arrival_steps is None and "last_arrival_steps" not in as_metrics(evaluation)


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
