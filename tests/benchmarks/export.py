"""Exported policies: how they answer in 10,000 states beside the simulator and its policy, and how long they take."""

import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.console import Console
from rich.table import Table

from actors.policy.baselines import Baseline
from actors.policy.network import QNetwork, snapshot
from learner.config import RunConfig
from learner.export.reference_states import Sensed, swarm_states
from learner.export.robot_module import make_robot
from learner.export.write import ONNX, PROGRAM, Agreement, onnx_session, write_export
from learner.presets import preset_config
from sim_core.methods import make_method
from tests.benchmarks.timing import Timed, ratio, spread, timed_rates

SETUPS = (("sensor", 10, 2), ("sensor", 25, 8), ("in", 10, 4), ("out", 10, 4), ("out", 25, 8))
STATES = 10_000
DECISIONS = 300
ROUNDS = 5
STATE_SEED = 2_000_000_000


def untrained(config: RunConfig) -> QNetwork:
    """A network of random weights, large enough that the best action changes from state to state."""
    torch.manual_seed(0)
    (size,) = make_method(config.world).observation_shape
    network = QNetwork(size, config.hidden_sizes, config.world.num_actions).eval()
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.mul_(4.0)
    return network


def one_by_one(decide: Callable[[Any], object], inputs: list) -> Callable[[], Timed]:
    """The median time of a single decision, which a busy machine leaves alone."""

    def timed() -> Timed:
        seconds = []
        for one in inputs:
            start_s = time.perf_counter()
            decide(one)
            seconds.append(time.perf_counter() - start_s)
        return Timed(1, statistics.median(seconds))

    return timed


def deciders(folder: Path, robot: torch.nn.Module, states: Sensed) -> dict[str, Callable[[], Timed]]:
    """Rivals that decide for one robot at a time, state after state."""
    session, program = onnx_session(folder / ONNX), torch.export.load(folder / PROGRAM).module()
    singles = [{name: array[i : i + 1] for name, array in states.inputs.items()} for i in range(DECISIONS)]
    tensors = [tuple(torch.from_numpy(np.ascontiguousarray(array)) for array in one.values()) for one in singles]

    return {
        "onnx": one_by_one(lambda one: session.run(["velocity"], one), singles),
        "program": one_by_one(torch.no_grad()(lambda one: program(*one)), tensors),
        "eager": one_by_one(torch.no_grad()(lambda one: robot(*one)), tensors),
    }


def measure(method: str, robots: int, groups: int) -> tuple[dict[str, Agreement], dict[str, list[float]], int]:
    """(how the files answer, decisions a second of each rival, distinct actions in the states)."""
    config = preset_config("thesis", method, robots, groups)
    network, world = untrained(config), config.world
    states = swarm_states(world, Baseline.FL_ORCA, snapshot(network, 0, 0.0), STATE_SEED, STATES)
    robot = make_robot(network, world).eval()
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "export"
        found = write_export(out, robot, robot.inputs(world), robot.outputs(world), {}, states)
        speeds = timed_rates(deciders(out, robot, states), ROUNDS)
    return found, speeds, len(set(states.expected["action"]))


def main() -> None:
    torch.set_num_threads(1)
    title = f"{STATES:,} states of rollouts, beside the simulator's perception, the numpy policy and its velocity"
    answers = Table(title=title)
    for column in ("setup", "file", "actions", "decided otherwise", "observation", "action values", "velocity"):
        answers.add_column(column, justify="right")
    times = Table(title=f"us a decision of one robot, one thread: median of {DECISIONS}, of {ROUNDS} rounds (range)")
    for column in ("setup", "onnxruntime", "ExportedProgram", "eager torch", "eager / onnxruntime"):
        times.add_column(column, justify="right")
    for method, robots, groups in SETUPS:
        name = f"{method} {robots}r×{groups}g"
        found, speeds, actions = measure(method, robots, groups)
        for file, answer in found.items():
            errors = [f"{answer.errors[key]:.1e}" for key in ("observation", "action_values", "velocity")]
            answers.add_row(name, file, str(actions), str(answer.different), *errors)
        us = {key: [1e6 / rate for rate in found_rates] for key, found_rates in speeds.items()}
        row = [spread(us[key]).text(0) for key in ("onnx", "program", "eager")]
        times.add_row(name, *row, ratio(us["eager"], us["onnx"]).text(1))
    Console(width=140).print(answers)
    Console(width=140).print(times)
