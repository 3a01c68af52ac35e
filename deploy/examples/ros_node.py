"""A ROS 2 node around a policy from `shoal export`: poses in, velocities out. It needs rclpy, numpy and onnxruntime.

    python3 deploy/examples/ros_node.py --ros-args -p export:=runs/RUN/artifacts/export -p goals:="[6., 0., -6., 0.]"

It subscribes `pose` (PoseStamped), the robot's own, and `group_0`, `group_1`, ... (PoseArray), the other robots that
are sensed, its own group first, all in one frame. It publishes `cmd_vel` (Twist) once a time step of the policy: the
velocity in the robot's frame, or a unicycle's speed and turn rate; zero once a topic has been silent for `stale_s`.
"""

import cmath
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
        goals = self.declare_parameter("goals", [0.0, 0.0]).value  # x, y of each group's goal, own group's first
        self.stale_ns = 1e9 * self.declare_parameter("stale_s", 0.5).value
        self.policy, self.about = loop["load"](Path(self.declare_parameter("export", "export").value))
        if self.about["shield"]["used"] or self.about["settings"]["world"]["groups"] * 2 != len(goals):
            raise SystemExit("name a goal (x, y) of each group; a policy with a shield needs velocities, too: not here")
        self.goals, self.tick, self.action = np.reshape(goals, (-1, 2)), 0, -1
        self.heard: dict[str, tuple[int, Any]] = {}  # topic: when it was heard (ns), and its newest message
        for topic in ("pose", *(f"group_{group}" for group in range(len(self.goals)))):
            kind = PoseStamped if topic == "pose" else PoseArray
            self.create_subscription(kind, topic, lambda message, topic=topic: self.hear(topic, message), 1)
        self.velocity = self.create_publisher(Twist, "cmd_vel", 1)
        self.create_timer(self.about["time_step_s"], self.drive)

    def hear(self, topic: str, message: Any) -> None:
        self.heard[topic] = self.get_clock().now().nanoseconds, message

    def drive(self) -> None:
        command, now = Twist(), self.get_clock().now().nanoseconds
        if sum(now - heard_ns <= self.stale_ns for heard_ns, _ in self.heard.values()) == 1 + len(self.goals):
            at, q = self.heard["pose"][1].pose.position, self.heard["pose"][1].pose.orientation
            yaw = math.atan2(2 * (q.w * q.z + q.x * q.y), 1 - 2 * (q.y * q.y + q.z * q.z))
            self.track(complex(*self.ask(np.array([at.x, at.y]))) * cmath.rect(1, -yaw), command)
        else:
            self.tick = 0  # decides as soon as it hears
        self.velocity.publish(command)

    def track(self, velocity: complex, command: Any) -> None:
        """Writes the command for a velocity in the robot's frame; a unicycle turns first, then drives ahead."""
        command.linear.x, command.linear.y, tick_s = velocity.real, velocity.imag, self.about["time_step_s"]
        if self.about["kinematics"]["kind"] == "unicycle":
            error, most = cmath.phase(velocity), self.about["kinematics"]["turn_rate_limit_rad_s"]
            command.angular.z = min(max(error / tick_s, -most), most)
            ahead = abs(velocity) * math.cos(error - command.angular.z * tick_s)
            command.linear.x, command.linear.y = max(0.0, ahead), 0.0

    def ask(self, robot: Any) -> Any:
        """The policy's velocity (x, y) in the frame of the poses, m/s."""
        poses = [self.heard[f"group_{group}"][1].poses for group in range(len(self.goals))]
        groups = np.full((len(poses), max(1, *map(len, poses)), 2), np.nan)  # NaN: no robot
        for place, sensed in zip(groups, poses, strict=True):
            place[: len(sensed)] = np.reshape([(p.position.x, p.position.y) for p in sensed], (-1, 2))
        decides, self.tick = self.tick % self.about["decision_interval_steps"] == 0, self.tick + 1
        if decides or self.about["method"] == "out":
            sensed = loop["sense"](self.about["method"], robot, groups, self.goals, -1 if decides else self.action)
            velocity, action = self.policy.run(["velocity", "action"], sensed)
            self.asked, self.action = velocity[0].astype(float), int(action[0])
        return self.asked


if __name__ == "__main__":
    rclpy.init()
    rclpy.spin(PolicyNode())
