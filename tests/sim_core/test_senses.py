"""The sensing stage: against a plain oracle and closed forms; no influence where nothing is sensed badly."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import kstest, norm

from sim_core.config import WorldConfig
from sim_core.jit import kernel
from sim_core.methods.headings import heading_velocities
from sim_core.pilot import Pilot
from sim_core.rng import add_normal
from sim_core.worlds import WorldBatch
from tests.sim_core.batches import assert_go_on_alike, started
from tests.sim_core.senses_oracle import Oracle, normal_pair

WORLD = {"robots": 5, "groups": 3, "arena_radius_m": 1.5, "robot_radius_m": 0.06, "orca_radius_m": 0.18}
SENSES = {
    "position_noise_m": 0.05,
    "position_loss": 0.2,
    "burst_loss": 0.2,
    "burst_steps": 5.0,
    "position_delay_steps": 3,
    "dropped_mates": 2,
    "sensing_range_m": 2.5,
    "field_of_view_deg": 250.0,
    "group_mix_up": 0.1,
    "track_steps": 3,
}
DRIVES = {"command_delay_steps": 2, "speed_error": 0.3, "heading_error_deg": 20.0}
METHODS = ("sensor", "in", "out")
NO_EFFECT = {"sensing_range_m": 1e6}
"""A condition under which the stage works and changes nothing."""


def make(num_worlds, method="sensor", seed=0, **fields):
    """A freshly reset batch."""
    return started(WorldConfig(method=method, **{**WORLD, **fields}), num_worlds, seed)


def wide(num_worlds, **fields):
    """A batch of worlds without a swarm to step: 10 robots in 2 groups that sense and do not collide."""
    return make(num_worlds, robots=10, groups=2, arena_radius_m=6.0, flocking="none", **fields)


def sensed(worlds):
    """`[num_worlds, num_robots, 4]`: x, y, vx, vy as they are sensed."""
    state = worlds.sensed
    return np.stack([state.pos_x, state.pos_y, state.vel_x, state.vel_y], axis=-1)


def others(worlds):
    """`[num_worlds, num_robots]`: all but the learning robots."""
    return np.arange(worlds.config.num_robots) != worlds.state.learner[:, None]


def mates(worlds):
    """`[num_worlds, num_robots]`: the other robots of the learning robots' groups."""
    group = worlds.state.group
    return others(worlds) & (group == group[worlds.state.learner][:, None])


