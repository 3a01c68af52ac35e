"""`shoal train` and `shoal resume`: a run with its display, and what it leaves behind."""

from __future__ import annotations

import dataclasses
import datetime
import shlex
import signal

from rich.console import Console

from actors.policy.baselines import Baseline
from actors.rollout.vector_env import env_shape
from deploy.console.summary_tables import evaluation_table, summary_lines
from deploy.console.training_display import make_display
from deploy.options.training import Launch, Resume, Train
from deploy.runs.artifacts import log_artifacts
from deploy.runs.folders import check_lasting, check_plain_name, make_folder, new_storage, run_location
from learner.checkpoints.checkpoint import Checkpoint, finished_names
from learner.config import RunConfig, config_hash
from learner.placement import Place
from learner.run import RunResult, execute, resume_point
from learner.run_folder import RunFolder, RunIdentity, find_run
from learner.tracking.journal import Row
from learner.tracking.mlflow_run import Tracker
from learner.tracking.redaction import full_uri, public_uri
from learner.training.memory_estimate import check_fits
from learner.update.learner import learning_device
from sim_core.checks import require


def run_base(config: RunConfig) -> str:
    """What names of runs with `config` begin with."""
    return config.name.replace("×", "").replace(" ", "-").replace("/", "-")


def _new_folder(config: RunConfig, launch: Launch, or_resume: bool) -> RunFolder:
    stamp = datetime.datetime.now().strftime("%Y%m%d-%H%M%S")
    folder = launch.runs_dir / (launch.name or f"{run_base(config)}-{stamp}")
    require(
        or_resume or not folder.exists(),
        f"{folder} exists already; choose another --name, or go on with `shoal resume {folder.name}`",
    )
    return RunFolder(folder)


def train(command: Train) -> int:
    """Starts a run; returns the exit code."""
    config, launch = command.run, command.launch
    check_lasting(launch.runs_dir)
    if launch.name is not None:
        check_plain_name(launch.name)
        require(launch.name not in list(Baseline), f"--name {launch.name} is that of a baseline; choose another")
    if command.or_resume:
        require(launch.name is not None, "--or-resume needs --name, the run to go on with")
    folder = _new_folder(config, launch, command.or_resume)
    if folder.has_begun():
        with folder.hold():
            _check_storage(folder, command.checkpoint_url)
            return _go_on(folder, config, launch.place())
    make_folder(launch.runs_dir, "--runs-dir")
    if launch.ray_address() is None:
        check_fits(config)
    else:
        env_shape(config.env)  # refuses an environment that cannot be made
    _check_device(config, launch.ray_address())
    storage = new_storage(command.checkpoint_url, folder.path.name, command.keep_best)
    tracker = Tracker(launch.tracking(), launch.experiment, launch.artifact_root())
    tracker.start(config)
    with folder.hold():
        folder.save_storage(storage)
        folder.save_config(config)
        folder.save_identity(RunIdentity(config.name, public_uri(tracker.uri), launch.experiment, tracker.run_id))
        return _run(folder, config, tracker, None, launch.place())


def resume(command: Resume) -> int:
    """Goes on with a run; returns the exit code."""
    folder = find_run(command.run, command.runs_dir)
    with folder.hold():
        config = folder.config()
        checkpoint, skipped = resume_point(folder, config)
        config = _extended(config, command.total_env_steps, checkpoint.state["env_steps"])
        config = dataclasses.replace(config, device=command.device or config.device)
        tracker = _tracker(folder.identity())
        _say_where(checkpoint, skipped)
        return _resumed(folder, config, tracker, checkpoint, command.place())


def _check_storage(folder: RunFolder, checkpoint_url: str | None) -> None:
    """Refuses a `--checkpoint-url` under which the run does not have its checkpoints."""
    if checkpoint_url is not None:
        location = folder.checkpoint_location()
        require(
            run_location(checkpoint_url, folder.path.name) == location,
            f"{folder.path} has its checkpoints at {location}; leave out --checkpoint-url, or choose another --name",
        )


def _go_on(folder: RunFolder, config: RunConfig, place: Place) -> int:
    """Goes on with a run that is not finished, from its start if it has no checkpoint; returns the exit code."""
    known = folder.config()
    require(
        config_hash(known) == config_hash(config),
        f"{folder.path} holds a run of other settings; choose another --name",
    )
    identity = folder.identity()
    tracker = _tracker(identity)
    if config.total_env_steps <= known.total_env_steps and tracker.is_finished(identity.mlflow_run_id):
        Console().print(f"run {folder.path} has finished before", highlight=False, soft_wrap=True)
        return 0
    checkpoint = None
    if finished_names(folder.checkpoint_location()):
        checkpoint, skipped = resume_point(folder, config)
        _say_where(checkpoint, skipped)
    return _resumed(folder, config, tracker, checkpoint, place)


def _tracker(identity: RunIdentity) -> Tracker:
    return Tracker(full_uri(identity.tracking_uri), identity.experiment, None)


def _say_where(checkpoint: Checkpoint, skipped: list[str]) -> None:
    for reason in skipped:
        Console().print(f"skipped: {reason}", markup=False, highlight=False, soft_wrap=True)
    Console().print(f"going on from {checkpoint.folder}", markup=False, highlight=False, soft_wrap=True)


def _resumed(
    folder: RunFolder, config: RunConfig, tracker: Tracker, checkpoint: Checkpoint | None, place: Place
) -> int:
    _check_device(config, place.address)
    tracker.resume(folder.identity().mlflow_run_id)
    folder.save_config(config)
    return _run(folder, config, tracker, checkpoint, place)


def _check_device(config: RunConfig, address: str | None) -> None:
    """Refuses a device that is not there; what a cluster has is checked once it is joined."""
    if config.engine == "process" or address is None:
        learning_device(config.device)


def _extended(config: RunConfig, total_env_steps: int | None, done: int) -> RunConfig:
    if total_env_steps is not None:
        config = dataclasses.replace(config, total_env_steps=total_env_steps)
    require(
        done < config.total_env_steps,
        f"the run has finished its {config.total_env_steps} env steps; "
        f"train on with --total-env-steps greater than {done}",
    )
    return config


def _run(folder: RunFolder, config: RunConfig, tracker: Tracker, checkpoint: Checkpoint | None, place: Place) -> int:
    console = Console()
    console.print(f"run {folder.path}", highlight=False, soft_wrap=True)
    with make_display(console, config.total_env_steps) as display:

        def finish(result: RunResult, rows: list[Row]) -> None:
            display.message("logging curve, animation and policy")
            log_artifacts(folder, config, tracker, result, rows)

        result = execute(folder, config, tracker, display, checkpoint, place, finish)
    if result.evaluation is None:
        name = signal.Signals(result.stopped_by).name if result.stopped_by else "a signal"
        saved = "checkpoint saved" if result.checkpoint else "its checkpoint could not be written"
        console.print(f"stopped by {name} at {result.env_steps:,} env steps; {saved}", highlight=False)
        console.print(f"go on with: {resume_command(folder)}", highlight=False, soft_wrap=True)
        return 128 + (result.stopped_by or 0)
    console.print(evaluation_table(result.evaluation, config.name))
    for line in summary_lines(folder, result, public_uri(tracker.uri), config.env.is_swarm):
        console.print(line, markup=False, highlight=False, soft_wrap=True)
    return 0


def resume_command(folder: RunFolder) -> str:
    """The command that goes on with a run, from anywhere."""
    return f"shoal resume {shlex.quote(str(folder.path))}"
