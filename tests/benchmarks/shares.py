"""`make shares`: what becomes of a swarm of which one robot, a quarter, half or all learn.

Policies are trained with the preset `best` and so many learning robots, in one process, and each is then played at
every share in the same worlds. What was trained and played is kept (`--runs-dir`), and a command that is given again
goes on. Cells tell the share of the learning robots whose group reaches its goal; `all`, that of the worlds in which
every one of them does; `hit`, the share that ends in a collision. FL-ORCA and the method's rule play the same worlds.
Differences are paired, by world: the mean over the trainings, less that of the trainings at `one`. `--goal` gives
M_sensor sectors that face the goal (`sector_frame`), whose direction its state does not hold.
"""

import argparse
import csv
import dataclasses
import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from actors.evaluation.evaluation_store import stored_or_played
from actors.evaluation.evaluator import Candidate, evaluate
from actors.evaluation.statistics import Estimate, mean
from actors.policy.baselines import Baseline
from actors.policy.policy import WeightsSnapshot
from actors.rollout.env_spec import EnvSpec
from actors.service.messages import EpisodeStats
from dashboards.figures.stress_curves import Panel, stress_curves_png
from deploy.runs.policy_lookup import find_policy
from learner.presets import preset_config
from learner.run_folder import RunFolder
from sim_core import ENV_ID
from sim_core.config import ONE_LEARNER, WorldConfig
from sim_core.outcomes import Outcome
from sim_core.plugins import DISSERTATION_METHODS
from tests.benchmarks.learners import SHARES
from tests.benchmarks.trainings import trained

FIRST_SEED = 2_000_000_000
EXPERIMENT = "shares"
"""In MLflow, where the view by learners compares the trainings."""
FINAL_WORLDS = 200
"""That a training's own evaluation plays at its end."""
RULES = (Baseline.FL_ORCA, Baseline.GREEDY)


def parse(arguments: list[str] | None = None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.shares", description=__doc__)
    parser.add_argument("--methods", nargs="+", choices=DISSERTATION_METHODS, default=list(DISSERTATION_METHODS))
    parser.add_argument("--setups", nargs="+", default=["10x2", "10x4"], metavar="ROBOTSxGROUPS")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2], help="of the trainings")
    parser.add_argument("--worlds", type=int, default=200, help="played by each player at each share")
    parser.add_argument("--goal", action="store_true", help="M_sensor's sectors face the goal")
    parser.add_argument("--runs-dir", type=Path, default=Path("runs/shares"), help="what is trained, played and found")
    return parser.parse_args(arguments)


class Played(NamedTuple):
    """What a player's trainings did at one share, or a rule: `[players, worlds, learners]` outcomes."""

    outcome: NDArray[np.int8]

    @property
    def arrived(self) -> NDArray[np.float64]:
        """Share of the learning robots of each world that arrived `[worlds]`, the mean over the trainings."""
        return np.asarray((self.outcome == Outcome.GOAL).mean(axis=(0, 2)))

    @property
    def of_each(self) -> NDArray[np.float64]:
        """Share of the learning robots that arrived `[players]`."""
        return np.asarray((self.outcome == Outcome.GOAL).mean(axis=(1, 2)))

    @property
    def rate(self) -> Estimate:
        """That of all, with the interval of worlds."""
        return Estimate(*np.clip(mean(self.arrived), 0.0, 1.0))

    def text(self) -> str:
        """A cell of the table."""
        rates = 100 * self.of_each
        text = f"{rates.mean():.0f}" + (f" ± {rates.std():.0f}" if len(rates) > 1 else "")
        if self.outcome.shape[2] == 1:
            return text
        everybody = 100 * (self.outcome == Outcome.GOAL).all(axis=2).mean()
        return f"{text}; all {everybody:.0f}; hit {100 * (self.outcome == Outcome.COLLISION).mean():.0f}"


Found = dict[str, dict[str, Played]]
"""What each player did, by its name and the share that it played at."""


