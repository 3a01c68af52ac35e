"""Objectives of a search: what they give for a trial, and which are refused."""

import pytest

from actors.evaluation.result_table import ResultRow
from deploy.runs.objectives import ObjectiveError, find_objectives, values_of
from learner.search.config import SearchConfig
from learner.search.trial import TrialResult
from sim_core.checks import ConfigError


def row(robots, groups, goal, policy="learned", trained=None):
    home = trained or (robots, groups)
    return ResultRow(
        "best", policy, "sensor", *home, 0, robots, groups, 100, goal, 100 - goal, 0, 0, 0, 200.0, "c0ffee"
    )


def result(tmp_path, rows, curves=()):
    return TrialResult(3, {"n_step": 2}, list(rows), [list(curve) for curve in curves], tmp_path)


def find(*names, **settings):
    return find_objectives(SearchConfig(space=("n_step=1..5",), objective=names, **settings))


CURVES = [[(1_000, 0.2), (2_000, 0.7), (3_000, 0.65)], [(1_000, 0.8)]]


@pytest.mark.parametrize(
    ("name", "expected", "minimised"),
    [
        ("success", (0.9 + 0.4) / 2, False),
        ("worst", 0.4, False),
        ("steps_to=0.7", (2_000 + 1_000) / 2, True),
        ("steps_to=0.75", (2 * 3_000 + 1_000) / 2, True),  # never: twice the training
    ],
)
def test_objectives_by_name(name, expected, minimised, tmp_path):
    (objective,) = find(name)
    rows = [row(10, 2, 90), row(5, 8, 40), row(25, 2, 1, trained=(10, 2))]
    assert values_of([objective], result(tmp_path, rows, CURVES)) == [pytest.approx(expected)]
    assert objective.minimised is minimised and objective.is_of_success


def test_the_claims_distance_is_how_far_checks_are_outside_their_ranges(tmp_path):
    """10r×2g and 25r×2g: claims 5, 7 and 8 to 15 say what their successes are."""
    (objective,) = find("claims")
    near = values_of([objective], result(tmp_path, [row(10, 2, 90), row(25, 2, 60)]))[0]
    far = values_of([objective], result(tmp_path, [row(10, 2, 90), row(25, 2, 90)]))[0]
    assert near == 0.0
    # 5: of its three checks 25r×2g is 20 points above its range, and 10r×2g less 25r×2g is at its edge
    assert far == pytest.approx(0.20 / 3)
    rule = values_of([objective], result(tmp_path, [row(10, 2, 90, "greedy"), row(25, 2, 90, "greedy")]))[0]
    assert rule == far, "a rule is judged like a policy"
    with pytest.raises(ObjectiveError, match="no claim is about the cells"):
        values_of([objective], result(tmp_path, [row(7, 7, 50)]))


def write(path, text):
    path.write_text(text)
    return str(path)


def test_a_users_function_is_an_objective(tmp_path):
    file = write(tmp_path / "mine.py", "def length(result):\n    return result.settings['n_step'] * len(result.rows)\n")
    (best,), (least,) = find(f"{file}:length"), find(f"min:{file}:length")
    assert (best.minimised, least.minimised) == (False, True) and best.name == least.name == "mine.py:length"
    assert best.source.startswith("def length") and not best.is_of_success
    assert values_of([best, least], result(tmp_path, [row(10, 2, 90)])) == [2.0, 2.0]


@pytest.mark.parametrize(
    ("body", "words"),
    [
        ("return float('nan')", "gave nan, which is no finite number"),
        ("return 1e400", "gave inf, which is no finite number"),
        ("return None", "gave None, which is no finite number"),
        ("return 'much'", "gave 'much', which is no finite number"),
        ("return result.rows[0].goals", r"raised AttributeError \(.*goals.*\) in mine.py, line 2"),
        ("return 1 / 0", r"raised ZeroDivisionError \(division by zero\) in mine.py, line 2"),
    ],
)
def test_what_is_no_number_fails_the_trial_with_a_sentence(body, words, tmp_path):
    file = write(tmp_path / "mine.py", f"def mine(result):\n    {body}\n")
    with pytest.raises(ObjectiveError, match=f"objective mine.py:mine {words}"):
        values_of(find(f"{file}:mine"), result(tmp_path, [row(10, 2, 90)]))


@pytest.mark.parametrize(
    ("text", "name", "words"),
    [
        ("def mine(result): return 1", "other", "mine.py has no function other"),
        ("mine = 3", "mine", "mine.py has no function mine"),
        ("def mine(result)\n", "mine", "mine.py, line 1: SyntaxError"),
        ("import nowhere_at_all\ndef mine(result): return 1", "mine", "mine.py, line 1: ModuleNotFoundError"),
    ],
)
def test_a_file_that_cannot_be_run_is_refused(text, name, words, tmp_path):
    file = write(tmp_path / "mine.py", text)
    with pytest.raises(ConfigError, match=words):
        find(f"{file}:{name}")


@pytest.mark.parametrize("names", [("claims",), ("success", "worst"), ("claims", "success")])
def test_trials_are_ended_early_by_one_objective_of_success_alone(names):
    with pytest.raises(ConfigError, match="prune needs one objective"):
        find(*names, prune=True)
    assert find("worst", prune=True)
