"""One evaluation in zarr: what was evaluated, in which world, and how each episode ended; checked when it is read."""

from __future__ import annotations

import dataclasses
import json
import shutil
import zlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import zarr
from numpy.typing import NDArray

from actors.rollout.env_spec import EnvSpec
from actors.service.messages import NO_TEAM, TEAM_DTYPE, EpisodeStats
from actors.storage.atomic_write import replacing_folder
from actors.storage.zarr_columns import load_rows, open_store, save_rows
from sim_core.checks import ConfigError, require
from sim_core.config import WorldConfig

FORMAT = "shoal-evaluation-1"
TEAM_FORMAT = "shoal-evaluation-2"
"""With TEAM_DTYPE's columns, where several robots of a world learn."""
_COLUMNS: list[Any] = [
    ("seed", np.int64),
    ("outcome", np.int8),
    ("length_steps", np.int32),
    ("episode_return", np.float64),
]
EPISODE_DTYPE = np.dtype(_COLUMNS)
TEAM_NAMES = TEAM_DTYPE.names or ()
_OF_EPISODES = tuple(name for name in EpisodeStats._fields if name not in ("team", "values"))
TEAM_EPISODE_DTYPE = np.dtype([*_COLUMNS, *TEAM_DTYPE.descr])


class StoredEvaluation(NamedTuple):
    """An evaluation as it is stored.

    `spec` is the environment, `candidate` the name of a run or a baseline, and `updates` the number of updates applied
    to the policy's weights, 0 for a baseline. `seed` `[episodes]` int64 holds the episodes' seeds in the order of
    `stats` (`entry_seeds`).
    """

    spec: EnvSpec
    candidate: str
    updates: int
    seed: NDArray[np.int64]
    stats: EpisodeStats


def refuse_existing(path: Path) -> None:
    """Raises ConfigError if something exists at `path`, since results are never overwritten."""
    require(not path.exists(), f"{path} exists and is not overwritten; name another file or remove it")


def save_evaluation(path: Path, evaluation: StoredEvaluation) -> None:
    """Writes a new zarr group at `path`, which appears once it is complete.

    Raises:
      ConfigError: something exists at `path`.
    """
    refuse_existing(path)
    team = evaluation.stats.team
    rows = np.zeros(len(evaluation.seed), TEAM_EPISODE_DTYPE if len(team) else EPISODE_DTYPE)
    rows["seed"] = evaluation.seed
    for name in (*_OF_EPISODES, *TEAM_NAMES) if len(team) else _OF_EPISODES:
        rows[name] = team[name] if name in TEAM_NAMES else getattr(evaluation.stats, name)
    header: dict[str, Any] = {
        "env_id": evaluation.spec.env_id,
        "world": dataclasses.asdict(evaluation.spec.world),
        "player": evaluation.candidate,
        "updates": evaluation.updates,
    }
    with replacing_folder(path) as partial:
        save_rows(partial, rows, TEAM_FORMAT if len(team) else FORMAT)
        zarr.open_group(str(partial), mode="r+").attrs.update({"header": header, "header_crc32": _crc32(header)})


def load_evaluation(path: Path) -> StoredEvaluation:
    """Reads what `save_evaluation` wrote.

    Raises:
      ValueError: the group is missing or damaged, or is no evaluation.
    """
    has_team = open_store(path).attrs.get("format") == TEAM_FORMAT
    rows = load_rows(path, TEAM_EPISODE_DTYPE, TEAM_FORMAT) if has_team else load_rows(path, EPISODE_DTYPE, FORMAT)
    attributes: Any = open_store(path).attrs.asdict()
    header = attributes.get("header")
    if header is None or _crc32(header) != attributes.get("header_crc32"):
        raise ValueError(f"the header of {path} is damaged (checksum); evaluate again")
    try:
        spec = EnvSpec(header["env_id"], WorldConfig(**header["world"]))
    except (TypeError, ConfigError) as error:
        raise ValueError(f"{path} has settings of another version of shoal ({error}); evaluate again") from error
    team = np.zeros(len(rows), TEAM_DTYPE) if has_team else NO_TEAM
    for name in TEAM_NAMES if has_team else ():
        team[name] = rows[name]
    stats = EpisodeStats(**{name: rows[name] for name in _OF_EPISODES}, team=team)
    return StoredEvaluation(spec, header["player"], header["updates"], rows["seed"], stats)


def find_evaluation(path: Path, spec: EnvSpec, updates: int, seeds: list[int]) -> EpisodeStats | None:
    """The episodes at `path`; None where there are none, or they are damaged, or of another evaluation.

    Args:
      path: a zarr group that belongs to one policy.
      spec: the environment.
      updates: number of updates applied to the policy's weights.
      seeds: one world was played per seed.

    Returns:
      One entry per seed, in order; one per learning robot of each seed's world where several learn.
    """
    try:
        stored = load_evaluation(path)
    except (ValueError, OSError):
        return None
    wanted = spec, updates, entry_seeds(seeds, stored.stats).tolist()
    is_wanted = (stored.spec, stored.updates, stored.seed.tolist()) == wanted
    return stored.stats if is_wanted else None


def entry_seeds(seeds: Sequence[int], stats: EpisodeStats) -> NDArray[np.int64]:
    """The seed of every entry of an evaluation of one setup: as many for each seed as robots of its world learn."""
    return np.repeat(np.array(seeds, np.int64), len(stats.outcome) // max(1, len(seeds)))


def stored_or_played(
    path: Path, spec: EnvSpec, candidate: str, updates: int, seeds: list[int], play: Callable[[], EpisodeStats]
) -> EpisodeStats:
    """The episodes of `find_evaluation`, or else those that `play` plays; they are stored as those of `candidate`."""
    found = find_evaluation(path, spec, updates, seeds)
    if found is not None:
        return found
    stats = play()
    shutil.rmtree(path, ignore_errors=True)
    save_evaluation(path, StoredEvaluation(spec, candidate, updates, entry_seeds(seeds, stats), stats))
    return stats


def _crc32(header: dict[str, Any]) -> int:
    return zlib.crc32(json.dumps(header, sort_keys=True).encode())
