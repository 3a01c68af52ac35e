"""Exported files, run by onnxruntime and torch, beside the simulator and its policy."""

import dataclasses
import importlib.util
import json

import numpy as np
import onnx
import pytest
import torch

from actors.policy.baselines import Baseline
from actors.policy.network import QNetwork, snapshot
from actors.rollout.vector_env import env_shape
from learner.config import RunConfig
from learner.export.ports import bare_inputs, bare_outputs
from learner.export.reference_states import observed_states, swarm_states
from learner.export.robot_module import NO_DECISION, BarePolicy, make_robot, robot_class
from learner.export.write import (
    GOLDEN,
    METADATA,
    METADATA_KEY,
    ONNX,
    PROGRAM,
    TOLERANCE,
    agreement,
    onnx_session,
    require_agreement,
    run_onnx,
    run_program,
    write_export,
)
from sim_core.checks import ConfigError
from sim_core.config import WorldConfig
from sim_core.methods import make_method
from tests.learner.export.test_robot_module import lively

WORLDS = {
    "sensor": WorldConfig(robots=5, groups=3),
    "in": WorldConfig(method="in", robots=5, groups=3, group_order="nearest", ellipse_covariance="full"),
    "out": WorldConfig(method="out", robots=5, groups=3),
}


@pytest.fixture(scope="module", params=WORLDS)
def exported(request, tmp_path_factory):
    """A world, the folder of its export, and the states of another seed."""
    config = WORLDS[request.param]
    network = lively(config)
    folder = tmp_path_factory.mktemp(request.param) / "export"
    weights = snapshot(network, 0, 0.0)
    states = swarm_states(config, Baseline.FL_ORCA, weights, seed=1, count=300)
    inputs, outputs = robot_class(config).inputs(config), robot_class(config).outputs(config)
    found = write_export(folder, make_robot(network, config), inputs, outputs, {"method": config.method}, states)
    assert found[ONNX].states == found[PROGRAM].states == 300
    return config, folder, swarm_states(config, Baseline.FL_ORCA, weights, seed=800, count=400)


def test_both_files_decide_as_simulator_and_policy(exported):
    config, folder, states = exported
    outputs = [port.name for port in robot_class(config).outputs(config)]
    for file, got in (
        (ONNX, run_onnx(folder / ONNX, states.inputs)),
        (
            PROGRAM,
            run_program(folder / PROGRAM, states.inputs, outputs),
        ),
    ):
        found = agreement(got, states.expected)
        assert found.different == 0, file
        assert max(found.errors.values()) < TOLERANCE, file
        assert set(found.errors) == {"velocity", "action_values", "observation"}


def test_the_file_says_what_goes_in_and_out(exported):
    config, folder, _ = exported
    model = onnx.load(folder / ONNX)
    onnx.checker.check_model(model, full_check=True)
    told = {entry.key: entry.value for entry in model.metadata_props}
    metadata = json.loads((folder / METADATA).read_text())
    carried = json.loads(told[METADATA_KEY])
    assert carried == {key: value for key, value in metadata.items() if key != "checked"}
    extra = {METADATA_KEY: ""}
    torch.export.load(folder / PROGRAM, extra_files=extra)
    assert json.loads(extra[METADATA_KEY]) == carried
    session = onnx_session(folder / ONNX)
    for told_ports, real in ((metadata["inputs"], session.get_inputs()), (metadata["outputs"], session.get_outputs())):
        assert [(port["name"], port["shape"]) for port in told_ports] == [(port.name, port.shape) for port in real]
        kinds = {"float32": "tensor(float)", "int64": "tensor(int64)", "bool": "tensor(bool)"}
        assert [kinds[port["dtype"]] for port in told_ports] == [port.type for port in real]


def test_any_number_of_robots_fits(exported):
    config, folder, states = exported
    names = [port.name for port in robot_class(config).outputs(config)]
    one = {name: array[:1] for name, array in states.inputs.items()}
    if config.method == "sensor":
        few = {name: array[:1, :0] for name, array in states.inputs.items()}
    else:
        few = {**one, "positions": one["positions"][:, :, :3], "mask": one["mask"][:, :, :3]}
    for inputs in (one, few):
        got, program = run_onnx(folder / ONNX, inputs), run_program(folder / PROGRAM, inputs, names)
        assert got["velocity"].shape == (1, 2)
        for name in names:
            np.testing.assert_allclose(got[name], program[name], atol=1e-5)
    np.testing.assert_array_equal(run_onnx(folder / ONNX, one)["action"], states.expected["action"][:1])


