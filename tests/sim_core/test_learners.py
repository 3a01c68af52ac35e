"""Several learning robots a world: who learns, what each of them meets, when episodes and worlds end."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from sim_core.checks import ConfigError
from sim_core.config import WorldConfig
from sim_core.outcomes import Outcome
from sim_core.pilot import Pilot
from sim_core.worlds import WorldBatch, is_done
from tests.sim_core.segregation import segregated_fraction

EXAMPLES = Path(__file__).parents[2] / "deploy" / "examples"
SMALL = {"robots": 5, "groups": 2, "arena_radius_m": 2.0, "horizon_steps": 120}
SEEDS = list(range(70, 76))
METHODS = ("sensor", "in", "out")


def batch(seeds=SEEDS, **settings):
    """A freshly reset batch of one world a seed, in a small arena so that groups meet soon."""
    worlds = WorldBatch(WorldConfig(**(SMALL | settings)), len(seeds))
    worlds.seed(seeds)
    worlds.reset()
    return worlds


def learners_of(worlds):
    """Learning robots `[num_worlds, learners]`."""
    return worlds.state.learner.reshape(worlds.num_worlds, -1)


@pytest.mark.parametrize(
    ("learners", "counts"), [("one", ()), (2, (2, 2)), (0.25, (1, 1)), ("0.5", (3, 3)), (1.0, (5, 5)), (".3", (2, 2))]
)
def test_a_count_or_a_share_of_every_group_learns(learners, counts):
    config = WorldConfig(**SMALL, learners=learners)
    assert config.learner_counts == counts and config.num_learners == (sum(counts) or 1)
    robots = learners_of(batch(list(range(40)), learners=learners))
    assert (np.diff(robots, axis=1) > 0).all()  # in ascending order, none twice
    if counts:
        for group, count in enumerate(counts):
            assert ((robots // 5 == group).sum(axis=1) == count).all()
        assert len(np.unique(robots)) == 10  # each robot learns somewhere


@pytest.mark.parametrize("learners", [0, -1, 6, "all", "1e-3", 0.0, 1.5, "50%", True, None])
def test_impossible_learners_are_refused_in_one_sentence(learners):
    with pytest.raises(ConfigError, match=r"^learners must be [^\n]*(not|string)[^\n]*$"):
        WorldConfig(**SMALL, learners=learners)


def test_robots_cannot_leave_a_world_that_is_sorted_into_a_grid():
    with pytest.raises(ConfigError, match="ended_learners must be fl-orca in worlds of more than 299 robots"):
        WorldConfig(robots=150, groups=2, arena_radius_m=20.0, learners=2, ended_learners="leave")


@pytest.mark.parametrize("method", METHODS)
def test_worlds_start_alike_whatever_learns_and_fewer_learners_are_among_more(method):
    chosen = {learners: batch(method=method, learners=learners) for learners in ("one", "1", "0.5", "1.0")}
    robots = {learners: [set(row) for row in learners_of(worlds).tolist()] for learners, worlds in chosen.items()}
    for fewer, more in (("one", "1"), ("1", "0.5"), ("0.5", "1.0")):
        assert all(a < b for a, b in zip(robots[fewer], robots[more], strict=True))
        np.testing.assert_array_equal(chosen[fewer].positions(), chosen[more].positions())


@pytest.mark.parametrize("method", METHODS)
def test_each_learning_robot_observes_and_ends_as_if_it_alone_learned(method):
    """Until an episode ends, a world in which all robots learn is, for each of them, one in which it alone does."""
    together = batch([5], method=method, learners=1.0, swarm_knows_learner="yes")
    rng = np.random.default_rng(1)
    for _ in range(25):
        before = together.get_state()
        result = together.step(rng.integers(0, 8, 10))
        after = together.state
        for row in range(10):
            alone = batch([5], method=method, swarm_knows_learner="yes")
            state = alone.get_state()
            for name in ("pos_x", "pos_y", "vel_x", "vel_y", "steps"):
                state[name] = getattr(after, name).copy()
            state |= {"learner": np.array([row], np.int32), "steps": before["steps"]}
            state |= {name: before[name][row : row + 1] for name in ("outside_steps", "goal_distance_m")}
            alone.set_state(state)
            alone.state.steps[:] = after.steps
            mask, outcome, reward = np.ones(1, np.bool_), np.zeros(1, np.int8), np.zeros(1, np.float32)
            alone.method.outcome(alone.state, mask, outcome)
            alone.method.reward(alone.state, mask, outcome, reward)
            observation = np.zeros_like(alone.observation())
            alone.method.perceive(alone.state, mask, observation)
            np.testing.assert_array_equal(observation[0], result.observation[row])
            assert outcome[0] == result.outcome[row] and reward[0] == result.reward[row]
        if is_done(result.outcome).any():
            break
    assert together.state.steps[0] >= 5


@pytest.mark.parametrize("ended", ["fl-orca", "leave"])
@pytest.mark.parametrize("method", METHODS)
def test_permuting_learners_permutes_results(method, ended):
    settings = {"method": method, "learners": 1.0, "ended_learners": ended, "decision_interval_steps": 2}
    settings |= {"outside_limit_steps": 5}
    first, second = batch(**settings), batch(**settings)
    order = np.concatenate([np.random.default_rng(world).permutation(10) + 10 * world for world in range(6)])
    for name in ("learner", "goal_distance_m"):
        getattr(second.state, name)[:] = getattr(first.state, name)[order]
    waiting = 0
    for action in np.random.default_rng(2).integers(0, 8, (60, 60)):
        one, other = first.step(action), second.step(action[order])
        for name, array in one._asdict().items():
            np.testing.assert_array_equal(array[order], getattr(other, name), err_msg=name)
        np.testing.assert_array_equal(first.positions(), second.positions())
        waiting += (~one.decided).sum()
    assert waiting > 100


@pytest.mark.parametrize("method", METHODS)
def test_a_batch_equals_its_worlds_one_by_one(method):
    together = batch(method=method, learners=0.5)
    alone = [batch([seed], method=method, learners=0.5) for seed in SEEDS]
    for action in np.random.default_rng(3).integers(0, 8, (70, 36)):
        result, done = together.step(action), together.ended_worlds()
        for i, worlds in enumerate(alone):
            rows = slice(6 * i, 6 * (i + 1))
            for name, array in worlds.step(action[rows])._asdict().items():
                np.testing.assert_array_equal(array, getattr(result, name)[rows], err_msg=name)
            assert worlds.ended_worlds()[0] == done[i]
            if done[i]:
                worlds.reset()
        if done.any():
            together.reset(done)
    np.testing.assert_array_equal(together.positions(), np.concatenate([worlds.positions() for worlds in alone]))


@pytest.mark.parametrize("history", [1, 2])
def test_an_ended_robot_waits_as_it_ended_and_fl_orca_drives_it(history):
    worlds, plan = batch(learners=1.0, history=history), np.random.default_rng(4).integers(0, 8, (200, 60))
    known = {}  # what was told of rows when they ended
    waited = 0
    for action in plan:
        was_over = is_done(worlds.outcome)
        state = worlds.get_state()
        result = worlds.step(action)
        np.testing.assert_array_equal(result.decided, ~was_over)
        for row in np.flatnonzero(was_over):
            for name in ("observation", "outcome", "steps", "episode_return"):
                np.testing.assert_array_equal(getattr(result, name)[row], known[row][name])
            assert result.reward[row] == 0
        waited += was_over.sum()
        other = batch(learners=1.0, history=history)  # the actions of those that wait do not count
        other.set_state(state)
        other.step(np.where(was_over, 0, action))
        np.testing.assert_array_equal(other.positions(), worlds.positions())
        for row in np.flatnonzero(is_done(result.outcome)):
            known.setdefault(row, {name: array[row] for name, array in result._asdict().items()})
        done = worlds.ended_worlds()
        for row in np.flatnonzero(np.repeat(done, 10)):
            known.pop(row, None)
        if done.any():
            worlds.reset(done)
            assert not is_done(worlds.outcome[np.repeat(done, 10)]).any()
    assert waited > 100


def test_a_world_that_has_ended_and_is_not_restarted_stays_as_it_ended():
    worlds = batch(learners=1.0, horizon_steps=7)
    while not worlds.ended_worlds().all():
        last = worlds.step(np.zeros(60, np.int64))
    state, again = worlds.get_state(), worlds.step(np.ones(60, np.int64))
    assert not again.decided.any() and not again.reward.any()
    np.testing.assert_array_equal(again.outcome, last.outcome)
    for name, array in worlds.get_state().items():
        np.testing.assert_array_equal(array, state[name], err_msg=name)


def test_the_horizon_ends_the_episodes_that_still_run():
    worlds = batch(learners=1.0, horizon_steps=7, stop_action=True)
    for _ in range(7):
        result = worlds.step(np.full(60, 8))
    assert (result.outcome == Outcome.TIMEOUT).all() and worlds.ended_worlds().all()


def test_robots_that_leave_are_nowhere_and_nobody_meets_them():
    """A robot at NaN is to the others as one that is far away, and does not count in its group's distance."""
    settings = {"learners": 1.0, "ended_learners": "leave", "separation_noise": 0.0}
    gone, far = batch(**settings), batch(**settings)
    for worlds, place in ((gone, np.nan), (far, 1e3)):
        worlds.outcome[[3, 17]] = int(Outcome.LOST)
        worlds.state.pos_x[0, 3] = worlds.state.pos_x[1, 7] = place
        worlds.state.pos_y[0, 3] = worlds.state.pos_y[1, 7] = place
    others = np.ones((6, 10), np.bool_)
    others[0, 3] = others[1, 7] = False
    action = np.random.default_rng(5).integers(0, 8, 60)
    far.config = dataclasses.replace(far.config, ended_learners="fl-orca")
    one, other = gone.step(action), far.step(action)
    np.testing.assert_array_equal(gone.positions()[others], far.positions()[others])
    np.testing.assert_array_equal(one.observation[others.ravel()], other.observation[others.ravel()])
    assert np.isnan(gone.positions()[~others]).all()
    while not gone.ended_worlds().all():  # the rest goes on to its end
        gone.step(np.random.default_rng(6).integers(0, 8, 60))
    assert gone.state.steps.max() <= SMALL["horizon_steps"]


