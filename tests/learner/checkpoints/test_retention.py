"""Which checkpoints are kept."""

import pytest

from learner.checkpoints.retention import Score, best_first, names_to_keep, score_at, scores_of
from learner.tracking.journal import Row

SCORES = [Score(100, 0.2), Score(200, 0.8), Score(300, 0.8), Score(400, 0.1)]
CHECKPOINTS = [(f"at {env_steps}", env_steps) for env_steps in (450, 350, 250, 200, 99)]


@pytest.mark.parametrize(
    ("env_steps", "score"), [(99, None), (100, 0.2), (199, 0.2), (200, 0.8), (399, 0.8), (9999, 0.1)]
)
def test_a_checkpoint_has_the_score_of_the_last_evaluation_at_or_before_it(env_steps, score):
    assert score_at(env_steps, SCORES) == score
    assert score_at(env_steps, SCORES[::-1]) == score


def test_scores_are_those_of_the_evaluations_among_rows():
    rows = [
        Row(5, 0, {"train/loss": 1.0}),
        Row(10, 0, {"eval/success_rate": 0.25, "eval/return": 3.0}),
        Row(20, 0, {"eval/return": -3.0}),
    ]
    assert scores_of(rows) == [Score(10, 0.25), Score(20, -3.0)]


def test_the_best_comes_first_and_of_equal_ones_the_newer():
    assert best_first(CHECKPOINTS, SCORES) == ["at 350", "at 250", "at 200", "at 450"]
    assert best_first(CHECKPOINTS, []) == []


@pytest.mark.parametrize(
    ("newest", "best", "kept"),
    [(1, 0, "450"), (1, 1, "450 350"), (2, 1, "450 350"), (1, 2, "450 350 250"), (9, 9, "450 350 250 200 99")],
)
def test_the_newest_and_the_best_are_kept(newest, best, kept):
    assert names_to_keep(CHECKPOINTS, newest, best, SCORES) == {f"at {env_steps}" for env_steps in kept.split()}
