"""`shoal resume`: resumes a run at its end, from its newest usable checkpoint, or from its start."""

from __future__ import annotations

import dataclasses

from deploy.options.training import Resume
from deploy.runs.tracking import opened_tracker
from deploy.training import finished_at, resume_training
from learner.run_folder import find_run
from sim_core.checks import require


def run(command: Resume) -> int:
    """Resumes a run; returns the exit code.

    Raises:
      ConfigError: there is no such run, it has no usable checkpoint, it has finished, or another process trains it.
    """
    folder = find_run(command.run, command.runs_dir)
    with folder.lock(), opened_tracker(folder) as tracker:
        config = folder.config()
        total = config.total_env_steps if command.total_env_steps is None else command.total_env_steps
        config = dataclasses.replace(config, total_env_steps=total, device=command.device or config.device)
        done = finished_at(folder, config, tracker)
        require(
            done is None,
            f"the run has finished its {total} env steps; train on with --total-env-steps greater than {done}",
        )
        return resume_training(folder, config, tracker, command.cluster_options())
