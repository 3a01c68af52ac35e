"""Runs that no machine can hold are refused at the start; estimates match what a run allocates."""

import dataclasses

import numpy as np
import psutil
import pytest

from actors.rollout.vector_env import env_shape
from learner.config import RunConfig
from learner.training.cluster import ProcessCluster
from learner.training.memory_estimate import bytes_by_setting, check_fits
from sim_core.checks import ConfigError
from sim_core.config import WorldConfig

MANY_WORLDS = {"envs_per_worker": 10**6, "steps_per_block": 1, "replay_capacity": 10**6}


def test_the_defaults_fit():
    assert check_fits(RunConfig()) == env_shape(RunConfig().env)


@pytest.mark.parametrize(
    ("changes", "part"),
    [
        ({"replay_capacity": 10**12}, "replay_capacity"),
        ({"hidden_sizes": (10**6, 10**6)}, "hidden_sizes"),
        ({"hidden_sizes": (10**30,)}, "hidden_sizes"),
        ({"workers": 10**5}, "workers and replay_shards"),
        ({"batch_size": 10**9}, "batch_size and updates_per_call"),
        ({"replay_capacity": 10**400}, "replay_capacity"),
        ({"n_step": 10**400}, "envs_per_worker, steps_per_block and n_step"),
        ({"n_step": 10**12}, "envs_per_worker, steps_per_block and n_step"),
        ({"eval_episodes": 10**15}, "eval_episodes and final_eval_episodes"),
        (
            {"world": WorldConfig(robots=1_000, arena_radius_m=100.0), **MANY_WORLDS},
            "workers, envs_per_worker and robots",
        ),
    ],
)
def test_a_run_that_no_machine_can_hold_is_refused_with_the_setting_to_blame(changes, part):
    with pytest.raises(ConfigError, match=f"of it by {part}, and this machine has"):
        check_fits(dataclasses.replace(RunConfig(), **changes))


def bytes_of_a_full_shard(config):
    """Bytes of a shard's rings once the ring of rows is full."""
    cluster = ProcessCluster(config, 0)
    worker, shard = cluster.workers[0], cluster.learner._shards[0].shard
    worker.set_weights(cluster.learner.weights())
    while shard.size < config.replay_capacity:
        worker.collect(0.5)
    return shard._rows.nbytes + shard._frames.slots.nbytes


def test_estimates_match_what_is_allocated(small_run):
    shape = env_shape(small_run.env)
    parts = bytes_by_setting(small_run, shape)
    learner = ProcessCluster(small_run, 0).learner
    larger = dataclasses.replace(small_run, replay_capacity=6_000)
    full = bytes_of_a_full_shard(larger)
    assert full <= bytes_by_setting(larger, shape)["replay_capacity"] < 1.3 * full
    online = sum(tensor.numel() for tensor in learner._learner.online.state_dict().values())
    assert parts["hidden_sizes"] == online * 4 * 5
    prioritised = dataclasses.replace(small_run, replay="prioritised", network="dueling")
    more, (shard, *_) = bytes_by_setting(prioritised, shape), ProcessCluster(prioritised, 0).learner._shards
    tree = prioritised.replay_shards * shard.shard._tree._tree.nbytes
    assert tree <= more["replay_capacity"] - parts["replay_capacity"] < 2.1 * tree
    assert more["hidden_sizes"] > parts["hidden_sizes"]
    assert sum(parts.values()) < psutil.virtual_memory().total
    assert all(np.isfinite(value) and value >= 0 for value in parts.values())