class Study(NamedTuple):
    """One method in one setup."""

    method: str
    setup: str
    options: argparse.Namespace

    @property
    def faces_goal(self) -> bool:
        return bool(self.options.goal) and self.method == "sensor"

    @property
    def name(self) -> str:
        return f"{self.method}{'-goal' if self.faces_goal else ''}-{self.setup}"

    @property
    def title(self) -> str:
        return f"{self.method}{', sectors face the goal' if self.faces_goal else ''} {self.setup}"

    def train(self, learners: str, seed: int) -> RunFolder:
        """A training, which is made unless it is there."""
        robots, groups = self.setup.split("x")
        settings = ["--preset", "best", "--method", self.method, "--robots", robots, "--groups", groups]
        settings += ["--learners", learners, "--seed", str(seed), "--engine", "process", "--experiment", EXPERIMENT]
        settings += ["--final-eval-episodes", str(FINAL_WORLDS)]
        if self.faces_goal:
            settings += ["--sector-frame", "goal", "--random-turns", "False"]
        return trained(self.options.runs_dir, f"{self.name}-{learners}-{seed}", settings)

    def world(self) -> WorldConfig:
        """The world of the trainings, in which one robot learns."""
        robots, groups = map(int, self.setup.split("x"))
        world = preset_config("best", self.method, robots, groups).world
        return dataclasses.replace(world, sector_frame="goal") if self.faces_goal else world

    def play(self, players: dict[str, Candidate], learners: str) -> Played:
        """What players, by name, did at a share; what has been played is read."""
        world = dataclasses.replace(self.world(), learners=learners)
        spec, seeds = EnvSpec(ENV_ID, world), list(range(FIRST_SEED, FIRST_SEED + self.options.worlds))
        found = []
        for name, player in players.items():
            path = self.options.runs_dir / "played" / f"{name}-at-{learners}"
            updates = player.version if isinstance(player, WeightsSnapshot) else 0

            def play(player: Candidate = player) -> EpisodeStats:
                return evaluate(spec, player, seeds)

            stats = stored_or_played(path, spec, name, updates, seeds, play)
            found.append(stats.outcome.reshape(len(seeds), world.num_learners))
        return Played(np.array(found))

    def run(self) -> Found:
        """Trains and plays what is missing."""
        found: Found = {}
        for rule in RULES:
            found[str(rule)] = {at: self.play({f"{self.name}-{rule}": rule}, at) for at in SHARES}
        for learners in SHARES:
            folders = [self.train(learners, seed) for seed in self.options.seeds]
            players: dict[str, Candidate] = {
                folder.path.name: find_policy(folder, folder.config()) for folder in folders
            }
            found[trained_at(learners)] = {at: self.play(players, at) for at in SHARES}
        return found


def trained_at(learners: str) -> str:
    return f"trained at {learners}"


def table(study: Study, found: Found) -> Table:
    """One row a player, one column a share that it is played at."""
    seeds = len(study.options.seeds)
    result = Table(title=f"{study.title}: % arrive (± over {seeds} seeds); all arrive; end in a collision")
    for column in ("player", *(f"played at {share}" for share in SHARES)):
        result.add_column(column, justify="left" if column == "player" else "right")
    for player, at in found.items():
        result.add_row(player, *(at[share].text() for share in SHARES))
    return result


def differences(study: Study, found: Found) -> Table:
    """Points by which the policies of other shares are better, or worse, than those of one robot."""
    result = Table(title=f"{study.title}: points of arrival above {trained_at(ONE_LEARNER)}, paired by world")
    for column in ("player", *(f"played at {share}" for share in SHARES)):
        result.add_column(column, justify="left" if column == "player" else "right")
    alone = found[trained_at(ONE_LEARNER)]
    for learners in SHARES[1:]:
        texts = []
        for share in SHARES:
            value, low, high = (
                100 * each for each in mean(found[trained_at(learners)][share].arrived - alone[share].arrived)
            )
            texts.append(f"{value:+.0f} ({low:+.0f} … {high:+.0f})")
        result.add_row(trained_at(learners), *texts)
    return result


def write(path: Path, studies: list[tuple[Study, Found]]) -> None:
    """Writes every cell as CSV: the rate of arrival with its interval, in shares."""
    columns = ["method", "setup", "player", "played_at", "trainings", "worlds", "arrive", "low", "high", "hit"]
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(columns)
        for study, found in studies:
            for player, at in found.items():
                for share, played in at.items():
                    hit = float((played.outcome == Outcome.COLLISION).mean())
                    numbers = (f"{number:.4f}" for number in (*played.rate, hit))
                    row = [study.method, study.setup, player, share, *played.outcome.shape[:2]]
                    writer.writerow([*row, *numbers])


def panel(study: Study, found: Found) -> Panel:
    """Arrival over the share of robots that learn."""
    robots = study.world().num_robots
    counts = [dataclasses.replace(study.world(), learners=share).num_learners for share in SHARES]
    curves = {player: [at[share].rate for share in SHARES] for player, at in found.items()}
    return Panel(f"share of robots that learn, {study.title}", tuple(round(c / robots, 3) for c in counts), curves)


def main(arguments: list[str] | None = None) -> int:
    options, console = parse(arguments), Console(width=150)
    studies = []
    for method in options.methods:
        for setup in options.setups:
            study = Study(method, setup, options)
            found = study.run()
            studies.append((study, found))
            console.print(table(study, found))
            console.print(differences(study, found))
    panels = [panel(study, found) for study, found in studies]
    path = options.runs_dir / "shares"
    write(path.with_suffix(".csv"), studies)
    stress_curves_png(panels, path.with_suffix(".png"), "Learning robots that arrive")
    print(path.with_suffix(".csv"), path.with_suffix(".png"))
    return 0


if __name__ == "__main__":
    sys.exit(main())
