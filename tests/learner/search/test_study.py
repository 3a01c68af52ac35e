"""The study of a search: trials are numbered once, whatever is killed in between."""

import dataclasses

import numpy as np
import pytest

from learner.search.config import SearchConfig
from learner.search.study import LEAST_FOR_IMPORTANCES, SearchStudy, StoredSearch
from sim_core.checks import ConfigError

SEARCH = SearchConfig(space=("learning_rate=1e-4..1e-2:log", "n_step=1..5", "loss=huber,mse"), budget="8")


def open_study(folder, search=SEARCH, minimised=(False,), sources=()):
    return SearchStudy(folder, search, minimised, sources)


def value_of(settings):
    """An objective that the learning rate decides alone."""
    return -abs(np.log10(settings["learning_rate"]) + 3)


def run_all(study):
    found = []
    while (asked := study.ask()) is not None:
        study.complete(asked.number, [value_of(asked.settings)])
        found.append(asked)
    return found


def test_trials_are_numbered_and_within_the_space(tmp_path):
    found = run_all(open_study(tmp_path))
    assert [each.number for each in found] == list(range(8))
    for _, settings in found:
        assert 1e-4 <= settings["learning_rate"] <= 1e-2 and settings["n_step"] in range(1, 6)
        assert settings["loss"] in ("huber", "mse")


def test_a_search_that_is_killed_twice_has_the_trials_of_one_that_is_not(tmp_path):
    (whole_folder := tmp_path / "whole").mkdir()
    (killed_folder := tmp_path / "killed").mkdir()
    whole = open_study(whole_folder)
    run_all(whole)
    for _ in range(2):
        study = open_study(killed_folder)
        for _ in range(2):
            asked = study.ask()
            study.complete(asked.number, [value_of(asked.settings)])
        study.ask()  # and never told: the session dies
    waiting = study.records()[-1]
    last = open_study(killed_folder)
    assert last.ask() == (waiting.number, waiting.settings), "what was under way is run first, under its number"
    last.complete(waiting.number, [value_of(waiting.settings)])
    run_all(last)
    assert [each[:4] for each in last.records()] == [each[:4] for each in whole.records()]
    assert not last.has_more() and last.ask() is None


def test_a_larger_budget_goes_on(tmp_path):
    run_all(open_study(tmp_path))
    more = open_study(tmp_path, dataclasses.replace(SEARCH, budget="10"))
    assert [each.number for each in run_all(more)] == [8, 9]


@pytest.mark.parametrize(
    ("changed", "sources", "words"),
    [
        ({"space": ("n_step=1..4",)}, (), "another space"),
        ({"episodes": 7}, (), "another episodes"),
        ({}, ("def f(result): return 1",), "another sources"),
    ],
)
def test_another_search_in_the_folder_is_refused(changed, sources, words, tmp_path):
    open_study(tmp_path)
    with pytest.raises(ConfigError, match=words):
        open_study(tmp_path, dataclasses.replace(SEARCH, **changed), sources=sources)


def test_a_damaged_file_is_refused_with_its_name(tmp_path):
    (tmp_path / "study.db").write_bytes(b"no database" * 100)
    with pytest.raises(ConfigError, match="study.db is no study that can be read"):
        open_study(tmp_path)
    with pytest.raises(ConfigError, match="holds no search"):
        StoredSearch(tmp_path / "nowhere")


def test_hours_count_over_sessions(tmp_path, monkeypatch):
    clock = [100.0]
    monkeypatch.setattr("learner.search.study.time.monotonic", lambda: clock[0])
    search = dataclasses.replace(SEARCH, budget="1h")
    for session in range(2):
        study = open_study(tmp_path, search)
        assert study.spent_s() == pytest.approx(1700 * session)
        asked = study.ask()
        clock[0] += 1700
        study.complete(asked.number, [0.0])
    asked = study.ask()
    clock[0] += 300
    assert asked is not None and study.ask() is None, "3700 of 3600 s"
    study.complete(asked.number, [0.0])


def test_the_worse_half_ends_at_a_rung(tmp_path):
    study = open_study(tmp_path)
    ends = {}
    for success in (0.2, 0.8, 0.4, 0.9, 0.1):
        number = study.ask().number
        ends[success] = study.must_end(number, 1, success)
    assert ends == {0.2: False, 0.8: False, 0.4: True, 0.9: False, 0.1: True}
    study.pruned(4)
    assert study.records()[4].state == "pruned" and study.front() == []


def test_the_worse_half_has_less_success_where_less_of_the_objective_is_better(tmp_path):
    study = open_study(tmp_path, minimised=(True,))
    ends = [study.must_end(study.ask().number, 1, success) for success in (0.5, 0.9, 0.2)]
    assert ends == [False, False, True]
    study.must_end(2, 1, 0.99)  # a resumed trial passes the rung again
    again = open_study(tmp_path, minimised=(True,))
    again.ask()
    assert again.must_end(again.ask().number, 2, 0.9) is False


def test_the_settings_that_matter_are_found(tmp_path):
    study = open_study(tmp_path, dataclasses.replace(SEARCH, budget="30"))
    asked = study.ask()
    study.complete(asked.number, [value_of(asked.settings)])
    assert study.importances() == [{}], f"nothing is said of fewer than {LEAST_FOR_IMPORTANCES} trials"
    run_all(study)
    (shares,) = study.importances()
    assert shares["learning_rate"] > 0.8 and sum(shares.values()) == pytest.approx(1)
    best = max(study.records(), key=lambda each: each.values)
    assert study.front() == [best.number]
    assert best.values[0] > -0.1, "30 trials come near the best learning rate"


def test_the_front_of_two_objectives(tmp_path):
    study = open_study(tmp_path, minimised=(False, True))
    points = [(0.5, 5.0), (0.9, 9.0), (0.4, 6.0), (0.7, 5.0), (0.9, 8.0), (0.1, 1.0)]
    for values in points:
        study.complete(study.ask().number, values)
    front = [i for i, (a, b) in enumerate(points) if not any(
        c >= a and d <= b and (c, d) != (a, b) for c, d in points)]  # fmt: skip
    assert study.front() == front == [3, 4, 5]


def test_a_stored_search_is_read_while_it_runs(tmp_path):
    study = open_study(tmp_path)
    asked = study.ask()
    stored = StoredSearch(tmp_path)
    assert stored.search.identity() == SEARCH.identity() and stored.minimised == [False]
    assert [(each.number, each.state) for each in stored.records()] == [(0, "running")]
    study.fail(asked.number, "no reason")
    assert stored.records()[0].reason == "no reason" and stored.records()[0].state == "failed"
