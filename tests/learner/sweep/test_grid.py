"""The grid of a sweep: its cells, the worlds that each is evaluated in, and which cells are done."""

import dataclasses

import pytest

from actors.evaluation.result_table import ResultRow
from learner.config import RunConfig, to_dict
from learner.sweep.grid import (
    ORIGINAL_DEFAULTS,
    SweepConfig,
    cell_hash,
    done_cells,
    extrapolation_worlds,
    make_baseline_cell,
    make_cell,
    make_cells,
    wanted_episodes,
)
from sim_core.checks import ConfigError

SMALL = SweepConfig(robots=(5, 10), groups=(1, 2), seeds=(0,), episodes=30, extrapolation_episodes=20, baselines=())


def rows_of(sweep, cell):
    """A complete set of results of a cell."""
    world = cell.config.world
    return [
        ResultRow(
            preset=sweep.label,
            policy="learned",
            method=world.method,
            trained_robots=world.robots,
            trained_groups=world.groups,
            seed=cell.config.seed,
            robots=robots,
            groups=groups,
            episodes=episodes,
            goal=episodes,
            lost=0,
            captured=0,
            collision=0,
            timeout=0,
            mean_length_steps=1.0,
            config=cell_hash(cell.config),
        )
        for (robots, groups), episodes in wanted_episodes(sweep, cell).items()
    ]


def test_the_dissertations_grid_has_75_setups_per_seed():
    cells = make_cells(SweepConfig(seeds=(0, 1), baselines=()))
    assert len(cells) == 150 and len({cell.key for cell in cells}) == 150
    setups = {(cell.config.world.method, cell.config.world.robots, cell.config.world.groups) for cell in cells}
    assert len(setups) == 75
    assert [cell.config.seed for cell in cells] == [0] * 75 + [1] * 75
    assert all(cell.config.final_eval_episodes == 3_000 and cell.config.engine == "process" for cell in cells)
    weights = [cell.weight for cell in cells[:75]]
    assert weights == sorted(weights) and weights[0] < weights[-1]


def test_a_policy_is_evaluated_in_every_setup_that_its_state_fits():
    sweep = SweepConfig()
    sensor = extrapolation_worlds(sweep, make_cell(sweep, "sensor", 10, 2, 0))
    assert len({(world.robots, world.groups) for world in sensor}) == 24
    assert (10, 2) not in {(world.robots, world.groups) for world in sensor}
    for method in ("in", "out"):
        others = extrapolation_worlds(sweep, make_cell(sweep, method, 10, 2, 0))
        assert {(world.robots, world.groups) for world in others} == {(r, 2) for r in (5, 15, 20, 25)}
        assert {world.method for world in others} == {method}
    assert extrapolation_worlds(SweepConfig(extrapolation="none"), make_cell(sweep, "sensor", 10, 2, 0)) == []


def test_what_a_figure_draws_has_as_many_episodes_as_fixed():
    """Figures 3.4 to 3.6: more robots or more groups than in the training, with M_sensor, from six trainings."""
    sweep = SweepConfig(robots=(5, 10, 25), groups=(1, 2, 8), episodes=3_000, extrapolation_episodes=300)
    drawn = {(25, 2), (10, 8)}
    wanted = wanted_episodes(sweep, make_cell(sweep, "sensor", 10, 2, 0))
    assert wanted == {(r, g): 3_000 if (r, g) in {(10, 2), *drawn} else 300 for r in (5, 10, 25) for g in (1, 2, 8)}
    for other in (("sensor", 10, 8), ("sensor", 25, 2), ("out", 10, 2)):
        wanted = wanted_episodes(sweep, make_cell(sweep, *other, 0))
        assert sorted(wanted.values())[:-1] == [300] * (len(wanted) - 1)


def test_a_cells_hash_depends_on_everything_that_decides_its_results():
    base = make_cell(SMALL, "sensor", 5, 2, 0)
    assert base.key.startswith("sensor-5r2g-s0-")
    assert make_cell(SMALL, "sensor", 5, 2, 0).key == base.key
    others = [
        make_cell(SMALL, "in", 5, 2, 0),
        make_cell(SMALL, "sensor", 10, 2, 0),
        make_cell(SMALL, "sensor", 5, 2, 1),
        make_cell(dataclasses.replace(SMALL, episodes=31), "sensor", 5, 2, 0),
        make_cell(dataclasses.replace(SMALL, env_steps=250_000), "sensor", 5, 2, 0),
        make_cell(dataclasses.replace(SMALL, first_seed=3), "sensor", 5, 2, 0),
    ]
    assert len({cell_hash(cell.config) for cell in [base, *others]}) == 7
    for where in ({"engine": "ray"}, {"device": "cuda"}):
        assert cell_hash(dataclasses.replace(base.config, **where)) == cell_hash(base.config)


