"""Recorded episodes in zarr, in the layout of diffusion_policy, which robotics users know.

`data/<key>` holds the states of all episodes one after the other, time first; `meta/episode_ends` holds where each
ends.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import zarr
from numpy.typing import NDArray

from actors.storage.atomic_write import replacing_folder
from actors.storage.zarr_columns import open_store
from sim_core.config import WorldConfig

FORMAT = "shoal-trajectories-1"
NO_ACTION = -1
"""Action of a step in which FL-ORCA drove the learning robot, and of the final state."""
BY_HAND = -2
"""Action of a step in which a person drove the learning robot."""


class Episode(NamedTuple):
    """One recorded episode of T env steps: T + 1 states, from the first to the final one.

    Shapes: position, velocity `[T + 1, num_robots, 2]` float32 (metres, m/s); machine, the state of FL-ORCA's state
    machine, `[T + 1, num_robots]` int8 (sim_core.swarm.flock_rules.STATE_NAMES); action `[T + 1]` int64, taken in the
    state of the same row, and reward `[T + 1]` float32, received for it (final row: NO_ACTION and 0); goal `[groups,
    2]` float32 (metres). `learner` is the index of the learning robot.

    Empty unless the world has them: sensed `[T + 1, num_robots, 2]` float32 (metres), positions as the learning robot
    senses them, NaN for none; asked `[T + 1, 2]` float32 (m/s), the velocity that was asked for in the state of the
    same row, before shield or unicycle (final row: 0).
    """

    position: NDArray[np.float32]
    velocity: NDArray[np.float32]
    machine: NDArray[np.int8]
    action: NDArray[np.int64]
    reward: NDArray[np.float32]
    goal: NDArray[np.float32]
    learner: int
    outcome: int
    seed: int
    sensed: NDArray[np.float32] = np.zeros((0, 0, 2), np.float32)
    asked: NDArray[np.float32] = np.zeros((0, 2), np.float32)

    @property
    def is_piloted(self) -> bool:
        """Whether actions or a person drove the learning robot, not FL-ORCA."""
        return bool((self.action[:-1] != NO_ACTION).any())


TIME_KEYS = ("position", "velocity", "machine", "action", "reward")
SOME_HAVE = ("sensed", "asked")
"""Keys in time that only episodes of some worlds have."""


def save_episodes(path: Path, episodes: list[Episode], config: WorldConfig) -> None:
    """Writes episodes of one setup to a zarr group at `path`; an older one is replaced once the new one is complete.

    Raises:
      ValueError: there are no episodes.
    """
    if not episodes:
        raise ValueError("no episodes to save")
    with replacing_folder(path) as partial:
        _write(partial, episodes, config)


def _write(path: Path, episodes: list[Episode], config: WorldConfig) -> None:
    root = zarr.open_group(str(path), mode="w", zarr_format=3)
    root.attrs.update({"format": FORMAT, "config": dataclasses.asdict(config)})
    for key in (*TIME_KEYS, *(key for key in SOME_HAVE if len(getattr(episodes[0], key)))):
        root.create_array(f"data/{key}", data=np.concatenate([getattr(episode, key) for episode in episodes]))
    ends = np.cumsum([len(episode.action) for episode in episodes]).astype(np.int64)
    root.create_array("meta/episode_ends", data=ends)
    root.create_array("meta/goal", data=np.stack([episode.goal for episode in episodes]))
    for key in ("learner", "outcome", "seed"):
        root.create_array(f"meta/{key}", data=np.array([getattr(episode, key) for episode in episodes], np.int64))


def load_episodes(path: Path) -> tuple[list[Episode], WorldConfig]:
    """Reads what `save_episodes` wrote.

    Raises:
      ValueError: `path` does not hold complete recorded episodes of this format.
    """
    try:
        root = open_store(path)
    except ValueError as error:
        raise ValueError(
            f"{path} holds no recorded episodes; name a folder that `shoal watch` or `shoal evaluate --record` wrote"
        ) from error
    if root.attrs.get("format") != FORMAT:
        raise ValueError(f"{path} is not in format {FORMAT}; record the episodes again")
    try:
        attributes: Any = root.attrs["config"]
        ends = _read(root, "meta/episode_ends")
        there = [key for key in SOME_HAVE if f"data/{key}" in root]
        columns = {key: _read(root, f"data/{key}") for key in (*TIME_KEYS, *there)}
        meta = {key: _read(root, f"meta/{key}") for key in ("goal", "learner", "outcome", "seed")}
    except KeyError as error:
        raise ValueError(f"{path} is incomplete ({error}); record the episodes again") from error
    starts = np.concatenate([[0], ends[:-1]])
    episodes = [
        Episode(
            **{key: column[start:end] for key, column in columns.items()},
            goal=meta["goal"][i],
            learner=int(meta["learner"][i]),
            outcome=int(meta["outcome"][i]),
            seed=int(meta["seed"][i]),
        )
        for i, (start, end) in enumerate(zip(starts, ends, strict=True))
    ]
    return episodes, WorldConfig(**attributes)


def _read(root: zarr.Group, key: str) -> Any:
    array = root[key]
    assert isinstance(array, zarr.Array)
    return np.asarray(array[...])
