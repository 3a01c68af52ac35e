"""The parts of a run take their settings from its config."""

import dataclasses

import pytest

from actors.replay.prioritised import PrioritySettings
from actors.rollout.vector_env import env_shape
from learner.training.cluster import ProcessCluster, learner_settings, rollout_settings, shard_settings


def test_settings_are_those_of_the_config(small_run):
    shape = env_shape(small_run.env)
    learner = learner_settings(small_run, shape)
    assert (learner.observation_size, learner.num_actions, learner.hidden_sizes) == (8, 4, (8,))
    assert learner.double and not learner_settings(dataclasses.replace(small_run, algorithm="dqn"), shape).double
    for settings in (learner, rollout_settings(small_run)):
        for name in {"batch_size", "target_update_interval", "steps_per_block", "n_step", "discount", "seed"}:
            assert getattr(settings, name, None) in (None, getattr(small_run, name)), name
    assert rollout_settings(small_run).num_envs == 4


def test_options_reach_the_learner_and_the_shards(small_run):
    shape = env_shape(small_run.env)
    plain = learner_settings(small_run, shape)
    assert (plain.network, plain.loss, plain.soft_target_rate, plain.device) == ("plain", "huber", None, "auto")
    assert [shard.priorities for shard in shard_settings(small_run, shape)] == [None]
    options = {"network": "dueling", "loss": "mse", "target_update": "soft", "target_update_rate": 0.2, "device": "cpu"}
    config = dataclasses.replace(small_run, replay="prioritised", priority_exponent=0.7, **options)
    changed = learner_settings(config, shape)
    assert (changed.network, changed.loss, changed.soft_target_rate, changed.device) == ("dueling", "mse", 0.2, "cpu")
    assert [shard.priorities for shard in shard_settings(config, shape)] == [PrioritySettings(0.7, 16)]


def test_shards_share_the_capacity_and_draw_from_their_own_streams(small_run):
    config = dataclasses.replace(small_run, replay_shards=3)
    settings = shard_settings(config, env_shape(config.env))
    assert [shard.capacity for shard in settings] == [333, 333, 333]
    assert len({shard.seed for shard in settings}) == 3


@pytest.mark.parametrize("placement", ["learner", "actors"])
def test_workers_push_to_the_shards_of_either_placement(small_run, placement):
    config = dataclasses.replace(small_run, replay_placement=placement, replay_shards=2, workers=2)
    cluster = ProcessCluster(config, 5)
    weights = cluster.learner.weights()
    for worker in cluster.workers:
        worker.set_weights(weights)
    reports = [worker.collect(0.5)[0] for worker in cluster.workers for _ in range(2)]
    assert [report.header.worker_id for report in reports] == [0, 0, 1, 1]
    assert {report.header.incarnation for report in reports} == {5}
    stored = sum(report.stored for report in reports)
    rows = cluster.learner.update(2, 1e-3)
    assert 0 < stored <= 4 * config.block_env_steps and rows.version == 2
    cluster.close()
