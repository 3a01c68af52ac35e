"""A share of the fuzz over command lines and config files; `make fuzz` runs more than ten thousand cases."""

import pytest
from hypothesis import HealthCheck, given, settings

from tests.integration.fuzzing import KINDS, check, workplace

CASES = 120


@pytest.fixture(scope="module", autouse=True)
def closed(tmp_path_factory):
    with workplace(tmp_path_factory.mktemp("fuzz")):
        yield


@pytest.mark.parametrize("kind", KINDS)
def test_any_input_is_taken_or_refused_with_a_sentence(kind):
    cases, check_case = KINDS[kind]
    outcomes = set()

    @given(cases)
    @settings(max_examples=CASES, deadline=None, suppress_health_check=list(HealthCheck))
    def fuzz(case):
        outcomes.add(check_case(case).outcome)

    fuzz()
    assert "refused" in outcomes


LONG = "x" * 5_000


@pytest.mark.parametrize(
    "arguments",
    [
        ["resume", LONG],
        ["evaluate", LONG],
        ["evaluate", "greedy", "--out", f"{LONG}.zarr"],
        ["train", "--name", LONG],
        ["train", "--runs-dir", LONG],
        ["train", "--runs-dir", "a-file/x"],
        ["train", "--replay-capacity", "1000000000000"],
        ["train", "--checkpoint-url", "nosuch://x"],
        ["train", "--checkpoint-url", "a-file/x"],
        ["train", "--config", "a-file"],
        ["resume", "line\nbreak"],
    ],
    ids=lambda arguments: " ".join(arguments)[:40],
)
def test_what_was_found_stays_refused(arguments):
    assert check(arguments).outcome == "refused"
