"""The run's config: what is refused, and what its hash depends on."""

import dataclasses
import json
import math

import pytest
import torch

from learner.config import AT_LEAST_ONE, RunConfig, config_hash, from_dict, identity_dict, to_dict
from learner.training.cluster import rollout_settings
from sim_core.checks import ConfigError
from sim_core.config import WorldConfig


def test_the_defaults_work_and_are_frozen():
    config = RunConfig()
    with pytest.raises(dataclasses.FrozenInstanceError):
        config.seed = 1
    assert config.env.is_swarm and config.block_env_steps == config.envs_per_worker * config.steps_per_block


@pytest.mark.parametrize("name", AT_LEAST_ONE)
@pytest.mark.parametrize("value", [0, -1, 1.5, 2.0, "3", None, True, math.nan])
def test_counts_must_be_positive_whole_numbers(name, value):
    with pytest.raises(ConfigError, match=name):
        RunConfig(**{name: value})


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("seed", [-1, 2**31, 0.5, True]),
        ("epsilon_start", [-0.1, 1.1, math.nan, "1"]),
        ("epsilon_end", [-0.1, 1.1, math.inf]),
        ("ladder_base", [-0.1, 1.1, None]),
        ("ladder_exponent", [-1, math.nan, math.inf]),
        ("discount", [0, -0.5, 1.01, math.nan, True]),
        ("discount_time_s", [-1, 1e-9, math.nan, math.inf, "2"]),
        ("samples_per_insert", [0, -1, math.nan, math.inf, "4"]),
        ("learning_rate", [0, -1, math.nan, math.inf]),
        ("learning_rate_end", [0, -1, math.nan, math.inf]),
        ("max_gradient_norm", [0, -1, math.nan]),
        ("teacher_weight", [-0.1, math.nan, math.inf, "1"]),
        ("teacher_weight_end", [-0.1, math.nan, math.inf]),
        ("teacher_margin", [-0.1, math.nan, math.inf]),
        ("teacher", ["dqn", None, 3]),
        ("random_turns", [1, "yes", None]),
        ("target_update_rate", [0, -0.1, 1.01, math.nan, None]),
        ("priority_exponent", [-0.1, 1.1, math.nan]),
        ("importance_exponent_start", [-0.1, 1.1, "0.4"]),
        ("importance_exponent_end", [-0.1, 1.1, True]),
        ("replay", ["prioritized", None]),
        ("network", ["duelling", 2]),
        ("loss", ["l2", None]),
        ("target_update", ["polyak", None]),
        ("learning_rate_schedule", ["constant", None]),
        ("device", ["gpu", "cuda:0", None]),
        ("hidden_sizes", [(), (0,), (8, -1), (8, 1.5), (True,), 8, "88", None, [8]]),
        ("engine", ["Ray", "", None, ["ray"]]),
        ("exploration", ["greedy", 1]),
        ("replay_placement", ["shard", {}]),
        ("algorithm", ["ddqn", None]),
        ("env_id", [None, 3]),
    ],
)
def test_values_out_of_range_are_refused(name, values):
    for value in values:
        with pytest.raises(ConfigError, match=name):
            RunConfig(**{name: value})


OTHER = WorldConfig(method="in")


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"replay_capacity": 8191, "min_replay": 100}, "replay_capacity.*8192 transitions in each of 1"),
        ({"replay_capacity": 32_767, "min_replay": 100, "replay_shards": 4}, "in each of 4"),
        ({"replay_capacity": 20_000, "min_replay": 20_001}, "min_replay.*must not exceed"),
        ({"total_env_steps": 20_000, "min_replay": 20_000}, "nothing is learned"),
        ({"policy_average_updates": -1}, "policy_average_updates must not be negative, not -1"),
        ({"setups": ("10r2g",)}, "ROBOTSxGROUPS, as in 10x2 or 25x8:2, not '10r2g'"),
        ({"setups": ("10x2:0",)}, "share of a setup must be greater than 0, not '10x2:0'"),
        ({"setups": ("10x2:1.2.3",)}, "share of a setup must be greater than 0, not '10x2:1.2.3'"),
        ({"setups": ("10x2", "10x2:3")}, "setups name 10x2 twice"),
        ({"setups": ("all", "25x8")}, "setups name 25x8 twice"),
        ({"setups": ("1x2",)}, "robots must be at least 2"),
        ({"setups": ("10x2",), "env_id": "CartPole-v1"}, "setups are those of our own environment, not of CartPole"),
        ({"setups": ("all",), "envs_per_worker": 24}, r"envs_per_worker \(24\) must be at least .* setups \(25\)"),
        (
            {"setups": ("5x2", "5x4"), "world": WorldConfig(method="in")},
            r"equally many groups, not \[2, 4\]: .*group_rows = 4",
        ),
        ({"network": "pooled"}, "network must be plain or dueling for sensor 10r×2g"),
        ({"network": "pooled", "env_id": "CartPole-v1"}, "network must be plain or dueling for CartPole-v1"),
        ({"teacher": "field"}, "teacher must be none or a rule of method sensor, which has: greedy; not field"),
        ({"teacher": "fl-orca", "world": OTHER}, "rule of method in, which has: greedy, field; not fl-orca"),
        ({"teacher": "greedy", "env_id": "CartPole-v1"}, "teacher must be none for CartPole-v1"),
        ({"random_turns": True, "env_id": "CartPole-v1"}, "random_turns are for our own environment, not for CartPole"),
        (
            {"random_turns": True, "world": WorldConfig(sector_frame="goal")},
            "random_turns must be False for method sensor with these settings",
        ),
        ({"setups": "all"}, "setups must be a list of texts such as 10x2, not 'all'"),
        ({"env_id": "CartPole-v1", "discount_time_s": 2.0}, "no duration; set discount"),
    ],
)
def test_values_that_contradict_each_other_are_refused(settings, words):
    with pytest.raises(ConfigError, match=words):
        RunConfig(**settings)


