"""A sweep: robots x groups x method x seed as cells, each one training and its evaluations. Pure; runs nothing."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import json
import tomllib
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, cast, get_args

from actors.evaluation.result_table import GROUPS, LEARNED, ROBOTS, ResultRow
from learner.config import WHERE, RunConfig, identity_dict, to_dict
from learner.presets import PresetName, preset_config
from sim_core.checks import ConfigError, check_fields, require
from sim_core.config import WorldConfig
from sim_core.plugins import METHODS, load, read_source, short_name

BaselineName = Literal["fl-orca", "greedy", "random"]


@dataclass(frozen=True, kw_only=True)
class SweepConfig:
    """Which cells a sweep has and how they are evaluated.

    Raises:
      ConfigError: a value is out of range.
    """

    preset: PresetName = "thesis"
    """Settings of every training: the text's reading, or our best."""
    methods: tuple[str, ...] = ("sensor", "in", "out")
    """State representations: names, or FILE.py:CLASS."""
    set: tuple[str, ...] = ()
    """Settings in place of the preset's, as NAME=VALUE: any field of `shoal train`, for calibration."""
    robots: tuple[int, ...] = ROBOTS
    """Robots per group."""
    groups: tuple[int, ...] = GROUPS
    """Group counts."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Training seeds; all cells of the first one are trained before those of the next."""
    env_steps: int | None = None
    """Env steps of each training; the preset's by default. What falls over the training falls over these."""
    episodes: int = 3_000
    """Fixed: greedy episodes in the setup of the training (3.3: 30 iterations of 100)."""
    extrapolation: Literal["all", "none"] = "all"
    """Extrapolation: every policy in every other setup that it fits (M_IN, M_OUT: of as many groups), or none."""
    extrapolation_episodes: int = 300
    """Extrapolation: greedy episodes in each other setup."""
    baselines: tuple[BaselineName, ...] = ("fl-orca", "greedy")
    """Rules that need no learning (see `shoal evaluate`), played in every setup as the policies are; may be empty."""
    baseline_episodes: int = 500
    """Episodes of each baseline in each setup."""
    first_seed: int = 2_000_000_000
    """Seed of the first evaluated episode; the others count on. Calibration uses others than the evaluation."""

    def __post_init__(self) -> None:
        check_fields(self)
        for name in ("methods", "robots", "groups", "seeds", "baselines"):
            values = getattr(self, name)
            some = isinstance(values, tuple) and (len(values) > 0 or name == "baselines")
            require(some, f"{name} must have at least one value")
            require(len(set(values)) == len(values), f"{name} must not repeat a value, as in {values}")
        rules = get_args(BaselineName)
        require(
            all(value in rules for value in self.baselines),
            f"baselines must be among {', '.join(rules)}, not {self.baselines}",
        )
        for method in self.methods:
            load(METHODS, method, read_source(METHODS, method))
        names = [short_name(METHODS, method) for method in self.methods]
        require(len(set(names)) == len(names), f"methods must have different names, not {', '.join(names)}")
        for name in ("episodes", "extrapolation_episodes", "baseline_episodes", "env_steps"):
            value = getattr(self, name)
            require(value is None or value >= 1, f"{name} must be at least 1, not {value}")
        changed_settings(self.set)
        most = 2**32 - 1 - max(self.episodes, self.extrapolation_episodes, self.baseline_episodes)
        require(0 <= self.first_seed <= most, f"first_seed must be in 0..{most}, not {self.first_seed}")

    @property
    def label(self) -> str:
        """What the results' column `preset` says: the preset and what was set in its place."""
        return "+".join((self.preset, *self.set))


NOT_SET = (
    "world seed engine device method sources robots groups env_id total_env_steps "
    "final_eval_episodes final_eval_first_seed"
).split()
"""Settings that the grid itself decides."""


