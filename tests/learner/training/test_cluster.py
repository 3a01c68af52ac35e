"""The components of a run take their settings from its config."""

import dataclasses

import pytest

from actors.policy.network import DuelingNetwork, QNetwork
from actors.replay.prioritised import PrioritySettings
from actors.rollout.vector_env import env_shape
from learner.training.cluster import ProcessCluster, rollout_settings, shard_settings


def test_settings_are_those_of_the_config(small_run):
    settings = rollout_settings(small_run)
    for name in ("steps_per_block", "n_step", "discount", "seed"):
        assert getattr(settings, name) == getattr(small_run, name), name
    assert settings.num_envs == 4
    learner = ProcessCluster(small_run, 0).learner._learner
    assert [tuple(layer.weight.shape) for layer in learner.online.layers[::2]] == [(8, 8), (4, 8)]


def test_options_reach_the_learner_and_the_shards(small_run):
    assert [shard.priorities for shard in shard_settings(small_run, env_shape(small_run.env))] == [None]
    assert isinstance(ProcessCluster(small_run, 0).learner._learner.online, QNetwork)
    options = {"network": "dueling", "device": "cpu", "replay": "prioritised", "priority_exponent": 0.7}
    config = dataclasses.replace(small_run, **options)
    assert [shard.priorities for shard in shard_settings(config, env_shape(config.env))] == [PrioritySettings(0.7, 16)]
    learner = ProcessCluster(config, 0).learner._learner
    assert isinstance(learner.online, DuelingNetwork) and learner.device.type == "cpu"


def test_shards_share_the_capacity_and_have_their_own_random_streams(small_run):
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
