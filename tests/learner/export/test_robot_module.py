"""A robot's decision in torch, beside the simulator's own perception, policy and velocity."""

import math

import numpy as np
import pytest
import torch

from actors.policy.baselines import Baseline
from actors.policy.network import QNetwork, snapshot
from learner.export.ellipse_methods import InsideRobot, OutsideRobot, RepulsiveField
from learner.export.reference_states import swarm_states
from learner.export.robot_module import NO_DECISION, BarePolicy, make_robot
from sim_core.config import WorldConfig
from sim_core.methods import make_method
from sim_core.methods.apf import field_params, repulsion
from sim_core.worlds import WorldBatch

NAMES = ("velocity", "action", "action_values", "observation")
WORLDS = {
    "sensor": WorldConfig(robots=6, groups=3),
    "sensor, counts apart": WorldConfig(robots=6, groups=3, sensor_counts="separate"),
    "sensor, odd sectors, stop": WorldConfig(robots=6, groups=1, sectors=5, stop_action=True),
    "sensor, three speeds": WorldConfig(robots=6, groups=2, speed_levels=3, stop_action=True),
    "out": WorldConfig(method="out", robots=6, groups=3),
    "out, itself counted, faster": WorldConfig(
        method="out", robots=6, groups=2, ellipse_counts_learner=True, learner_speed_limit_m_s=1.5, apf_range_m=1.5
    ),
    "in, full, nearest": WorldConfig(
        method="in", robots=6, groups=4, ellipse_covariance="full", group_order="nearest", apf_range_m=1.5
    ),
    "in, rows for more groups": WorldConfig(method="in", robots=5, groups=3, group_rows=7),
    "sensor, bad senses": WorldConfig(robots=6, groups=3, position_loss=0.5, position_noise_m=0.1, dropped_mates=1),
    "in, bad senses, nearest": WorldConfig(
        method="in", robots=4, groups=4, group_order="nearest", position_loss=0.6, apf_range_m=1.5
    ),
    "out, bad senses, itself counted": WorldConfig(
        method="out", robots=4, groups=3, ellipse_counts_learner=True, burst_loss=0.4, position_delay_steps=3
    ),
    "in, all, printed": WorldConfig(method="in", robots=6, groups=2, apf_rows="all", ellipse_axes="printed"),
}


def lively(config, seed=0):
    """A network whose best action changes from state to state."""
    torch.manual_seed(seed)
    size = int(np.prod(make_method(config).observation_shape))
    network = QNetwork(size, (32,), config.num_actions).eval()
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.mul_(4.0)
    return network


def decide(robot, *inputs):
    with torch.no_grad():
        answers = robot(*(torch.as_tensor(x) for x in inputs))
    return dict(zip(NAMES, (answer.numpy() for answer in answers), strict=True))


def observation_error(config, found, expected):
    """Largest error of every state; an angle counts as much as its ellipse is longer than wide, which it turns."""
    error = np.abs(found - expected)
    if config.method != "sensor":
        rows, wanted = (array.reshape(len(error), config.groups, -1) for array in (error, expected))
        rows[..., 4] *= wanted[..., 1] - wanted[..., 0]
    return error.max(1)


@pytest.mark.parametrize("config", WORLDS.values(), ids=WORLDS)
def test_it_decides_as_the_simulator_with_its_policy(config):
    network = lively(config)
    states = swarm_states(config, Baseline.FL_ORCA, snapshot(network, 0, 0.0), seed=5, count=1_000)
    found = decide(make_robot(network, config), *states.inputs.values())
    assert len(set(states.expected["action"])) > 2
    close = 0.0 if config.method == "sensor" else 2e-5
    error = observation_error(config, found["observation"], states.expected["observation"])
    same = error <= close
    assert same.mean() >= 0.999, "but for states within rounding of a jump"
    np.testing.assert_array_equal(found["action"][same], states.expected["action"][same])
    np.testing.assert_allclose(found["velocity"][same], states.expected["velocity"][same], atol=2e-5)
    np.testing.assert_allclose(
        found["action_values"][same], states.expected["action_values"][same], rtol=1e-4, atol=1e-4
    )


