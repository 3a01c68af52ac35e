"""The ROS 2 node: driven by stubs of rclpy and of messages, and by a bag that rosbags writes and reads."""

from __future__ import annotations

import dataclasses
import json
import math
import runpy
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import Writer
from rosbags.typesys import Stores, get_typestore

import deploy
from actors.evaluation.evaluator import record_episode
from actors.evaluation.trajectory import Episode
from actors.policy.network import snapshot
from actors.rollout.env_spec import EnvSpec
from deploy.commands.export import metadata
from learner.config import RunConfig
from learner.export.reference_states import swarm_states
from learner.export.robot_module import make_robot, robot_class
from learner.export.write import write_export
from sim_core import ENV_ID
from sim_core.config import WorldConfig
from tests.learner.export.test_robot_module import lively

NODE = Path(deploy.__file__).parent / "examples" / "ros_node.py"
STORE = get_typestore(Stores.ROS2_HUMBLE)
TYPES = STORE.types
STEPS = 40
WORLDS = {
    "sensor": WorldConfig(robots=4, groups=2, horizon_steps=STEPS),
    "in": WorldConfig(method="in", robots=4, groups=3, horizon_steps=STEPS, arena_radius_m=1.5),
    "out": WorldConfig(method="out", robots=4, groups=2, horizon_steps=STEPS, decision_interval_steps=3),
}


class Played:
    """An export and an episode of its policy."""

    def __init__(self, world: WorldConfig, folder: Path) -> None:
        self.world, self.folder = world, folder / "export"
        network = lively(world, seed=3)
        weights = snapshot(network, 0, 0.0)
        states = swarm_states(world, weights, weights, seed=1, count=100)
        about = metadata(RunConfig(world=world), weights, bare=False)
        robot = robot_class(world)
        write_export(self.folder, make_robot(network, world), robot.inputs(world), robot.outputs(world), about, states)
        self.episode = record_episode(EnvSpec(ENV_ID, world), weights, 5)

    def order(self) -> list[np.ndarray]:
        """The other robots by group, the own group first, as the world orders groups."""
        groups, sizes = self.world.groups, self.world.group_sizes
        group = np.repeat(np.arange(groups), sizes)
        own, robots = group[self.episode.learner], np.arange(len(group))
        found = [robots[(group == (own + i) % groups) & (robots != self.episode.learner)] for i in range(groups)]
        self.goals = np.roll(self.episode.goal, -own, axis=0)
        return found


