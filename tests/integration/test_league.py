"""GA3C-CADRL in the league: the reader of its checkpoint, its network against PyTorch's LSTM, how it drives ours."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from rich.table import Table

from actors.evaluation.evaluator import evaluate
from actors.policy.baselines import Baseline
from actors.rollout.env_spec import EnvSpec
from learner.presets import preset_config
from sim_core import ENV_ID
from sim_core.checks import ConfigError
from sim_core.worlds import WorldBatch
from tests.benchmarks import league
from tests.benchmarks.cadrl import method, network
from tests.benchmarks.cadrl.checkpoint import MAGIC, read_arrays
from tests.benchmarks.cadrl.network import INPUTS, MOST_OTHERS, OTHER_VALUES, OWN_VALUES, SPEEDS, TURNS_RAD, Weights


def varint(value):
    return bytes([value & 0x7F | 0x80]) + varint(value >> 7) if value > 0x7F else bytes([value])


def block(entries, shared=0):
    """Keys share their first `shared` bytes with the key before."""
    body, restart = b"", b"\0\0\0\0"
    for i, (key, value) in enumerate(entries):
        keep = shared if i else 0
        body += varint(keep) + varint(len(key) - keep) + varint(len(value)) + key[keep:] + value
    return body + restart + (1).to_bytes(4, "little") + b"\0" + b"crc_"


def write_checkpoint(prefix, arrays):
    """As TensorFlow does; its keys are sorted, and here share their first letter."""
    data, entries = b"", []
    for name in sorted(arrays):
        array = arrays[name]
        sizes = b"".join(b"\x12" + varint(len(size)) + size for size in (b"\x08" + varint(n) for n in array.shape))
        place = b"\x20" + varint(len(data)) + b"\x28" + varint(array.nbytes) + b"\x35crc_"
        kind = 1 if array.dtype == np.float32 else 3
        entries.append((name.encode(), b"\x08" + varint(kind) + b"\x12" + varint(len(sizes)) + sizes + place))
        data += array.tobytes()
    first = block([(b"", b"\x08\x01\x1a\x02\x08\x01")])
    second = block(entries, shared=1)
    handles = [varint(0) + varint(len(first) - 5), varint(len(first)) + varint(len(second) - 5)]
    index = block([(b"a", handles[0]), (b"z", handles[1])])
    at = len(first) + len(second)
    footer = varint(0) + varint(0) + varint(at) + varint(len(index) - 5)
    table = first + second + index + footer.ljust(40, b"\0") + MAGIC.to_bytes(8, "little")
    prefix.with_name(f"{prefix.name}.index").write_bytes(table)
    prefix.with_name(f"{prefix.name}.data-00000-of-00001").write_bytes(data)


def test_a_checkpoint_is_read(tmp_path):
    rng = np.random.default_rng(0)
    arrays = {"net/a": rng.normal(size=(300, 7)).astype(np.float32), "net/b": np.arange(5, dtype=np.float32)}
    write_checkpoint(tmp_path / "c", arrays | {"net/step": np.array(3, np.int32), "no": np.array(2.5, np.float32)})
    found = read_arrays(tmp_path / "c")
    assert found.keys() == {"net/a", "net/b", "no"} and found["no"].shape == ()
    assert all(np.array_equal(found[name], array) for name, array in arrays.items())


def test_what_is_no_checkpoint_is_refused(tmp_path):
    write_checkpoint(tmp_path / "c", {"a": np.zeros(3, np.float32)})
    table = (tmp_path / "c.index").read_bytes()
    (tmp_path / "c.index").write_bytes(table[:-1] + b"x")
    with pytest.raises(ValueError, match="no table"):
        read_arrays(tmp_path / "c")


@pytest.fixture
def weights():
    rng = np.random.default_rng(1)

    def layer(inputs, units):
        kernel = rng.normal(0, 1 / math.sqrt(inputs), (inputs, units))
        return kernel.astype(np.float32), rng.normal(size=units).astype(np.float32)

    return Weights(
        layer(OTHER_VALUES + 8, 32), (layer(OWN_VALUES + 8, 16), layer(16, 16), layer(16, 16)), layer(16, 11)
    )


def in_torch(observation, weights):
    """The same by PyTorch's LSTM, robot by robot; its gates stand in another order, and it adds no bias to forget."""
    kernel, bias = weights.lstm
    enter, new, forget, leave = np.split(np.arange(len(bias)), 4)
    order = np.concatenate([enter, forget, new, leave])
    bias = bias.copy()
    bias[forget] += 1
    lstm = torch.nn.LSTM(OTHER_VALUES, len(bias) // 4, batch_first=True)
    with torch.no_grad():
        lstm.weight_ih_l0.copy_(torch.tensor(kernel[:OTHER_VALUES, order].T))
        lstm.weight_hh_l0.copy_(torch.tensor(kernel[OTHER_VALUES:, order].T))
        lstm.bias_ih_l0.copy_(torch.tensor(bias[order]))
        lstm.bias_hh_l0.zero_()
        count, rest = int(observation[0]), torch.tensor(observation[1:])
        own = (rest[:OWN_VALUES] - torch.tensor(network.OWN_MEAN)) / torch.tensor(network.OWN_SCALE)
        others = rest[OWN_VALUES:].reshape(MOST_OTHERS, OTHER_VALUES)[:count]
        others = (others - torch.tensor(network.OTHER_MEAN)) / torch.tensor(network.OTHER_SCALE)
        last = lstm(others[None])[1][0][0, 0] if count else torch.zeros(len(bias) // 4)
        x = torch.cat([own, last])
        for kernel, bias in weights.layers:
            x = torch.relu(x @ torch.tensor(kernel) + torch.tensor(bias))
        return (x @ torch.tensor(weights.logits[0]) + torch.tensor(weights.logits[1])).numpy()


def test_the_network_is_an_lstm_over_as_many_robots_as_are_there(weights):
    observation = np.random.default_rng(2).normal(size=(MOST_OTHERS + 1, INPUTS)).astype(np.float32)
    observation[:, 0] = np.arange(MOST_OTHERS + 1)
    found = network.action_logits(observation, weights)
    assert np.allclose(found, [in_torch(row, weights) for row in observation], atol=1e-5)


@pytest.fixture(params=["sensor", "out"])
def config(request):
    """GA3C-CADRL's world, in which the swarm avoids the learning robot, or does not."""
    return league.cadrl_world(preset_config("best", request.param, 10, 3).world)


def test_it_starts_where_our_methods_start(config):
    ours = preset_config("best", "sensor", 10, 3).world
    starts = []
    for world in (config, ours):
        worlds = WorldBatch(world, 3)
        worlds.seed([5, 6, 7])
        worlds.reset()
        starts.append((worlds.positions().copy(), worlds.state.learner.copy()))
    assert np.array_equal(starts[0][0], starts[1][0]) and np.array_equal(starts[0][1], starts[1][1])


def seen(config, x, y, vx=0.0, vy=0.0):
    """What a robot sees whose world has robots at `x`, `y` `[robots]`; the first robot of the first group drives."""
    worlds = WorldBatch(config, 1)
    worlds.seed([0])
    worlds.reset()
    state = worlds.state
    state.learner[:] = 0
    state.pos_x[:], state.pos_y[:] = x, y
    state.vel_x[:], state.vel_y[:] = 0.0, 0.0
    state.vel_x[0, 0], state.vel_y[0, 0] = vx, vy
    return config.method_class(config).observe(state)[0], state


def test_it_sees_the_nearest_robots_in_the_frame_of_its_goal_the_nearest_last(config):
    """The group's centre is north of the robot: along is north, across is west."""
    x, y = np.arange(30) * 0.0 + 50, np.arange(30) * 1.0 + 50
    x[:10], y[:10] = 0.0, [0, *range(1, 10)]  # the own group, above the robot
    x[10:12], y[10:12] = [0.5, -2.5], [0.0, 0.0]  # of another group: one to the east, one to the west
    found, _ = seen(config, x, y, vx=-1.0)
    scale = config.method_class.enlarged
    radius_m = getattr(config, config.method_class.radius_field)
    assert found[0] == MOST_OTHERS
    assert found[1:5] == pytest.approx([5 * scale, math.pi / 2, scale, radius_m * scale])
    others = found[5:].reshape(MOST_OTHERS, OTHER_VALUES) / scale
    gaps = others[:, 6]
    assert np.all(np.diff(gaps) <= 0)  # the nearest last
    expected = [0.0, -0.5, 0.0, 0.0, radius_m, 2 * radius_m, 0.5 - 2 * radius_m]
    assert others[-1] == pytest.approx(expected, abs=1e-5)
    assert [0.0, 2.5] == pytest.approx(next(each[:2] for each in others if each[1] > 1), abs=1e-5)
    assert np.count_nonzero(gaps < 10) == 11  # all that are near are among the 19


def test_an_action_turns_once_a_decision_and_a_stop_keeps_the_heading(config):
    driver = config.method_class(config)
    _, state = seen(config, np.arange(30.0), np.zeros(30), vx=0.0, vy=0.5)
    out = np.zeros((2, 1), np.float32)
    left = int(np.argmin(np.abs(TURNS_RAD - math.pi / 6) + np.abs(SPEEDS - 1)))
    driver.velocity(state, np.array([left]), *out)
    assert np.arctan2(*out[::-1, 0]) == pytest.approx(math.pi / 2 + math.pi / 6, abs=1e-5)
    assert np.hypot(*out[:, 0]) == pytest.approx(config.learner_speed_m_s)
    state.vel_x[0, 0], state.vel_y[0, 0] = out[:, 0]
    state.steps[:] += 1  # within the decision
    again = np.zeros((2, 1), np.float32)
    driver.velocity(state, np.array([left]), *again)
    assert np.array_equal(again, out)
    state.steps[:] = config.decision_interval_steps
    stop = int(np.argmin(np.abs(TURNS_RAD) + SPEEDS))
    driver.velocity(state, np.array([stop]), *again)
    assert np.hypot(*again[:, 0]) == pytest.approx(method.CREEP_M_S, rel=1e-4)
    assert np.arctan2(*again[::-1, 0]) == pytest.approx(np.arctan2(*out[::-1, 0]), abs=1e-4)


def test_it_plays_as_a_rule(config, weights, monkeypatch):
    drives = config.method_class.rules.__func__.__globals__  # of the module that is made of the method's file
    monkeypatch.setitem(drives, "published_weights", lambda: weights)
    found = evaluate(EnvSpec(ENV_ID, config), Baseline.GREEDY, [1, 2, 3])
    assert np.all(found.length_steps > 0) and len(found.outcome) == 3


def test_the_table_has_rates_with_intervals_and_paired_differences():
    world = preset_config("best", "sensor", 5, 1).world
    field = [
        league.Player("FL-ORCA", world, Baseline.FL_ORCA),
        league.Player(league.CADRL, dataclasses.replace(world, horizon_steps=4), Baseline.FL_ORCA),
    ]
    table = Table(*(["column"] * 8))
    league.add_rows(table, "5x1", field, league.parse(["--episodes", "20"]))
    rows = list(zip(*(column.cells for column in table.columns), strict=True))
    assert rows[0] == ("5x1", "FL-ORCA", "100.0 % (83.9 … 100.0)", *["0.0"] * 4, "+100.0 (+100.0 … +100.0)")
    assert rows[1] == ("5x1", league.CADRL, "0.0 % (0.0 … 16.1)", *["0.0"] * 3, "100.0", "")


def test_another_number_of_actions_is_refused(config):
    with pytest.raises(ConfigError, match="11 actions"):
        dataclasses.replace(config, sectors=8)
