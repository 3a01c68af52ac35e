"""Warm spares: a spare that has begun is what a new actor would be, and it takes a lost one's place."""

import dataclasses
import os
import time

import numpy as np
import psutil
import pytest

from actors.policy.network import snapshot
from actors.policy.policy import WeightsSnapshot, blank_weights
from actors.replay.node import ShardNode
from actors.rollout.env_spec import EnvSpec
from actors.rollout.node import RolloutNode
from actors.rollout.vector_env import env_shape
from actors.service.rpc import LocalCalls, local_handle
from deploy.chaos.processes import TITLES, is_of_kind
from learner.cluster_options import ClusterOptions
from learner.ray_backend.spares import SpareShard, SpareWorker
from learner.training.cluster import rollout_settings, shard_settings
from learner.update.networks import acting_network
from tests.integration.conftest import PATIENCE_S, SMALL


def weights(config):
    rng = np.random.default_rng(0)
    sizes = [
        int(np.prod(env_shape(config.env).observation_space.shape)),
        *config.hidden_sizes,
        config.world.num_actions,
    ]
    layers = []
    for fan_in, fan_out in zip(sizes, sizes[1:], strict=False):
        layers += [rng.normal(size=(fan_out, fan_in)).astype(np.float32), np.zeros(fan_out, np.float32)]
    return WeightsSnapshot(3, 0.0, tuple(layers), 0)


@pytest.mark.parametrize("history", [1, 2])
def test_blank_weights_have_the_shape_of_the_acting_network(history):
    plain = dataclasses.replace(SMALL, world=dataclasses.replace(SMALL.world, method="in", history=history))
    for kind in ("plain", "dueling", "pooled"):
        config = dataclasses.replace(plain, network=kind)
        shape = env_shape(config.env)
        row_size = config.env.row_size if kind == "pooled" else 0
        blank = blank_weights(shape.observation_size, config.policy_sizes, shape.num_actions, row_size)
        theirs = snapshot(acting_network(config, shape), 0, 0.0)
        assert [array.shape for array in blank.arrays] == [array.shape for array in theirs.arrays]
        assert blank.row_size == theirs.row_size and not any(array.any() for array in blank.arrays)


def test_a_worker_that_cannot_be_made_says_so_in_the_call_that_needs_it():
    settings = rollout_settings(SMALL)._replace(env=EnvSpec("NoSuchEnv-v0", SMALL.world))
    worker = RolloutNode(settings, 0, 0, LocalCalls(), [None], 0)
    worker.prepare(weights(SMALL))
    with pytest.raises(Exception, match="NoSuchEnv"):
        worker.set_weights(weights(SMALL))


@pytest.mark.parametrize("kind", ["prepared", "spare"])
def test_a_rehearsed_worker_does_what_a_new_one_does_bit_for_bit(kind):
    settings, shape = rollout_settings(SMALL), env_shape(SMALL.env)
    stored = []
    for rehearsed in (False, True):
        shard = ShardNode(shard_settings(SMALL, shape)[0])
        arguments = (1, 7, LocalCalls(), [local_handle(shard)], 0)
        if rehearsed and kind == "spare":
            worker = SpareWorker(settings, weights(SMALL))
            assert worker.is_ready()
            worker.begin(*arguments)
        else:
            worker = RolloutNode(settings, *arguments)
            if rehearsed:
                worker.prepare(weights(SMALL))
        worker.set_weights(weights(SMALL))
        (report,) = worker.collect(0.2)
        assert (report.header.worker_id, report.header.incarnation, report.header.sequence) == (1, 7, 0)
        stored.append(shard.sample(200).columns)
    for name, column in stored[0].items():
        np.testing.assert_array_equal(column, stored[1][name])


def test_a_spare_shard_that_has_begun_is_empty_and_stores():
    settings, shape = rollout_settings(SMALL), env_shape(SMALL.env)
    shard = SpareShard()
    assert shard.is_ready()
    shard.begin(shard_settings(SMALL, shape, 5)[0])
    assert shard.size() == 0
    worker = RolloutNode(settings, 0, 0, LocalCalls(), [local_handle(shard)], 0)
    worker.set_weights(weights(SMALL))
    worker.collect(0.2)
    assert shard.size() > 0


