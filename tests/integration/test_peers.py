"""The benchmark against peers: its watch, and that contenders do the work that is set."""

import dataclasses

import numpy as np
import pytest
import torch
from rich.console import Console
from stable_baselines3.common.env_util import make_vec_env

from actors.policy.network import QNetwork
from actors.policy.policy import Policy
from actors.rollout.vector_env import env_shape, make_vector_env
from learner.config import RunConfig
from tests.benchmarks import contest, entrants, peers
from tests.benchmarks.contenders.sb3 import Vectorised
from tests.benchmarks.contest import Finding, Heat, Lap, float_env, heat_of, policy_of, rhythm, target_every_env_steps
from tests.benchmarks.service import most_updates

CARTPOLE = entrants.contests()["cartpole"].config


class Clock:
    def __init__(self):
        self.now_s = 100.0

    def __call__(self):
        return self.now_s


@pytest.fixture
def clock(monkeypatch):
    clock = Clock()
    monkeypatch.setattr(contest.time, "perf_counter", clock)
    return clock


def heat(threshold=None, **changes):
    config = dataclasses.replace(RunConfig(), eval_every_env_steps=1000, eval_episodes=4, **changes)
    return Heat(config, 8, 1, 10.0, threshold)


def test_rates_are_counted_from_after_the_warm_up_and_for_the_time_asked(clock):
    lap = Lap(heat())
    env_steps = updates = 0
    for second in range(100):
        clock.now_s += 1
        env_steps += 1000 if second < 20 else 50
        updates += 0 if second < 5 else 10
        if lap.over(env_steps, updates):
            break
    assert second == 5 + contest.WARM_S + 10  # the first update, then the warm-up
    found = lap.finding()
    assert (found.env_steps_per_s, found.updates_per_s, found.to_threshold_s) == (1000, 10, None)


def test_the_watch_stands_still_while_the_judge_plays(clock, monkeypatch):
    scores = iter([0.2, 0.9])

    def play(spec, weights, seeds):
        clock.now_s += 50
        return next(scores)

    monkeypatch.setattr(contest, "evaluate", play)
    monkeypatch.setattr(contest, "summarise", lambda stats: stats)
    monkeypatch.setattr(contest, "score", lambda evaluation: evaluation)
    lap = Lap(heat(threshold=0.85))
    for step in range(1, 5):
        clock.now_s += 1
        assert lap.over(step * 500, step, list) == (step == 4)  # judged at 1,000 and 2,000 env steps
    found = lap.finding()
    assert found.to_threshold_s == 4.0 and found.score == 0.9


def test_the_judge_scores_the_network_that_it_is_given():
    torch.manual_seed(0)
    network = QNetwork(16, (32, 32), 8)
    weights = policy_of(network)
    observation = np.random.default_rng(0).normal(size=(5, 16)).astype(np.float32)
    expected = network(torch.from_numpy(observation)).detach().numpy()
    found = Policy(weights).values(observation)
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-5)
    lap = Lap(heat(threshold=2.0))
    assert not lap.over(1000, 1, lambda: weights)
    assert 0.0 <= lap.finding().score <= 1.0


@pytest.mark.parametrize("envs", [8, 16, 64, 256])
@pytest.mark.parametrize(("batch", "samples"), [(64, 8.0), (256, 2.0), (512, 8.0)])
def test_the_rhythm_keeps_the_samples_per_insert(envs, batch, samples):
    config = dataclasses.replace(RunConfig(), batch_size=batch, samples_per_insert=samples)
    beat = rhythm(config, envs)
    assert beat.updates * batch / (beat.vector_steps * envs) == samples


def test_the_target_period_in_env_steps_is_that_in_updates():
    config = dataclasses.replace(RunConfig(), batch_size=256, samples_per_insert=2.0, target_update_interval=500)
    assert target_every_env_steps(config) == 64_000


def test_a_heat_travels_as_json():
    sent = heat(threshold=0.5, hidden_sizes=(8, 8))
    assert heat_of(sent.to_json()) == sent


def test_the_vectorised_environment_does_as_stable_baselines3s_own():
    ours, theirs = Vectorised(make_vector_env(CARTPOLE.env, 3)), make_vec_env("CartPole-v1", 3, seed=5)
    ours.seed(5)
    np.testing.assert_array_equal(ours.reset(), theirs.reset())
    actions, ended = np.random.default_rng(0).integers(2, size=(120, 3)), 0
    for action in actions:
        found, expected = ours.step(action), theirs.step(action)
        for mine, other in zip(found[:3], expected[:3], strict=True):
            np.testing.assert_array_equal(mine, other)
        for mine, other in zip(found[3], expected[3], strict=True):
            assert ("terminal_observation" in mine) == ("terminal_observation" in other)
            if "terminal_observation" in mine:
                ended += 1
                np.testing.assert_array_equal(mine["terminal_observation"], other["terminal_observation"])
    assert ended >= 5
    ours.close()


