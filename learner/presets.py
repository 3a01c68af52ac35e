"""Named settings of a training: `thesis`, the reading closest to the dissertation's text, and `best`, ours.

`thesis` takes what the text says as it is printed: one-step updates (Algorithms 1 and 2) of the squared error, a
constant learning rate of 0.001 (its lambda), a constant epsilon of 0.05, the numbers of Tables 3.2 and 4.2, robots
that are captured when others surround them, and for M_IN and M_OUT the row *Lost* of Table 4.1. It says nothing of
how long and how often to update or to copy the target network, nor of the robots' size: those are calibrated on seeds
that no evaluation uses (README of `sim_core`, open questions).

- With a constant rate the last policy depends on when training stops, so trainings differ by up to 28 points: take
  several.
- The target network is copied every 50 updates. With 500 values are still rising when training ends, and neither DQN
  nor Double DQN overestimates.
- ORCA: with 10 neighbours and 0.2 m large swarms jam, and FL-ORCA itself in the learning robot's place hardly reaches
  the goal of 25r×8g within the horizon.
- The robots' radius: 0.06 m leaves room between swarm robots that do not avoid the learning robot. With 0.1 m it
  collides in M_OUT whatever the field does.
- M_IN and M_OUT: all robots of a group span its ellipse, as the text has it; the sum u_nn + u_apf may be faster than
  u_nn, as the text bounds neither.

`best` plays in the same worlds, with the same robots and swarm, and knows of other robots what the method knows. A
robot of M_IN or M_OUT that senses none of its own group plays on. One decision lasts several simulator steps: at 0.05
s one action changes hardly anything, so the values of two actions differ by less than the network's error. It learns
from three decisions at a time and from more samples with a smaller rate, and

- M_sensor counts own and other robots apart: their difference hides a crowd of both. It looks further ahead than the
  others (a discount of 0.985 a decision): with 0.97 it comes too late in large swarms, where only timeouts are left. It
  acts by averaged weights and learns from turned transitions.
- M_IN and M_OUT are rewarded for progress towards the goal inside the ellipse, not for being inside: with few robots
  the learning robot can hardly leave an ellipse that it spans, and lingers.
- M_IN and M_OUT have a gain of the potential field of 0.05 m^4/s, which the text does not give. With the 0.15 of
  `thesis` the field throws the robot from one neighbour at the next.
- M_IN decides in every step: nothing but its own decisions keeps it from robots that do not avoid it.
- M_IN and M_OUT have a rule of theirs as a teacher (`field`, `greedy`), and learn from turned transitions.

`generalist` is `best` for one policy that learns all setups of the dissertation at once. For M_sensor it has a wider,
dueling network, looks further ahead, and averages its weights over a quarter of a short training: with more env
steps or more updates it gets worse.

What a preset sets for one method alone stands with the method (`Method.presets`).
"""

from __future__ import annotations

from typing import Any, Literal

from learner.config import RunConfig
from sim_core.config import WorldConfig
from sim_core.plugins import METHODS, find

PresetName = Literal["thesis", "best"]
"""Presets of one setup, those of sweeps."""
TrainingPreset = Literal["thesis", "best", "generalist"]
"""Presets of one training."""

_COMMON: dict[str, Any] = {
    "total_env_steps": 500_000,
    "learning_rate_decay_env_steps": 500_000,
    "epsilon_decay_env_steps": 100_000,
    "replay_capacity": 250_000,
    "eval_every_env_steps": 250_000,
    "checkpoint_every_env_steps": 250_000,
    "keep_checkpoints": 1,
    "steps_per_block": 32,
    "updates_per_call": 32,
}
_THESIS: dict[str, Any] = {
    **_COMMON,
    "epsilon_start": 0.05,
    "n_step": 1,
    "loss": "mse",
    "learning_rate_end": 1e-3,
    "target_update_interval": 50,
}
_BEST: dict[str, Any] = {
    **_COMMON,
    "discount": 0.97,
    "n_step": 3,
    "samples_per_insert": 8.0,
    "learning_rate": 3e-4,
    "learning_rate_end": 2e-5,
    "replay_capacity": 500_000,
}
_GENERALIST: dict[str, Any] = {
    **_BEST,
    "setups": ("all",),
    "envs_per_worker": 200,
    "total_env_steps": 2_000_000,
    "learning_rate_decay_env_steps": 2_000_000,
    "epsilon_decay_env_steps": 200_000,
    "replay_capacity": 1_000_000,
    "eval_every_env_steps": 200_000,
    "eval_episodes": 500,
    "checkpoint_every_env_steps": 500_000,
}
_TRAINING = {"thesis": _THESIS, "best": _BEST, "generalist": _GENERALIST}


def preset_config(name: TrainingPreset, method: str, robots: int = 10, groups: int = 2) -> RunConfig:
    """The settings that a preset gives one method in one setup.

    A method without presets takes M_sensor's, except that its transitions are not turned: nothing says how its state
    turns.

    Args:
      name: the preset.
      method: a method's name or `FILE.py:CLASS`.
      robots: robots per group.
      groups: groups.

    Raises:
      ConfigError: the method is unknown or the setup is not possible.
    """
    own = find(METHODS, method).presets
    training, world = (own or find(METHODS, "sensor").presets)[name]
    if not own:
        training = {**training, "random_turns": False}
    chosen = WorldConfig(method=method, robots=robots, groups=groups, **world)
    return RunConfig(world=chosen, **(_TRAINING[name] | training))
