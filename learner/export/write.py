"""A trained policy as files that leave the lab: ONNX, a torch ExportedProgram, and what stands in them.

An export is a folder, whole or not there: `policy.onnx`, `policy.pt2`, `policy.json` (names, shapes, units and
settings; both files carry the same text under the key `shoal`) and `golden.npz`, some states with the answers that are
expected of them. Both files are run on states of real rollouts, and an export that decides otherwise than the
simulator with its policy is refused.
"""

from __future__ import annotations

import json
import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from actors.storage.atomic_write import replacing_folder
from learner.export.ports import Port
from learner.export.reference_states import Sensed
from sim_core.checks import ConfigError, require_packages

ONNX, PROGRAM, METADATA, GOLDEN = "policy.onnx", "policy.pt2", "policy.json", "golden.npz"
METADATA_KEY = "shoal"
"""Under which the ONNX file and the ExportedProgram carry the metadata."""
PACKAGES = ("onnx", "onnxscript", "onnxruntime")
GOLDEN_STATES = 32
TOLERANCE = 1e-4
"""Largest error of observations, values and velocities, absolute, or relative where they are larger than 1."""
MOST_DIFFERENT = 1e-3
"""Largest share of states that may be decided otherwise: within rounding of a tie of two values, or of a jump of the
state, such as the angle of a round ellipse."""


class Agreement(NamedTuple):
    """How an exported file answers beside what is expected.

    `states` were asked; `different` of them it decides or sees otherwise; `errors` are the largest of each output in
    the rest, as `TOLERANCE` counts.
    """

    states: int
    different: int
    errors: dict[str, float]


def check_packages() -> None:
    """Raises ConfigError unless the packages for ONNX are there."""
    require_packages("shoal export", "export", *PACKAGES)


def check_folder(folder: Path) -> None:
    """Raises ConfigError where an export would replace anything but an older export."""
    ours = {ONNX, PROGRAM, METADATA, GOLDEN}
    if folder.exists() and not (folder.is_dir() and {path.name for path in folder.iterdir()} <= ours):
        raise ConfigError(f"{folder} holds other things than an export; name another folder with --out")


def agreement(got: dict[str, NDArray[Any]], expected: dict[str, NDArray[Any]]) -> Agreement:
    """Compares answers by output name, first axis the states."""
    states = len(expected["action"])
    errors = {}
    for name, wanted in expected.items():
        if name != "action":
            error = np.abs(got[name].astype(np.float64) - wanted) / np.maximum(1.0, np.abs(wanted))
            errors[name] = error.reshape(states, -1).max(1, initial=0.0)
    different = got["action"] != expected["action"]
    if "observation" in errors:
        different = different | (errors["observation"] > TOLERANCE)
    same = {name: float(error[~different].max(initial=0.0)) for name, error in errors.items()}
    return Agreement(states, int(different.sum()), same)


def require_agreement(found: Agreement, file: str) -> None:
    """Raises ConfigError unless a file answers as it should."""
    few = found.different <= max(1, MOST_DIFFERENT * found.states)
    wrong = [name for name, error in found.errors.items() if not error <= TOLERANCE]  # so that no NaN passes
    if not few or wrong:
        raise ConfigError(
            f"{file} does not answer as the simulator and its policy do: {found.different} of {found.states} states "
            f"differ, and errors are too large in: {', '.join(wrong) or 'nothing'}; nothing was exported, report this"
        )


def run_onnx(path: Path, inputs: dict[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """The outputs of an ONNX file by name, computed by onnxruntime on one thread."""
    session = onnx_session(path)
    names = [port.name for port in session.get_outputs()]
    return dict(zip(names, session.run(names, inputs), strict=True))


def onnx_session(path: Path) -> Any:
    """An onnxruntime session of an ONNX file on the CPU, on one thread."""
    import onnxruntime  # optional

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    return onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])


def run_program(path: Path, inputs: dict[str, NDArray[Any]], outputs: list[str]) -> dict[str, NDArray[Any]]:
    """The outputs of an ExportedProgram's file by name."""
    module = torch.export.load(path).module()
    with torch.no_grad():
        answers = module(*(torch.from_numpy(np.ascontiguousarray(array)) for array in inputs.values()))
    return {name: answer.numpy() for name, answer in zip(outputs, answers, strict=True)}