def test_the_hash_ignores_settings_with_their_default(monkeypatch):
    config = make_cell(SMALL, "out", 5, 2, 0).config
    before = cell_hash(config)
    plain = to_dict

    def with_more(some):  # a later version, with one more setting of the run and of the world
        values = plain(some)
        return {**values, "later": 3, "world": {**values["world"], "later_m": 0.5}}

    monkeypatch.setattr("learner.sweep.grid.to_dict", with_more)
    assert cell_hash(config) == before
    assert cell_hash(dataclasses.replace(config, n_step=4)) != before


def test_schedules_are_stretched_to_the_length_of_the_training():
    config = make_cell(dataclasses.replace(SMALL, env_steps=400_000), "out", 5, 1, 0).config
    assert config.total_env_steps == config.learning_rate_decay_env_steps == 400_000
    assert config.importance_exponent_env_steps == RunConfig().importance_exponent_env_steps  # unused
    prioritised = dataclasses.replace(SMALL, env_steps=400_000, set=("replay=prioritised",))
    assert make_cell(prioritised, "out", 5, 1, 0).config.importance_exponent_env_steps == 400_000
    given = dataclasses.replace(prioritised, set=("replay=prioritised", "importance_exponent_env_steps=7"))
    assert make_cell(given, "out", 5, 1, 0).config.importance_exponent_env_steps == 7
    preset = make_cell(SMALL, "out", 5, 1, 0).config
    assert config.epsilon_decay_env_steps / 400_000 == preset.epsilon_decay_env_steps / preset.total_env_steps


def test_a_rules_results_stay_valid_when_a_training_setting_changes():
    plain, trained, world = (
        dataclasses.replace(SMALL, set=changed)
        for changed in ((), ("discount=0.5", "n_step=2"), ("robot_radius_m=0.05",))
    )

    def hashes(sweep):
        rule, policy = make_baseline_cell(sweep, "greedy", "sensor", 5, 2), make_cell(sweep, "sensor", 5, 2, 0)
        return cell_hash(rule.config), cell_hash(policy.config)

    assert hashes(plain)[0] == hashes(trained)[0] != hashes(world)[0]
    assert hashes(plain)[1] != hashes(trained)[1]
    rule = make_baseline_cell(plain, "greedy", "sensor", 5, 2).config  # and when a default changes: it is not hashed
    assert all(getattr(rule, name) == value for name, value in ORIGINAL_DEFAULTS.items())


def test_baselines_are_evaluated_in_the_world_of_every_cell():
    sweep = dataclasses.replace(SMALL, baselines=("greedy", "fl-orca"), baseline_episodes=7)
    cells = make_cells(sweep)
    played, trained = cells[:-12], cells[-12:]
    assert trained == make_cells(SMALL) and len({cell.key for cell in cells}) == len(cells) == 36
    assert {cell.policy for cell in played} == {"greedy", "fl-orca"} and {cell.policy for cell in trained} == {
        "learned"
    }
    for policy in ("greedy", "fl-orca"):
        worlds = [cell.config.world for cell in played if cell.policy == policy]
        assert sorted(worlds, key=str) == sorted((cell.config.world for cell in trained), key=str)
    assert all(
        wanted_episodes(sweep, cell) == {(c.robots, c.groups): 7} for cell in played for c in [cell.config.world]
    )
    assert played[0].name == "greedy: sensor 5r×1g"
    rows = [row._replace(policy=cell.policy) for cell in played for row in rows_of(sweep, cell)]
    assert set(done_cells(sweep, cells, rows)) == {cell.key for cell in played}
    learned = [row._replace(policy="learned") for row in rows]
    assert not done_cells(sweep, cells, learned)


