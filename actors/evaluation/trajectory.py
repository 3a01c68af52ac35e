"""Recorded episodes in zarr, in the layout that robotics users know from diffusion_policy.

`data/<key>` is time-major over all episodes one after the other; `meta/episode_ends` says where each ends.
"""

from __future__ import annotations

import dataclasses
import shutil
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import zarr
from numpy.typing import NDArray

from actors.storage.zarr_columns import open_store
from sim_core.config import WorldConfig

FORMAT = "shoal-trajectories-1"
NO_ACTION = -1
"""Action of a step that FL-ORCA drove, and of the ended state."""


class Episode(NamedTuple):
    """One recorded episode of T env steps: T + 1 states, from the start to the ended one.

    Shapes: position, velocity `[T + 1, num_robots, 2]` float32 (metres, m/s); machine `[T + 1, num_robots]`
    int8 (sim_core.swarm.flock_rules.STATE_NAMES); action `[T + 1]` int64 and reward `[T + 1]` float32, taken in and
    received for the state of the same row (last row: NO_ACTION and 0); goal `[groups, 2]` float32.
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


TIME_KEYS = ("position", "velocity", "machine", "action", "reward")


def save_episodes(path: Path, episodes: list[Episode], config: WorldConfig) -> None:
    """Writes episodes of one setup to a new zarr group at `path`; an older one there is replaced once the new is whole.

    Raises:
      ValueError: there are no episodes.
    """
    if not episodes:
        raise ValueError("no episodes to save")
    part = path.with_name(path.name + ".part")
    shutil.rmtree(part, ignore_errors=True)
    root = zarr.open_group(str(part), mode="w", zarr_format=3)
    root.attrs.update({"format": FORMAT, "config": dataclasses.asdict(config)})
    for key in TIME_KEYS:
        root.create_array(f"data/{key}", data=np.concatenate([getattr(episode, key) for episode in episodes]))
    ends = np.cumsum([len(episode.action) for episode in episodes]).astype(np.int64)
    root.create_array("meta/episode_ends", data=ends)
    root.create_array("meta/goal", data=np.stack([episode.goal for episode in episodes]))
    for key in ("learner", "outcome", "seed"):
        root.create_array(f"meta/{key}", data=np.array([getattr(episode, key) for episode in episodes], np.int64))
    shutil.rmtree(path, ignore_errors=True)
    part.rename(path)


def load_episodes(path: Path) -> tuple[list[Episode], WorldConfig]:
    """Reads what `save_episodes` wrote.

    Raises:
      ValueError: `path` holds something else.
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
        columns = {key: _read(root, f"data/{key}") for key in TIME_KEYS}
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
