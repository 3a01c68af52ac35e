"""Trains a run in the foreground: shows its progress, stores its artifacts, and tells how to resume it."""

from __future__ import annotations

import shlex
import signal

from actors.rollout.env_guard import env_guard
from actors.rollout.vector_env import env_shape
from deploy.console.summary_tables import evaluation_table, setups_table, summary_lines
from deploy.console.terminal import plain_console
from deploy.console.training_display import make_display
from deploy.runs.artifacts import log_artifacts
from learner.checkpoints.checkpoint import Checkpoint
from learner.cluster_options import ClusterOptions
from learner.config import RunConfig, check_files_unchanged
from learner.run import RunResult, RunSession
from learner.run_folder import RunFolder
from learner.tracking.journal import Row
from learner.tracking.local_store import find_store
from learner.tracking.mlflow_run import Tracker
from learner.tracking.redaction import full_uri, public_uri
from learner.update.learner import learning_device


def check_device(config: RunConfig, address: str | None) -> None:
    """Raises ConfigError if this machine lacks the config's device; a cluster's is checked once Ray has joined it."""
    if config.engine == "process" or address is None:
        learning_device(config.device)


def check_environment(folder: RunFolder, config: RunConfig, deadline_s: float) -> None:
    """Rehearses the run's environment, so that nothing starts if it does what it must not.

    Raises:
      ConfigError: see `env_shape`; a user's own traceback is kept in the run's folder.
    """
    with folder.traceback_kept(), env_guard(deadline_s):
        env_shape(config.env)


def open_tracker(folder: RunFolder) -> Tracker:
    """The MLflow tracker of a run that exists already.

    Raises:
      ConfigError: its store cannot be opened, or has gone.
    """
    identity = folder.identity()
    return Tracker(full_uri(find_store(identity.tracking_uri, identity.mlflow_run_id, folder.path)), None, None)


def print_resume_point(checkpoint: Checkpoint, skipped: list[str]) -> None:
    """Prints the checkpoint from which a run resumes, and why newer ones were skipped."""
    for reason in skipped:
        plain_console().print(f"skipped: {reason}", soft_wrap=True)
    plain_console().print(f"going on from {checkpoint.folder}", soft_wrap=True)


def resume_training(
    folder: RunFolder, config: RunConfig, tracker: Tracker, checkpoint: Checkpoint | None, options: ClusterOptions
) -> int:
    """Resumes a run from a checkpoint, or from its start if it has none; returns the exit code.

    Raises:
      ConfigError: the config's device is not there, or a user's own method or scene has changed, or its environment
        does what it must not.
    """
    check_files_unchanged(config)
    check_environment(folder, config, options.deadline_s)
    check_device(config, options.address)
    identity = folder.identity()
    tracker.resume(identity.mlflow_run_id)
    folder.save_identity(identity._replace(tracking_uri=public_uri(tracker.uri)))
    folder.save_config(config)
    return run_training(folder, config, tracker, checkpoint, options)


def run_training(
    folder: RunFolder, config: RunConfig, tracker: Tracker, checkpoint: Checkpoint | None, options: ClusterOptions
) -> int:
    """Trains to the end or to a signal; returns the exit code, 128 + the signal's number after one."""
    console = plain_console()
    console.print(f"run {folder.path}", soft_wrap=True)
    with make_display(console, config.total_env_steps) as display:

        def finish(result: RunResult, rows: list[Row]) -> None:
            display.message("logging curve, animation and policy")
            log_artifacts(folder, config, tracker, result, rows, display.message)

        result = RunSession(folder, config, tracker, display, options).execute(checkpoint, finish)
    if result.evaluation is None:
        name = signal.Signals(result.stopped_by).name if result.stopped_by else "a signal"
        saved = "checkpoint saved" if result.checkpoint else "its checkpoint could not be written"
        console.print(f"stopped by {name} at {result.env_steps:,} env steps; {saved}")
        console.print(f"resume with: {resume_command(folder)}", soft_wrap=True)
        return 128 + (result.stopped_by or 0)
    console.print(evaluation_table(result.evaluation, config.name))
    if result.by_setup:
        console.print(setups_table(result.by_setup))
    for line in summary_lines(folder, result, public_uri(tracker.uri), config.env.is_swarm):
        console.print(line, soft_wrap=True)
    return 0


def resume_command(folder: RunFolder) -> str:
    """The command that resumes a run, from any working directory."""
    return f"shoal resume {shlex.quote(str(folder.path))}"
