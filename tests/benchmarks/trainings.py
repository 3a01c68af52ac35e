"""Studies of trainings by `shoal train` that are kept: one that is there is used, one that was cut off goes on."""

import argparse
from pathlib import Path

from deploy.cli import main as shoal
from learner.run_folder import RunFolder
from sim_core.plugins import DISSERTATION_METHODS


def trained(runs_dir: Path, name: str, settings: list[str]) -> RunFolder:
    """The run of a training, which is made unless it is there."""
    folder = RunFolder(runs_dir / name)
    if shoal(["train", *settings, "--runs-dir", str(runs_dir), "--name", name, "--or-resume", "True"]):
        raise SystemExit(f"the training {folder.path} has not come to its end")
    return folder


def study_parser(module: str, text: str | None, episodes: int, runs_dir: Path) -> argparse.ArgumentParser:
    """A command line that names the trainings of a study and what their policies play.

    Args:
      module: the study's.
      text: its docstring.
      episodes: per player, setup and condition, by default.
      runs_dir: of the trainings, by default.
    """
    parser = argparse.ArgumentParser(prog=f"python -m {module}", description=text)
    parser.add_argument("--methods", nargs="+", choices=DISSERTATION_METHODS, default=list(DISSERTATION_METHODS))
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2], help="of the trainings")
    parser.add_argument("--episodes", type=int, default=episodes, help="per player, setup and condition")
    parser.add_argument(
        "--first-seed", type=int, default=2_000_000_000, help="of the episodes; calibration: 3000000000"
    )
    parser.add_argument("--runs-dir", type=Path, default=runs_dir, help="finished trainings are kept")
    parser.add_argument("train", nargs="*", help="after --: settings of the trainings, as of `shoal train`")
    return parser
