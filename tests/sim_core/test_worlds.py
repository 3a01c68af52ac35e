"""Batches of worlds: determinism, independence, who influences whom, checkpoints, and the swarm as a whole."""

import numpy as np
import pytest

from sim_core.config import WorldConfig
from sim_core.outcomes import Outcome
from sim_core.pilot import Pilot
from sim_core.worlds import WorldBatch, is_done, is_terminated

SEEDS = list(range(40, 48))
SETTINGS = {"robots": 5, "groups": 2, "arena_radius_m": 2.0}


def batch(seeds, **settings):
    """A freshly reset batch of one world a seed, in a small arena so that groups meet soon."""
    worlds = WorldBatch(WorldConfig(**(SETTINGS | settings)), len(seeds))
    worlds.seed(seeds)
    worlds.reset()
    return worlds


def actions(steps, num_worlds, seed=0):
    """Random actions `[steps, num_worlds]`."""
    return np.random.default_rng(seed).integers(0, 8, (steps, num_worlds))


def run(worlds, plan):
    """Steps through the plan; the results and the positions of every step."""
    return [(worlds.step(action), worlds.positions()) for action in plan]


def assert_same_state(first, second, rows=slice(None)):
    """All arrays of both batches are equal, bit for bit, in the worlds `rows`."""
    other = second.get_state()
    for name, array in first.get_state().items():
        np.testing.assert_array_equal(array[rows], other[name][rows], err_msg=name)


def test_same_seed_same_run():
    first, second, plan = batch(SEEDS), batch(SEEDS), actions(120, 8)
    for (a, _), (b, _) in zip(run(first, plan), run(second, plan), strict=True):
        for x, y in zip(a, b, strict=True):
            np.testing.assert_array_equal(x, y)
    assert_same_state(first, second)
    other = batch([seed + 100 for seed in SEEDS])
    assert not np.array_equal(other.state.pos_x, batch(SEEDS).state.pos_x)


@pytest.mark.parametrize("method", ["sensor", "in", "out"])
def test_a_batch_equals_its_worlds_one_by_one(method):
    together, plan = batch(SEEDS, method=method), actions(120, 8)
    results = run(together, plan)
    for i, seed in enumerate(SEEDS):
        alone = batch([seed], method=method)
        for (a, pos_a), (b, pos_b) in zip(results, run(alone, plan[:, i : i + 1]), strict=True):
            np.testing.assert_array_equal(pos_a[i], pos_b[0])
            for x, y in zip(a, b, strict=True):
                np.testing.assert_array_equal(x[i], y[0])
        for name, array in alone.get_state().items():
            np.testing.assert_array_equal(array[0], together.get_state()[name][i], err_msg=name)


def test_a_push_in_one_world_changes_no_other():
    first, second, plan = batch(SEEDS), batch(SEEDS), actions(60, 8)
    second.state.pos_x[3, 1] += np.float32(0.3)
    run(first, plan), run(second, plan)
    assert_same_state(first, second, [i for i in range(8) if i != 3])
    assert not np.array_equal(first.state.pos_x[3], second.state.pos_x[3])


@pytest.mark.parametrize("method", ["in", "out"])
def test_the_ellipse_methods_are_unknown_to_the_swarm(method):
    runs = []
    for seed in (1, 2):
        worlds = batch(SEEDS, method=method)
        path = np.array([pos for _, pos in run(worlds, actions(60, 8, seed))])
        keep = np.arange(10) != worlds.state.learner[:, None]
        runs.append((path[:, keep], path[:, ~keep]))
    np.testing.assert_array_equal(runs[0][0], runs[1][0])
    assert not np.array_equal(runs[0][1], runs[1][1])


@pytest.mark.parametrize("flocking", ["published", "uniform"])
@pytest.mark.parametrize("known", [False, True])
def test_the_swarm_reacts_to_the_learning_robot_only_if_it_knows_it(known, flocking):
    runs = []
    for seed in (1, 2, None):  # two random pilots, and FL-ORCA
        worlds = batch(SEEDS, swarm_knows_learner="yes" if known else "no", flocking=flocking)
        plan = [Pilot.FREE] * 120 if seed is None else actions(120, 8, seed)
        path = np.array([pos for _, pos in run(worlds, plan)])
        keep = np.arange(10) != worlds.state.learner[:, None]
        runs.append((path[:, keep], path[:, ~keep]))
    for swarm, pilot in runs[1:]:
        assert not np.array_equal(pilot, runs[0][1])
        assert np.array_equal(swarm, runs[0][0]) != known


