"""A rollout worker of worlds with one learning robot makes, bit for bit, the blocks that it made before.

The digests were computed at commit d5548b7, the last one that knew a single learning robot.
"""

import hashlib
import json

import numpy as np
import pytest

from actors.policy.policy import WeightsSnapshot
from actors.rollout.env_spec import EnvSpec
from actors.rollout.vector_env import env_shape
from actors.rollout.worker import RolloutSettings, RolloutWorker
from sim_core import ENV_ID
from sim_core.config import WorldConfig

SMALL = {"robots": 5, "groups": 2, "arena_radius_m": 2.0, "horizon_steps": 60}
DIGESTS = {"sensor": "5dc80d422d96a5c1", "in": "cb09725b2b91b833", "out": "d2407ef89fbdadfd"}


def digest_of(method):
    """SHA-256 of three blocks of a worker that acts at random half of the time, and of what a checkpoint keeps of it.

    The network's weights are 0, so that no library's order of summation counts.
    """
    spec = EnvSpec(ENV_ID, WorldConfig(**SMALL, method=method))
    shape = env_shape(spec)
    sizes = [shape.observation_size, 8, shape.num_actions]
    layers = [array for a, b in zip(sizes, sizes[1:], strict=False) for array in (np.zeros((b, a)), np.zeros(b))]
    worker = RolloutWorker(RolloutSettings(spec, 6, 50, 3, 0.99, 11), 1, 2)
    worker.set_weights(WeightsSnapshot(4, 2.5, tuple(array.astype(np.float32) for array in layers)))
    digest = hashlib.sha256()
    for _ in range(3):
        block = worker.collect(0.5)
        digest.update(str(tuple(block.header)).encode())
        for array in (*block.packed, *block.episodes[:3]):
            digest.update(array.tobytes())
    state = worker.get_state()
    for name, array in sorted(state["arrays"].items()):
        digest.update(f"{name} {array.dtype} {array.shape}".encode() + array.tobytes())
    digest.update(json.dumps(state["meta"], sort_keys=True).encode())
    worker.close()
    return digest.hexdigest()[:16]


@pytest.mark.parametrize("method", DIGESTS)
def test_blocks_of_one_learning_robot_are_as_ever(method):
    assert digest_of(method) == DIGESTS[method]
