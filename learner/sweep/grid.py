"""The grid of a sweep: for each method, setup and seed a cell, one training with its evaluations. Pure functions."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import json
import tomllib
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, cast, get_args

from actors.evaluation.result_table import GROUPS, LEARNED, ROBOTS, ResultRow, is_drawn
from learner.config import WHERE, RunConfig, identity_dict, to_dict
from learner.presets import PresetName, preset_config
from sim_core.checks import ConfigError, check_fields, require
from sim_core.config import WorldConfig
from sim_core.plugins import DISSERTATION_METHODS, METHODS, find, short_name

BaselineName = Literal["fl-orca", "fl-orca-snapped", "greedy", "field", "random"]


@dataclass(frozen=True, kw_only=True)
class SweepConfig:
    """The cells of a sweep, and how they are evaluated.

    Raises:
      ConfigError: a value is out of range.
    """

    preset: PresetName = "thesis"
    """Settings of every training: those of the dissertation, or our best."""
    methods: tuple[str, ...] = DISSERTATION_METHODS
    """State representations: names, or FILE.py:CLASS."""
    set: tuple[str, ...] = ()
    """Settings that override the preset's, as NAME=VALUE: any field of `shoal train`, for calibration."""
    robots: tuple[int, ...] = ROBOTS
    """Robots per group."""
    groups: tuple[int, ...] = GROUPS
    """Group counts."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Training seeds; all cells of a seed are trained before those of the next. Without any, baselines alone play."""
    env_steps: int | None = None
    """Env steps of each training, the preset's by default; schedules are stretched to them."""
    episodes: int = 3_000
    """Fixed: greedy episodes in the setup of the training (3.3: 30 iterations of 100)."""
    extrapolation: Literal["all", "none"] = "all"
    """Extrapolation: every policy in every other setup that it fits (M_IN, M_OUT: equal group count), or none."""
    extrapolation_episodes: int = 100
    """Extrapolation: greedy episodes in each other setup; as many as Fixed where Figures 3.4 to 3.6 draw it."""
    baselines: tuple[BaselineName, ...] = ("fl-orca", "greedy", "field")
    """Rules that do not learn (see `shoal evaluate`), in every setup of the methods that have them; may be empty."""
    baseline_episodes: int = 3_000
    """Episodes of each baseline in each setup."""
    first_seed: int = 2_000_000_000
    """Seed of the first evaluated episode, later ones add 1 each. Calibration uses other seeds than evaluation."""

    def __post_init__(self) -> None:
        check_fields(self)
        for name in ("methods", "robots", "groups", "seeds", "baselines"):
            values = getattr(self, name)
            some = isinstance(values, tuple) and (len(values) > 0 or name in ("seeds", "baselines"))
            require(some, f"{name} must have at least one value")
            require(len(set(values)) == len(values), f"{name} must not repeat a value, as in {values}")
        require(bool(self.seeds or self.baselines), "seeds or baselines must have at least one value")
        rules = get_args(BaselineName)
        require(
            all(value in rules for value in self.baselines),
            f"baselines must be among {', '.join(rules)}, not {self.baselines}",
        )
        for method in self.methods:
            find(METHODS, method)
        names = [short_name(METHODS, method) for method in self.methods]
        require(len(set(names)) == len(names), f"methods must have different names, not {', '.join(names)}")
        for name in ("episodes", "extrapolation_episodes", "baseline_episodes", "env_steps"):
            value = getattr(self, name)
            require(value is None or value >= 1, f"{name} must be at least 1, not {value}")
        parse_overrides(self.set)
        most = 2**32 - 1 - max(self.episodes, self.extrapolation_episodes, self.baseline_episodes)
        require(0 <= self.first_seed <= most, f"first_seed must be in 0..{most}, not {self.first_seed}")

    @property
    def label(self) -> str:
        """The results' column `preset`: the preset and its overrides, joined by `+`."""
        return "+".join((self.preset, *self.set))


SET_BY_GRID = (
    "world seed engine device method sources robots groups env_id total_env_steps "
    "final_eval_episodes final_eval_first_seed learners"
).split()
"""Settings that no override may name: the grid sets them itself, and its tables count worlds of one learning robot."""