def test_an_unknown_learning_robot_can_be_run_over():
    worlds = batch([7], swarm_knows_learner="no")
    learner = int(worlds.state.learner[0])
    mate = (learner + 1) % 5 + 5 * (learner // 5)
    worlds.state.pos_x[0, learner], worlds.state.pos_y[0, learner] = worlds.positions()[0, mate]
    result = worlds.step(np.array([0]))
    assert result.outcome[0] == Outcome.COLLISION
    assert np.isfinite(worlds.positions()).all()


def test_a_pilot_moves_the_learning_robot_by_its_heading():
    worlds = batch(SEEDS)
    rows, learner = np.arange(8), worlds.state.learner
    before = worlds.positions()[rows, learner]
    worlds.step(np.arange(8))
    alpha = np.pi / 8 + np.arange(8) * np.pi / 4 - np.pi  # Eq. 3.3
    expected = 0.05 * np.stack([np.cos(alpha), np.sin(alpha)], axis=1)
    np.testing.assert_allclose(worlds.positions()[rows, learner] - before, expected, atol=1e-6)


@pytest.mark.parametrize("method", ["sensor", "in", "out"])
def test_a_saved_batch_goes_on_bit_for_bit(method):
    first, plan = batch(SEEDS, method=method), actions(80, 8)
    run(first, plan[:40])
    second = WorldBatch(first.config, 8)
    second.set_state(first.get_state())
    for (a, _), (b, _) in zip(run(first, plan[40:]), run(second, plan[40:]), strict=True):
        for x, y in zip(a, b, strict=True):
            np.testing.assert_array_equal(x, y)
    np.testing.assert_array_equal(first.reset(), second.reset())  # the random streams too
    assert_same_state(first, second)


def test_saved_arrays_are_copies_and_give_back_the_observation():
    worlds = batch(SEEDS)
    observation = worlds.step(np.zeros(8, np.int64)).observation
    saved = worlds.get_state()
    run(worlds, actions(5, 8))
    np.testing.assert_array_equal(worlds.set_state(saved), observation)
    assert_same_state(worlds, worlds)
    for name, array in saved.items():
        np.testing.assert_array_equal(array, worlds.get_state()[name], err_msg=name)


@pytest.mark.parametrize("spoil", ["missing", "shape", "dtype"])
def test_a_state_that_does_not_fit_is_refused_whole(spoil):
    worlds = batch(SEEDS)
    before, saved = worlds.get_state(), batch([seed + 9 for seed in SEEDS]).get_state()
    if spoil == "missing":
        del saved["rng"]
    else:
        saved["rng"] = saved["rng"][:4] if spoil == "shape" else saved["rng"].astype(np.int64)
    with pytest.raises(ValueError, match="rng"):
        worlds.set_state(saved)
    for name, array in before.items():
        np.testing.assert_array_equal(array, worlds.get_state()[name], err_msg=name)


def test_results_and_observations_are_copies():
    worlds = batch(SEEDS)
    first = worlds.reset()
    kept = first.copy()
    result = worlds.step(np.zeros(8, np.int64))
    reward = result.reward.copy()
    run(worlds, actions(20, 8))
    np.testing.assert_array_equal(first, kept)
    np.testing.assert_array_equal(result.reward, reward)


def test_unseeded_worlds_differ_and_seeds_are_one_a_world():
    worlds = WorldBatch(WorldConfig(), 4)
    worlds.reset()
    assert len(np.unique(worlds.state.pos_x[:, 0])) == 4
    with pytest.raises(ValueError, match="seeds"):
        worlds.seed([1])


def test_actions_are_checked():
    worlds = batch(SEEDS)
    for action in (np.full(8, 8), np.full(8, -1), np.zeros(7, np.int64)):
        with pytest.raises(ValueError, match="action"):
            worlds.step(action)


def test_the_horizon_cuts_at_its_step_exactly():
    worlds = batch([1, 2], arena_radius_m=6.0, horizon_steps=7)
    for step in range(1, 8):
        result = worlds.step(Pilot.FREE)
        assert result.steps.tolist() == [step, step]
        expected = Outcome.TIMEOUT if step == 7 else Outcome.RUNNING
        assert result.outcome.tolist() == [expected] * 2
    assert is_done(result.outcome).all() and not is_terminated(result.outcome, False).any()
    assert is_terminated(result.outcome, True).all()


@pytest.mark.parametrize(
    ("method", "settings"),
    [
        ("sensor", {"sector_frame": "goal", "horizon_steps": 90}),
        ("in", {"outside_limit_steps": 3}),
        ("out", {"outside_limit_steps": 3, "learner_speed_limit_m_s": 1.5}),
    ],
)
@pytest.mark.parametrize("interval", [4, 7])
def test_a_decision_is_so_many_steps_with_one_action(method, settings, interval):
    count, decisions = 48, 120 // interval
    settings = settings | {"method": method}
    chosen = actions(decisions, count)
    slow, fast = batch(range(count), **settings, decision_interval_steps=interval), batch(range(count), **settings)
    ended = np.zeros(count, np.bool_)
    for action in chosen:
        watched = []
        result = slow.step(action, lambda seen=watched: seen.append(slow.positions()))
        reward, over, last = np.zeros(count, np.float32), ended.copy(), {}
        for inner in range(interval):
            step = fast.step(action)
            reward[~over] += step.reward[~over]
            for world in np.flatnonzero(is_done(step.outcome) & ~over):
                last[world] = (step, {name: array[world].copy() for name, array in fast.get_state().items()})
            if inner < len(watched):
                np.testing.assert_array_equal(watched[inner][~over], fast.positions()[~over])
            over |= is_done(step.outcome)
        now = fast.get_state()
        for world in np.flatnonzero(~ended):
            end, state = last.get(world, (step, {name: array[world] for name, array in now.items()}))
            assert result.outcome[world] == end.outcome[world] and result.reward[world] == reward[world]
            assert result.steps[world] == end.steps[world] and result.episode_return[world] == end.episode_return[world]
            np.testing.assert_array_equal(result.observation[world], end.observation[world])
            for name, array in slow.get_state().items():
                np.testing.assert_array_equal(array[world], state[name], err_msg=name)
        ended = over
    assert ended.sum() > 5 and (slow.state.steps[ended] % interval).any()


@pytest.mark.parametrize(("method", "columns"), [("sensor", 16), ("in", 9), ("out", 7)])
def test_a_history_holds_the_last_observations_the_newest_first(method, columns):
    settings = {"method": method, "horizon_steps": 40, "groups": 3}
    plain, seeing = batch(SEEDS, **settings), batch(SEEDS, **settings, history=3)
    frames = [plain.observation()] * 3

    def stacked():
        rows = [frame.reshape(8, -1, columns) for frame in reversed(frames[-3:])]
        return np.concatenate(rows, axis=2).reshape(8, -1)

    np.testing.assert_array_equal(seeing.observation(), stacked())
    ended = 0
    for action in actions(100, 8, seed=4):
        result, expected = seeing.step(action), plain.step(action)
        frames.append(expected.observation)
        np.testing.assert_array_equal(result.observation, stacked())
        done = is_done(result.outcome)
        if done.any():
            first = plain.reset(done)
            for frame in frames[-3:]:
                frame[done] = first[done]
            np.testing.assert_array_equal(seeing.reset(done), stacked())
            saved, ended = seeing.get_state(), ended + 1
    assert ended > 1
    other = batch(SEEDS, **settings, history=3)
    np.testing.assert_array_equal(other.set_state(seeing.get_state()), seeing.observation())
    assert "history" in saved and "history" not in plain.get_state()


def test_what_is_terminal():
    every = np.array(list(Outcome), np.int8)
    names = {Outcome.GOAL, Outcome.LOST, Outcome.CAPTURED, Outcome.COLLISION}
    assert {Outcome(o) for o in every[is_terminated(every, False)]} == names
    assert {Outcome(o) for o in every[is_terminated(every, True)]} == names | {Outcome.TIMEOUT}


def test_returns_add_up_and_restart():
    worlds, total = batch(SEEDS), np.zeros(8)
    for result, _ in run(worlds, actions(15, 8)):
        total += result.reward
        np.testing.assert_allclose(result.episode_return, total, rtol=1e-5)
    worlds.reset()
    result = worlds.step(Pilot.FREE)
    np.testing.assert_allclose(result.episode_return, result.reward)


@pytest.mark.parametrize("flocking", ["published", "uniform"])
def test_the_swarm_alone_arrives_and_never_collides(flocking):
    num_worlds = 64
    worlds = WorldBatch(WorldConfig(robots=10, groups=2, flocking=flocking), num_worlds)
    worlds.seed(list(range(num_worlds)))
    worlds.reset()
    nearest_m, outcome = np.inf, np.zeros(num_worlds, np.int8)
    pairs = np.triu_indices(20, 1)
    for _ in range(worlds.config.horizon_steps):
        result = worlds.step(Pilot.FREE)
        running = outcome == Outcome.RUNNING
        outcome[running] = result.outcome[running]
        pos = worlds.positions()
        nearest_m = min(nearest_m, np.linalg.norm(pos[:, pairs[0]] - pos[:, pairs[1]], axis=-1).min())
        assert np.hypot(worlds.state.vel_x, worlds.state.vel_y).max() < worlds.config.max_speed_m_s + 1e-4
    assert nearest_m > 2 * worlds.config.robot_radius_m
    assert (outcome == Outcome.GOAL).mean() > 0.9, np.bincount(outcome, minlength=6)
