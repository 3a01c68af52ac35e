"""A share of the fuzz over environments of a user's own; `make fuzz` trains in 2,000."""

from hypothesis import HealthCheck, example, given, settings

from tests.integration.env_fuzzing import CASES, DEEDS, ERRORS, PLACES, SOUND, Case, check_env, env_workplace

SHARE = 20
SOUND_CASE = Case(SOUND[0], 20, "nothing", 0, "raise", ERRORS[0], None, True)


def test_any_environment_is_trained_in_or_refused_with_a_sentence(tmp_path):
    outcomes = set()

    @given(CASES)
    @example(SOUND_CASE)
    @example(SOUND_CASE._replace(what="reward", when=40, value=float("nan")))
    @settings(max_examples=SHARE, deadline=None, suppress_health_check=list(HealthCheck))
    def fuzz(case):
        outcomes.add(check_env(case).outcome)

    with env_workplace(tmp_path):
        fuzz()
    assert outcomes == {"finished", "refused"}


def test_a_call_that_ends_in_any_way_is_survived(tmp_path):
    """In a run or a picture it ends the run with a sentence, or leaves the picture out; closing hurts nobody."""
    ends = {"reset": "refused", "step": "refused", "render": "finished", "close": "finished"}
    with env_workplace(tmp_path):
        for place in PLACES:
            for how in sorted(set(DEEDS) - {"sleep"}):
                found = check_env(SOUND_CASE._replace(what=place, when=0, how=how))
                assert found.outcome == ends.get(place, "refused"), (place, how)