def test_a_robot_leaves_in_the_step_after_its_end():
    worlds = batch(learners=1.0, ended_learners="leave")
    for action in np.random.default_rng(7).integers(0, 8, (100, 60)):
        was_over = is_done(worlds.outcome)
        worlds.step(action)
        gone = np.isnan(worlds.positions()[..., 0]).ravel()
        goes_on = np.repeat(~worlds.ended_worlds(), 10)
        np.testing.assert_array_equal(gone[goes_on], was_over[goes_on])
        if worlds.ended_worlds().any():
            worlds.reset(worlds.ended_worlds())
        if gone.any():
            return
    raise AssertionError("nobody left")


@pytest.mark.parametrize("method", METHODS)
def test_a_saved_batch_goes_on_bit_for_bit(method):
    settings = {"method": method, "learners": 0.5, "position_noise_m": 0.02, "history": 2}
    worlds, plan = batch(**settings), np.random.default_rng(8).integers(0, 8, (80, 36))
    for action in plan[:40]:
        worlds.step(action)
        if worlds.ended_worlds().any():
            worlds.reset(worlds.ended_worlds())
    other = batch([0] * 6, **settings)
    other.set_state(worlds.get_state())
    chosen = worlds.alone(np.arange(6) % 2 == 0)
    for action in plan[40:]:
        one, same = worlds.step(action), other.step(action)
        part = chosen.step(action[np.repeat(np.arange(6) % 2 == 0, 6)])
        rows = one.decided
        np.testing.assert_array_equal(one.observation[rows], same.observation[rows])
        for name in ("reward", "outcome", "episode_return", "decided"):
            np.testing.assert_array_equal(getattr(one, name), getattr(same, name), err_msg=name)
            np.testing.assert_array_equal(getattr(one, name)[np.repeat(np.arange(6) % 2 == 0, 6)], getattr(part, name))
        if worlds.ended_worlds().all():
            break