def test_settings_override_the_presets():
    sweep = dataclasses.replace(SMALL, set=("n_step=5", "apf_rows=all", "time_step_s=0.04", "hidden_sizes=[64, 32]"))
    config, preset = make_cell(sweep, "in", 5, 2, 0).config, make_cell(SMALL, "in", 5, 2, 0).config
    assert (config.n_step, config.hidden_sizes, config.world.apf_rows) == (5, (64, 32), "all")
    world = dataclasses.replace(config.world, apf_rows=preset.world.apf_rows, time_step_s=preset.world.time_step_s)
    assert dataclasses.replace(config, n_step=preset.n_step, hidden_sizes=preset.hidden_sizes, world=world) == preset
    assert sweep.label == "thesis+n_step=5+apf_rows=all+time_step_s=0.04+hidden_sizes=[64, 32]"
    assert SMALL.label == "thesis"
    rows = [row._replace(preset=sweep.label) for row in rows_of(SMALL, make_cell(SMALL, "in", 5, 2, 0))]
    assert not done_cells(sweep, make_cells(sweep), rows)
    assert done_cells(sweep, make_cells(sweep), rows_of(sweep, make_cell(sweep, "in", 5, 2, 0)))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("n_step", "NAME=VALUE"),
        ("=3", "NAME=VALUE"),
        ("n_stp=3", "cannot change 'n_stp'"),
        ("robots=7", "cannot change 'robots'"),
        ("learners=0.5", "cannot change 'learners'"),
        ("seed=7", "cannot change 'seed'"),
        pytest.param(f"hidden_sizes={'[' * 100_000}", "hidden_sizes is nested too deeply", id="nested"),
        ("final_eval_first_seed=7", "cannot change 'final_eval_first_seed'"),
        ("total_env_steps=70000", "cannot change 'total_env_steps'"),
    ],
)
def test_an_invalid_override_is_refused(text, words):
    with pytest.raises(ConfigError, match=words):
        SweepConfig(set=(text,))


def test_an_override_with_an_invalid_value_is_refused_before_anything_runs():
    with pytest.raises(ConfigError, match="n_step must be a whole number"):
        make_cells(dataclasses.replace(SMALL, set=("n_step=three",)))


def test_a_cell_is_done_when_its_results_are_complete():
    cells = make_cells(SMALL)
    rows = [row for cell in cells for row in rows_of(SMALL, cell)]
    done = done_cells(SMALL, cells, rows)
    assert done == {cell.key: rows_of(SMALL, cell) for cell in cells}
    first = cells[0]
    for i, row in enumerate(rows_of(SMALL, first)):
        others = [other for other in rows if other != row]
        assert set(done_cells(SMALL, cells, others)) == set(done) - {first.key}, i
        for decoy in (
            row._replace(episodes=row.episodes - 1, goal=row.goal - 1),
            row._replace(config="0" * 12),
            row._replace(policy="greedy"),
            row._replace(preset="best"),
            row._replace(robots=7),
        ):
            assert set(done_cells(SMALL, cells, [*others, decoy])) == set(done) - {first.key}, decoy


def test_results_of_more_episodes_are_accepted():
    cell = make_cell(SMALL, "in", 5, 2, 0)
    rows = [row._replace(episodes=row.episodes + 5, goal=row.goal + 5) for row in rows_of(SMALL, cell)]
    assert done_cells(SMALL, [cell], rows) == {cell.key: rows}


def test_without_seeds_the_baselines_alone_play():
    sweep = SweepConfig(seeds=(), robots=(5,), groups=(1, 2))
    played = [(cell.policy, cell.config.world.method) for cell in make_cells(sweep)]
    assert sorted(set(played)) == [
        ("field", "in"),
        *(("fl-orca", method) for method in ("in", "out", "sensor")),
        *(("greedy", method) for method in ("in", "out", "sensor")),
    ]
    assert len(played) == 14 and all(cell.config.final_eval_episodes == 3_000 for cell in make_cells(sweep))


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"robots": ()}, "robots must have at least one"),
        ({"seeds": (1, 1)}, "seeds must not repeat"),
        ({"seeds": (), "baselines": ()}, "seeds or baselines must have at least one"),
        ({"methods": ("sensor", "north")}, "method must be one of: sensor, in, out"),
        ({"episodes": 0}, "episodes must be at least 1"),
        ({"extrapolation_episodes": 0}, "extrapolation_episodes must be at least 1"),
        ({"env_steps": 0}, "env_steps must be at least 1"),
        ({"baselines": ("swarm",)}, "baselines must be among fl-orca, fl-orca-snapped, greedy, field, random"),
        ({"baseline_episodes": 0}, "baseline_episodes must be at least 1"),
        ({"first_seed": -1}, "first_seed must be in"),
        ({"first_seed": 2**32 - 5}, "first_seed must be in"),
        ({"preset": "ours"}, "preset must be one of: thesis, best"),
        ({"extrapolation": "some"}, "extrapolation must be one of"),
    ],
)
def test_invalid_settings_are_refused(settings, words):
    with pytest.raises(ConfigError, match=words):
        SweepConfig(**settings)


def test_a_setup_that_does_not_fit_is_refused_before_anything_runs():
    with pytest.raises(ConfigError, match="does not fit"):
        make_cells(SweepConfig(robots=(5, 400), groups=(8,)))
