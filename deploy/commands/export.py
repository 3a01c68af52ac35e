"""`shoal export`: writes a trained policy as ONNX and as a torch ExportedProgram, for robots and other programs."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, NamedTuple

from rich.table import Table
from torch import nn

from actors.policy.network import load_snapshot
from actors.policy.policy import WeightsSnapshot
from actors.rollout.vector_env import env_shape
from deploy.console.terminal import plain_console
from deploy.options.results import Export
from deploy.runs.folders import make_folder
from deploy.runs.policy_lookup import find_policy
from learner.checkpoints.checkpoint import read_checkpoint
from learner.checkpoints.manifest import MANIFEST
from learner.checkpoints.store import FolderStore
from learner.config import RunConfig, config_hash, to_dict
from learner.export.policy_file import read_policy
from learner.export.ports import FRAME, Port, bare_inputs, bare_outputs
from learner.export.reference_states import Sensed, observed_states, swarm_states
from learner.export.robot_module import BarePolicy, make_robot, robot_class
from learner.export.saved_policy import read_saved_policy
from learner.export.write import Agreement, check_packages, write_export
from learner.run_folder import RunFolder, find_run
from learner.tracking.mlflow_run import git_commit
from learner.update.networks import acting_network
from sim_core.checks import require
from sim_core.config import WorldConfig
from sim_core.shield import shield_responsibility

FORMAT = "shoal-policy-1"


class LoadedPolicy(NamedTuple):
    """A policy with the run that it comes from and that run's config."""

    folder: RunFolder
    config: RunConfig
    weights: WeightsSnapshot


def load_policy(name: str, runs_dir: Path) -> LoadedPolicy:
    """Loads the policy of a run, of one of its checkpoints, or of a policy file in a run's folder.

    Args:
      name: the run's name, or a path of the run, the checkpoint or the file.
      runs_dir: folder of all runs.

    Raises:
      ConfigError: there is none, or it does not fit its run's config.
    """
    path = Path(name)
    if path.is_file():
        folder = find_run(str(path.absolute().parent), runs_dir)
        config = folder.config()
        return LoadedPolicy(folder, config, read_saved_policy(path, config, env_shape(config.env)))
    if (path / MANIFEST).is_file():
        folder = find_run(str(path.absolute().parent.parent), runs_dir)
        config = folder.config()
        checkpoint = read_checkpoint(FolderStore(path.absolute().parent), path.absolute().name)
        return LoadedPolicy(folder, config, read_policy(checkpoint, config, env_shape(config.env)))
    folder = find_run(name, runs_dir)
    config = folder.config()
    return LoadedPolicy(folder, config, find_policy(folder, config))


class _Exportable(NamedTuple):
    """The module to export, its inputs and outputs, and the reference states to check the files on."""

    module: nn.Module
    inputs: list[Port]
    outputs: list[Port]
    states: Sensed


def _exportable(command: Export, config: RunConfig, weights: WeightsSnapshot) -> _Exportable:
    shape = env_shape(config.env)
    network = acting_network(config, shape)
    load_snapshot(network, weights)
    if command.bare:
        states = observed_states(config.env, weights, command.first_seed, command.states)
        world = config.world
        names = world.method_class.observation_names(world) if config.env.is_swarm and world.history == 1 else ()
        return _Exportable(BarePolicy(network), bare_inputs(shape, names), bare_outputs(shape), states)
    world = config.world
    states = swarm_states(world, weights, weights, command.first_seed, command.states)
    robot = make_robot(network, world)
    return _Exportable(robot, robot.inputs(world), robot.outputs(world), states)


def shield_numbers(world: WorldConfig) -> dict[str, Any]:
    """What a robot needs for its shield (deploy/examples/shield.py), and whether the policy is used with one."""
    return {
        "used": world.shield == "orca",
        "radius_m": world.robot_radius_m + world.shield_margin_m,
        "horizon_s": world.shield_horizon_s,
        "range_m": world.outer_radius_m,
        "time_step_s": world.time_step_s,
        "responsibility": shield_responsibility(world),
        "top_speed_m_s": world.method_class.top_speed_m_s(world),
    }


def kinematic_numbers(world: WorldConfig) -> dict[str, Any]:
    """How the robot reaches the velocities that the policy asks for."""
    if world.kinematics == "holonomic":
        return {"kind": "holonomic"}
    return {
        "kind": "unicycle",
        "turn_rate_limit_rad_s": math.radians(world.turn_rate_limit_deg_s),
        "acceleration_limit_m_s2": world.acceleration_limit_m_s2,
    }


def metadata(config: RunConfig, weights: WeightsSnapshot, bare: bool) -> dict[str, Any]:
    """The metadata of an exported file, in addition to its inputs and outputs."""
    world = config.world
    robot = {
        "method": world.method_name,
        "setup": world.setup,
        "frame": FRAME,
        "time_step_s": world.time_step_s,
        "decision_interval_steps": world.decision_interval_steps,
        "outer_radius_m": world.outer_radius_m,
        "shield": shield_numbers(world),
        "kinematics": kinematic_numbers(world),
    }
    origin = {"run": config.name, "config_hash": config_hash(config), "updates": weights.version}
    settings = {"commit": git_commit(), "settings": to_dict(config)}
    return {"format": FORMAT, "env_id": config.env_id, **({} if bare else robot), **origin, **settings}


def run(command: Export) -> int:
    """Writes the export and prints how far it agrees with the simulator's policy; returns the exit code.

    Raises:
      ConfigError: a package of the extra `export` is missing, there is no such policy, it cannot be exported in this
        form, or the folder cannot be written to.
    """
    check_packages()
    folder, config, weights = load_policy(command.run, command.runs_dir)
    require(
        command.bare or config.world.sector_frame == "world",
        "a robot's export takes positions in the world's frame, but this policy was trained with sector_frame = goal; "
        "export observation to action values with --bare True",
    )
    require(
        command.bare or config.world.history == 1,
        f"a robot's export decides on what the robot senses now, but this policy was trained with history = "
        f"{config.world.history}; export observation to action values with --bare True",
    )
    require(
        config.env.is_swarm or command.bare,
        f"what a robot senses in {config.env_id} is not known; export observation to action values with --bare True",
    )
    if not command.bare:
        robot_class(config.world)  # raises if the method has no robot module
    out = command.out or folder.artifacts / ("export-bare" if command.bare else "export")
    make_folder(out.absolute().parent, "--out")
    module, inputs, outputs, states = _exportable(command, config, weights)
    found = write_export(out, module, inputs, outputs, metadata(config, weights, command.bare), states)
    console = plain_console()
    console.print(agreement_table(found))
    console.print(str(out), soft_wrap=True)
    return 0


def agreement_table(found: dict[str, Agreement]) -> Table:
    """How far the exported files agree with the simulator and its policy, a row per file."""
    states = next(iter(found.values())).states
    table = Table(title=f"agreement with the simulator and its policy in {states:,} states of rollouts")
    names = list(next(iter(found.values())).errors)
    for column in ("file", "decided differently", *(f"largest error: {name}" for name in names)):
        table.add_column(column, justify="right")
    for file, answer in found.items():
        table.add_row(file, str(answer.different), *(f"{answer.errors[name]:.1e}" for name in names))
    return table
