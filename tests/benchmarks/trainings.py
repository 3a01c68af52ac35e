"""Trainings by `shoal train` that are kept: one that is there is used, one that was cut off goes on."""

from pathlib import Path

from deploy.cli import main as shoal
from learner.run_folder import RunFolder


def trained(runs_dir: Path, name: str, settings: list[str]) -> RunFolder:
    """The run of a training, which is made unless it is there."""
    folder = RunFolder(runs_dir / name)
    if shoal(["train", *settings, "--runs-dir", str(runs_dir), "--name", name, "--or-resume", "True"]):
        raise SystemExit(f"the training {folder.path} has not come to its end")
    return folder
