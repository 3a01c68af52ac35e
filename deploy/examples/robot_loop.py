"""A robot's control loop with a policy from `shoal export`; it needs numpy and onnxruntime, and nothing of shoal.

    python deploy/examples/robot_loop.py runs/RUN/artifacts/export

In this example, all groups move straight to their goals, and the robot follows its own group. On a real robot,
positions come from its sensors and teammates, the velocity goes to its motors, and the loop waits for the next tick.
"""

import json
import runpy
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime

shielded = runpy.run_path(str(Path(__file__).with_name("shield.py")))["shielded"]


def load(folder: Path) -> tuple[Any, dict[str, Any]]:
    """Loads the policy and its metadata; ends the program if it computes other values than when it was exported."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    policy = onnxruntime.InferenceSession(str(folder / "policy.onnx"), options, providers=["CPUExecutionProvider"])
    with np.load(folder / "golden.npz") as golden:
        states = {name.removeprefix("in."): golden[name] for name in golden if name.startswith("in.")}
        if not np.allclose(policy.run(["action_values"], states)[0], golden["out.action_values"], atol=1e-3):
            sys.exit(f"{folder} does not answer as it should on this machine")
    return policy, json.loads((folder / "policy.json").read_text("utf-8"))


def sense(method: str, robot: Any, groups: Any, goals: Any, held: int) -> dict[str, Any]:
    """The robot's input, a batch of one: positions of the other robots relative to it, in metres, own group first.

    `held` is the action of the last decision, -1 to decide.
    """
    positions = (groups - robot)[None].astype(np.float32)  # [1, groups, robots, 2]; NaN: not sensed
    mask = np.isfinite(positions).all(axis=-1)
    positions = np.nan_to_num(positions)
    if method != "sensor":
        inputs = {"positions": positions, "mask": mask, "goals": (goals - robot)[None].astype(np.float32)}
        return inputs | ({"held": np.array([held])} if method == "out" else {})
    other, other_mask = positions[:, 1:].reshape(1, -1, 2), mask[:, 1:].reshape(1, -1)
    return {"own": positions[:, 0], "own_mask": mask[:, 0], "other": other, "other_mask": other_mask}


def main(folder: Path, seconds: float = 12.0, walk_m_s: float = 0.5) -> None:
    """Runs the loop; prints the robot's velocity and its distance from its group once a second."""
    policy, about = load(folder)
    if about["kinematics"]["kind"] != "holonomic":
        sys.exit("this loop moves a robot that reaches every velocity at once, which a unicycle does not")
    tick_s, count = about["time_step_s"], about["settings"]["world"]["groups"]
    starts = 6.0 * np.stack([turn(np.arange(count) * 2 * np.pi / count) for turn in (np.cos, np.sin)], axis=1)
    groups = starts[:, None] + np.random.default_rng(0).uniform(-0.7, 0.7, (count, 6, 2))
    robot, goals, spent_s, action = starts[0].copy(), -starts, 0.0, np.array([-1])
    walk, driven = walk_m_s * goals / np.linalg.norm(goals, axis=1, keepdims=True), np.zeros(2)
    for tick in range(round(seconds / tick_s)):
        decides, begin_s = tick % about["decision_interval_steps"] == 0, time.perf_counter()
        if decides or about["method"] == "out":  # M_OUT's potential field acts between decisions, too
            held = -1 if decides else int(action[0])
            velocity, action = policy.run(["velocity", "action"], sense(about["method"], robot, groups, goals, held))
        if about["shield"]["used"]:
            others, theirs = (groups - robot).reshape(-1, 2), np.repeat(walk, groups.shape[1], axis=0)
            driven = shielded(velocity[0], driven, others, theirs, about["shield"])
        else:
            driven = velocity[0]
        spent_s += time.perf_counter() - begin_s
        robot, groups = robot + tick_s * driven, groups + tick_s * walk[:, None]
        if tick % round(1 / tick_s) == 0:
            away_m = np.linalg.norm(robot - groups[0].mean(axis=0))
            print(f"{tick * tick_s:.0f} s: drives {driven.round(2)} m/s, {away_m:.2f} m from its group")
    print(f"{1e6 * spent_s / (tick + 1):.0f} us a tick")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