@pytest.fixture(scope="module", params=WORLDS)
def played(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Played:
    return Played(WORLDS[request.param], tmp_path_factory.mktemp(request.param))


def vector(x: float = 0.0, y: float = 0.0) -> Any:
    return SimpleNamespace(x=x, y=y, z=0.0)


class Ros:
    """As much of rclpy and geometry_msgs as the node uses."""

    def __init__(self, **parameters: Any) -> None:
        self.parameters = parameters
        self.now_ns = 0
        self.heard_by: dict[str, Any] = {}
        self.published: list[Any] = []
        self.tick: Any = None
        self.period_s = 0.0

    def node_class(ros) -> type:  # noqa: N805
        class Node:
            def __init__(self, name: str) -> None:
                assert name.isidentifier()

            def declare_parameter(self, name: str, default: Any) -> Any:
                return SimpleNamespace(value=ros.parameters.get(name, default))

            def create_subscription(self, kind: Any, topic: str, callback: Any, qos: int) -> None:
                ros.heard_by[topic] = (kind, callback)

            def create_publisher(self, kind: Any, topic: str, qos: int) -> Any:
                assert topic == "cmd_vel"
                return SimpleNamespace(publish=ros.published.append)

            def create_timer(self, period_s: float, callback: Any) -> None:
                ros.period_s, ros.tick = period_s, callback

            def get_clock(self) -> Any:
                return SimpleNamespace(now=lambda: SimpleNamespace(nanoseconds=ros.now_ns))

        return Node

    def say(self, topic: str, message: Any) -> None:
        self.heard_by[topic][1](message)


def start(monkeypatch: pytest.MonkeyPatch, played: Played, **parameters: Any) -> Ros:
    """Starts the node of an export among stubs."""
    played.order()
    goals = [float(value) for value in played.goals.ravel()]
    ros = Ros(export=str(played.folder), **{"goals": goals, **parameters})
    messages, rclpy, node = (ModuleType(name) for name in ("geometry_msgs.msg", "rclpy", "rclpy.node"))
    for name in ("PoseStamped", "PoseArray"):
        setattr(messages, name, type(name, (), {}))
    messages.Twist = lambda: SimpleNamespace(linear=vector(), angular=vector())  # type: ignore[attr-defined]
    node.Node = ros.node_class()  # type: ignore[attr-defined]
    for module in (ModuleType("geometry_msgs"), messages, rclpy, node):
        monkeypatch.setitem(sys.modules, module.__name__, module)
    runpy.run_path(str(NODE))["PolicyNode"]()
    return ros


def pose(x: float, y: float, yaw: float = 0.0) -> Any:
    turn = SimpleNamespace(x=0.0, y=0.0, z=math.sin(yaw / 2), w=math.cos(yaw / 2))
    return SimpleNamespace(position=vector(float(x), float(y)), orientation=turn)


def say_state(ros: Ros, played: Played, step: int, yaw: float) -> None:
    position = played.episode.position[step]
    ros.say("pose", SimpleNamespace(pose=pose(*position[played.episode.learner], yaw)))
    for group, robots in enumerate(played.order()):
        ros.say(f"group_{group}", SimpleNamespace(poses=[pose(*position[robot]) for robot in robots]))


def driven(command: Any, yaw: float) -> np.ndarray:
    """A Twist's velocity in the frame of the poses."""
    cos, sin = math.cos(yaw), math.sin(yaw)
    return np.array([cos * command.linear.x - sin * command.linear.y, sin * command.linear.x + cos * command.linear.y])


def expected(episode: Episode) -> np.ndarray:
    return episode.velocity[1:, episode.learner]


def test_the_node_is_short():
    assert len(NODE.read_text().splitlines()) <= 80


def test_it_drives_as_the_policy_does_in_the_simulator(monkeypatch: pytest.MonkeyPatch, played: Played):
    ros = start(monkeypatch, played)
    assert ros.period_s == pytest.approx(played.world.time_step_s)
    assert {topic: kind.__name__ for topic, (kind, _) in ros.heard_by.items()} == {
        "pose": "PoseStamped",
        **{f"group_{group}": "PoseArray" for group in range(played.world.groups)},
    }
    found = []
    for step in range(len(played.episode.action) - 1):
        yaw = 0.7 * step  # whichever way the robot faces
        say_state(ros, played, step, yaw)
        ros.tick()
        found.append(driven(ros.published[-1], yaw))
        ros.now_ns += int(1e9 * ros.period_s)
    np.testing.assert_allclose(found, expected(played.episode), atol=1e-4)
    assert len({tuple(np.round(v, 2)) for v in found}) > 2
    assert all(command.angular == vector() and command.linear.z == 0.0 for command in ros.published)


def test_it_stops_while_a_topic_is_silent(monkeypatch: pytest.MonkeyPatch, played: Played):
    ros = start(monkeypatch, played, stale_s=0.2)
    ros.tick()
    assert driven(ros.published[-1], 0.0).tolist() == [0.0, 0.0]  # nothing heard yet
    say_state(ros, played, 0, 0.0)
    ros.now_ns = 199_000_000
    ros.tick()
    first = driven(ros.published[-1], 0.0)
    np.testing.assert_allclose(first, expected(played.episode)[0], atol=1e-4)
    ros.now_ns = 300_000_000
    position = played.episode.position[0]
    ros.say("pose", SimpleNamespace(pose=pose(*position[played.episode.learner])))  # of the group nothing new
    ros.tick()
    assert driven(ros.published[-1], 0.0).tolist() == [0.0, 0.0]
    say_state(ros, played, 0, 0.0)
    ros.tick()
    np.testing.assert_allclose(driven(ros.published[-1], 0.0), first, atol=1e-6)


def test_robots_that_are_not_sensed_are_left_out(monkeypatch: pytest.MonkeyPatch, played: Played):
    """Groups of unlike lengths, and one that is empty: the robot drives on, or stops where its method must."""
    ros = start(monkeypatch, played)
    say_state(ros, played, 0, 0.0)
    position, robots = played.episode.position[0], played.order()
    ros.say("group_1", SimpleNamespace(poses=[pose(*position[robots[1][0]])]))
    ros.tick()
    some = driven(ros.published[-1], 0.0)
    assert np.isfinite(some).all() and some.any()
    ros.say("group_0", SimpleNamespace(poses=[]))
    ros.tick()
    ros.tick(), ros.tick()  # past the decision's interval
    assert driven(ros.published[-1], 0.0).tolist() == [0.0, 0.0]


def test_it_refuses_what_it_cannot_drive(monkeypatch: pytest.MonkeyPatch, played: Played):
    for goals in ([1.0, 2.0], [1.0] * (2 * played.world.groups + 1)):
        with pytest.raises(SystemExit, match="name a goal"):
            start(monkeypatch, played, goals=goals)


def test_a_unicycle_gets_speed_and_turn_rate(monkeypatch: pytest.MonkeyPatch, tmp_path_factory: pytest.TempPathFactory):
    """Driven by them from where it faces, it moves as the unicycle in the simulator does."""
    world = dataclasses.replace(
        WORLDS["sensor"], kinematics="unicycle", turn_rate_limit_deg_s=90.0, acceleration_limit_m_s2=100.0
    )
    played = Played(world, tmp_path_factory.mktemp("unicycle"))
    ros = start(monkeypatch, played)
    episode = played.episode
    away = played.goals[0] - episode.position[0, episode.learner]
    yaw, found, turned = math.atan2(away[1], away[0]), [], []
    for step in range(len(episode.action) - 1):
        say_state(ros, played, step, yaw)
        ros.tick()
        command = ros.published[-1]
        assert command.linear.y == 0.0 and abs(command.angular.z) <= math.radians(90.0) + 1e-9
        yaw += command.angular.z * world.time_step_s
        found.append(command.linear.x * np.array([math.cos(yaw), math.sin(yaw)]))
        turned.append(command.angular.z)
    np.testing.assert_allclose(found, expected(episode), atol=1e-4)
    assert np.ptp(turned) > 1.0


def write_bag(path: Path, played: Played) -> None:
    """Records the episode's poses as ROS 2 would."""
    kinds = {"pose": "geometry_msgs/msg/PoseStamped"}
    kinds |= {f"group_{group}": "geometry_msgs/msg/PoseArray" for group in range(played.world.groups)}
    names = ("Header", "Time", "Pose", "Point", "Quaternion")
    packages = ("std_msgs", "builtin_interfaces", *["geometry_msgs"] * 3)
    header, time, a_pose, point, turn = (
        TYPES[f"{package}/msg/{name}"] for package, name in zip(packages, names, strict=True)
    )
    with Writer(path, version=9) as writer:
        topics = {topic: writer.add_connection(f"/{topic}", kind, typestore=STORE) for topic, kind in kinds.items()}
        for step, position in enumerate(played.episode.position[:-1]):
            stamp_ns = int(1e9 * step * played.world.time_step_s)

            def stamped(ns: int = stamp_ns) -> Any:
                return header(stamp=time(sec=ns // 10**9, nanosec=ns % 10**9), frame_id="map")

            def at(robot: int, where: np.ndarray = position) -> Any:
                x, y = map(float, where[robot])
                return a_pose(position=point(x=x, y=y, z=0.0), orientation=turn(x=0.0, y=0.0, z=0.0, w=1.0))

            said = {"pose": TYPES[kinds["pose"]](header=stamped(), pose=at(played.episode.learner))}
            for group, robots in enumerate(played.order()):
                poses = [at(robot) for robot in robots]
                said[f"group_{group}"] = TYPES["geometry_msgs/msg/PoseArray"](header=stamped(), poses=poses)
            for topic, message in said.items():
                data = STORE.serialize_cdr(message, kinds[topic])
                writer.write(topics[topic], stamp_ns, data)


def test_it_drives_from_a_bag_and_its_commands_make_another(
    monkeypatch: pytest.MonkeyPatch, played: Played, tmp_path: Path
):
    write_bag(tmp_path / "poses", played)
    ros = start(monkeypatch, played)
    twist, three = TYPES["geometry_msgs/msg/Twist"], TYPES["geometry_msgs/msg/Vector3"]
    with AnyReader([tmp_path / "poses"], default_typestore=STORE) as reader, Writer(tmp_path / "out", version=9) as out:
        velocity = out.add_connection("/cmd_vel", twist.__msgtype__, typestore=STORE)
        last = f"/group_{played.world.groups - 1}"
        for connection, stamp_ns, data in reader.messages():
            ros.now_ns = stamp_ns
            ros.say(connection.topic.lstrip("/"), reader.deserialize(data, connection.msgtype))
            if connection.topic == last:
                ros.tick()
                command = ros.published[-1]
                message = twist(three(**vars(command.linear)), three(**vars(command.angular)))
                out.write(velocity, stamp_ns, STORE.serialize_cdr(message, twist.__msgtype__))
    with AnyReader([tmp_path / "out"], default_typestore=STORE) as reader:
        assert [(c.topic, c.msgtype) for c in reader.connections] == [("/cmd_vel", "geometry_msgs/msg/Twist")]
        found = [reader.deserialize(data, c.msgtype).linear for c, _, data in reader.messages()]
    np.testing.assert_allclose([(v.x, v.y) for v in found], expected(played.episode), atol=1e-4)
    about = json.loads((played.folder / "policy.json").read_text())
    assert about["method"] == played.world.method
