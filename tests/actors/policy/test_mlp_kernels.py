"""How the kernels' matrix products are computed."""

import json
import os
import subprocess
import sys

import pytest

SCRIPT = """
import json, sys
import scipy.linalg.cython_blas  # as in a notebook, before anything of ours
import numpy as np
from threadpoolctl import threadpool_info

threads = lambda: sorted(each["num_threads"] for each in threadpool_info() if each["user_api"] == "blas")
before = threads()
{make}
print(json.dumps([before, threads()]))
"""
POLICY = """
from actors.policy.policy import Policy, WeightsSnapshot
shapes = [(4, 2), (4,), (5, 4), (5,), (3, 7), (3,)]  # of a pooled network, which multiplies with BLAS
Policy(WeightsSnapshot(0, 0.0, tuple(np.zeros(shape, np.float32) for shape in shapes), 2))
"""
LEARNER = """
from actors.rollout.vector_env import env_shape
from learner.config import RunConfig
from learner.update.learner import Learner
config = RunConfig()
Learner(config, env_shape(config.env))
"""


@pytest.mark.parametrize("make", [POLICY, LEARNER], ids=["policy", "learner"])
def test_blas_has_one_thread_whoever_has_loaded_it_before(make):
    """With two, a training of M_IN in 5r×2g had another policy than with one."""
    env = {name: value for name, value in os.environ.items() if not name.endswith("_NUM_THREADS")}
    env |= {"OPENBLAS_NUM_THREADS": "2"}
    words = [sys.executable, "-c", SCRIPT.format(make=make)]
    done = subprocess.run(words, env=env, capture_output=True, text=True, check=True)
    before, after = json.loads(done.stdout)
    assert set(before) == {2} and set(after) == {1}