def changed_settings(assignments: tuple[str, ...]) -> tuple[dict[str, Any], dict[str, Any]]:
    """The run's and the world's settings of NAME=VALUE texts; values are those of TOML, names those of the fields.

    Raises:
      ConfigError: a text is no assignment, or its name no setting that a sweep leaves free.
    """
    run: dict[str, Any] = {}
    world: dict[str, Any] = {}
    for text in assignments:
        name, sign, value = text.partition("=")
        require(bool(sign) and bool(name), f"set takes NAME=VALUE, not {text!r}")
        require(
            name not in NOT_SET
            and (name in RunConfig.__dataclass_fields__ or name in WorldConfig.__dataclass_fields__),
            f"set cannot change {name!r}; `shoal train --help` lists the settings",
        )
        try:
            parsed = tomllib.loads(f"value = {value}")["value"]
        except tomllib.TOMLDecodeError:
            parsed = value  # a plain word
        part = run if name in RunConfig.__dataclass_fields__ else world
        part[name] = tuple(parsed) if isinstance(parsed, list) else parsed
    return run, world


class Cell(NamedTuple):
    """One training of a sweep, or a baseline in one setup; `key` tells configs apart and names its folder."""

    key: str
    config: RunConfig
    policy: str = LEARNED

    @property
    def name(self) -> str:
        """What people call it, such as `sensor 10r×2g s0` or `greedy: sensor 10r×2g`."""
        world = self.config.world
        return self.config.name if self.policy == LEARNED else f"{self.policy}: {world.method_name} {world.setup}"

    @property
    def weight(self) -> float:
        """What the cell costs, roughly: env steps x (robots and a part for perception and learning)."""
        robots, steps = self.config.world.num_robots, self.config.world.horizon_steps * self.config.final_eval_episodes
        played = steps * (robots + 10.0)
        return played + (self.config.total_env_steps * (robots + 60.0) if self.policy == LEARNED else 0.0)


FIRST_DEFAULTS = {"steps_per_block": 32, "updates_per_call": 32}
"""Defaults that have changed since the first results were committed, as they were then."""


@functools.lru_cache(maxsize=4096)  # a table of results asks for the same ones after every cell
def cell_hash(config: RunConfig) -> str:
    """Twelve hex digits of all that decides a cell's results; unlike `config_hash`, the training's length counts.

    Only what differs from the first defaults goes in, so that results stay known when a later version has more
    settings or other defaults. A test holds the presets against the settings of committed results.
    """
    defaults = to_dict(RunConfig()) | FIRST_DEFAULTS
    given = identity_dict(config)
    world = {name: value for name, value in given["world"].items() if value != defaults["world"][name]}
    run = {name: value for name, value in given.items() if value != defaults[name]}
    values = {**run, "world": world}
    for name in WHERE:
        values.pop(name, None)
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()[:12]


