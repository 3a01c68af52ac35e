"""Faults of a chaos run, and their recovery times."""

import io
import signal
import subprocess
import sys

import psutil
import pytest

from deploy.chaos.config import write_config
from deploy.chaos.faults import FULL, KINDS, MLFLOW, TRACKER, FaultKind, InjectedFault, fault_table, with_recovery
from deploy.chaos.injection import ChaosRun
from deploy.chaos.processes import TITLES, fill_disk, is_of_kind
from deploy.cli import main, read_config_file
from deploy.console.terminal import plain_console
from deploy.options.training import Chaos
from learner.tracking.fault_log import DRIVER, FaultEntry
from learner.tracking.journal import PushedMark
from learner.tracking.tracker_process import MlflowProcess


def entry(time_s, event, part):
    return FaultEntry(time_s, event, part, "died", "restart", 1, 1.0)


def fault(what, victim, time_s):
    return InjectedFault(FaultKind(what, victim, 1), time_s)


def recoveries(faults, log):
    return [made.recovery_s for made in with_recovery(faults, log)]


def test_a_component_has_recovered_when_one_of_its_kind_works_again():
    log = [
        entry(11.0, "failed", "rollout worker 1"),
        entry(12.5, "mended", "replay shard 0"),
        entry(13.0, "mended", "rollout worker 1"),
        entry(30.0, "mended", "rollout worker 0"),
    ]
    faults = [fault("killed", "rollout worker", 10.0), fault("frozen", "rollout worker", 14.0)]
    assert recoveries(faults, log) == [3.0, 16.0]


def test_a_rebuilt_or_resumed_run_has_recovered_from_everything():
    log = [entry(20.0, "mended", "learner"), entry(40.0, "resumed", DRIVER)]
    kinds = ["rollout worker", "replay shard", "learner", "evaluation"]
    assert recoveries([fault("killed", kind, 15.0) for kind in kinds], log) == [5.0] * 4
    assert recoveries([fault("killed", kind, 25.0) for kind in kinds], log) == [15.0] * 4


def test_a_lost_driver_has_recovered_when_the_run_is_resumed():
    log = [entry(20.0, "mended", "learner"), entry(40.0, "resumed", DRIVER)]
    assert recoveries([fault("killed", DRIVER, 15.0)], log) == [25.0]


def test_unrecovered_faults_and_delays_have_no_recovery_time():
    log = [entry(20.0, "mended", "rollout worker 0")]
    assert recoveries([fault("killed", "rollout worker", 21.0), fault("delayed", "rollout worker", 10.0)], log) == [
        None,
        None,
    ]


def test_the_table_counts_faults_and_gives_median_and_maximum():
    faults = [fault("killed", "learner", 0.0)._replace(recovery_s=seconds) for seconds in (1.0, 9.0, 2.0)]
    console = plain_console(width=100, record=True, file=io.StringIO())
    console.print(fault_table([*faults, fault("delayed", "learner", 0.0)]))
    rows = [
        [cell.strip() for cell in line.split("│")[1:-1]] for line in console.export_text().splitlines() if "│" in line
    ]
    assert rows == [["learner delayed", "1", "", ""], ["learner killed", "3", "2.0", "9.0"]]


def test_every_kind_of_process_is_a_victim():
    killed = {kind.victim for kind in KINDS if kind.action == "killed"}
    assert killed == {"rollout worker", "replay shard", "evaluation", "learner", DRIVER, MLFLOW, TRACKER}
    assert {kind.victim for kind in KINDS if kind.action == FULL} == {"rollout worker", "replay shard", "learner"}


def test_the_process_that_writes_to_mlflow_is_found_by_its_command_line():
    process = MlflowProcess()
    try:
        words = psutil.Process(process.pid).cmdline()
    finally:
        process.close()
    assert [kind for kind in TITLES if is_of_kind(words, kind)] == [TRACKER]


class FakeServer:
    def kill(self):
        pass

    def start_again(self):
        pass


class FakeDriver:
    """A driver whose child writes to MLflow, and is replaced when the test says so."""

    def __init__(self):
        self.child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)", TITLES[TRACKER][0]])
        self.writers = [psutil.Process(self.child.pid)]

    def children(self, kind):
        assert kind == TRACKER
        return self.writers


def test_an_outage_of_mlflow_ends_when_another_process_has_delivered_rows(tmp_path):
    chaos = ChaosRun(Chaos(out=tmp_path), plain_console(file=io.StringIO()))
    chaos.driver, chaos.server = driver, server = FakeDriver(), FakeServer()
    chaos.folder.path.mkdir()
    mark = PushedMark(chaos.folder.pushed, 1_000)
    mark.write(10)
    kind = next(kind for kind in KINDS if kind.victim == TRACKER)
    assert chaos._cut_off_mlflow(kind, 5.0) and driver.child.wait() == -signal.SIGKILL and chaos.server is server
    mark.write(20)  # by the process that was killed: its reply was on the way
    chaos._follow_outage()
    assert chaos.outages == []
    driver.writers = []
    chaos._follow_outage()
    assert chaos.outages == []
    driver.writers = [psutil.Process()]
    chaos._follow_outage()
    assert [fault.kind for fault in chaos.outages] == [kind] and chaos.outages[0].recovery_s > 0


def test_a_process_that_has_gone_by_itself_is_no_fault(tmp_path):
    chaos = ChaosRun(Chaos(out=tmp_path), plain_console(file=io.StringIO()))
    chaos.driver, chaos.server = driver, _ = FakeDriver(), FakeServer()
    driver.child.kill()
    driver.child.wait()
    kind = next(kind for kind in KINDS if kind.victim == TRACKER)
    assert not chaos._cut_off_mlflow(kind, 5.0)
    driver.writers = []
    assert not chaos._cut_off_mlflow(kind, 5.0)


WRITER = """
import pathlib, sys
for line in sys.stdin:
    try:
        pathlib.Path(line.strip()).write_text("x")
        print("written", flush=True)
    except OSError as error:
        print(type(error).__name__, flush=True)
"""


def test_a_process_gets_write_errors_while_its_disk_is_full(tmp_path):
    with subprocess.Popen(
        [sys.executable, "-c", WRITER], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as writer:

        def write(name):
            writer.stdin.write(f"{tmp_path / name}\n")
            writer.stdin.flush()
            return writer.stdout.readline().strip()

        assert write("a") == "written"
        empty = fill_disk(psutil.Process(writer.pid))
        assert write("b") == "OSError"
        empty()
        assert write("c") == "written"


def test_the_chaos_run_has_two_of_every_component_that_can_be_lost(tmp_path):
    write_config(tmp_path / "chaos.toml", 5_000)
    config = read_config_file(tmp_path / "chaos.toml")
    assert (config.engine, config.workers, config.replay_shards, config.replay_placement) == ("ray", 2, 2, "actors")
    assert config.total_env_steps == 5_000


@pytest.mark.parametrize(
    ("flag", "value"),
    [
        ("--env-steps", "10"),
        ("--every-s", "0"),
        ("--deadline-s", "3"),
        ("--limit-s", "-1"),
    ],
)
def test_impossible_options_are_refused(capsys, tmp_path, monkeypatch, flag, value):
    monkeypatch.chdir(tmp_path)
    assert main(["chaos", flag, value]) == 2
    assert flag in capsys.readouterr().err and not list(tmp_path.iterdir())
