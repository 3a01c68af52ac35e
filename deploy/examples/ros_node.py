"""A ROS 2 node around a policy from `shoal export`: poses in, velocities out. It needs rclpy, numpy and onnxruntime.

    python3 deploy/examples/ros_node.py --ros-args -p export:=runs/RUN/artifacts/export -p goals:="[6., 0., -6., 0.]"

It subscribes `pose` (PoseStamped), the robot's own, and `group_0`, `group_1`, ... (PoseArray), the other robots that
are sensed, its own group first, all in one frame. It publishes `cmd_vel` (Twist) in the robot's frame once a time step
of the policy, zero once a topic has been silent for `stale_s`. `goals`: x, y of each group's goal, its own first.
"""

import math
import runpy
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from geometry_msgs.msg import PoseArray, PoseStamped, Twist
from rclpy.node import Node

loop = runpy.run_path(str(Path(__file__).with_name("robot_loop.py")))


class PolicyNode(Node):
    """Drives one robot with an exported policy."""

    def __init__(self) -> None:
        super().__init__("shoal_policy")
        folder = Path(self.declare_parameter("export", "export").value)
        self.goals = np.array(self.declare_parameter("goals", [0.0, 0.0]).value, np.float32).reshape(-1, 2)
        self.stale_ns = 1e9 * self.declare_parameter("stale_s", 0.5).value
        self.policy, self.about = loop["load"](folder)
        if self.about["shield"]["used"] or self.about["settings"]["world"]["groups"] != len(self.goals):
            raise SystemExit("name a goal (x, y) of each group; a policy with a shield needs velocities, too: not here")
        self.tick, self.action = 0, -1
        self.heard: dict[str, tuple[int, Any]] = {}  # topic: when it was heard (ns), and its message
        for topic in ("pose", *(f"group_{group}" for group in range(len(self.goals)))):
            kind = PoseStamped if topic == "pose" else PoseArray
            self.create_subscription(kind, topic, lambda message, topic=topic: self.hear(topic, message), 1)
        self.velocity = self.create_publisher(Twist, "cmd_vel", 1)
        self.create_timer(self.about["time_step_s"], self.drive)

    def hear(self, topic: str, message: Any) -> None:
        """Keeps a topic's newest message."""
        self.heard[topic] = self.get_clock().now().nanoseconds, message

    def drive(self) -> None:
        """Publishes the velocity of this time step."""
        now, command = self.get_clock().now().nanoseconds, Twist()
        fresh = [message for heard_ns, message in self.heard.values() if now - heard_ns <= self.stale_ns]
        if len(fresh) == 1 + len(self.goals):
            pose = self.heard["pose"][1].pose
            x, y = self.ask(np.array([pose.position.x, pose.position.y]))
            q = pose.orientation
            yaw = math.atan2(2 * (q.w * q.z + q.x * q.y), 1 - 2 * (q.y * q.y + q.z * q.z))
            cos, sin = math.cos(yaw), math.sin(yaw)
            command.linear.x, command.linear.y = cos * x + sin * y, cos * y - sin * x
        else:
            self.tick = 0  # decides as soon as it hears
        self.velocity.publish(command)

    def ask(self, robot: Any) -> Any:
        """The policy's velocity (x, y) in the frame of the poses, m/s."""
        poses = [self.heard[f"group_{group}"][1].poses for group in range(len(self.goals))]
        groups = np.full((len(poses), max(1, *map(len, poses)), 2), np.nan)  # NaN: no robot
        for group, sensed in enumerate(poses):
            groups[group, : len(sensed)] = np.reshape([(p.position.x, p.position.y) for p in sensed], (-1, 2))
        decides = self.tick % self.about["decision_interval_steps"] == 0
        self.tick += 1
        if decides or self.about["method"] == "out":
            sensed = loop["sense"](self.about["method"], robot, groups, self.goals, -1 if decides else self.action)
            velocity, action = self.policy.run(["velocity", "action"], sensed)
            self.held, self.action = velocity[0].astype(float), int(action[0])
        return self.held


if __name__ == "__main__":
    rclpy.init()
    rclpy.spin(PolicyNode())
