"""Starts a run's components under its engine: as Ray actors, or in this process, which then needs no Ray."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from actors.service.rpc import Calls, LocalCalls
from learner.cluster_options import ClusterOptions
from learner.config import RunConfig
from learner.training.cluster import Cluster, ProcessCluster


def open_cluster(config: RunConfig, incarnation: int, options: ClusterOptions) -> Cluster:
    """Starts the run's components under its engine."""
    if config.engine == "process":
        return ProcessCluster(config, incarnation)
    from learner.ray_backend.cluster import RayCluster

    return RayCluster(config, incarnation, options)


@contextmanager
def closed_on_error(cluster: Cluster) -> Iterator[None]:
    """Closes the components if the `with` block raises anything, Ctrl-C too: a run that has not begun leaves none."""
    try:
        yield
    except BaseException:
        cluster.close()
        raise


@contextmanager
def open_calls(config: RunConfig, options: ClusterOptions) -> Iterator[tuple[Calls, int]]:
    """Calls for tasks alone, without the run's components, under its engine; and how many to make at once."""
    if config.engine == "process":
        yield LocalCalls(), 1
    else:
        from learner.ray_backend.cluster import task_calls

        with task_calls(options.address) as calls:
            yield calls