@pytest.mark.parametrize("conditions", ["fixed", "drawn"])
@pytest.mark.parametrize("left_out", [None, *SENSES])
def test_the_stage_senses_what_the_oracle_does(conditions, left_out):
    fields = {name: value for name, value in SENSES.items() if name != left_out}
    worlds = make(3, seed=40, conditions=conditions, horizon_steps=40, **fields, **DRIVES)
    oracles = [Oracle(worlds.config, worlds, world) for world in range(3)]
    headings = heading_velocities(worlds.config, np.float32)
    for step in range(25):
        found = sensed(worlds)
        for world, oracle in enumerate(oracles):
            np.testing.assert_allclose(found[world], oracle.look(), atol=2e-6, err_msg=f"world {world}, step {step}")
        action = np.array([step % 8, (step // 2) % 8, 3])
        driven = [oracle.drive(headings[a]) for oracle, a in zip(oracles, action, strict=True)]
        worlds.step(action)  # also after an episode's end: only what is sensed and driven counts here
        velocity = worlds.state.vel_x, worlds.state.vel_y
        learner = worlds.state.learner[:, None]
        moved = np.concatenate([np.take_along_axis(v, learner, axis=1) for v in velocity], axis=1)
        np.testing.assert_allclose(moved, driven, atol=2e-6)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("action", [Pilot.FREE, Pilot.SNAPPED, "plan"])
def test_a_stage_that_changes_nothing_is_bit_for_bit_none(method, action):
    plain, through = make(5, method), make(5, method, **NO_EFFECT)
    assert plain.sensed is plain.state and through.sensed is not through.state
    assert set(through.get_state()) > set(plain.get_state())
    for step in range(60):
        taken = np.arange(5) * step % 8 if action == "plan" else action
        one, other = plain.step(taken), through.step(taken)
        for name, value in one._asdict().items():
            np.testing.assert_array_equal(getattr(other, name), value, err_msg=name)
        for name, value in plain.get_state().items():
            np.testing.assert_array_equal(through.get_state()[name], value, err_msg=name)


@pytest.mark.parametrize("method", METHODS)
def test_outcome_and_reward_are_those_of_the_true_positions(method):
    """The same actions lead to the same episodes, whatever is sensed; M_OUT's velocity alone depends on it."""
    plain, blind = make(8, method), make(8, method, position_loss=1.0, apf_gain_m4_s=0.0)
    plain = plain if method != "out" else make(8, method, apf_gain_m4_s=0.0)
    differ = False
    for step in range(80):
        one, other = plain.step(np.arange(8) * step % 8), blind.step(np.arange(8) * step % 8)
        differ |= not np.array_equal(one.observation, other.observation)
        for name in ("reward", "outcome", "steps", "episode_return"):
            np.testing.assert_array_equal(getattr(other, name), getattr(one, name), err_msg=name)
    assert differ


def test_losses_are_as_frequent_as_they_should_be():
    worlds = wide(200, position_loss=0.3)
    lost = [np.isnan(worlds.sensed.pos_x)[others(worlds)]]
    for _ in range(20):
        worlds.step(np.zeros(200, np.int64))
        lost.append(np.isnan(worlds.sensed.pos_x)[others(worlds)])
    running = np.concatenate(lost[:15])
    assert abs(running.mean() - 0.3) < 4 * math.sqrt(0.21 / running.size)


def test_a_robot_that_is_lost_is_tracked_at_its_last_velocity_for_so_many_steps():
    worlds = wide(200, position_loss=0.5, track_steps=2)
    plain = wide(200, position_loss=0.5)
    unknown, followed = [], 0
    for _ in range(20):
        before, lost = sensed(worlds), np.isnan(plain.sensed.pos_x)
        for batch in (worlds, plain):
            batch.step(np.zeros(200, np.int64))
        now, known = sensed(worlds), others(worlds)
        unknown.append(np.isnan(now[..., 0])[known])
        gone = np.isnan(plain.sensed.pos_x) & ~lost & known  # sensed in the last step, not in this one
        expected = before[gone]
        expected[:, :2] += expected[:, 2:] * worlds.config.time_step_s
        np.testing.assert_allclose(now[gone], expected, atol=1e-6)
        seen = ~np.isnan(plain.sensed.pos_x)
        np.testing.assert_array_equal(now[seen], sensed(plain)[seen])
        followed += gone.sum()
    share = np.concatenate(unknown[3:])
    assert followed > 1000 and abs(share.mean() - 0.125) < 0.01, "lost three times in a row"


def test_bursts_have_their_share_and_their_mean_length():
    worlds = wide(300, burst_loss=0.25, burst_steps=8.0, swarm_knows_learner="yes", method="in")
    lost = []
    for _ in range(60):
        lost.append(np.isnan(worlds.sensed.pos_x)[others(worlds)])
        worlds.state.steps[:] += 1  # the channel's steps, without the swarm's
        worlds._senses.sense(np.ones(300, np.bool_))
    lost = np.stack(lost)  # [steps, robots]
    # variance of a share in a stationary chain of two states with the correlation 1 - 1/8 - 1/24 a step
    rho = 1 - 1 / 8 - 0.25 / 0.75 / 8
    assert abs(lost.mean() - 0.25) < 4 * math.sqrt(0.1875 / lost.size * (1 + rho) / (1 - rho))
    assert abs(lost[0].mean() - 0.25) < 4 * math.sqrt(0.1875 / lost[0].size)  # from the first step on
    assert abs(lost[-1].mean() - 0.25) < 4 * math.sqrt(0.1875 / lost[0].size)
    ends = lost[:-1] & ~lost[1:]
    share = ends.sum() / lost[:-1].sum()
    assert abs(share - 1 / 8) < 4 * math.sqrt(1 / 8 * 7 / 8 / lost[:-1].sum())


def test_noise_has_its_variance_and_no_bias_and_is_independent():
    worlds = wide(400, position_noise_m=0.2)
    error = np.stack([worlds.sensed.pos_x - worlds.state.pos_x, worlds.sensed.pos_y - worlds.state.pos_y])
    error = error[:, others(worlds)] / 0.2
    count = error.shape[1]
    assert (np.abs(error.mean(axis=1)) < 4 / math.sqrt(count)).all()
    assert (np.abs(error.var(axis=1) - 1) < 4 * math.sqrt(2 / count)).all()
    assert abs(np.corrcoef(error)[0, 1]) < 4 / math.sqrt(count)
    assert not (worlds.sensed.vel_x - worlds.state.vel_x).any()


@kernel
def _normal(stream, x, y):
    add_normal(stream, 3, 5, np.float32(1), x, y)


def test_normal_numbers_are_those_of_box_and_muller():
    x, y = np.zeros((2, 50_000), np.float32)
    _normal(np.uint64(2**63 + 5), x, y)
    expected = np.array([normal_pair(2**63 + 5, 3 + 5 * i) for i in range(len(x))])
    np.testing.assert_allclose(np.stack([x, y], axis=1), expected, atol=2e-6)


def test_normal_numbers_are_normal_and_independent():
    x, y = np.zeros((2, 1_000_000), np.float32)
    _normal(np.uint64(77), x, y)
    for found in (x, y):
        assert kstest(found, norm.cdf).pvalue > 0.001
        for beyond in (2.0, 3.0, 4.0):  # the tails, which the test before hardly sees
            expected = 2 * norm.sf(beyond)
            assert abs((np.abs(found) > beyond).mean() - expected) < 4 * math.sqrt(expected / len(found))
    for power in (1, 2):
        assert abs(np.corrcoef(x**power, y**power)[0, 1]) < 4 / math.sqrt(len(x))
        assert abs(np.corrcoef(x[1:] ** power, x[:-1] ** power)[0, 1]) < 4 / math.sqrt(len(x))


def test_positions_and_velocities_are_exactly_as_late_as_they_should_be():
    worlds = make(4, "out", position_delay_steps=4, speed_error=0.1)
    past = []
    for _ in range(12):
        state = worlds.state
        past.append(np.stack([state.pos_x, state.pos_y, state.vel_x, state.vel_y], axis=-1).copy())
        found, expected = sensed(worlds), past[max(0, len(past) - 5)].copy()
        rows = np.arange(4), state.learner
        expected[rows] = past[-1][rows]
        np.testing.assert_array_equal(found, expected)
        worlds.step(Pilot.FREE)


def test_mates_are_dropped_for_the_episode_all_alike():
    worlds = wide(600, dropped_mates=3)
    dropped = np.isnan(worlds.sensed.pos_x)
    assert (dropped.sum(axis=1) == 3).all() and not (dropped & ~mates(worlds)).any()
    count, total = (dropped[mates(worlds)].reshape(600, 9).sum(axis=0), 600 / 3)
    assert (np.abs(count - total) < 4 * math.sqrt(600 * 1 / 3 * 2 / 3)).all()
    worlds.step(np.zeros(600, np.int64))
    np.testing.assert_array_equal(np.isnan(worlds.sensed.pos_x), dropped)
    worlds.reset()
    assert not np.array_equal(np.isnan(worlds.sensed.pos_x), dropped)
    assert np.isnan(wide(5, dropped_mates=9).sensed.pos_x)[mates(wide(5))].all()


def test_the_view_is_around_the_direction_of_motion():
    worlds = wide(50, field_of_view_deg=120.0, method="in", apf_gain_m4_s=0.0)
    rows, learner = np.arange(50), worlds.state.learner
    for start, ahead in ((True, None), (False, heading_velocities(worlds.config, np.float64)[5])):
        if not start:
            worlds.step(np.full(50, 5))
        position = worlds.positions().astype(float)
        away = position - position[rows, learner][:, None]
        goal = worlds.goals()[rows, worlds.state.group[learner]] - position[rows, learner]
        facing = goal if start else np.broadcast_to(ahead, (50, 2))
        cos = (away * facing[:, None]).sum(-1) / np.linalg.norm(facing, axis=-1)[:, None]
        clear = np.abs(cos - 0.5 * np.linalg.norm(away, axis=-1)) > 1e-5
        seen = ~np.isnan(worlds.sensed.pos_x)
        expected = cos > 0.5 * np.linalg.norm(away, axis=-1)
        checked = others(worlds) & clear
        np.testing.assert_array_equal(seen[checked], expected[checked])
        assert 0.05 < seen[others(worlds)].mean() < 0.95


def test_a_mix_up_exchanges_robots_of_different_groups():
    worlds = wide(300, group_mix_up=0.05)
    position, found = worlds.positions(), sensed(worlds)[..., :2]
    moved = (found != position).any(axis=-1)
    assert not moved[np.arange(300), worlds.state.learner].any()
    for world in np.flatnonzero(moved.any(axis=1)):
        assert sorted(map(tuple, found[world])) == sorted(map(tuple, position[world]))
    expected = 2 * 0.05  # each exchange moves two robots; few robots are moved twice
    assert abs(moved[others(worlds)].mean() - expected) < 0.02
    alone = make(4, groups=1, group_mix_up=1.0)
    np.testing.assert_array_equal(sensed(alone)[..., :2], alone.positions())


def test_driving_errors_are_uniform_within_their_bounds():
    worlds = wide(2000, speed_error=0.4, heading_error_deg=30.0)
    worlds.step(np.zeros(2000, np.int64))
    rows, learner = np.arange(2000), worlds.state.learner
    velocity = worlds.state.vel_x[rows, learner] + 1j * worlds.state.vel_y[rows, learner]
    ratio = velocity / complex(*heading_velocities(worlds.config, np.float64)[0])
    for error, bound in ((np.abs(ratio) - 1, 0.4), (np.degrees(np.angle(ratio)), 30.0)):
        assert np.abs(error).max() <= bound * 1.00001 and np.abs(error).max() > 0.97 * bound
        assert abs(error.mean()) < 4 * bound / math.sqrt(3 * 2000)
        assert abs(error.std() - bound / math.sqrt(3)) < 0.02 * bound


def test_drawn_conditions_are_uniform_between_none_and_their_value():
    drawn = wide(1000, conditions="drawn", position_loss=0.8, position_delay_steps=3, dropped_mates=4)
    conditions = drawn.get_state()["senses_conditions"]
    assert conditions[:, 1].max() <= 0.8 and abs(conditions[:, 1].mean() - 0.4) < 4 * 0.8 / math.sqrt(12 * 1000)
    for column, values in ((3, 4), (4, 5)):
        counts = np.bincount(conditions[:, column].astype(int), minlength=values)
        assert len(counts) == values
        assert (np.abs(counts - 1000 / values) < 4 * math.sqrt(1000 / values)).all()
    assert abs(np.corrcoef(conditions[:, 1], conditions[:, 4])[0, 1]) < 4 / math.sqrt(1000)
    limited = wide(200, conditions="drawn", sensing_range_m=2.0, field_of_view_deg=90.0)
    conditions = limited.get_state()["senses_conditions"]
    assert (conditions[:, 5] >= 2.0).all() and conditions[:, 5].max() > 50.0
    assert (conditions[:, 6] <= math.cos(math.radians(45.0)) + 1e-12).all() and conditions[:, 6].min() < -0.99


def test_what_a_small_loss_hides_a_larger_one_hides_too_whatever_else_is_on():
    few, many = wide(50, position_loss=0.2), wide(50, position_loss=0.6, position_noise_m=0.1, dropped_mates=1)
    for _ in range(5):
        hidden, more = (np.isnan(worlds.sensed.pos_x) for worlds in (few, many))
        assert (more | ~hidden).all() and more.sum() > hidden.sum()
        few.step(np.zeros(50, np.int64)), many.step(np.zeros(50, np.int64))
        np.testing.assert_array_equal(few.positions(), many.positions())  # the swarm meets the same noise


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("counts", [True, False])
def test_a_robot_that_senses_nobody_knows_its_goal_alone(method, counts):
    worlds = make(4, method, position_loss=1.0, ellipse_counts_learner=counts, group_order="nearest")
    found = worlds.observation().astype(float)
    if method == "sensor":
        assert not found.any()
        return
    rows = found.reshape(4, 3, -1)
    itself = worlds.config.ellipse_smallest_half_axis_m * worlds.config.ellipse_scale_per_m if counts else 0.0
    np.testing.assert_allclose(rows[:, 0, :2], itself)  # the ellipse of the robot itself, or none
    np.testing.assert_array_equal(rows[:, 1:, :5], 0)
    assert np.abs(rows[:, :, 5:7]).min(axis=(1, 2)).max() > 0 and not rows[:, :, 7:].any()


def test_ellipses_are_those_of_the_robots_that_are_sensed():
    worlds = make(6, "in", position_loss=0.3, ellipse_scale_per_m=1.0)
    rows = worlds.observation().reshape(6, 3, -1)
    position, state = worlds.sensed_positions(), worlds.state
    for world in range(6):
        own = state.group[state.learner[world]]
        for place in range(3):
            robots = position[world, state.group == (own + place) % 3]
            itself = position[world, state.learner[world]]
            robots = robots[np.isfinite(robots).all(axis=1) & (robots != itself).any(axis=1)]
            if len(robots):
                np.testing.assert_allclose(rows[world, place, 2:4], robots.mean(axis=0) - itself, atol=1e-5)


@pytest.mark.parametrize("method", METHODS)
def test_fl_orca_that_senses_nobody_heads_for_its_goal(method):
    worlds = make(5, method, position_loss=1.0)
    for _ in range(10):
        worlds.step(Pilot.FREE)
    rows, learner = np.arange(5), worlds.state.learner
    velocity = np.stack([worlds.state.vel_x[rows, learner], worlds.state.vel_y[rows, learner]], axis=-1)
    goal = worlds.goals()[rows, worlds.state.group[learner]] - worlds.positions()[rows, learner]
    cos = (velocity * goal).sum(axis=-1) / np.linalg.norm(velocity, axis=-1) / np.linalg.norm(goal, axis=-1)
    assert (cos > 0.999).all()


@pytest.mark.parametrize("method", METHODS)
def test_a_saved_batch_goes_on_as_the_one_that_was_not_saved(method):
    fields = {**SENSES, **DRIVES, "conditions": "drawn", "history": 3, "shield": "orca", "horizon_steps": 60}
    worlds, restored = make(6, method, **fields), make(6, method, seed=99, **fields)
    for step in range(7):
        worlds.step(np.arange(6) * step % 8)
    np.testing.assert_array_equal(restored.set_state(worlds.get_state()), worlds.observation())
    assert_go_on_alike(worlds, restored, 30)


def test_a_mask_may_be_a_view_of_another_array():
    whole, every_second = make(4, position_loss=0.5), np.zeros(8, np.bool_)
    every_second[[0, 6]] = True  # of the view [::2]: worlds 0 and 3
    strided = make(4, position_loss=0.5)
    for worlds, mask in ((whole, every_second[::2].copy()), (strided, every_second[::2])):
        worlds.step(np.zeros(4, np.int64))
        worlds.reset(mask)
    np.testing.assert_array_equal(sensed(strided), sensed(whole))


@st.composite
def conditions(draw):
    """Some of all conditions, at some strength."""
    chosen = draw(st.sets(st.sampled_from([*SENSES, *DRIVES]), min_size=1))
    fields = {name: value for name, value in {**SENSES, **DRIVES}.items() if name in chosen}
    return fields | {
        "conditions": draw(st.sampled_from(["fixed", "drawn"])),
        "shield": draw(st.sampled_from(["none", "orca"])),
    }


@settings(max_examples=30, deadline=None, derandomize=True)
@given(fields=conditions(), method=st.sampled_from(METHODS), num_worlds=st.integers(2, 11), data=st.data())
def test_a_world_depends_neither_on_its_batch_nor_on_masks_nor_on_order(fields, method, num_worlds, data):
    config = WorldConfig(method=method, **{**WORLD, **fields})
    order = data.draw(st.permutations(range(num_worlds)))
    restarts = data.draw(st.lists(st.integers(0, num_worlds - 1), min_size=8, max_size=8))
    together, alone = WorldBatch(config, num_worlds), [WorldBatch(config, 1) for _ in range(num_worlds)]
    together.seed(order)
    for seed, world in enumerate(alone):
        world.seed([seed])
        world.reset()
    together.reset()
    for step, restarted in enumerate(restarts):
        seeds = np.array(order)
        mask = seeds == restarted
        together.reset(mask)
        alone[restarted].reset()
        together.step(seeds * (step + 1) % 8)
        for seed, world in enumerate(alone):
            world.step(np.array([seed * (step + 1) % 8]))
            place = order.index(seed)
            np.testing.assert_array_equal(sensed(together)[place], sensed(world)[0])
            np.testing.assert_array_equal(together.observation()[place], world.observation()[0])
            for name, value in world.get_state().items():
                np.testing.assert_array_equal(together.get_state()[name][place], value[0], err_msg=name)
