"""`shoal resume`: resumes a run from its newest usable checkpoint."""

from __future__ import annotations

import dataclasses

from deploy.options.training import Resume
from deploy.training import open_tracker, print_resume_point, resume_training
from learner.config import RunConfig
from learner.run import resume_point
from learner.run_folder import find_run
from sim_core.checks import require


def run(command: Resume) -> int:
    """Resumes a run; returns the exit code.

    Raises:
      ConfigError: there is no such run, it has no usable checkpoint, it has finished, or another process trains it.
    """
    folder = find_run(command.run, command.runs_dir)
    with folder.lock():
        config = folder.config()
        checkpoint, skipped = resume_point(folder, config)
        config = _extended(config, command.total_env_steps, checkpoint.state["env_steps"])
        config = dataclasses.replace(config, device=command.device or config.device)
        tracker = open_tracker(folder)
        print_resume_point(checkpoint, skipped)
        return resume_training(folder, config, tracker, checkpoint, command.cluster_options())


def _extended(config: RunConfig, total_env_steps: int | None, done: int) -> RunConfig:
    """The config with the new target; raises ConfigError if `done` env steps have reached it."""
    if total_env_steps is not None:
        config = dataclasses.replace(config, total_env_steps=total_env_steps)
    require(
        done < config.total_env_steps,
        f"the run has finished its {config.total_env_steps} env steps; "
        f"train on with --total-env-steps greater than {done}",
    )
    return config
