"""Trains a run in the foreground: shows its progress, stores its artifacts, and tells how to resume it."""

from __future__ import annotations

import shlex
import signal

from deploy.console.summary_tables import evaluation_table, setups_table, summary_lines
from deploy.console.terminal import plain_console
from deploy.console.training_display import make_display
from deploy.runs.checks import check_device, check_environment
from deploy.runs.end_imports import EndImports
from learner.checkpoints.checkpoint import Checkpoint, finished_names
from learner.cluster_options import ClusterOptions
from learner.config import RunConfig, check_files_unchanged
from learner.run import RunResult, RunSession, Step, resume_point
from learner.run_end import SHOWN, RunEnd
from learner.run_folder import RunFolder
from learner.tracking.journal import Row
from learner.tracking.redaction import public_uri
from learner.tracking.tracked_run import TrackedRun
from learner.training.cluster import Cluster
from learner.training.stop_signals import Interrupted


def finished_at(folder: RunFolder, config: RunConfig, tracker: TrackedRun) -> int | None:
    """Env steps of a run whose training and end are whole; None of any other.

    Runs of earlier versions have no record of their end. MLflow knows whether they have finished.
    """
    end = RunEnd.open(folder.end, config)
    if end is not None:
        return end.state.env_steps if end.is_complete else None
    is_longer = config.total_env_steps > folder.config().total_env_steps
    is_finished = not is_longer and not folder.end.exists() and tracker.is_finished(folder.identity().mlflow_run_id)
    return config.total_env_steps if is_finished else None


def _resume_point(folder: RunFolder, config: RunConfig) -> Checkpoint | None:
    """The checkpoint from which an unfinished run goes on; None where it needs none. Prints what will be done."""
    console = plain_console()
    if RunEnd.open(folder.end, config) is not None:
        console.print("all env steps are done; going on with the end of the run")
        return None
    if not finished_names(folder.checkpoint_location()) and not folder.end.exists():
        console.print("there is no checkpoint yet; starting again")
        return None
    checkpoint, skipped = resume_point(folder, config)
    for reason in skipped:
        console.print(f"skipped: {reason}", soft_wrap=True)
    console.print(f"going on from {checkpoint.folder}", soft_wrap=True)
    return checkpoint


def resume_training(folder: RunFolder, config: RunConfig, tracker: TrackedRun, options: ClusterOptions) -> int:
    """Resumes a run at its end, from its newest usable checkpoint, or from its start; returns the exit code.

    Raises:
      ConfigError: no checkpoint can be used, the config's device is not there, a user's own method or scene has
        changed, or its environment does what it must not.
    """
    checkpoint = _resume_point(folder, config)
    check_files_unchanged(config)
    check_environment(folder, config, options.deadline_s)
    check_device(config, options.address)
    identity = folder.identity()
    tracker.resume(identity.mlflow_run_id)
    folder.save_identity(identity._replace(tracking_uri=public_uri(tracker.uri)))
    folder.save_config(config)
    return run_training(folder, config, tracker, checkpoint, options)


def run_training(
    folder: RunFolder,
    config: RunConfig,
    tracker: TrackedRun,
    checkpoint: Checkpoint | None,
    options: ClusterOptions,
    opened: Cluster | None = None,
) -> int:
    """Trains to the end or to a signal; returns the exit code, 128 + the signal's number after one.

    Where `opened` is given, the components have been started already.
    """
    console = plain_console()
    console.print(f"run {folder.path}", soft_wrap=True)
    try:
        with make_display(console, config.total_env_steps) as display:

            def steps(result: RunResult, rows: list[Row]) -> list[Step]:
                from deploy.runs.artifacts import artifact_steps  # at the end, since it imports matplotlib

                return artifact_steps(folder, config, tracker, display.message, result, rows)

            shown = EndImports(display, tracker, config.engine == "ray")
            result = RunSession(folder, config, tracker, shown, options, opened).execute(checkpoint, steps)
    except Interrupted as interrupted:
        return _stopped(folder, interrupted.signal, "")
    if result.evaluation is None:
        saved = "checkpoint saved" if result.checkpoint else "its checkpoint could not be written"
        return _stopped(folder, result.stopped_by or 0, f" at {result.env_steps:,} env steps; {saved}")
    _show(folder, config, tracker, result)
    return 0


def _stopped(folder: RunFolder, number: int, where: str) -> int:
    """Tells how to resume a run that a signal stopped; returns the exit code."""
    console = plain_console()
    console.print(f"stopped by {signal.Signals(number).name if number else 'a signal'}{where}")
    console.print(f"resume with: {resume_command(folder)}", soft_wrap=True)
    return 128 + number


def _show(folder: RunFolder, config: RunConfig, tracker: TrackedRun, result: RunResult) -> None:
    """Prints the summary of a finished run, which is then complete if MLflow knows that it is finished."""
    assert result.evaluation is not None
    console = plain_console()
    console.print(evaluation_table(result.evaluation, config.name))
    if result.by_setup:
        console.print(setups_table(result.by_setup))
    for line in summary_lines(folder, result, public_uri(tracker.uri), config.env.is_swarm):
        console.print(line, soft_wrap=True)
    end = RunEnd.open(folder.end, config)
    if end is not None and result.is_known:
        end.make(SHOWN, lambda: None)


def resume_command(folder: RunFolder) -> str:
    """The command that resumes a run, from any working directory."""
    return f"shoal resume {shlex.quote(str(folder.path))}"
