"""Random command lines and config files for `shoal`, and what must come of each: exit code 0 or 2, and a sentence.

A case runs `main` in this process, up to the ports where a valid command would begin its work: the training run, the
sweep's cells, the evaluation's episodes, the recorded episode, the report's files. Those raise `WorkStarted`.
"""

from __future__ import annotations

import contextlib
import datetime
import io
import json
import math
import signal
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

import pytest
from hypothesis import strategies as st

import deploy.commands.evaluate
import deploy.commands.report
import deploy.commands.stress
import deploy.commands.sweep
import deploy.commands.train
import deploy.commands.watch
import deploy.training
import learner.tracking.mlflow_run
from deploy.cli import BAD_INPUT, main
from learner.config import RunConfig
from learner.run_folder import RunFolder, RunIdentity
from learner.sweep.grid import SweepConfig
from sim_core.config import WorldConfig
from tests.integration.conftest import SMALL

HANG_S = 300.0
"""A case that takes longer hangs; usual ones take hundredths of a second."""
CONFIG_FILE = "fuzzed.toml"


class WorkStarted(BaseException):
    """A valid command has come to its work."""


class Hang(BaseException):
    """A case has taken too long."""


class Found(NamedTuple):
    """What came of a case: `accepted`, `refused` or `help`, and its seconds."""

    outcome: str
    seconds: float


class NoTracker:
    """Stands in for MLflow, whose database would take most of the time; its URIs have a fuzz of their own."""

    def __init__(self, uri: str, experiment: str, artifact_root: str | None) -> None:
        self.uri, self.run_id = uri, "fuzzed"

    def start(self, config: RunConfig) -> None:
        pass

    def resume(self, run_id: str) -> None:
        pass

    def is_finished(self, run_id: str) -> bool:
        return False


def _start(*args: Any, **kwargs: Any) -> NoReturn:
    raise WorkStarted


@contextlib.contextmanager
def workplace(folder: Path) -> Iterator[None]:
    """An empty folder to run cases in, with two runs to name and every port to work closed."""
    runs = {"r": SMALL, "other-env": RunConfig(env_id="CartPole-v1")}
    for name, config in runs.items():
        run = RunFolder(folder / "runs" / name)
        run.save_config(config)
        run.save_identity(RunIdentity(name, "http://127.0.0.1:9", "shoal", "0"))
    (folder / "no-run").mkdir()
    (folder / "a-file").write_text("of no use")
    (folder / "results.csv").write_text("preset,policy\n")
    ports = {
        deploy.training: ("RunSession",),
        learner.tracking.mlflow_run: ("Tracker",),
        deploy.commands.train: ("open_cluster",),
        deploy.commands.sweep: ("run_cells", "Tracker"),
        deploy.commands.evaluate: ("evaluate_in_tasks", "record_episode"),
        deploy.commands.stress: ("evaluate_each",),
        deploy.commands.watch: ("record_episode", "foreign_animation"),
        deploy.commands.report: ("_write",),
    }
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        for name in ("MLFLOW_TRACKING_URI", "RAY_ADDRESS"):
            patch.delenv(name, raising=False)
        for module, names in ports.items():
            for name in names:
                patch.setattr(module, name, NoTracker if name == "Tracker" else _start)
        yield


def _too_long(number: int, frame: Any) -> NoReturn:
    raise Hang


class Ended(NamedTuple):
    """How a command ended: exit code, or WorkStarted; what it printed; seconds."""

    code: object
    out: str
    error: str
    seconds: float


def run_command(arguments: Sequence[str]) -> Ended:
    """Runs `shoal` in this process; raises Hang if it takes too long."""
    out, err = io.StringIO(), io.StringIO()
    before = signal.signal(signal.SIGALRM, _too_long)
    signal.setitimer(signal.ITIMER_REAL, HANG_S)
    start_s = time.perf_counter()
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            code: object = main(arguments)
    except WorkStarted:
        code = WorkStarted
    except SystemExit as stop:  # tyro's way out
        code = stop.code
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)
    return Ended(code, out.getvalue(), err.getvalue(), time.perf_counter() - start_s)


