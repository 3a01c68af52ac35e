"""`shoal stress`: policies and rules under a grid of bad senses and late commands, on the same start scenes."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from rich.table import Table

from actors.evaluation.conditions import Axis, Condition, along, breaking_point, grid, parse_axis
from actors.evaluation.statistics import as_percent, paired_comparison, success_rate
from dashboards.figures.stress_curves import stress_curves_png
from deploy.console.summary_tables import signed_percent
from deploy.console.terminal import plain_console
from deploy.options.results import Stress
from deploy.options.training import ray_address
from deploy.playing.players import Target, check_same_starts, find_players
from deploy.playing.stress_results import CURVES, StressResults
from deploy.runs.folders import check_plain_name, make_folder
from deploy.runs.tracking import opened_tracker
from learner.file_names import IDENTITY
from learner.ray_backend.cluster import evaluate_each
from learner.tracking.tracked_run import TrackingError
from sim_core.checks import ConfigError

FOLDER = "stress"
"""In the folder of runs: the folders of these results."""


def run(command: Stress) -> int:
    """Plays what is missing of the grid, then prints, stores and draws all of it; returns the exit code.

    Raises:
      ConfigError: there is no such run or policy, the players do not start alike, a condition cannot be, or the folder
        cannot be written to.
    """
    axes = [parse_axis(text) for text in command.vary]
    targets = find_players(command)
    check_same_starts(targets)
    conditions = grid(axes)
    name = command.name or re.sub(r"[^\w.+=-]+", "-", "+".join(target.name for target in targets))
    check_plain_name(name)
    folder = command.runs_dir / FOLDER / name
    seeds = list(range(command.first_seed, command.first_seed + command.episodes))
    results = StressResults(folder, targets, axes, conditions, seeds)
    make_folder(folder, "the folder of results,")
    play_missing(results, seeds, ray_address(command.address))
    console = plain_console()
    console.print(_table(results, targets, conditions))
    console.print(_breaks(results, targets, axes))
    written = [results.write_table()]
    if panels := results.panels():
        written.append(folder / CURVES)
        stress_curves_png(panels, written[-1], f"success under bad senses, {command.episodes} episodes a point")
    for path in written:
        console.print(str(path), soft_wrap=True)
    for target in targets:
        _log(target, written, f"{FOLDER}/{name}")
    return 0


def _log(target: Target, written: Sequence[Path], place: str) -> None:
    """Adds files to the artifacts of a player's run in MLflow, if it has one; says so if that is not possible."""
    if target.folder is None or not (target.folder.path / IDENTITY).is_file():
        return
    try:
        with opened_tracker(target.folder) as tracker:
            for path in written:
                tracker.attach(target.folder.identity().mlflow_run_id, path, place)
    except (ConfigError, TrackingError) as error:
        plain_console(stderr=True).print(f"not logged to MLflow for {target.name}: {error}", soft_wrap=True)


def play_missing(results: StressResults, seeds: list[int], address: str | None) -> None:
    """Plays and stores the cells that are not there yet, in Ray tasks (see `evaluate_each`)."""
    missing, console = results.missing(), plain_console()
    if not missing:
        return
    console.print(f"{len(results) - len(missing)} of {len(results)} evaluations are there", soft_wrap=True)
    played = evaluate_each([(cell.spec, cell.target.candidate) for cell in missing], seeds, address)
    for number, (cell, stats) in enumerate(zip(missing, played, strict=True), start=1):
        results.save(cell, stats)
        console.print(f"{number} of {len(missing)}: {cell.target.name}, {_words(cell.condition)}", soft_wrap=True)


def _words(condition: Condition) -> str:
    return ", ".join(f"{name} {value}" for name, value in condition.items())


def _table(results: StressResults, targets: Sequence[Target], conditions: Sequence[Condition]) -> Table:
    """Success rates; paired differences to the first player, and of each player to the first condition."""
    table = Table(title=f"success rate; differences to {targets[0].name} and to the first condition are paired")
    for column in ("setup", *conditions[0], "player"):
        table.add_column(column)
    for column in ("success rate, 95 %", f"to {targets[0].name}", "to the first condition"):
        table.add_column(column, justify="right")
    for setup, name in enumerate(results.setups()):
        for number, condition in enumerate(conditions):
            for player, target in enumerate(targets):
                goals = results.goals(player, setup, number)
                to_first = paired_comparison(results.goals(0, setup, number), goals).difference if player else None
                to_clean = paired_comparison(results.goals(player, setup, 0), goals).difference if number else None
                where = ("", *("" for _ in condition)) if player else (name, *map(str, condition.values()))
                share = as_percent(success_rate(goals))
                table.add_row(*where, target.name, share, signed_percent(to_first), signed_percent(to_clean))
            table.add_section()
    return table


def _breaks(results: StressResults, targets: Sequence[Target], axes: Sequence[Axis]) -> Table:
    """Where each player's success falls to 50 % along each axis, the others at their first values."""
    table = Table(title="where success falls to 50 %, with the other conditions at their first values")
    table.add_column("setup")
    table.add_column("condition")
    for target in targets:
        table.add_column(target.name, justify="right")
    every = grid(axes)
    for setup, name in enumerate(results.setups()):
        for axis in axes:
            if len(axis.values) < 2 or any(isinstance(value, str) for value in axis.values):
                continue
            places = [every.index(condition) for condition in along(axis, axes)]
            row = [
                breaking_point(axis.values, _rates(results, player, setup, places)) for player in range(len(targets))
            ]
            table.add_row(name, axis.name, *("–" if value is None else f"{value:.3g}" for value in row))
    return table


def _rates(results: StressResults, player: int, setup: int, conditions: list[int]) -> list[float]:
    return [float(results.goals(player, setup, condition).mean()) for condition in conditions]
