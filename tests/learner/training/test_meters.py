"""Means between two rows of metrics, against numbers computed by hand."""

import json

import numpy as np
import pytest

from actors.service.messages import BlockHeader, BlockReport, EpisodeStats
from learner.training import meters as meters_module
from learner.training.meters import Meters
from learner.update.learner_node import UpdateReport
from learner.update.stats import UpdateStats


def report(outcomes, returns, lengths, env_steps=100, staleness_updates=0, staleness_s=0.0, rate=0.5):
    header = BlockHeader(1, 0, 0, 0, 0, 0.0, rate, env_steps)
    episodes = EpisodeStats(np.array(outcomes, np.int8), np.array(lengths, np.int32), np.array(returns, np.float64))
    return BlockReport(header, episodes, env_steps, staleness_updates, staleness_s)


@pytest.fixture
def clock(monkeypatch):
    """A clock that stands still until it is moved."""
    now = [50.0]
    monkeypatch.setattr(meters_module.time, "perf_counter", lambda: now[0])
    return now


def filled():
    meters = Meters()
    meters.record_block(
        report([1, 2, 1], [4.0, -1.0, 3.0], [10, 20, 60], staleness_updates=3, staleness_s=0.5, rate=0.8)
    )
    meters.record_block(report([5], [-2.0], [30], staleness_updates=1, staleness_s=1.5, rate=0.7))
    meters.record_updates(UpdateReport(UpdateStats(1.0, 2.0, 3.0), 8, {"updates": 3.0, "waits": 0.5}), 8)
    meters.record_updates(UpdateReport(UpdateStats(2.0, 4.0, 6.0), 16, {"updates": 4.0, "samples": 0.5}), 8)
    return meters


def test_a_row_holds_means_over_episodes_blocks_and_calls():
    row = filled().row(1234, 3.5)
    expected = {
        "train/epsilon": 0.7,
        "train/return": 1.0,
        "train/episode_length": 30.0,
        "train/success_rate": 0.5,
        "train/loss": 1.5,
        "train/q_mean": 3.0,
        "train/td_error": 4.5,
        "policy/staleness_updates": 2.0,
        "policy/staleness_s": 1.0,
        "replay/size": 1234.0,
        "replay/samples_per_insert": 3.5,
        "time/learner_updates": 7 / 8,
        "time/learner_samples": 0.5 / 8,
        "time/learner_publishes": 0.0,
        "time/learner_stores": 0.0,
        "time/learner_waits": 0.5 / 8,
    }
    assert expected.items() <= row.items()
    rest = {name for name in row if name not in expected}
    assert rest == {
        "speed/env_steps_per_s",
        "speed/updates_per_s",
        "system/cpu_utilization_percentage",
        "system/system_memory_usage_percentage",
    }


def test_shares_of_time_are_over_all_workers_together():
    meters = Meters()
    meters.record_block(report([], [], [])._replace(seconds={"acts": 3.0, "waits": 1.0}))
    meters.record_block(report([], [], [])._replace(seconds={"acts": 1.0, "stores": 3.0}))
    meters.record_block(report([], [], []))  # a block without times of its own: another report has them
    row = meters.row(0, 0.0)
    assert {name: share for name, share in row.items() if name.startswith("time/")} == {
        "time/worker_acts": 0.5,
        "time/worker_stores": 0.375,
        "time/worker_waits": 0.125,
    }


def test_means_are_over_episodes_not_blocks():
    meters = Meters()
    meters.record_block(report([1], [1.0], [1]))
    meters.record_block(report([2, 2, 2], [0.0] * 3, [1] * 3))
    assert meters.row(0, 0.0)["train/success_rate"] == 0.25


def test_the_next_row_starts_from_zero_and_omits_what_was_not_measured(clock):
    meters = filled()
    clock[0] += 10
    meters.row(0, 1.0)
    clock[0] += 10
    row = meters.row(0, 1.0)
    assert not {"train/return", "train/success_rate", "train/loss", "policy/staleness_s"} & row.keys()
    assert row["speed/env_steps_per_s"] == row["speed/updates_per_s"] == 0
    assert row["train/epsilon"] == 0.7


def test_no_success_rate_without_outcomes():
    meters = Meters()
    meters.record_block(report([-1, -1], [3.0, 5.0], [1, 1]))
    row = meters.row(0, 0.0)
    assert row["train/return"] == 4.0 and "train/success_rate" not in row


def test_speeds_are_measured_from_the_last_row_or_the_start_of_the_clock(clock):
    meters = filled()
    clock[0] += 1000  # set-up
    meters.start_clock()
    clock[0] += 4
    row = meters.row(0, 0.0)
    assert (row["speed/env_steps_per_s"], row["speed/updates_per_s"]) == (50.0, 4.0)
    meters.record_block(report([], [], [], env_steps=30))
    clock[0] += 2
    assert meters.row(0, 0.0)["speed/env_steps_per_s"] == 15.0


def test_a_restored_state_gives_the_same_means_but_not_the_same_speeds(clock):
    meters = filled()
    state = json.loads(json.dumps(meters.get_state()))
    resumed = Meters()
    resumed.set_state(state)
    for one in (meters, resumed):
        one.record_block(report([1, 1], [9.0, 8.0], [7, 6], rate=0.1))
    clock[0] += 1
    first, second = meters.row(5, 2.0), resumed.row(5, 2.0)
    changing = {name for name in first if name.startswith(("speed/", "system/"))}
    assert {k: v for k, v in first.items() if k not in changing} == {
        k: v for k, v in second.items() if k not in changing
    }
    assert second["speed/env_steps_per_s"] == 100.0  # the time before the crash does not count


def test_a_saved_state_does_not_change_with_the_meters():
    meters = filled()
    state = meters.get_state()
    kept = json.dumps(state)
    meters.record_block(report([1], [9.0], [7]))
    assert json.dumps(state) == kept
