"""The outcomes."""

from sim_core.outcomes import ENDED, OUTCOME_NAMES, Outcome


def test_names_and_ends():
    assert OUTCOME_NAMES == ("running", "goal", "lost", "captured", "collision", "timeout")
    assert Outcome.RUNNING not in ENDED and len(ENDED) == 5 and int(Outcome.RUNNING) == 0
