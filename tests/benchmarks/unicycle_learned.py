"""What learning as a unicycle gains: policies trained so, beside policies trained as a holonomic robot, and the rules.

For every method, trainings of the preset `generalist` in three setups with several seeds, with either robot; then all
drive a unicycle in the same start scenes. M_IN's and M_OUT's teacher, a rule for a holonomic robot, fades in trainings
as a unicycle.

python -m tests.benchmarks.unicycle_learned
"""

import argparse
import sys
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from actors.evaluation.evaluator import Candidate
from actors.evaluation.statistics import mean
from actors.rollout.env_spec import EnvSpec
from deploy.console.summary_tables import signed_percent
from deploy.runs.policy_lookup import find_policy
from sim_core import ENV_ID
from sim_core.outcomes import Outcome
from sim_core.plugins import METHODS, find
from tests.benchmarks.robustness import CLEAN, FADES, rules_of, training
from tests.benchmarks.trainings import study_parser
from tests.benchmarks.unicycle import LIMITS

TURN_DEG_S, ACCELERATION_M_S2 = LIMITS[1]
HOLONOMIC, TRAINED = "trained as a holonomic robot", "trained as a unicycle"
DRIVING = (
    *("--kinematics", "unicycle", "--turn-rate-limit-deg-s", str(TURN_DEG_S)),
    *("--acceleration-limit-m-s2", str(ACCELERATION_M_S2)),
)


def parse(arguments: list[str] | None = None) -> argparse.Namespace:
    parser = study_parser("tests.benchmarks.unicycle_learned", __doc__, 1_000, Path("runs/robustness"))
    return parser.parse_args(arguments)


def outcomes(method: str, options: argparse.Namespace) -> dict[str, dict[str, np.ndarray]]:
    """By setup and player: the outcomes `[trainings, episodes]` of driving a unicycle; of a rule `[1, episodes]`."""
    kinds = {HOLONOMIC: (CLEAN, ()), TRAINED: ("unicycle", (*DRIVING, *FADES))}
    runs = {
        player: [training(method, kind, seed, settings, options) for seed in options.seeds]
        for player, (kind, settings) in kinds.items()
    }
    from learner.ray_backend.cluster import evaluate_in_tasks  # imports Ray, which `shoal train` configures first

    worlds = runs[TRAINED][0].config().env.worlds
    players: dict[str, list[Candidate]] = {
        name: [find_policy(folder, folder.config()) for folder in folders] for name, folders in runs.items()
    } | {str(rule): [rule] for rule in rules_of(worlds[0])}
    seeds = list(range(options.first_seed, options.first_seed + options.episodes))
    unicycles = [EnvSpec(ENV_ID, world) for world in worlds]
    found: dict[str, dict[str, np.ndarray]] = {world.setup: {} for world in worlds}
    for name, members in players.items():
        played = [evaluate_in_tasks(unicycles, member, seeds, None) for member in members]
        for place, world in enumerate(worlds):
            found[world.setup][name] = np.array([stats[place].outcome for stats in played])
    return found


def main(arguments: list[str] | None = None) -> int:
    options = parse(arguments)
    limits = f"{TURN_DEG_S:.0f}°/s, {ACCELERATION_M_S2:.0f} m/s²"
    table = Table(
        title=f"success (and collisions) of a unicycle of {limits}: {len(options.seeds)} trainings, "
        f"{options.episodes} episodes a setup"
    )
    for name in ("method", "setup", "player", "success", "trained as a unicycle is better by"):
        table.add_column(name, justify="left" if name in ("method", "setup", "player") else "right")
    for method in options.methods:
        for setup, players in outcomes(method, options).items():
            goals = {name: (found == Outcome.GOAL).mean(axis=0) for name, found in players.items()}
            for name, found in players.items():
                crashed = float((found == Outcome.COLLISION).mean())
                gained = "" if name == TRAINED else signed_percent(mean(goals[TRAINED] - goals[name]))
                success = f"{100 * goals[name].mean():.1f} % ({100 * crashed:.1f})"
                table.add_row(find(METHODS, method).label, setup, name, success, gained)
            table.add_section()
    Console(width=150).print(table)
    return 0


if __name__ == "__main__":
    sys.exit(main())