def test_all_setups_are_those_of_the_dissertation():
    spec = RunConfig(setups=("all",)).env
    assert [(world.robots, world.groups) for world in spec.worlds] == [
        (robots, groups) for robots in (5, 10, 15, 20, 25) for groups in (1, 2, 3, 4, 8)
    ]
    weighted = RunConfig(setups=("7x3", "25x8:2.5")).env
    assert [(world.setup, share) for world, share in weighted.shares] == [("7r×3g", 1.0), ("25r×8g", 2.5)]
    assert RunConfig().env.worlds == [RunConfig().world]
    assert RunConfig(setups=("all",)).name == "sensor in 25 setups s0"


def test_limits_themselves_are_accepted():
    RunConfig(replay_capacity=32_768, min_replay=32_768, replay_shards=4, total_env_steps=32_769)
    RunConfig(seed=2**31 - 1, discount=1.0, epsilon_start=0.0, epsilon_end=1, ladder_base=1, ladder_exponent=0)


@pytest.mark.parametrize(("interval", "step_s"), [(1, 0.05), (4, 0.05), (3, 0.1)])
def test_a_discount_of_time_is_the_same_after_a_second_whatever_a_decision_lasts(interval, step_s):
    world = WorldConfig(decision_interval_steps=interval, time_step_s=step_s)
    config = RunConfig(world=world, discount=0.5, discount_time_s=2.0)
    assert config.decision_discount ** (1 / (interval * step_s)) == pytest.approx(math.exp(-0.5))
    assert rollout_settings(config).discount == config.decision_discount
    assert RunConfig(discount=0.5).decision_discount == 0.5


def test_the_learning_rate_falls_linearly_and_stays():
    config = RunConfig(learning_rate=1e-3, learning_rate_end=2e-4, learning_rate_decay_env_steps=1000)
    rates = [config.learning_rate_at(env_steps) for env_steps in (0, 250, 1000, 10**9)]
    assert rates == pytest.approx([1e-3, 8e-4, 2e-4, 2e-4])


def test_a_teachers_weight_falls_linearly_and_stays():
    config = RunConfig(teacher="greedy", teacher_weight=2.0, teacher_weight_end=0.5, teacher_decay_env_steps=1000)
    weights = [config.teacher_weight_at(env_steps) for env_steps in (0, 500, 1000, 10**9)]
    assert weights == pytest.approx([2.0, 1.25, 0.5, 0.5])


def test_a_learning_rate_that_ends_where_it_starts_is_constant():
    config = RunConfig(learning_rate=1e-3, learning_rate_end=1e-3, learning_rate_decay_env_steps=1000)
    assert {config.learning_rate_at(env_steps) for env_steps in range(0, 3000, 100)} == {1e-3}


def test_the_cosine_schedule_is_that_of_pytorch():
    config = RunConfig(
        learning_rate=1e-3,
        learning_rate_end=2e-4,
        learning_rate_decay_env_steps=50,
        learning_rate_schedule="cosine",
    )
    optimiser = torch.optim.SGD([torch.nn.Parameter(torch.zeros(1))], lr=1e-3)
    theirs = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, T_max=50, eta_min=2e-4)
    for env_steps in range(51):
        assert config.learning_rate_at(env_steps) == pytest.approx(theirs.get_last_lr()[0], rel=1e-9)
        optimiser.step()
        theirs.step()
    assert config.learning_rate_at(10**9) == pytest.approx(2e-4)


def test_the_importance_exponent_changes_linearly_and_stays():
    config = RunConfig(importance_exponent_start=0.4, importance_exponent_end=0.9, importance_exponent_env_steps=1000)
    exponents = [config.importance_exponent_at(env_steps) for env_steps in (0, 200, 1000, 10**9)]
    assert exponents == pytest.approx([0.4, 0.5, 0.9, 0.9])