def _free_sizes(port: Port) -> dict[int, str]:
    """Names of the sizes that may be any number, by axis."""
    return {axis: size for axis, size in enumerate(port.shape) if isinstance(size, str)}


def _program(module: nn.Module, ports: list[Port]) -> torch.export.ExportedProgram:
    """The module's graph for any number of robots where a port's shape says so."""
    sizes = {name for port in ports for name in _free_sizes(port).values()}
    dims = {name: torch.export.Dim(name, min=0) for name in sorted(sizes)}
    arrays = [np.zeros([3 if isinstance(s, str) else s for s in port.shape], port.dtype) for port in ports]
    shapes = tuple({i: dims[name] for i, name in free.items()} for free in map(_free_sizes, ports))
    example = tuple(torch.from_numpy(array) for array in arrays)
    program = torch.export.export(module.eval(), example, dynamic_shapes=shapes, strict=False)
    for node in program.graph.nodes:
        node.meta.pop("stack_trace", None)  # paths of this machine
    return program


@contextmanager
def _quiet() -> Iterator[None]:
    """Keeps torch's remarks away: on packages it can do without, its internals, and axes that share a name."""
    registry = logging.getLogger("torch.onnx._internal.exporter._registration")
    level = registry.level
    registry.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", r"`isinstance\(treespec, LeafSpec\)`", FutureWarning)
            warnings.filterwarnings("ignore", r"# The axis name: \w+ will not be used", UserWarning)
            yield
    finally:
        registry.setLevel(level)


def _save_onnx(
    program: torch.export.ExportedProgram, inputs: list[Port], outputs: list[Port], text: str, path: Path
) -> None:
    with _quiet():
        made = torch.onnx.export(
            program,
            dynamo=True,
            verbose=False,
            input_names=[port.name for port in inputs],
            output_names=[port.name for port in outputs],
            dynamic_shapes=[_free_sizes(port) for port in inputs],  # the program has them; this names them
        )
    assert made is not None
    for node in made.model.graph.all_nodes():
        node.metadata_props.clear()  # paths of this machine
    made.model.producer_name = "shoal"
    made.model.metadata_props[METADATA_KEY] = text
    made.save(str(path), external_data=False)


def write_export(
    folder: Path, module: nn.Module, inputs: list[Port], outputs: list[Port], metadata: dict[str, Any], states: Sensed
) -> dict[str, Agreement]:
    """Writes an export and checks it; an older one in its place is replaced once the new is whole and right.

    Args:
      folder: where to.
      module: computes `outputs`, in this order, from `inputs`, in theirs.
      inputs: the inputs.
      outputs: the outputs.
      metadata: what the files shall say of themselves, beside inputs and outputs.
      states: what to check on; the first become the golden states.

    Returns:
      How each file answers on `states`, by file name.

    Raises:
      ConfigError: a package is missing, the folder holds other things, or a file does not answer as expected.
    """
    check_packages()
    check_folder(folder)
    described = {**metadata, "inputs": [p.described() for p in inputs], "outputs": [p.described() for p in outputs]}
    text = json.dumps(described, ensure_ascii=False)
    with replacing_folder(folder) as partial:
        partial.mkdir(parents=True)
        program = _program(module, inputs)
        _save_onnx(program, inputs, outputs, text, partial / ONNX)
        torch.export.save(program, partial / PROGRAM, extra_files={METADATA_KEY: text})
        found = _checked(partial, outputs, states)
        checks = {name: answer._asdict() for name, answer in found.items()}
        (partial / METADATA).write_text(json.dumps({**described, "checked": checks}, indent=2, ensure_ascii=False))
        _save_golden(partial / GOLDEN, states)
    return found


def _checked(folder: Path, outputs: list[Port], states: Sensed) -> dict[str, Agreement]:
    answers = {
        ONNX: run_onnx(folder / ONNX, states.inputs),
        PROGRAM: run_program(folder / PROGRAM, states.inputs, [port.name for port in outputs]),
    }
    found = {name: agreement(got, states.expected) for name, got in answers.items()}
    for name, answer in found.items():
        require_agreement(answer, name)
    return found


def _save_golden(path: Path, states: Sensed) -> None:
    arrays = {f"in.{name}": array[:GOLDEN_STATES] for name, array in states.inputs.items()}
    arrays |= {f"out.{name}": array[:GOLDEN_STATES] for name, array in states.expected.items()}
    np.savez_compressed(path, allow_pickle=False, **arrays)