def is_seen_as(pid, *kinds):
    """Whether the title of a process is that of a component of one of the kinds."""
    words = psutil.Process(pid).cmdline()
    return any(is_of_kind(words, kind) for kind in kinds)


def wait_until(condition):
    end_s = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < end_s
        time.sleep(0.05)


@pytest.mark.ray
def test_a_spare_that_could_not_start_is_replaced_a_few_times(caplog):
    import ray

    from learner.ray_backend.cluster import connect, leave
    from learner.ray_backend.spares import MOST_FAILURES, Spare, Spares

    class Fails(Spare):
        def __init__(self):
            raise ValueError("no kernels here")

    class Works(Spare):
        def begin(self):
            pass

    connect(1, None, 1)
    try:
        kinds = [Works, Fails]
        spares = Spares(1, lambda: ray.remote(num_cpus=0)(kinds.pop()).remote())
        spares.keep()
        ((_, ready),) = spares._waiting
        ray.wait([ready], timeout=PATIENCE_S)
        spares.keep()
        ((spare, ready),) = spares._waiting
        assert ray.get(ready, timeout=PATIENCE_S) and not kinds
        assert spares.take() is spare
        assert spares.take() is None

        started = []
        spares = Spares(1, lambda: started.append(ray.remote(num_cpus=0)(Fails).remote()) or started[-1])
        for _ in range(MOST_FAILURES):
            assert "could not start" not in caplog.text
            spares.keep()
            ray.wait([ready for _, ready in spares._waiting], timeout=PATIENCE_S)
        for _ in range(2):
            spares.keep()
        assert len(started) == MOST_FAILURES and not spares._waiting
        assert caplog.text.count("spares could not start") == 1
    finally:
        leave()


@pytest.mark.ray
def test_spares_take_the_places_of_lost_actors_and_are_replaced():
    import ray

    from learner.ray_backend.cluster import RayCluster

    config = dataclasses.replace(SMALL, engine="ray", replay_placement="actors")
    cluster = RayCluster(config, 0, ClusterOptions(spares=1))
    try:

        def pid(actor):
            return ray.get(actor.__ray_call__.remote(lambda _: os.getpid()), timeout=PATIENCE_S)

        waiting = [cluster._spare_workers, cluster._spare_shards]
        assert cluster._spare_workers.take(0, 1) is None, "none has been started"
        cluster.keep_spares()
        cluster.keep_spares()
        (worker, ready), (shard, other_ready) = (pair for spares in waiting for pair in spares._waiting)
        ray.get([ready, other_ready], timeout=PATIENCE_S)
        spare_pids = [pid(worker), pid(shard)]
        for number in spare_pids:
            assert not is_seen_as(number, *TITLES), "nobody mistakes a spare that waits for a component"
        cluster.discard(cluster.workers[0])
        assert pid(cluster.place_worker(0, 1)) == spare_pids[0]
        assert pid(cluster.place_shard(0, 1)) == spare_pids[1]
        wait_until(lambda: is_seen_as(spare_pids[0], "rollout worker"))
        wait_until(lambda: is_seen_as(spare_pids[1], "replay shard"))
        assert not any(spares._waiting for spares in waiting)

        cluster.keep_spares()
        ((dead, ready),) = cluster._spare_workers._waiting
        ray.get(ready, timeout=PATIENCE_S)
        number = pid(dead)
        ray.kill(dead)
        wait_until(lambda: not os.path.exists(f"/proc/{number}"))
        made = cluster.place_worker(0, 2)  # a spare that died after it was ready is found out by its first call
        with pytest.raises(ray.exceptions.RayActorError):
            ray.get(made.set_weights.remote(weights(config)), timeout=PATIENCE_S)
    finally:
        cluster.close()
