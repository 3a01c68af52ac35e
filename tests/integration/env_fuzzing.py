"""Random environments of a user's own: what goes wrong in them, when and how; and what must come of a training in each.

A case is a whole training by `main`, with a small network and few steps, in this process. MLflow, whose database would
take most of the time, and the drawing of the curve are left out.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from hypothesis import strategies as st
from hypothesis.extra import numpy as st_numpy
from numpy.typing import NDArray
from safetensors.numpy import load_file

import deploy.runs.artifacts
import learner.tracking.mlflow_run
from actors.evaluation import evaluator
from actors.replay.shard import ReplayShard
from actors.rollout.foreign_env import rehearse_env
from actors.service.messages import TransitionBlock
from deploy.cli import BAD_INPUT, FAILED
from learner.config import RunConfig
from learner.tracking.journal import read_rows
from learner.update.learner_node import WEIGHTS
from tests.integration.conftest import flags
from tests.integration.fuzzing import Found, NoTracker, run_command

ENV_ID = "shoal-test/Drawn-v0"
SETTINGS = RunConfig(
    env_id=ENV_ID,
    engine="process",
    total_env_steps=400,
    workers=1,
    envs_per_worker=2,
    steps_per_block=10,
    min_replay=60,
    replay_capacity=300,
    batch_size=8,
    updates_per_call=4,
    hidden_sizes=(8,),
    eval_every_env_steps=200,
    eval_episodes=2,
    final_eval_episodes=2,
    log_every_env_steps=100,
    checkpoint_every_env_steps=100,
)
LIMIT_S = 1.0
"""How long one call of an environment may take."""
LONGEST = 150
"""Steps of an evaluated episode after which it counts as one that never ends."""
PART = spaces.Box(-1, 1, (2,), np.float32)
SOUND = (
    spaces.Box(-np.inf, np.inf, (3,), np.float32),
    spaces.Box(-1, 1, (2, 2), np.float64),
    spaces.Box(0, 255, (4, 4, 3), np.uint8),
    spaces.Box(-9, 9, (2,), np.int64),
    spaces.Discrete(5, start=-1),
    spaces.MultiBinary(4),
    spaces.MultiDiscrete([2, 3]),
    spaces.Dict({"a": PART, "b": spaces.Discrete(3)}),
    spaces.Tuple((PART, spaces.Box(0, 255, (2,), np.uint8))),
)
UNSOUND = (None, "Box", [3], spaces.Box(-1, 1, (), np.float32), spaces.Sequence(PART), spaces.Discrete(10**12))
NUMBERS = st.one_of(
    st.floats(), st.integers(-(10**40), 10**40), st.sampled_from([np.float32("nan"), np.float64("inf"), 1e38, -1e30])
)
ARRAYS = st_numpy.arrays(
    st.sampled_from([np.float16, np.float32, np.float64, np.uint8, np.int64, np.bool_, np.complex64, "U3"]),
    st_numpy.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=4),
)
JUNK = st.recursive(
    st.one_of(st.none(), st.booleans(), NUMBERS, st.text(max_size=5), st.binary(max_size=5), ARRAYS),
    lambda inner: st.one_of(
        st.lists(inner, max_size=3),
        st.lists(inner, max_size=5).map(tuple),
        st.dictionaries(
            st.sampled_from(["a", "b", "outcome", "final_obs", "final_info", "episode"]), inner, max_size=3
        ),
    ),
    max_leaves=4,
)
"""Anything that an environment may give in the place of what it should."""


class Stuck(Exception):
    """An error of a user's own, which cannot say what it is."""

    def __str__(self) -> str:
        raise RuntimeError("no words")


class Abrupt(BaseException):
    """One that `except Exception` lets through."""


ERRORS = (RuntimeError("a\nb"), ValueError(), Stuck(), Abrupt("no"), KeyError("x"), AssertionError("🤖 [bold]"))
PLACES = ("make", "spaces", "reset", "step", "render", "close")
ANSWERS = ("first", "observation", "reward", "terminated", "truncated", "info", "image", "answer", "space")
DEEDS = ("raise",) * 5 + ("exit", "leave", "sleep")


class Case(NamedTuple):
    """An environment: its observation space, the steps of its episodes (None: without end), and what goes wrong.

    At its step `when`, and at every later one, `what` happens: a call of PLACES ends by the deed `how`, or one of
    ANSWERS is `value`; `nothing` is a sound environment.
    """

    space: Any
    episode: int | None
    what: str
    when: int
    how: str
    error: BaseException
    value: Any
    draws: bool


CASES = st.builds(
    Case,
    st.sampled_from(SOUND),
    st.one_of(st.integers(1, 30), st.integers(1, 30), st.none()),
    st.sampled_from(("nothing", *PLACES, *ANSWERS, *ANSWERS)),
    st.one_of(st.integers(0, 3), st.integers(4, 120)),
    st.sampled_from(DEEDS),
    st.sampled_from(ERRORS),
    st.one_of(JUNK, st.sampled_from(UNSOUND)),
    st.booleans(),
)


