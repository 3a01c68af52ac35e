"""`shoal submit`: `shoal train` or `shoal sweep` as a job of a Ray cluster, the same again to go on."""

from __future__ import annotations

import os
import re
import shlex
import sys
from pathlib import Path

from deploy.commands.sweep import sweep_name
from deploy.commands.train import run_base
from deploy.options.training import Launch, Submit, Sweep, Train
from deploy.ray_jobs import Ending, Job, JobServer
from learner.config import config_hash
from learner.tracking.mlflow_run import COMMIT, git_commit
from learner.training.stop_signals import StopRequest, stop_on_signals
from sim_core.checks import require

TRACKING = "MLFLOW_TRACKING_URI"
STOPPING = "shoal: stopping the job, which saves a checkpoint first; Ctrl-C again leaves it to itself"
OK, FAILED, SIGNALLED = 0, 1, 128


def run_name(command: Train | Sweep) -> str:
    """The name under which a job runs and goes on: the given one, or what its settings say."""
    if isinstance(command, Sweep):
        return sweep_name(command)
    return command.launch.name or f"{run_base(command.run)}-{config_hash(command.run)}"


def job_arguments(arguments: tuple[str, ...], command: Train | Sweep) -> list[str]:
    """The arguments after `shoal` in the job: the given ones, with a name and an absolute folder of runs.

    A job's own folder is a copy that goes away, so relative folders are those of where it is submitted.
    """
    runs_dir = command.launch.runs_dir.absolute()
    added = ["--name", run_name(command), "--runs-dir", str(runs_dir)]
    return [*arguments, *added, *(["--or-resume", "True"] if isinstance(command, Train) else [])]


def job_name(arguments: tuple[str, ...], command: Train | Sweep) -> str:
    """The job's id but for the attempt's number: what runs, and under which name."""
    return re.sub(r"[^\w.-]+", "-", f"shoal-{arguments[0]}-{run_name(command)}")


def submit(command: Submit, job: Train | Sweep) -> int:
    """Submits the job or finds the one under way, and follows it; returns the exit code of the job's command."""
    working_dir = command.working_dir.absolute()
    require(
        (working_dir / "deploy" / "cli.py").is_file(),
        f"--working-dir {working_dir} is no checkout of shoal, which the job is to run; name one",
    )
    _check_launch(job.launch)
    server = JobServer(command.address)
    with stop_on_signals() as stop:
        found = _submitted(server, command, job, working_dir)
        if not command.follow:
            return OK
        ending = server.follow(found.id, stop, _write, STOPPING)
    return _exit_code(ending, found, stop)


def _check_launch(launch: Launch) -> None:
    require(launch.address is None, "a job runs on the cluster that takes it; name that one with `submit --address`")


def _submitted(server: JobServer, command: Submit, job: Train | Sweep, working_dir: Path) -> Job:
    """The last attempt where it is under way, else a new one."""
    name = job_name(command.command, job)
    running = [attempt for attempt in server.attempts(name) if not attempt.has_ended]
    if running:
        _write(f"shoal: following job {running[-1].id}, which is under way\n")
        return running[-1]
    entrypoint = f"python -m deploy {shlex.join(job_arguments(command.command, job))}"
    env = {COMMIT: git_commit()} | {key: os.environ[key] for key in (TRACKING,) if os.environ.get(key)}
    found = server.submit(name, entrypoint, working_dir, env, command.stop_wait_s)
    _write(f"shoal: job {found.id} on {server.address}\n")
    return found


def _exit_code(ending: Ending, job: Job, stop: StopRequest) -> int:
    if ending.status == "SUCCEEDED":
        return OK
    _write(f"shoal: job {job.id} {ending.status.lower()}; the same `shoal submit` goes on with it\n")
    if ending.status == "STOPPED":
        return SIGNALLED + (stop.signal or 15)
    return ending.exit_code or FAILED


def _write(text: str) -> None:
    sys.stdout.write(text)
    sys.stdout.flush()