def test_both_files_stop_the_robot_where_it_cannot_decide(exported):
    """Nobody in sight, and positions that are no numbers."""
    config, folder, states = exported
    names = [port.name for port in robot_class(config).outputs(config)]
    blind = {name: np.zeros_like(array) if name.endswith("mask") else array for name, array in states.inputs.items()}
    wrong = [
        {
            name: np.full_like(array, value) if array.dtype == np.float32 else array
            for name, array in states.inputs.items()
        }
        for value in (np.nan, np.inf)
    ]
    for inputs in (blind, *wrong):
        for got in (run_onnx(folder / ONNX, inputs), run_program(folder / PROGRAM, inputs, names)):
            assert (got["action"] == NO_DECISION).all() and (got["velocity"] == 0.0).all()
            assert np.isfinite(got["action_values"]).all() and np.isfinite(got["observation"]).all()
    (action,) = [port for port in robot_class(config).outputs(config) if port.name == "action"]
    assert "-1 and no velocity where" in action.meaning


def test_golden_states_come_with_their_answers(exported):
    _, folder, _ = exported
    with np.load(folder / GOLDEN, allow_pickle=False) as file:
        golden = dict(file)
    inputs = {name[3:]: golden[name] for name in golden if name.startswith("in.")}
    got = run_onnx(folder / ONNX, inputs)
    np.testing.assert_array_equal(got["action"], golden["out.action"])
    np.testing.assert_allclose(got["velocity"], golden["out.velocity"], atol=1e-5)


def test_no_path_of_this_machine_goes_along(exported):
    _, folder, _ = exported
    here = str(importlib.util.find_spec("torch").origin).rsplit("/", 2)[0].encode()
    for path in folder.iterdir():
        assert here not in path.read_bytes()


def bare(config: RunConfig, folder, change=lambda states: states):
    shape = env_shape(config.env)
    torch.manual_seed(0)
    network = QNetwork(shape.observation_size, (16,), shape.num_actions).eval()
    states = change(observed_states(config.env, snapshot(network, 0, 0.0), seed=3, count=60))
    return write_export(folder, BarePolicy(network), bare_inputs(shape), bare_outputs(shape), {}, states), states


@pytest.mark.parametrize(
    "config", [RunConfig(env_id="CartPole-v1"), RunConfig(world=WORLDS["sensor"])], ids=["cp", "s"]
)
def test_a_bare_policy_takes_what_the_environment_gives(config, tmp_path):
    found, states = bare(config, tmp_path / "e")
    assert found[ONNX].different == found[PROGRAM].different == 0
    space = env_shape(config.env).observation_space
    (port,) = onnx_session(tmp_path / "e" / ONNX).get_inputs()
    assert port.shape == ["batch", *space.shape]
    assert states.inputs["observation"].dtype == space.dtype


def test_a_file_that_decides_otherwise_is_refused_and_the_older_one_stays(tmp_path):
    folder = tmp_path / "e"
    bare(RunConfig(env_id="CartPole-v1"), folder)
    before = {path.name: path.read_bytes() for path in folder.iterdir()}

    def wrong(states):
        return states._replace(expected={**states.expected, "action_values": states.expected["action_values"] + 0.01})

    with pytest.raises(ConfigError, match="policy.onnx does not answer as .* action_values"):
        bare(RunConfig(env_id="CartPole-v1"), folder, wrong)
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before
    assert [path.name for path in tmp_path.iterdir()] == ["e"]


def test_disagreement_is_counted_by_state():
    expected = {"action": np.array([0, 1, 2]), "observation": np.zeros((3, 2)), "action_values": np.full((3, 2), 10.0)}
    got = {key: array.copy() for key, array in expected.items()}
    got["action"][1] = 0
    got["observation"][2, 1] = 0.5
    got["action_values"][0] += 1e-4
    found = agreement(got, expected)
    assert (found.states, found.different) == (3, 2)
    assert found.errors["action_values"] == pytest.approx(1e-5)
    with pytest.raises(ConfigError, match="2 of 3 states differ"):
        require_agreement(found, "f")
    got["action_values"][0] = np.nan
    with pytest.raises(ConfigError, match="action_values"):
        require_agreement(agreement({**got, "action": expected["action"]}, expected), "f")


def test_a_folder_with_other_things_is_refused(tmp_path):
    (tmp_path / "thesis.tex").write_text("years of work")
    with pytest.raises(ConfigError, match="--out"):
        bare(RunConfig(env_id="CartPole-v1"), tmp_path)
    assert (tmp_path / "thesis.tex").read_text() == "years of work"


def test_a_missing_package_is_named(monkeypatch, tmp_path):
    real = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "onnxscript" else real(name))
    with pytest.raises(ConfigError, match=r"package onnxscript: .*pip install 'shoal\[export\]'"):
        bare(RunConfig(env_id="CartPole-v1"), tmp_path / "e")
    assert not list(tmp_path.iterdir())


def test_ports_fit_every_method():
    for name, world in WORLDS.items():
        (size,) = make_method(world).observation_shape
        assert robot_class(world).outputs(world)[-1].shape == ("batch", size), name
    faster = dataclasses.replace(WORLDS["out"], learner_speed_limit_m_s=1.5)
    assert "at most 1.5 m/s" in robot_class(faster).outputs(faster)[0].meaning
