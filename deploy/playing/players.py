"""Who plays: policies of runs, or baselines, with the world that each plays in."""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

from actors.evaluation.conditions import Condition, world_under
from actors.evaluation.evaluator import Candidate
from actors.policy.baselines import Baseline, check_exists
from actors.rollout.env_spec import EnvSpec
from deploy.options.results import Players
from deploy.runs.policy_lookup import find_policy
from learner.presets import preset_config
from learner.run_folder import RunFolder, find_run
from sim_core import ENV_ID
from sim_core.checks import require
from sim_core.config import WorldConfig
from sim_core.plugins import SCENES

SCENE_SETTINGS = ("scene", "arena_radius_m", "start_spacing_m", "start_jitter_m", "learners")
"""World settings, beside robots and groups, that decide where episodes start, and whose they are."""


class Target(NamedTuple):
    """What is evaluated: the environment, the policy or baseline, its name and number of updates, and a title.

    `folder` is the run's folder, None for a baseline.
    """

    spec: EnvSpec
    candidate: Candidate
    name: str
    updates: int
    title: str
    folder: RunFolder | None


def find_players(command: Players) -> list[Target]:
    """The players in the order of the command; beside runs, baselines play in the world of the first run."""
    names = list(Baseline)
    trained = {name: _trained(command, name) for name in command.run if name not in names}
    first = next(iter(trained.values()), None)
    spec = _baseline_spec(command) if first is None else first.spec
    baselines = {name: _baseline(spec, Baseline(name)) for name in command.run if name in names}
    return [(trained | baselines)[name] for name in command.run]


def _baseline_spec(command: Players) -> EnvSpec:
    method = command.method or "sensor"
    default = preset_config(command.preset, method).world if command.preset else WorldConfig(method=method)
    return EnvSpec(ENV_ID, _resized(default, command))


def _baseline(spec: EnvSpec, baseline: Baseline) -> Target:
    check_exists(baseline, spec.world)
    return Target(spec, baseline, str(baseline), 0, f"{baseline}, {spec.world.method_name} {spec.world.setup}", None)


def under(target: Target, condition: Condition) -> Target:
    """The player under a condition alone; as it is if the condition is empty.

    Raises:
      ConfigError: it plays another environment than ours, or a value cannot be.
    """
    if not condition:
        return target
    spec = target.spec
    require(spec.is_swarm, f"--under sets conditions of our own environment, not of {spec.env_id}")
    shares = tuple((world_under(world, condition), share) for world, share in spec.shares)
    return target._replace(spec=EnvSpec(spec.env_id, world_under(spec.world, condition), shares))


def check_same_starts(targets: list[Target]) -> None:
    """Raises ConfigError unless the players' episodes start alike."""
    first = targets[0]
    for target in targets:
        require(target.spec.is_swarm, f"{target.name} plays {target.spec.env_id}, whose episodes have no outcomes")
        require(
            _start_scenes(target.spec) == _start_scenes(first.spec),
            f"the episodes of {target.name} and {first.name} do not start alike: their setups, scenes or learning "
            "robots differ; name one setup for all with --robots, --groups and --learners",
        )


def _start_scenes(spec: EnvSpec) -> list[tuple[object, ...]]:
    """What decides where robots start and where their goals are, beside the seed, of every setup."""
    return [
        (*(getattr(world, name) for name in SCENE_SETTINGS), world.source(SCENES), world.group_sizes)
        for world in spec.worlds
    ]


def _trained(command: Players, run: str) -> Target:
    for name in ("method", "preset"):
        require(
            getattr(command, name) is None,
            f"--{name} is for the baselines {', '.join(Baseline)}; the run {run!r} has a {name} of its own",
        )
    folder = find_run(run, command.runs_dir)
    config = folder.config()
    resized = command.robots is not None or command.groups is not None
    require(
        config.env.is_swarm or (not resized and command.learners is None),
        f"--robots, --groups and --learners apply to our own environment, not to {config.env_id}",
    )
    if resized or command.learners is not None:
        setups = () if resized else config.setups
        config = dataclasses.replace(config, world=_resized(config.world, command), setups=setups)
    weights = find_policy(folder, config, command.checkpoint)
    return Target(config.env, weights, folder.path.name, weights.version, config.title, folder)


def _resized(world: WorldConfig, command: Players) -> WorldConfig:
    """The world with the robots, groups and learning robots that the command asks for."""
    return dataclasses.replace(
        world,
        robots=world.robots if command.robots is None else command.robots,
        groups=world.groups if command.groups is None else command.groups,
        learners=world.learners if command.learners is None else command.learners,
    )
