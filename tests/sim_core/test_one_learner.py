"""A world with one learning robot is, bit for bit, what it was before several robots of a world could learn.

The digests were computed at commit 9f8553d, before worlds could have several learning robots.
"""

import hashlib

import numpy as np
import pytest

from sim_core.config import WorldConfig
from sim_core.pilot import Pilot
from sim_core.worlds import WorldBatch, is_done

SMALL = {"robots": 5, "groups": 2, "arena_radius_m": 2.0, "horizon_steps": 90}
BAD_SENSES = {"position_noise_m": 0.05, "burst_loss": 0.2, "group_mix_up": 0.02, "speed_error": 0.1, "shield": "orca"}
DIGESTS = {
    "sensor": "92846cf327af4fa8",
    "in": "540274131caa1770",
    "out": "87c935d63efaa739",
    "bad senses": "6d6c032580e08394",
    "swarm": "4d4dc351d59cfb08",
}
CASES = {
    "sensor": {"decision_interval_steps": 3, "history": 2},
    "in": {"method": "in"},
    "out": {"method": "out", "ellipse_counts_learner": True},
    "bad senses": BAD_SENSES,
    "swarm": {"method": "out"},
}


def digest_of(settings, pilot=None):
    """SHA-256 of observations, rewards, outcomes and the saved state over 120 decisions of 6 worlds that restart."""
    worlds, digest = WorldBatch(WorldConfig(**(SMALL | settings)), 6), hashlib.sha256()
    digest.update(worlds.reset().tobytes())
    plan = np.random.default_rng(0).integers(0, 8, (120, 6))
    for action in plan:
        result = worlds.step(action if pilot is None else pilot)
        for array in result[:5]:
            digest.update(array.tobytes())
        done = is_done(result.outcome)
        if done.any():
            digest.update(worlds.reset(done).tobytes())
    for name, array in sorted(worlds.get_state().items()):
        digest.update(f"{name} {array.dtype} {array.shape}".encode() + array.tobytes())
    return digest.hexdigest()[:16]


@pytest.mark.parametrize("case", CASES)
def test_one_learning_robot_is_as_ever(case):
    assert digest_of(CASES[case], Pilot.FREE if case == "swarm" else None) == DIGESTS[case]