def check(arguments: Sequence[str], config: bytes | None = None) -> Found:
    """Runs one case.

    Args:
      arguments: the command line.
      config: content of CONFIG_FILE, None to leave it out.

    Raises:
      AssertionError: another exit code than 0 or 2, no message, a traceback, or more than one sentence of ours.
      Hang: it took too long.
    """
    if config is not None:
        Path(CONFIG_FILE).write_bytes(config)
    code, out, error, seconds = run_command(arguments)
    if code is WorkStarted:
        return Found("accepted", seconds)
    assert code in (0, BAD_INPUT), f"exit code {code}: {error}"
    assert "Traceback" not in error, error
    if code == 0:
        assert out, "neither work nor help"
        return Found("help", seconds)
    assert error.strip(), "refused without a word"
    if error.startswith("shoal: "):
        assert error.count("\n") == 1 and len(error) > len("shoal: x\n"), f"no sentence: {error!r}"
    return Found("refused", seconds)


FLAGS = sorted(
    {
        f"--{name.replace('_', '-')}"
        for kind in (RunConfig, WorldConfig, SweepConfig)
        for name in kind.__dataclass_fields__
        if name not in ("world",)
    }
    | set(
        "--config --preset --runs-dir --name --experiment --address --checkpoint-url --keep-best --at-once --known "
        "--out --total-env-steps --episodes --first-seed --record --checkpoint --format --help -h --tracking-uri "
        "--vary --no-such-flag -- --=".split()
    )
)
COMMANDS = ("train", "sweep", "report", "resume", "evaluate", "stress", "watch")
NUMBERS = st.one_of(
    st.integers(-3, 12).map(str),
    st.sampled_from("0 1 2 64 1000 1000000 4294967295 99999999999 1e9 1e400 -1e9 nan inf -inf 0.5 0x10 1_000".split()),
    st.integers(-(2**70), 2**70).map(str),
    st.floats(allow_nan=True, allow_infinity=True).map(str),
)
"""Numbers of all sizes, and what looks like one."""
WORDS = st.sampled_from(
    (
        "sensor in out thesis best greedy fl-orca random ray process learner actors html mp4 png newest True False "
        "r other-env no-run a-file results.csv runs runs/r . /proc/nothing /dev/null x.zarr .zarr a/b.zarr "
        "CartPole-v1 Pendulum-v1 NoSuchEnv-v0 shoal/SegregatedSwarm-v0 module:Env-v0 batch_size=3 batch_size= =3 "
        "seed=1 memory://x s3:// nosuch://x file:///proc/x s3://u:p@b/x [bold] [/bold] a[b] {} %s $(id) ;id |id `id` *"
    ).split()
    + ["", " ", "two words", "line\nbreak", "ünïcödé ✓", "\udc80\udcff", "x" * 5_000, CONFIG_FILE]
)
"""Values that some flag takes, and some that none does; nothing that leads out of the workplace and can be written."""
TEXTS = st.text(st.characters(exclude_characters="\0/", exclude_categories=("Cs",)), max_size=20)
VALUES = st.one_of(NUMBERS, WORDS, TEXTS)
ASSIGNMENTS = st.builds(lambda flag, values: [flag, *values], st.sampled_from(FLAGS), st.lists(VALUES, max_size=3))
JOINED = st.builds(lambda flag, value: [f"{flag}={value}"], st.sampled_from(FLAGS), VALUES)


def _line(command: str, positional: list[str], parts: list[list[str]]) -> list[str]:
    return [command, *positional, *(word for part in parts for word in part)]