def test_learning_robots_sense_each_with_noise_of_its_own():
    worlds = batch(learners=1.0, position_noise_m=0.05, burst_loss=0.1, command_delay_steps=1, shield="orca")
    error = worlds.sensed_positions() - np.repeat(worlds.positions(), 10, axis=0)
    own = np.zeros((60, 10), np.bool_)
    own[np.arange(60), worlds.state.learner] = True
    assert (error[own] == 0).all()
    known = error[~own & np.isfinite(error[..., 0])]
    assert len(np.unique(known.round(7))) > 0.9 * known.size  # no two robots share their errors
    assert 0.04 < known.std() < 0.06
    for action in np.random.default_rng(9).integers(0, 8, (10, 60)):
        worlds.step(action)
    assert np.isfinite(worlds.asked).all()


def test_one_of_several_senses_as_one_alone_would(monkeypatch):
    """What a row senses is what the senses of a single learning robot give for the same world and stream."""
    several = batch([3], learners=1.0, position_noise_m=0.05)
    single = batch([3], position_noise_m=0.05)
    for row in range(10):
        state = single.get_state()
        state["learner"] = np.array([row], np.int32)
        single.set_state(state)
        single.state.rng[:] = several._view.state.rng[row]
        single._senses.begin(np.ones(1, np.bool_))
        np.testing.assert_array_equal(single.sensed_positions()[0], several.sensed_positions()[row])


