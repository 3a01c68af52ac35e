"""Texts of a search's space: what they mean, and which are refused."""

import pytest

from learner.search.space import Choices, Range, assignment, parse_space
from learner.sweep.grid import parse_overrides
from sim_core.checks import ConfigError


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("learning_rate=1e-4..1e-2:log", Range("learning_rate", 1e-4, 1e-2, False, True)),
        ("n_step=1..5", Range("n_step", 1, 5, True, False)),
        ("batch_size=32..1024:log", Range("batch_size", 32, 1024, True, True)),
        ("discount=0.9..1", Range("discount", 0.9, 1.0, False, False)),
        ("arena_radius_m=.5..1_0", Range("arena_radius_m", 0.5, 10.0, False, False)),
        ("loss=huber,mse", Choices("loss", ("huber", "mse"))),
        ("captured_is = among, surrounded".replace(" = ", "="), Choices("captured_is", ("among", "surrounded"))),
        ("hidden_sizes=[64],[128, 128]", Choices("hidden_sizes", ("[64]", "[128, 128]"))),
        ("stop_action=true,false", Choices("stop_action", ("true", "false"))),
        ("n_step=1,3,5", Choices("n_step", ("1", "3", "5"))),
    ],
)
def test_ranges_and_choices(text, expected):
    assert parse_space((text,)) == (expected,)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("learning_rat=1..2", "cannot vary 'learning_rat'; `shoal train --help` lists the settings"),
        ("robots=5..10", "cannot vary 'robots'"),
        ("seed=1..2", "cannot vary 'seed'"),
        ("n_step", "takes NAME=LOW..HIGH"),
        ("n_step=", "takes NAME=LOW..HIGH"),
        ("=1..2", "takes NAME=LOW..HIGH"),
        ("n_step=5..1", "is empty"),
        ("n_step=3..3", "is empty"),
        ("learning_rate=0..1:log", "must begin above 0"),
        ("learning_rate=-1..1:log", "must begin above 0"),
        ("n_step=1..2.5", "is a whole number"),
        ("discount=0..1e999", "must be finite"),
        ("loss=0..1", "loss is no number"),
        ("n_step=3", "has one value only"),
        ("loss=mse,mse", "names a value twice"),
    ],
)
def test_what_is_no_space_is_refused(text, words):
    with pytest.raises(ConfigError, match=words.replace("..", r"\.\.")):
        parse_space((text,))


def test_a_setting_is_varied_once():
    with pytest.raises(ConfigError, match="varies n_step twice"):
        parse_space(("n_step=1..3", "loss=mse,huber", "n_step=2..4"))


@pytest.mark.parametrize(
    ("name", "value", "run", "world"),
    [
        ("learning_rate", 1.5e-05, {"learning_rate": 1.5e-05}, {}),
        ("n_step", 3, {"n_step": 3}, {}),
        ("hidden_sizes", "[64, 32]", {"hidden_sizes": (64, 32)}, {}),
        ("stop_action", "true", {}, {"stop_action": True}),
        ("captured_is", "surrounded", {}, {"captured_is": "surrounded"}),
    ],
)
def test_a_value_is_an_override_of_a_sweep(name, value, run, world):
    assert parse_overrides((assignment(name, value),)) == (run, world)
