"""A search's settings: the sweep that a trial is, and what is refused before anything runs."""

import dataclasses

import pytest

from learner.search.config import EVALUATIONS, SearchConfig, check_search
from learner.sweep.grid import make_cell
from sim_core.checks import ConfigError

SEARCH = SearchConfig(space=("learning_rate=1e-4..1e-2:log", "n_step=1..5"), env_steps=60_000, episodes=30)


def test_a_trial_is_a_small_sweep_with_its_settings():
    sweep, cells = dataclasses.replace(SEARCH, robots=(5, 10), seeds=(0, 1), set=("loss=mse",)).cells(
        {"learning_rate": 2e-3, "n_step": 4}
    )
    assert sweep.set == ("loss=mse", "learning_rate=0.002", "n_step=4") and sweep.baselines == ()
    assert len(cells) == 4
    for cell in cells:
        config = cell.config
        assert (config.learning_rate, config.n_step, config.loss) == (2e-3, 4, "mse")
        assert (config.total_env_steps, config.final_eval_episodes) == (60_000, 30)
        assert config.final_eval_first_seed == 3_000_000_000, "calibration's episodes, which no evaluation plays"


def test_a_trial_without_training_plays_a_rule():
    sweep, cells = dataclasses.replace(SEARCH, policy="greedy", space=("arena_radius_m=4.0..8.0",)).cells(
        {"arena_radius_m": 5.0}
    )
    assert [cell.policy for cell in cells] == ["greedy"] and sweep.extrapolation == "none"
    assert cells[0].config.world.arena_radius_m == 5.0 and cells[0].config.final_eval_episodes == 30


def test_pruning_evaluates_at_equal_parts_of_the_training():
    _, (cell,) = dataclasses.replace(SEARCH, prune=True).cells({"n_step": 2})
    assert cell.config.eval_every_env_steps == 60_000 // EVALUATIONS
    _, (plain,) = SEARCH.cells({"n_step": 2})
    sweep = SEARCH.sweep({"n_step": 2})
    assert plain == make_cell(sweep, "sensor", 10, 2, 0)


@pytest.mark.parametrize(
    ("budget", "trials", "hours"), [("20", 20, None), ("1", 1, None), ("2h", None, 2.0), ("0.5h", None, 0.5)]
)
def test_a_budget_is_in_trials_or_hours(budget, trials, hours):
    search = dataclasses.replace(SEARCH, budget=budget)
    assert (search.trials, search.hours) == (trials, hours)
    assert search.identity() == SEARCH.identity(), "a search may go on with another budget"


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"budget": "0"}, "budget must be trials or hours"),
        ({"budget": "many"}, "budget must be trials or hours"),
        ({"budget": "0h"}, "more than 0 hours"),
        ({"objective": ()}, "objective must name at least one"),
        ({"seeds": (), "policy": "greedy"}, "seeds must have at least one"),
        ({"objective": ("success", "success")}, "name each once"),
        ({"objective": ("one/mine.py:f", "two/mine.py:f")}, "name each once"),
        ({"space": ("n_step=1..5",), "set": ("n_step=3",)}, "both name n_step"),
        ({"prune": True, "policy": "greedy"}, "greedy is not trained"),
        ({"policy": "swarm"}, "policy must be one of"),
        ({"episodes": 0}, "episodes must be at least 1"),
        ({"robots": ()}, "robots must have at least one value"),
    ],
)
def test_invalid_settings_are_refused(changed, words):
    with pytest.raises(ConfigError, match=words):
        dataclasses.replace(SEARCH, **changed)


@pytest.mark.parametrize(
    ("space", "words"),
    [
        ("discount=0.5..1.5", "space discount=1.5: discount must be in"),
        ("n_step=0..3", "space n_step=0: n_step must be at least 1"),
        ("loss=mse,hubber", "space loss=hubber: loss must be one of: huber, mse"),
        ("robot_radius_m=0.05..0.5", "orca_radius_m .* must be at least robot_radius_m"),
    ],
)
def test_an_end_that_no_trial_could_have_is_refused(space, words):
    with pytest.raises(ConfigError, match=words):
        check_search(dataclasses.replace(SEARCH, space=(space,)))


def test_an_end_that_fits_some_values_of_another_setting_is_not():
    check_search(dataclasses.replace(SEARCH, space=("orca_radius_m=0.05..0.2", "robot_radius_m=0.03..0.1")))


def test_a_rule_that_no_method_has_is_refused():
    with pytest.raises(ConfigError, match="have no rule field"):
        check_search(dataclasses.replace(SEARCH, policy="field"))