@pytest.mark.parametrize("ended", ["fl-orca", "leave"])
def test_a_method_of_a_users_own_knows_one_learning_robot_and_serves_several(ended):
    """The example in plain numpy gives what its twin with a kernel gives, and what it gives a robot alone."""
    examples = {"compass.py": "Compass", "compass_kernel.py": "FastCompass"}
    plain, fast = (
        batch(method=f"{EXAMPLES / file}:{name}", learners=1.0, ended_learners=ended) for file, name in examples.items()
    )
    alone = batch(method=f"{EXAMPLES / 'compass.py'}:Compass")
    row = np.flatnonzero(plain.state.learner[:10] == alone.state.learner[0])[0]
    np.testing.assert_array_equal(plain.observation()[row], alone.observation()[0])
    for action in np.random.default_rng(12).integers(0, 8, (60, 60)):
        one, other = plain.step(action), fast.step(action)
        np.testing.assert_allclose(one.observation, other.observation, atol=1e-5)
        np.testing.assert_array_equal(one.outcome, other.outcome)
        np.testing.assert_array_equal(one.reward, other.reward)
    assert (~one.decided).any()


def test_fl_orca_drives_several_learning_robots_as_the_swarm():
    free, swarm = batch(learners=1.0), batch(learners=1.0)
    for _ in range(10):
        free.step(Pilot.FREE)
        swarm.swarm_step()
    np.testing.assert_array_equal(free.positions(), swarm.positions())


@pytest.mark.parametrize("settings", [{}, {"shield": "orca"}])
def test_snapped_to_actions_each_takes_the_one_nearest_to_fl_orcas_velocity(settings):
    snapped, free = batch(learners=0.5, **settings), batch(learners=0.5)
    before = free.positions()
    chosen = snapped.actions_nearest_to_swarm()
    free.step(Pilot.FREE)
    wanted = (free.positions() - before)[np.arange(36) // 6, free.state.learner] / np.float32(0.05)
    error = np.linalg.norm(snapped.method.headings[None] - wanted[:, None], axis=-1)
    np.testing.assert_allclose(error[np.arange(36), chosen], error.min(axis=1), atol=1e-4)


@pytest.mark.parametrize("ended", ["fl-orca", "leave"])
def test_segregation_is_that_of_equation_3_1(ended):
    worlds = batch(learners=1.0, ended_learners=ended, groups=3, robots=4)
    for action in np.random.default_rng(10).integers(0, 8, (30, 72)):
        worlds.step(action)
        positions = worlds.positions()
        whole = np.isfinite(positions).all(axis=(1, 2))
        expected = segregated_fraction(positions[whole], 3)
        np.testing.assert_allclose(worlds.segregation()[whole], expected)
    gone = worlds.positions()[0].copy()
    gone[4:8] = np.nan  # a group that is gone leaves one pair
    worlds.state.pos_x[0], worlds.state.pos_y[0] = gone.T
    left = np.concatenate([gone[:4], gone[8:]])
    assert worlds.segregation()[0] == segregated_fraction(left, 2)


def test_collisions_with_learning_robots_are_told_from_others():
    worlds = batch([1], learners=2, swarm_knows_learner="no", groups=1, robots=4)
    state, (first, second) = worlds.state, worlds.state.learner
    other = next(robot for robot in range(4) if robot not in (first, second))
    contact_m = 2 * worlds.config.robot_radius_m

    def step(near):
        """Puts robot `first` beside the robot `near`, all of them at rest far from others."""
        worlds.reset()
        state.pos_x[0], state.pos_y[0] = np.arange(4) * 0.7, 0.0
        state.pos_x[0, first] = state.pos_x[0, near] + 0.3 * contact_m
        state.learner[:] = first, second
        worlds.step(Pilot.FREE)
        return worlds.outcome.tolist(), worlds.hit_learner.tolist()

    collision = int(Outcome.COLLISION)
    outcome, hit = step(second)
    assert outcome == [collision, collision] and hit == [True, True]
    outcome, hit = step(other)
    assert outcome[0] == collision and hit == [False, False]