@pytest.mark.parametrize(("network", "expected"), [("plain", (7, 5)), ("dueling", (7, 10))])
def test_a_policy_acts_with_a_plain_network(network, expected):
    assert RunConfig(network=network, hidden_sizes=(7, 5)).policy_sizes == expected


def test_round_trip_through_json(small_run):
    for config in (RunConfig(), small_run):
        assert from_dict(json.loads(json.dumps(to_dict(config)))) == config


def test_missing_keys_take_the_defaults():
    assert from_dict({}) == RunConfig()
    config = from_dict({"workers": 3, "hidden_sizes": [7], "world": {"robots": 5}})
    assert config == RunConfig(workers=3, hidden_sizes=(7,), world=WorldConfig(robots=5))


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"worker": 3}, "unknown key 'worker' in the config"),
        ({"robots": 3}, "unknown key 'robots' in the config"),
        ({"world": {"robot": 3}}, r"unknown key 'robot' in the config section \[world\]"),
        ({"world": {"workers": 3}}, r"unknown key 'workers' in the config section \[world\]"),
        ({"world": 3}, r"section \[world\]"),
        ({"world": {"robots": 1}}, "robots must be at least 2"),
        ({"hidden_sizes": 5}, "hidden_sizes"),
        ({"workers": "three"}, "workers"),
    ],
)
def test_bad_dicts_are_refused(values, words):
    with pytest.raises(ConfigError, match=words):
        from_dict(values)


def changed(config, name):
    """`config` with another valid value of one field."""
    value = getattr(config, name)
    others = {
        "engine": "ray" if value == "process" else "process",
        "exploration": "ladder",
        "replay_placement": "actors" if value == "learner" else "learner",
        "algorithm": "dqn",
        "gradients": "autograd",
        "device": "cpu",
        "replay": "prioritised",
        "network": "dueling",
        "loss": "mse",
        "target_update": "soft",
        "learning_rate_schedule": "cosine",
        "env_id": "CartPole-v1",
        "world": dataclasses.replace(config.world, reward_scale=2.0),
        "hidden_sizes": (*config.hidden_sizes, 4),
        "setups": ("4x2", "5x1"),
        "random_turns": True,
        "teacher": "greedy",
        "discount_time_s": 2.0,
    }
    if name not in others:
        others[name] = value + 1 if isinstance(value, int) else value / 2
    return dataclasses.replace(config, **{name: others[name]})


@pytest.mark.parametrize("name", [field.name for field in dataclasses.fields(RunConfig)])
def test_the_hash_depends_on_every_field_but_length_and_placement(small_run, name):
    other = changed(small_run, name)
    assert other != small_run
    same = config_hash(other) == config_hash(small_run)
    assert same == (name in ("total_env_steps", "engine", "device"))


def test_settings_that_were_added_leave_earlier_hashes_as_they_were():
    assert config_hash(RunConfig()) == "7692f3056dac"  # of the version before UNCOUNTED's settings
    assert config_hash(RunConfig(seed=3)) == "d8903ec0579d"


def test_the_hash_is_stable(small_run):
    assert config_hash(small_run) == config_hash(from_dict(to_dict(small_run)))
    assert len(config_hash(small_run)) == 12 and int(config_hash(small_run), 16) >= 0


def test_hashes_do_not_know_of_several_learning_robots_where_one_learns():
    """Runs from before there were several keep their hashes."""
    plain = RunConfig()
    assert not {"learners", "ended_learners"} & identity_dict(plain)["world"].keys()
    several = dataclasses.replace(plain, world=WorldConfig(learners="1.0"))
    leaving = dataclasses.replace(plain, world=WorldConfig(learners="1.0", ended_learners="leave"))
    assert len({config_hash(config) for config in (plain, several, leaving)}) == 3
    assert identity_dict(leaving)["world"]["ended_learners"] == "leave"


def test_a_learning_robot_is_an_environment():
    several = RunConfig(world=WorldConfig(robots=10, groups=2, learners="1.0"), envs_per_worker=64)
    assert several.block_env_steps == 60 * several.steps_per_block  # three worlds of 20
    assert several.title == "sensor 10r×2g, learners 1.0" and RunConfig().title == "sensor 10r×2g"
    large = RunConfig(world=WorldConfig(robots=25, groups=8, learners="1.0"), envs_per_worker=64)
    assert large.block_env_steps == 200 * large.steps_per_block  # a world at least
    mixed = RunConfig(world=WorldConfig(learners="0.5"), setups=("10x2", "5x2"), envs_per_worker=64)
    assert mixed.block_env_steps == (30 + 30) * mixed.steps_per_block  # worlds of 10 and of 6