def parse_overrides(assignments: tuple[str, ...]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Parses overrides of a preset.

    Args:
      assignments: NAME=VALUE, with a field's name and a TOML value; a value that is not TOML is a string.

    Returns:
      Settings of `RunConfig` and settings of `WorldConfig`, by name.

    Raises:
      ConfigError: a text is not an assignment, or names a setting that cannot be overridden.
    """
    run: dict[str, Any] = {}
    world: dict[str, Any] = {}
    for text in assignments:
        name, sign, value = text.partition("=")
        require(bool(sign) and bool(name), f"set takes NAME=VALUE, not {text!r}")
        require(
            name not in SET_BY_GRID
            and (name in RunConfig.__dataclass_fields__ or name in WorldConfig.__dataclass_fields__),
            f"set cannot change {name!r}; `shoal train --help` lists the settings",
        )
        try:
            parsed = tomllib.loads(f"value = {value}")["value"]
        except tomllib.TOMLDecodeError:
            parsed = value  # a bare word
        except RecursionError as error:
            raise ConfigError(f"set {name} is nested too deeply; settings are plain values and lists") from error
        settings = run if name in RunConfig.__dataclass_fields__ else world
        settings[name] = tuple(parsed) if isinstance(parsed, list) else parsed
    return run, world


def assigned(assignments: tuple[str, ...]) -> list[str]:
    """The names of the settings that overrides set."""
    return [text.partition("=")[0] for text in assignments]


class Cell(NamedTuple):
    """One training of a sweep, or one baseline in one setup; `key` is unique and the name of its folder."""

    key: str
    config: RunConfig
    policy: str = LEARNED

    @property
    def name(self) -> str:
        """Name for users, such as `sensor 10r×2g s0` or `greedy: sensor 10r×2g`."""
        world = self.config.world
        return self.config.name if self.policy == LEARNED else f"{self.policy}: {world.method_name} {world.setup}"

    @property
    def weight(self) -> float:
        """Estimated relative cost: robot steps, and a constant per decision for perception and for learning."""
        world = self.config.world
        robots, interval = world.num_robots, world.decision_interval_steps
        decisions = world.horizon_steps / interval * self.config.final_eval_episodes
        evaluation = decisions * (robots * interval + 10.0)
        training = self.config.total_env_steps * (robots * interval + 60.0)
        return evaluation + (training if self.policy == LEARNED else 0.0)


ORIGINAL_DEFAULTS: dict[str, Any] = {"steps_per_block": 32, "updates_per_call": 32}
"""Original values of the defaults that have changed since the first results were committed."""


@functools.lru_cache(maxsize=4096)  # the table of results needs every cell's hash again after each cell
def cell_hash(config: RunConfig) -> str:
    """Hash of all settings that decide a cell's results, 12 hex digits; unlike `config_hash`, the length counts.

    Only settings that differ from the original defaults are hashed, so that results stay valid when a later version has
    more settings or other defaults. A test checks the presets against the settings of committed results.
    """
    defaults = to_dict(RunConfig()) | ORIGINAL_DEFAULTS
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
      ConfigError: the setup is impossible.
    """
    preset = preset_config(sweep.preset, method, robots, groups)
    run, world = parse_overrides(sweep.set)
    env_steps = sweep.env_steps or preset.total_env_steps
    config = dataclasses.replace(
        preset,
        world=dataclasses.replace(preset.world, **world),
        total_env_steps=env_steps,
        learning_rate_decay_env_steps=env_steps,
        epsilon_decay_env_steps=max(1, preset.epsilon_decay_env_steps * env_steps // preset.total_env_steps),
        seed=seed,
        engine="process",
        device="cpu",  # cells share a machine, one per CPU
        final_eval_episodes=sweep.episodes,
        final_eval_first_seed=sweep.first_seed,
    )
    prioritised = run.get("replay") == "prioritised"  # otherwise the default stays, or cells would change their keys
    scheduled = {"importance_exponent_env_steps": env_steps} if prioritised else {}
    config = dataclasses.replace(config, **{**scheduled, **run})
    name = config.world.method_name
    return Cell(f"{name}-{robots}r{groups}g-s{seed}-{cell_hash(config)}", config)


def sweep_of_label(label: str) -> SweepConfig:
    """A sweep with this label, and the default grid and evaluations.

    Raises:
      ConfigError: no sweep has this label.
    """
    preset, *changed = label.split("+")
    return SweepConfig(preset=cast(PresetName, preset), set=tuple(changed))


def world_of_label(label: str, method: str, robots: int, groups: int) -> WorldConfig:
    """The world of one method and setup in a sweep with this label.

    Where that is impossible (the overrides do not fit the method and setup, or no sweep has the label), the world of
    the label's preset without overrides; where that is impossible, too, the world of `thesis`.
    """
    for known in (label, label.split("+")[0]):
        try:
            return make_cell(sweep_of_label(known), method, robots, groups, 0).config.world
        except ConfigError:
            continue
    return make_cell(SweepConfig(), method, robots, groups, 0).config.world


def expected_hash(sweep: SweepConfig, row: ResultRow) -> str | None:
    """Hash of the cell that has the row's method, setup and seed in this sweep; None if no such cell is possible."""
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
    """All cells: baselines, then seed after seed, the cheapest of each first, so that most results are early.

    Raises:
      ConfigError: a setup is impossible.
    """
    from actors.policy.baselines import Baseline, exists  # imports kernels, which options do without

    setups = [(method, r, g) for method in sweep.methods for r in sweep.robots for g in sweep.groups]
    played = [[make_baseline_cell(sweep, baseline, *setup) for setup in setups] for baseline in sweep.baselines]
    rounds = [[cell for cell in cells if exists(Baseline(cell.policy), cell.config.world)] for cells in played]
    rounds += [[make_cell(sweep, *setup, seed) for setup in setups] for seed in sweep.seeds]
    return [cell for cells in rounds for cell in sorted(cells, key=lambda cell: cell.weight)]


def make_baseline_cell(sweep: SweepConfig, baseline: BaselineName, method: str, robots: int, groups: int) -> Cell:
    """The cell of a baseline in the world of a method and setup; no setting of trainings is in its hash.

    Raises:
      ConfigError: the setup is impossible.
    """
    config = RunConfig(
        world=make_cell(sweep, method, robots, groups, 0).config.world,
        engine="process",
        device="cpu",
        final_eval_episodes=sweep.baseline_episodes,
        final_eval_first_seed=sweep.first_seed,
        **ORIGINAL_DEFAULTS,
    )
    name = config.world.method_name
    return Cell(f"{baseline}-{name}-{robots}r{groups}g-{cell_hash(config)}", config, baseline)


def _extrapolation_setups(sweep: SweepConfig, cell: Cell) -> list[tuple[int, int]]:
    """(robots, groups) of the other setups in which a cell's policy is evaluated (Extrapolation).

    Where the size of a method's state depends on the number of groups (M_IN, M_OUT), that number stays.
    """
    world = cell.config.world
    if sweep.extrapolation == "none" or cell.policy != LEARNED:
        return []
    most = world.method_class.max_groups(world)
    groups = [g for g in sweep.groups if g == world.groups or (most > world.groups and g <= most)]
    return [(r, g) for r in sweep.robots for g in groups if (r, g) != (world.robots, world.groups)]


def extrapolation_worlds(sweep: SweepConfig, cell: Cell) -> list[WorldConfig]:
    """The worlds of the other setups in which a cell's policy is evaluated (Extrapolation)."""
    world = cell.config.world
    return [dataclasses.replace(world, robots=r, groups=g) for r, g in _extrapolation_setups(sweep, cell)]


def wanted_episodes(sweep: SweepConfig, cell: Cell) -> dict[tuple[int, int], int]:
    """How many episodes a complete cell has in each setup, by (robots, groups)."""
    world, fixed = cell.config.world, cell.config.final_eval_episodes
    own, others = (world.robots, world.groups), _extrapolation_setups(sweep, cell)
    is_sensor = world.method == DISSERTATION_METHODS[0]
    drawn = [played for played in others if is_sensor and is_drawn(own, played)]
    return {own: fixed} | dict.fromkeys(others, sweep.extrapolation_episodes) | dict.fromkeys(drawn, fixed)


def done_cells(sweep: SweepConfig, cells: Iterable[Cell], rows: Iterable[ResultRow]) -> dict[str, list[ResultRow]]:
    """The results of the cells that are complete in `rows`, by key; others are left out."""
    by_cell: dict[tuple[str, str], dict[tuple[int, int], ResultRow]] = {}
    for row in rows:
        if row.preset == sweep.label:
            by_cell.setdefault((row.policy, row.config), {})[row.robots, row.groups] = row
    done = {}
    for cell in cells:
        found, wanted = by_cell.get((cell.policy, cell_hash(cell.config)), {}), wanted_episodes(sweep, cell)
        if all(setup in found and found[setup].episodes >= count for setup, count in wanted.items()):
            done[cell.key] = [found[setup] for setup in wanted]
    return done
