"""A share of the fuzz over command lines and config files; `make fuzz` runs more than ten thousand cases."""

import pytest
from hypothesis import HealthCheck, given, settings

from tests.integration.fuzzing import KINDS, workplace

CASES = 120


@pytest.fixture(scope="module", autouse=True)
def closed(tmp_path_factory):
    with workplace(tmp_path_factory.mktemp("fuzz")):
        yield


@pytest.mark.parametrize("kind", KINDS)
def test_any_input_is_taken_or_refused_with_a_sentence(kind):
    cases, check = KINDS[kind]
    outcomes = set()

    @given(cases)
    @settings(max_examples=CASES, deadline=None, suppress_health_check=list(HealthCheck))
    def fuzz(case):
        outcomes.add(check(case).outcome)

    fuzz()
    assert "refused" in outcomes
