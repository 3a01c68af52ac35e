"""The run that `shoal chaos` trains: small, with two of every component that can be lost, and a task to learn."""

from __future__ import annotations

from pathlib import Path

NAME = "run"
CONFIG = "chaos.toml"

_TEXT = """\
total_env_steps = {env_steps}
workers = 2
envs_per_worker = 8
steps_per_block = 16
replay_shards = 2
replay_placement = "actors"
replay_capacity = 20000
min_replay = 1024
samples_per_insert = 1.0
batch_size = 32
updates_per_call = 4
hidden_sizes = [32]
epsilon_decay_env_steps = 30000
learning_rate_decay_env_steps = {env_steps}
n_step = 2
target_update_interval = 50
eval_every_env_steps = 4000
eval_episodes = 50
final_eval_episodes = 1000
log_every_env_steps = 2000
checkpoint_every_env_steps = 8000

[world]
robots = 3
groups = 2
arena_radius_m = 3.0
horizon_steps = 400
"""


def write_config(path: Path, env_steps: int) -> None:
    """Writes the run's settings as TOML, for `shoal train --config`."""
    path.write_text(_TEXT.format(env_steps=env_steps))
