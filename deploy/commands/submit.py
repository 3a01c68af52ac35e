"""`shoal submit`: runs `shoal train` or `shoal sweep` as a job on a Ray cluster; the same command again resumes it."""

from __future__ import annotations

import json
import os
import re
import shlex
import sys
from pathlib import Path

from deploy.options.training import Launch, Submit, Sweep, Train
from deploy.ray_jobs import Job, JobResult, JobServer
from deploy.runs.folders import default_name, default_sweep_name
from learner.config import config_hash
from learner.sweep.grid import parse_overrides
from learner.tracking.mlflow_run import COMMIT, git_commit
from learner.training.stop_signals import StopRequest, stop_on_signals
from sim_core.checks import require
from sim_core.plugins import METHODS, SCENES, SOURCES, file_of, read_source

TRACKING = "MLFLOW_TRACKING_URI"
STOPPING = "shoal: stopping the job, which saves a checkpoint first; Ctrl-C again leaves it to itself"
OK, FAILED, SIGNALLED = 0, 1, 128


def run_name(command: Train | Sweep) -> str:
    """The name under which a job runs and is resumed: the given one, or one that its settings decide."""
    if command.launch.name is not None:
        return command.launch.name
    if isinstance(command, Sweep):
        return default_sweep_name(command.grid)
    return f"{default_name(command.run)}-{config_hash(command.run)}"


def job_arguments(arguments: tuple[str, ...], command: Train | Sweep) -> list[str]:
    """The job's command line after `shoal`: the given one, with a name and an absolute folder of runs.

    A job runs in a temporary copy of its working folder. Relative paths therefore count from where it is submitted.

    Args:
      arguments: the job's command line as given.
      command: the same, parsed.
    """
    runs_dir = command.launch.runs_dir.absolute()
    added = ["--name", run_name(command), "--runs-dir", str(runs_dir)]
    return [*arguments, *added, *(["--or-resume", "True"] if isinstance(command, Train) else [])]


def job_name(arguments: tuple[str, ...], command: Train | Sweep) -> str:
    """The job's id without its attempt number: the command, and the name under which it runs."""
    return re.sub(r"[^\w.-]+", "-", f"shoal-{arguments[0]}-{run_name(command)}")


def run(command: Submit) -> int:
    """Submits the job, or finds it if it is still running, and follows it; returns the job's exit code.

    Raises:
      ConfigError: the working folder is no checkout of shoal, the job names a cluster of its own, or no job server
        takes it.
    """
    assert command.job is not None
    working_dir = command.working_dir.absolute()
    require(
        (working_dir / "deploy" / "cli.py").is_file(),
        f"--working-dir {working_dir} is not a checkout of shoal, which the job runs; name one",
    )
    _check_launch(command.job.launch)
    server = JobServer(command.address)
    with stop_on_signals() as stop:
        job = _running_or_submitted(server, command, command.job, working_dir)
        if not command.follow:
            return OK
        result = server.follow(job.id, stop, _write, STOPPING)
    return _exit_code(result, job, stop)


def _check_launch(launch: Launch) -> None:
    require(launch.address is None, "a job runs on the cluster that takes it; name that one with `submit --address`")


def _running_or_submitted(server: JobServer, command: Submit, job: Train | Sweep, working_dir: Path) -> Job:
    """The last attempt if it is still running, else a new one."""
    name = job_name(command.arguments, job)
    running = [attempt for attempt in server.attempts(name) if not attempt.has_ended]
    if running:
        _write(f"shoal: following job {running[-1].id}, which is under way\n")
        return running[-1]
    entrypoint = f"python -m deploy {shlex.join(job_arguments(command.arguments, job))}"
    env = {COMMIT: git_commit()} | {key: os.environ[key] for key in (TRACKING,) if os.environ.get(key)}
    env |= {SOURCES: json.dumps(_user_files(job))}
    submitted = server.submit(name, entrypoint, working_dir, env, command.stop_wait_s)
    _write(f"shoal: job {submitted.id} on {server.address}\n")
    return submitted


def _user_files(job: Train | Sweep) -> dict[str, str]:
    """Texts of the user's own methods and scenes, by the names under which the job looks for them."""
    if isinstance(job, Train):
        names = [(METHODS, job.run.world.method), (SCENES, job.run.world.scene)]
    else:
        scene = parse_overrides(job.grid.set)[1].get("scene")
        names = [(METHODS, method) for method in job.grid.methods] + ([(SCENES, scene)] if scene else [])
    found: dict[str, str] = {}
    for kind, name in names:
        path = file_of(kind, name)
        if path:
            found[path] = found[os.path.relpath(path)] = read_source(kind, name)
    return found


def _exit_code(result: JobResult, job: Job, stop: StopRequest) -> int:
    if result.status == "SUCCEEDED":
        return OK
    _write(f"shoal: job {job.id} {result.status.lower()}; the same `shoal submit` goes on with it\n")
    if result.status == "STOPPED":
        return SIGNALLED + (stop.signal or 15)
    return result.exit_code or FAILED


def _write(text: str) -> None:
    sys.stdout.write(text)
    sys.stdout.flush()
