"""`shoal train`: starts a run, or with `--or-resume` resumes it if it exists."""

from __future__ import annotations

from contextlib import ExitStack

from actors.policy.baselines import Baseline
from actors.rollout.env_guard import env_guard
from deploy.console.terminal import plain_console
from deploy.options.training import Launch, Train
from deploy.runs.checks import check_device, check_environment
from deploy.runs.folders import (
    check_outlasts_job,
    check_plain_name,
    make_folder,
    new_storage,
    run_location,
    stamped_name,
)
from deploy.runs.tracking import opened_tracker
from learner.cluster_options import ClusterOptions
from learner.config import RunConfig, config_hash
from learner.engine import closed_on_error, open_cluster
from learner.run_folder import RunFolder, RunIdentity, Storage
from learner.tracking.begin_tracking import TrackingStart
from learner.tracking.redaction import public_uri
from learner.training.memory_estimate import check_fits
from sim_core.checks import require


def run(command: Train) -> int:
    """Trains a new run; returns the exit code.

    Raises:
      ConfigError: the name, a folder, the environment, the device or the tracking server cannot be used, the run does
        not fit in memory, or the run that `--or-resume` names has other settings.
    """
    config, launch = command.run, command.launch
    check_outlasts_job(launch.runs_dir)
    if launch.name is not None:
        check_plain_name(launch.name)
        require(launch.name not in list(Baseline), f"--name {launch.name} is that of a baseline; choose another")
    if command.or_resume:
        require(launch.name is not None, "--or-resume needs --name, the run to resume")
    folder = _run_folder(config, launch, command.or_resume)
    if folder.has_begun():
        with folder.lock():
            _check_storage(folder, command.checkpoint_url)
            return _resume(folder, config, launch.cluster_options())
    make_folder(launch.runs_dir, "--runs-dir")
    with TrackingStart() as tracking:  # before all that takes long
        check_environment(folder, config, launch.deadline_s)
        if launch.ray_address() is None:
            check_fits(config)
        check_device(config, launch.ray_address())
        storage = new_storage(command.checkpoint_url, folder.path.name, command.keep_best)
        return _start(folder, config, storage, launch, tracking)


def _start(folder: RunFolder, config: RunConfig, storage: Storage, launch: Launch, tracking: TrackingStart) -> int:
    """Starts the components while MLflow's store is opened, then the run; trains it; returns the exit code."""
    tracking.open(launch.tracking(), launch.experiment, launch.artifact_root())
    with folder.traceback_kept(), env_guard(launch.deadline_s):  # it makes an environment
        opened = open_cluster(config, 0, launch.cluster_options())
    with ExitStack() as stack:
        with closed_on_error(opened):
            from deploy.training import run_training  # here: MLflow and the components load meanwhile

            tracker = tracking.run()
            stack.enter_context(folder.lock())
            _check_free(folder, not folder.has_begun())  # another process may have begun it meanwhile
            tracker.start(config)
            folder.save_storage(storage)
            folder.save_config(config)
            folder.save_identity(RunIdentity(config.name, public_uri(tracker.uri), launch.experiment, tracker.run_id))
        return run_training(folder, config, tracker, None, launch.cluster_options(), opened)


def _run_folder(config: RunConfig, launch: Launch, or_resume: bool) -> RunFolder:
    """The run's folder; raises ConfigError if it exists and must not."""
    folder = RunFolder(launch.runs_dir / (launch.name or stamped_name(config)))
    _check_free(folder, or_resume)
    return folder


def _check_free(folder: RunFolder, may_exist: bool) -> None:
    """Raises ConfigError if the folder holds a run, or anything else, and must not."""
    require(
        may_exist or not folder.is_taken(),
        f"{folder.path} exists already; choose another --name, or resume it with `shoal resume {folder.path.name}`",
    )


def _check_storage(folder: RunFolder, checkpoint_url: str | None) -> None:
    """Raises ConfigError if the run's checkpoints are not at `--checkpoint-url`."""
    if checkpoint_url is not None:
        location = folder.checkpoint_location()
        require(
            run_location(checkpoint_url, folder.path.name) == location,
            f"{folder.path} has its checkpoints at {location}; leave out --checkpoint-url, or choose another --name",
        )


def _resume(folder: RunFolder, config: RunConfig, options: ClusterOptions) -> int:
    """Resumes an unfinished run; returns the exit code."""
    from deploy.training import finished_at, resume_training

    require(
        config_hash(folder.config()) == config_hash(config),
        f"{folder.path} holds a run of other settings; choose another --name",
    )
    with opened_tracker(folder) as tracker:
        if finished_at(folder, config, tracker) is not None:
            plain_console().print(f"run {folder.path} has finished before", soft_wrap=True)
            return 0
        return resume_training(folder, config, tracker, options)