COMMAND_LINES = st.one_of(
    st.builds(
        _line,
        st.sampled_from(COMMANDS),
        st.lists(VALUES, max_size=1),
        st.lists(ASSIGNMENTS | JOINED, max_size=4),
    ),
    st.lists(VALUES | st.sampled_from(COMMANDS) | st.sampled_from(FLAGS), max_size=6),
)
"""Whole command lines: a command with some flags, or anything."""


def _toml(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, float):
        return str(value) if math.isfinite(value) else str(value).lower().replace("infinity", "inf")
    if isinstance(value, list):
        return "[" + ", ".join(map(_toml, value)) + "]"
    if isinstance(value, dict):
        return "{" + ", ".join(f"{json.dumps(key)} = {_toml(item)}" for key, item in value.items()) + "}"
    if isinstance(value, datetime.date | datetime.time):
        return value.isoformat()
    return json.dumps(value) if isinstance(value, str) else str(value)


LEAVES = st.one_of(
    st.integers(-3, 100),
    st.sampled_from([0, 1, 2, 1_000, 10**6, 2**31, 2**32, 10**12, 10**18, 10**30, -1, 0.5, 1.5, 1e-9, 1e300]),
    st.floats(),
    st.booleans(),
    st.sampled_from(["sensor", "in", "out", "ray", "process", "dqn", "actors", "CartPole-v1", "Nothing-v9", "a:b", ""]),
    TEXTS,
    st.dates(),
    st.times(),
)
TOML_VALUES = st.recursive(
    LEAVES, lambda inner: st.lists(inner, max_size=4) | st.dictionaries(TEXTS, inner, max_size=3), max_leaves=6
)


def _values(kind: type) -> st.SearchStrategy[dict[str, Any]]:
    known = st.sampled_from(sorted(set(kind.__dataclass_fields__) - {"world"}))
    return st.dictionaries(known, LEAVES | TOML_VALUES, max_size=4)


def _document(run: dict[str, Any], world: dict[str, Any], stray: dict[str, Any]) -> bytes:
    lines = [f"{json.dumps(name)} = {_toml(value)}" for name, value in {**run, **stray}.items()]
    lines += ["[world]", *(f"{name} = {_toml(value)}" for name, value in world.items())] if world else []
    return "\n".join(lines).encode("utf-8", "surrogatepass")


def _mutated(document: bytes, cuts: list[tuple[int, bytes]]) -> bytes:
    changed = bytearray(document)
    for place, put in cuts:
        at = place % (len(changed) + 1)
        changed[at : at + len(put) // 2] = put
    return bytes(changed)


DOCUMENTS = st.builds(
    _document, _values(RunConfig), _values(WorldConfig), st.just({}) | st.dictionaries(TEXTS, TOML_VALUES, max_size=1)
)
CONFIG_FILES = st.one_of(
    DOCUMENTS,
    st.builds(_mutated, DOCUMENTS, st.lists(st.tuples(st.integers(0, 999), st.binary(max_size=4)), max_size=3)),
    st.binary(max_size=60),
)
"""Contents of a config file: settings with all kinds of values, such files with bytes changed, or anything."""

KINDS: dict[str, tuple[st.SearchStrategy[Any], Callable[[Any], Found]]] = {
    "command lines": (COMMAND_LINES, check),
    "config files": (CONFIG_FILES, lambda document: check(["train", "--config", CONFIG_FILE], document)),
    "config files with flags": (
        st.tuples(DOCUMENTS, st.lists(ASSIGNMENTS | JOINED, max_size=2)),
        lambda case: check(_line("train", ["--config", CONFIG_FILE], case[1]), case[0]),
    ),
}
"""What is fuzzed: by name, the cases and how one is checked."""


class Counts:
    """Outcomes of the cases of one kind, and the slowest one's seconds."""

    def __init__(self) -> None:
        self.outcomes: Counter[str] = Counter()
        self.slowest_s = 0.0

    def take(self, found: Found) -> None:
        self.outcomes[found.outcome] += 1
        self.slowest_s = max(self.slowest_s, found.seconds)
