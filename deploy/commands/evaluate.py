"""`shoal evaluate`: success and failure rates of a trained policy or a baseline on fixed seeds."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.table import Table

from actors.evaluation.conditions import parse_condition
from actors.evaluation.evaluation_store import StoredEvaluation, entry_seeds, refuse_existing, save_evaluation
from actors.evaluation.evaluator import record_episode
from actors.evaluation.trajectory import save_episodes
from actors.policy.baselines import Baseline
from actors.rollout.env_spec import EnvSpec
from actors.rollout.worker import join_stats
from actors.service.messages import EpisodeStats
from deploy.console.summary_tables import compared, evaluation_table, setups_table
from deploy.console.terminal import plain_console
from deploy.options.results import Evaluate
from deploy.options.training import ray_address
from deploy.playing.players import Target, check_same_starts, find_players, under
from deploy.runs.folders import make_folder
from learner.ray_backend.cluster import evaluate_in_tasks
from learner.training.evaluation_summary import summarise
from sim_core.checks import require
from sim_core.outcomes import Outcome


def run(command: Evaluate) -> int:
    """Prints the rates, and stores what `--out` and `--record` ask for; returns the exit code.

    Raises:
      ConfigError: there is no such run or policy, a flag does not apply to it, or a file to write exists.
    """
    condition = parse_condition(command.under)
    targets = [under(target, condition) for target in find_players(command)]
    if len(targets) > 1:
        return _compare(command, targets)
    target = targets[0]
    require(
        command.out is None or not target.spec.shares,
        f"--out stores the episodes of one setup, and {target.name!r} has learned {len(target.spec.worlds)}: name one "
        "with --robots and --groups",
    )
    if command.out is not None:
        _check_outputs(command.out, command.record, target.spec)
    seeds = list(range(command.first_seed, command.first_seed + command.episodes))
    played = _play(command, target, seeds)
    stats = join_stats(played)
    if len(played) > 1:
        setups = (world.setup for world in target.spec.worlds)
        plain_console().print(setups_table(dict(zip(setups, map(summarise, played), strict=True))))
    kind = "episodes" if isinstance(target.candidate, Baseline) else "greedy episodes"
    plain_console().print(evaluation_table(summarise(stats), target.title, kind))
    if command.out is not None:
        _record(command.out, target, seeds[: command.record])
        seed = entry_seeds(seeds, stats)
        save_evaluation(command.out, StoredEvaluation(target.spec, target.name, target.updates, seed, stats))
        plain_console().print(str(command.out), soft_wrap=True)
    return 0


def _play(command: Evaluate, target: Target, seeds: list[int]) -> list[EpisodeStats]:
    """The player's episodes in each of its setups, from one start of Ray."""
    specs = [target.spec.of_setup(world) for world in target.spec.worlds]
    return evaluate_in_tasks(specs, target.candidate, seeds, ray_address(command.address))


def _compare(command: Evaluate, targets: list[Target]) -> int:
    """Prints the players' success rates and their paired differences to the first one; returns the exit code.

    Raises:
      ConfigError: their episodes do not start alike.
    """
    first, seeds = targets[0], list(range(command.first_seed, command.first_seed + command.episodes))
    check_same_starts(targets)
    table = Table(title=f"{command.episodes} episodes a setup; differences to {first.name} are paired")
    for name in ("setup", "player", "success rate", "95 % interval", "difference", "95 % interval", "sign test"):
        table.add_column(name, justify="left" if name in ("setup", "player") else "right")
    played = [_play(command, target, seeds) for target in targets]
    for i, world in enumerate(first.spec.worlds):
        goals = list[NDArray[np.bool_]]()
        for target, stats in zip(targets, played, strict=True):
            goals.append(np.equal(stats[i].outcome, int(Outcome.GOAL)).reshape(len(seeds), -1))
            table.add_row(*compared(world.setup if target is first else "", target.name, goals))
        table.add_section()
    plain_console().print(table)
    return 0


def episodes_path(out: Path) -> Path:
    """Where `--record` writes trajectories: `FILE-episodes.zarr` beside the results."""
    return out.with_name(f"{out.stem}-episodes{out.suffix}")


def _check_outputs(out: Path, record: int, spec: EnvSpec) -> None:
    refuse_existing(out)
    if record:
        require(spec.is_swarm, f"--record applies to our own environment, not to {spec.env_id}")
        refuse_existing(episodes_path(out))
    make_folder(out.parent, "the folder of --out,")


def _record(out: Path, target: Target, seeds: list[int]) -> None:
    if seeds:
        episodes = [record_episode(target.spec, target.candidate, seed) for seed in seeds]
        save_episodes(episodes_path(out), episodes, target.spec.world)
        plain_console().print(str(episodes_path(out)), soft_wrap=True)