def test_peers_get_the_world_that_is_set():
    spec = entrants.contests()["wide"].config.env
    shape = env_shape(spec).observation_space.shape
    assert float_env(spec).observation_space.shape == shape == (72,)


def test_the_limit_is_one_core_for_the_learner_and_all_cores_for_everything():
    config = dataclasses.replace(CARTPOLE, batch_size=100, samples_per_insert=10.0)  # ten env steps an update
    assert most_updates(config, env_steps_per_s=1e12, updates_per_s=50.0, cores=2) == 50.0
    assert most_updates(config, env_steps_per_s=100.0, updates_per_s=20.0, cores=2) == pytest.approx(2 / (0.1 + 0.05))


MADE = Finding(600.0, 1.0, 0.0, 2.0, 10, 0.9)
"""Of a training that reached the threshold after two seconds."""
SWARM = entrants.contests()["swarm"]


def entry_of(name, kind=""):
    return entrants.Entry(name, entrants.Contender("x"), entrants.Style(1, 1, kind))


def test_the_last_table_has_what_ours_is_to_each():
    ours, other = entry_of("shoal"), entry_of("other")
    slower = [MADE._replace(env_steps_per_s=rate, to_threshold_s=time_s) for rate, time_s in ((300, 4.0), (100, None))]
    found = {ours: [MADE, MADE], other: slower}
    players = [peers.Soonest(entry, entry) for entry in found]
    assert peers.rate_ratios(SWARM, found)["other"] == "4.00 (2.00 … 6.00)"
    assert peers.time_ratios(SWARM, players, found, 20.0)[0]["other"] == "≥ 6.00 (2.00 … 10.00)"
    found[ours][0] = MADE._replace(to_threshold_s=None)
    assert "other" not in peers.time_ratios(SWARM, players, found, 20.0)[0]


def test_times_with_the_start_up_are_those_of_the_style_that_is_soonest_from_its_start():
    quick, light, other = entry_of("shoal"), entry_of("shoal", entrants.ONE_PROCESS), entry_of("other")
    found = {
        quick: [MADE._replace(start_up_s=8.0)],
        light: [MADE._replace(to_threshold_s=4.0, start_up_s=1.0)],
        other: [MADE._replace(to_threshold_s=16.0, start_up_s=4.0)],
    }
    alone, whole = peers.time_ratios(SWARM, [peers.Soonest(quick, light), peers.Soonest(other, other)], found, 20.0)
    assert (alone["other"], whole["other"]) == ("8.00 (8.00 … 8.00)", "4.00 (4.00 … 4.00)")
    assert whole[""] == f"{alone['']}, with start-up"


def test_a_contender_chooses_a_style_for_each_time(monkeypatch):
    spent = {("", 64): (2.0, 8.0), (entrants.ONE_PROCESS, 64): (3.0, 1.0)}

    def run(entry, config, seconds, threshold):
        wait_s, start_up_s = spent.get((entry.style.variant, entry.style.envs), (9.0, 9.0))
        return MADE._replace(to_threshold_s=wait_s, start_up_s=start_up_s)

    monkeypatch.setattr(entrants.Entry, "run", run)
    found = peers.soonest("shoal", entrants.Contender("shoal"), SWARM, 20.0, Console(quiet=True))
    assert (found.trained.style.variant, found.started.style.variant) == ("", entrants.ONE_PROCESS)


@pytest.mark.ray
@pytest.mark.slow
@pytest.mark.parametrize(
    ("module", "variant"), [("shoal", ""), ("shoal", entrants.ONE_PROCESS), ("sb3", ""), ("limit", "")]
)
def test_contenders_draw_as_many_samples_per_insert_as_they_are_told(module, variant):
    contender = entrants.Contender(module)
    found = entrants.run_heat(contender, Heat(CARTPOLE, 16, 1, 2.0, None, variant))
    drawn = found.updates_per_s * CARTPOLE.batch_size / found.env_steps_per_s
    assert drawn == pytest.approx(CARTPOLE.samples_per_insert, rel=0.25)
    assert found.start_up_s > 0 or module == "limit"


def test_a_contender_that_fails_says_why():
    with pytest.raises(RuntimeError, match=r"(?s)sb3 failed: .*Environment `nothing` doesn't exist"):
        entrants.run_heat(
            entrants.Contender("sb3"), Heat(dataclasses.replace(CARTPOLE, env_id="nothing-v0"), 1, 1, 1.0, None)
        )