@pytest.mark.parametrize("method", ["sensor", "in", "out"])
def test_between_decisions_it_drives_as_the_simulator(method):
    config = WorldConfig(method=method, robots=5, groups=2, arena_radius_m=2.0, decision_interval_steps=5)
    robot, worlds, sensed, driven = make_robot(lively(config), config), WorldBatch(config, 40), [], []
    worlds.reset()

    def watch():
        learner = worlds.state.learner
        driven.append(np.stack([worlds.state.vel_x, worlds.state.vel_y], axis=-1)[np.arange(40), learner])
        sensed.append(robot.sense(worlds))

    different = 0
    for _ in range(8):
        sensed, driven = [robot.sense(worlds)], []
        action = decide(robot, *sensed[0].values())["action"]
        worlds.step(np.maximum(action, 0), watch)  # in worlds that have ended as lost there is no decision
        running = worlds.state.steps[:, None] == worlds.state.steps.max()  # the others stopped where they ended
        for step, inputs in enumerate(sensed[:-1]):
            if step and "held" in inputs:
                inputs["held"] = action
            if step == 0 or "held" in inputs:
                velocity = decide(robot, *inputs.values())["velocity"]
            np.testing.assert_allclose(driven[step][running[:, 0]], velocity[running[:, 0]], atol=2e-5)
        different += int((np.abs(np.diff(driven, axis=0)).max(axis=(0, 2)) > 0.01).sum())
    assert (different > 20) == (method == "out"), "u_apf changes within a decision"


@pytest.mark.parametrize("config", WORLDS.values(), ids=WORLDS)
def test_order_and_unused_places_do_not_count(config):
    network = lively(config)
    states = swarm_states(config, Baseline.FL_ORCA, snapshot(network, 0, 0.0), seed=9, count=50)
    robot, rng = make_robot(network, config), np.random.default_rng(0)
    expected = decide(robot, *states.inputs.values())
    changed = dict(states.inputs)
    for name, mask in (("own", "own_mask"), ("other", "other_mask"), ("positions", "mask")):
        if name in changed:
            axis = changed[mask].ndim - 1
            spare = [(0, 0)] * axis + [(0, 3)]
            wider = np.pad(changed[name], [*spare, (0, 0)], constant_values=np.nan), np.pad(changed[mask], spare)
            order = rng.permutation(wider[1].shape[axis])
            changed[name], changed[mask] = (np.take(array, order, axis=axis) for array in wider)
    found = decide(robot, *changed.values())
    np.testing.assert_array_equal(found["action"], expected["action"])
    np.testing.assert_allclose(found["velocity"], expected["velocity"], atol=1e-6)


def test_the_sensor_counts_where_robots_are():
    config = WorldConfig(robots=5, groups=2)
    east, west_ring, too_far, ahead = (0.3, 0.01), (-1.0, -0.01), (1.5, 0.0), (0.0, 0.4)
    own, other = np.float32([[east, west_ring, too_far]]), np.float32([[ahead, east]])
    robot = make_robot(lively(config), config)
    seen = decide(robot, own, np.ones((1, 3), bool), other, np.ones((1, 2), bool))["observation"][0]
    expected = np.zeros(16)
    expected[4] = 0  # an own and another robot
    expected[6] = -1  # 90 degrees, where the sector from 90 to 135 begins
    expected[8 + 0] = 1
    np.testing.assert_array_equal(seen, expected)


def test_a_full_ellipse_is_that_of_its_eigenvectors():
    config = WorldConfig(method="in", robots=6, groups=2, ellipse_covariance="full", ellipse_counts_learner=True)
    rng = np.random.default_rng(1)
    positions = rng.normal(size=(200, 2, 6, 2)).astype(np.float32)
    mask = np.ones((200, 2, 6), bool)
    mask[:, 0, 5] = False
    robot = InsideRobot(lively(config), config)
    seen = decide(robot, positions, mask, np.zeros((200, 2, 2), np.float32))["observation"].reshape(200, 2, 9)
    for i in range(200):
        for group in range(2):
            points = positions[i, group][mask[i, group]].astype(float)
            points = np.vstack([points, [0, 0]]) if group == 0 else points
            values, vectors = np.linalg.eigh(np.cov(points.T))
            theta = math.atan2(vectors[1, 1], vectors[0, 1])
            row = seen[i, group]
            np.testing.assert_allclose(row[:2] / 0.5, np.sqrt(5.991 * values), rtol=1e-5)
            np.testing.assert_allclose(row[2:4] / 0.5, points.mean(0), atol=1e-5)
            assert -math.pi / 2 < row[4] <= math.pi / 2 + 1e-6
            assert abs(math.sin(row[4] - theta)) < 1e-4, "an axis has no direction"


@pytest.mark.parametrize(
    ("shared", "half", "expected"),
    [(0.0, 1.0, 0.0), (0.0, -1.0, math.pi / 2), (-0.0, -1.0, math.pi / 2), (0.0, 0.0, 0.0), (1.0, 0.0, math.pi / 4)],
)
def test_the_angle_at_its_edges(shared, half, expected):
    config = WorldConfig(method="out", ellipse_covariance="full")
    robot = OutsideRobot(lively(config), config)
    found = robot._angle(torch.tensor([shared], dtype=torch.float64), torch.tensor([half], dtype=torch.float64))
    assert found.item() == pytest.approx(expected, abs=1e-7)


