"""Overestimation: late evaluations alone, one sample a training, and what statement 26 makes of it."""

import pytest

from actors.evaluation.value_table import ValueRow, read_values, write_values
from dashboards.analysis.aggregate import Results
from dashboards.analysis.claim_checks import Verdict, number_text
from dashboards.analysis.claims import judge
from dashboards.analysis.overestimation import overestimation
from sim_core.checks import ConfigError
from tests.dashboards.tables import claimed_table


def rows(algorithm: str, gaps: list[float]) -> list[ValueRow]:
    """Trainings, one a gap between value and return in their second half; the first half must not count."""
    training = ("thesis", "sensor", 10, 2, algorithm)
    return [
        ValueRow(*training, seed, steps, 1000, 100, 9.0, 0.0, 0.5 + (gap if steps >= 500 else 70.0), 0.5)
        for seed, gap in enumerate(gaps)
        for steps in (250, 499, 500, 750)
    ]


def test_each_training_is_a_sample():
    found = overestimation(rows("dqn", [0.1, 0.2, 0.3]), "dqn")
    assert found is not None and (found.seeds, found.episodes) == (3, 600)
    assert found.estimate.value == pytest.approx(0.2)
    assert found.estimate.high - 0.2 == pytest.approx(4.3027 * 0.1 / 3**0.5, rel=1e-3)  # Student's t of two degrees
    assert overestimation(rows("dqn", [0.1]), "double_dqn") is None


@pytest.mark.parametrize(
    ("dqn", "double_dqn", "verdicts"),
    [
        ([0.30, 0.31, 0.32], [0.10, 0.11, 0.12], [Verdict.HOLDS, Verdict.HOLDS]),
        ([0.10, 0.11, 0.12], [0.30, 0.31, 0.32], [Verdict.HOLDS, Verdict.FAILS]),
        ([-0.20, -0.21, -0.22], [-0.30, -0.31, -0.32], [Verdict.FAILS, Verdict.HOLDS]),
        ([0.10, 0.11, 0.12], [0.0, 0.1, 0.2], [Verdict.HOLDS, Verdict.UNDECIDED]),
    ],
)
def test_the_statement_needs_overestimation_and_less_of_it(dqn, double_dqn, verdicts):
    values = [*rows("dqn", dqn), *rows("double_dqn", double_dqn)]
    checks = judge(Results(claimed_table(), values=values))[25].checks
    assert [check.verdict for check in checks] == verdicts


def test_rewards_are_shown_in_tau():
    checks = judge(Results(claimed_table(), values=rows("dqn", [-0.25, -0.25])))[25].checks
    assert number_text(checks[0]) == "−0.250 (−0.250 … −0.250) τ"
    assert checks[1].verdict is Verdict.NO_DATA and "make overestimation" in number_text(checks[1])


def test_a_table_of_values_comes_back_and_another_is_refused(tmp_path):
    path, known = tmp_path / "values.csv", rows("dqn", [0.1])
    write_values(path, known)
    assert read_values(path) == sorted(known)
    path.write_text("what,else\n")
    with pytest.raises(ConfigError, match="no table of values"):
        read_values(path)