class Drawn(gym.Env[Any, Any]):
    """The environment of a case."""

    case: Case
    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 10}

    def __init__(self, render_mode: str | None = None) -> None:
        self.render_mode = render_mode
        self.steps = self.total = 0
        if not self.case.draws:
            self.metadata = {"render_modes": None}
        self._do("make")
        self.sound = self.case.space
        self.action_space = spaces.Discrete(3)

    @property
    def observation_space(self) -> Any:  # type: ignore[override]
        self._do("spaces")
        return self._give("space", self.sound)

    def _is_now(self, what: str) -> bool:
        return self.case.what == what and self.total >= self.case.when

    def _do(self, place: str) -> None:
        if not self._is_now(place):
            return
        if self.case.how == "raise":
            raise self.case.error
        if self.case.how == "exit":
            sys.exit(3)
        if self.case.how == "leave":
            os._exit(3)
        time.sleep(1_000)

    def _give(self, what: str, sound: Any) -> Any:
        return self.case.value if self._is_now(what) else sound

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.steps = 0
        self._do("reset")
        return self._give("first", (self._seen(), self._give("info", {})))

    def _seen(self) -> Any:
        self.sound.seed(int(self.np_random.integers(2**31)))
        return self._give("observation", self.sound.sample())

    def step(self, action: Any) -> Any:
        self.steps += 1
        self.total += 1
        self._do("step")
        over = self.case.episode is not None and self.steps >= self.case.episode
        flags = self._give("terminated", False), self._give("truncated", over)
        return self._give("answer", (self._seen(), self._give("reward", 1.0), *flags, self._give("info", {})))

    def render(self) -> Any:
        self._do("render")
        return self._give("image", np.zeros((16, 16, 3), np.uint8))

    def close(self) -> None:
        self._do("close")


class QuietTracker(NoTracker):
    """Stands in for MLflow during a whole run; remembers how it ended."""

    retry_timeout_s = 0.0
    started_ms = 0
    status = ""

    def push(self, rows: Any) -> None:
        pass

    def log_results(self, metrics: dict[str, float], time_ms: int) -> None:
        assert all(map(np.isfinite, metrics.values())), metrics

    def load_end(self) -> None:
        pass

    def begin_policy(self, weights: Any, *others: Any) -> None:
        _check_finite("policy", *weights.arrays)

    def log_artifact(self, path: Path) -> None:
        assert path.exists()

    def log_policy(self, weights: Any, *others: Any) -> None:
        _check_finite("policy", *weights.arrays)

    def end(self, status: str) -> None:
        QuietTracker.status = status


def _check_finite(what: str, *arrays: NDArray[Any]) -> None:
    for array in arrays:
        assert array.dtype.kind not in "fc" or np.isfinite(array.astype(np.float32)).all(), f"{what} is not finite"


@contextlib.contextmanager
def env_workplace(folder: Path) -> Iterator[None]:
    """An empty folder to run cases in, with their environment registered, and every number that is stored checked."""
    gym.register(ENV_ID, entry_point=Drawn)
    add = ReplayShard.add

    def checked(shard: ReplayShard, block: TransitionBlock) -> Any:
        rows, frames = block.packed
        _check_finite("a transition", rows["reward"], rows["discount"], rows["observation"], frames)
        return add(shard, block)

    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.delenv("MLFLOW_TRACKING_URI", raising=False)
        patch.setattr(learner.tracking.mlflow_run, "Tracker", QuietTracker)
        patch.setattr(deploy.runs.artifacts, "learning_curve_png", lambda points, path, *more: path.touch())
        patch.setattr(evaluator, "MAX_EPISODE_STEPS", LONGEST)
        patch.setattr(ReplayShard, "add", checked)
        try:
            yield
        finally:
            gym.registry.pop(ENV_ID)


def check_env(case: Case) -> Found:
    """Trains in the environment of a case.

    Raises:
      AssertionError: a traceback, an exit code that is none of ours, no sentence, or a number that is not finite.
      Hang: it took too long.
    """
    Drawn.case, QuietTracker.status = case, ""
    rehearse_env.cache_clear()
    run = Path("runs/r")
    shutil.rmtree(run, ignore_errors=True)
    code, _, error, seconds = run_command(["train", "--name", "r", "--deadline-s", str(LIMIT_S), *flags(SETTINGS)])
    assert code in (0, FAILED, BAD_INPUT) and "Traceback" not in error, f"exit code {code}: {error}"
    if code == 0:
        assert QuietTracker.status == "FINISHED"
    else:
        named = ENV_ID in error or "diverged" in error
        assert error.startswith("shoal: ") and error.count("\n") == 1 and named, f"no sentence: {error!r}"
        assert QuietTracker.status == ("FAILED" if (run / "run.json").exists() else "")
    for path in run.glob(f"checkpoints/*/{WEIGHTS}"):
        _check_finite(str(path), *load_file(path).values())
    if (run / "metrics.jsonl").exists():
        assert all(np.isfinite(list(row.metrics.values())).all() for row in read_rows(run / "metrics.jsonl"))
    return Found("finished" if code == 0 else "refused", seconds)