def test_the_field_is_that_of_every_robot():
    config = WorldConfig(method="out", apf_range_m=1.0)
    positions = np.random.default_rng(2).uniform(-1.2, 1.2, (500, 2)).astype(np.float32)
    positions[0] = 0.0
    found = RepulsiveField(config).parts(torch.from_numpy(positions), torch.ones(500, dtype=torch.bool)).numpy()
    expected = [repulsion(x, y, field_params(config)) for x, y in positions]
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-6)
    assert np.isfinite(found).all() and (found[0] == 0.0).all()


def test_a_policy_that_has_learned_with_bad_senses_always_decides():
    config = WorldConfig(method="in", robots=4, groups=2, position_loss=0.1)
    positions, goals = np.ones((1, 2, 4, 2), np.float32), np.ones((1, 2, 2), np.float32)
    found = decide(make_robot(lively(config), config), positions, np.zeros((1, 2, 4), bool), goals)
    assert found["action"][0] != NO_DECISION and np.abs(found["velocity"][0]).max() > 0.0
    rows = found["observation"].reshape(2, 9)
    assert not rows[:, :5].any() and not rows[:, 7:].any() and (rows[:, 5:7] == config.goal_scale_per_m).all()


def test_without_a_robot_of_every_group_there_is_no_decision():
    config = WorldConfig(method="out", robots=4, groups=2)
    positions, goals = np.ones((2, 2, 4, 2), np.float32), np.ones((2, 2, 2), np.float32)
    mask = np.ones((2, 2, 4), bool)
    mask[1, 1] = False
    found = decide(make_robot(lively(config), config), positions, mask, goals, np.array([-1, -1]))
    assert found["action"][0] != NO_DECISION and np.abs(found["velocity"][0]).max() > 0.0
    assert found["action"][1] == NO_DECISION and (found["velocity"][1] == 0.0).all()
    assert np.isfinite(found["action_values"]).all()


def test_a_robot_that_senses_none_of_its_group_stops():
    """As where its training has ended; far robots and those of other groups are no company."""
    config = WorldConfig(robots=4, groups=2)
    own, other = np.full((4, 3, 2), 0.4, np.float32), np.full((4, 4, 2), -0.4, np.float32)
    own_mask, other_mask = np.ones((4, 3), bool), np.ones((4, 4), bool)
    own_mask[1] = other_mask[1] = False  # nobody at all
    own_mask[2] = False
    own[3] = 1.2  # beyond R2
    found = decide(make_robot(lively(config), config), own, own_mask, other, other_mask)
    assert (found["action"] == NO_DECISION).tolist() == [False, True, True, True]
    assert (np.abs(found["velocity"]).max(1) == 0.0).tolist() == [False, True, True, True]
    empty = np.zeros((1, 0, 2), np.float32), np.zeros((1, 0), bool)
    assert decide(make_robot(lively(config), config), *empty, *empty)["action"] == [NO_DECISION]
    trained = WorldConfig(robots=4, groups=2, position_loss=0.5)
    assert (decide(make_robot(lively(trained), trained), own, own_mask, other, other_mask)["action"] >= 0).all()


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("config", WORLDS.values(), ids=WORLDS)
def test_a_position_that_is_no_number_stops_the_robot_where_it_counts(config, value):
    states = swarm_states(config, Baseline.FL_ORCA, snapshot(lively(config), 0, 0.0), seed=5, count=40)
    robot = make_robot(lively(config), config)
    before = decide(robot, *states.inputs.values())
    filled = {name for name, array in states.inputs.items() if array.size}
    for name in filled & {"own", "other", "positions", "goals"}:
        inputs = {key: array.copy() for key, array in states.inputs.items()}
        mask = inputs.get(f"{name}_mask", inputs.get("mask")) if name != "goals" else None
        place = (slice(None), *([0] * (inputs[name].ndim - 2)))
        inputs[name][(*place, 1)] = value
        counts = np.ones(40, bool) if mask is None else mask[place]
        found = decide(robot, *inputs.values())
        assert (found["action"][counts] == NO_DECISION).all() and (found["velocity"][counts] == 0.0).all()
        assert all(np.isfinite(answer).all() for answer in found.values())
        np.testing.assert_array_equal(found["action"][~counts], before["action"][~counts])
        np.testing.assert_array_equal(found["velocity"][~counts], before["velocity"][~counts])


def test_a_bare_policy_does_not_decide_on_what_is_no_number():
    config = WorldConfig(robots=4, groups=2)
    policy, observation = BarePolicy(lively(config)), np.ones((3, 16), np.float32)
    observation[1, 5], observation[2, 0] = np.nan, np.inf
    with torch.no_grad():
        action = policy(torch.from_numpy(observation))[0].numpy()
    assert (action == NO_DECISION).tolist() == [False, True, True]