def make_cell(sweep: SweepConfig, method: str, robots: int, groups: int, seed: int) -> Cell:
    """The cell of one method, setup and seed.

    Raises:
      ConfigError: the setup is not possible.
    """
    preset = preset_config(sweep.preset, method, robots, groups)
    run, world = changed_settings(sweep.set)
    env_steps = sweep.env_steps or preset.total_env_steps
    config = dataclasses.replace(
        preset,
        world=dataclasses.replace(preset.world, **world),
        total_env_steps=env_steps,
        learning_rate_decay_env_steps=env_steps,
        epsilon_decay_env_steps=max(1, preset.epsilon_decay_env_steps * env_steps // preset.total_env_steps),
        seed=seed,
        engine="process",
        device="cpu",  # cells share a machine, one a CPU
        final_eval_episodes=sweep.episodes,
        final_eval_first_seed=sweep.first_seed,
    )
    prioritised = run.get("replay") == "prioritised"  # else the default stays, with which cells have their names
    scheduled = {"importance_exponent_env_steps": env_steps} if prioritised else {}
    config = dataclasses.replace(config, **{**scheduled, **run})
    name = config.world.method_name
    return Cell(f"{name}-{robots}r{groups}g-s{seed}-{cell_hash(config)}", config)


def sweep_of_label(label: str) -> SweepConfig:
    """A sweep of this label, its grid and its evaluations as by default.

    Raises:
      ConfigError: the label is no sweep's.
    """
    preset, *changed = label.split("+")
    return SweepConfig(preset=cast(PresetName, preset), set=tuple(changed))


def world_of_label(label: str, method: str, robots: int, groups: int) -> WorldConfig:
    """The world in which a sweep of this label plays.

    Where there is none, because its settings do not fit this method and setup or the label is no sweep's, that of its
    preset alone, and that of `thesis` at last.
    """
    for known in (label, label.split("+")[0]):
        try:
            return make_cell(sweep_of_label(known), method, robots, groups, 0).config.world
        except ConfigError:
            continue
    return make_cell(SweepConfig(), method, robots, groups, 0).config.world


def expected_hash(sweep: SweepConfig, row: ResultRow) -> str | None:
    """The hash of the cell whose row this would be with the sweep's settings; None if the sweep could not have it."""
    setup = (row.trained_robots, row.trained_groups)
    known = {short_name(METHODS, method): method for method in sweep.methods}
    try:
        method = known.get(row.method, row.method)
        if row.policy == LEARNED:
            return cell_hash(make_cell(sweep, method, *setup, row.seed).config)
        return cell_hash(make_baseline_cell(sweep, cast(BaselineName, row.policy), method, *setup).config)
    except ConfigError:
        return None


def make_cells(sweep: SweepConfig) -> list[Cell]:
    """All cells: baselines, then seed after seed; of each the cheapest first, so that most results come early.

    Raises:
      ConfigError: a setup is not possible.
    """
    setups = [(method, r, g) for method in sweep.methods for r in sweep.robots for g in sweep.groups]
    parts = [[make_baseline_cell(sweep, baseline, *setup) for setup in setups] for baseline in sweep.baselines]
    parts += [[make_cell(sweep, *setup, seed) for setup in setups] for seed in sweep.seeds]
    return [cell for part in parts for cell in sorted(part, key=lambda cell: cell.weight)]


def make_baseline_cell(sweep: SweepConfig, baseline: BaselineName, method: str, robots: int, groups: int) -> Cell:
    """The cell of a baseline in the world that the preset gives a method in one setup.

    Raises:
      ConfigError: the setup is not possible.
    """
    trained = make_cell(sweep, method, robots, groups, 0).config
    config = dataclasses.replace(trained, final_eval_episodes=sweep.baseline_episodes)
    name = config.world.method_name
    return Cell(f"{baseline}-{name}-{robots}r{groups}g-{cell_hash(config)}", config, baseline)


def _other_setups(sweep: SweepConfig, cell: Cell) -> list[tuple[int, int]]:
    """(robots, groups) of the other setups in which a cell's policy is evaluated (Extrapolation).

    Where a method's state depends on the number of groups, as that of M_IN and M_OUT, groups stay.
    """
    world = cell.config.world
    if sweep.extrapolation == "none" or cell.policy != LEARNED:
        return []
    groups = sweep.groups if world.method_class.fits_any_groups else (world.groups,)
    return [(r, g) for r in sweep.robots for g in groups if (r, g) != (world.robots, world.groups)]


def other_worlds(sweep: SweepConfig, cell: Cell) -> list[WorldConfig]:
    """The worlds of the other setups in which a cell's policy is evaluated (Extrapolation)."""
    world = cell.config.world
    return [dataclasses.replace(world, robots=r, groups=g) for r, g in _other_setups(sweep, cell)]


def wanted(sweep: SweepConfig, cell: Cell) -> dict[tuple[int, int], int]:
    """Episodes that a cell's results must have, by (robots, groups) played in."""
    world, fixed = cell.config.world, cell.config.final_eval_episodes
    others = dict.fromkeys(_other_setups(sweep, cell), sweep.extrapolation_episodes)
    return {(world.robots, world.groups): fixed} | others


def done_cells(sweep: SweepConfig, cells: Iterable[Cell], rows: Iterable[ResultRow]) -> dict[str, list[ResultRow]]:
    """The results of every cell, by key, that `rows` hold in full; a cell of which they hold a part is left out."""
    by_cell: dict[tuple[str, str], dict[tuple[int, int], ResultRow]] = {}
    for row in rows:
        if row.preset == sweep.label:
            by_cell.setdefault((row.policy, row.config), {})[row.robots, row.groups] = row
    done = {}
    for cell in cells:
        found, need = by_cell.get((cell.policy, cell_hash(cell.config)), {}), wanted(sweep, cell)
        if all(setup in found and found[setup].episodes >= count for setup, count in need.items()):
            done[cell.key] = [found[setup] for setup in need]
    return done
