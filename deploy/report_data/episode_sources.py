"""Episodes to choose from in a report: played again by the policies of a sweep or a run, or recorded."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple, Protocol

from actors.evaluation.evaluation_store import load_evaluation
from actors.evaluation.evaluator import Candidate, evaluate, record_episode
from actors.evaluation.result_table import LEARNED, ResultRow, read_table
from actors.evaluation.trajectory import Episode, load_episodes
from actors.policy.baselines import Baseline
from actors.policy.network import WeightsSnapshot
from dashboards.analysis.aggregate import Setup
from dashboards.analysis.methods import in_order
from dashboards.pages.assets import to_json
from dashboards.pages.player import player_data
from dashboards.pages.report_page import EpisodeGroup
from deploy.runs.policy_lookup import NewestPolicy, find_policy
from learner.file_names import EVALUATIONS, RESULTS
from learner.run_folder import RunFolder
from sim_core.checks import ConfigError
from sim_core.config import WorldConfig
from sim_core.outcomes import ENDED, OUTCOME_NAMES, Outcome

RUN_EPISODES = 100
"""Episodes that a run's newest policy plays so that there are some of every outcome to choose from."""
NEWEST = "newest"
NOT_KNOWN = "–"


class Shelf(Protocol):
    """Episodes by group, outcome and number."""

    def groups(self) -> list[EpisodeGroup]:
        """What there is now."""
        ...

    def episode(self, key: str, outcome: str, number: int) -> dict[str, Any]:
        """One episode for the player.

        Raises:
          LookupError: there is no such episode.
          ConfigError, ValueError: it is there and cannot be read or played.
        """
        ...


class _Place(NamedTuple):
    """Where a group's episodes come from: a cell's folder, and the row that counts them."""

    folder: RunFolder
    row: ResultRow


class SweepShelf:
    """The evaluated episodes of a sweep's cells: their seeds are stored, and a seed plays the same episode again.

    Args:
      cells: the folder of the cells; it may be missing.
    """

    def __init__(self, cells: Path) -> None:
        self._cells = cells
        self._places: dict[str, _Place] = {}

    def groups(self) -> list[EpisodeGroup]:
        """A group a policy and setup: learned ones first, in the order of methods and setups."""
        self._places = dict(sorted(self._found(), key=lambda item: _order(item[1].row)))
        return [_group(key, place.row) for key, place in self._places.items()]

    def _found(self) -> Iterator[tuple[str, _Place]]:
        for table in sorted(self._cells.glob(f"*/{RESULTS}")):
            folder = RunFolder(table.parent)
            for row in read_table(table):
                if row.policy in list(Baseline) or folder.policy.is_file():
                    yield f"{folder.path.name}/{row.robots}r{row.groups}g", _Place(folder, row)

    def episode(self, key: str, outcome: str, number: int) -> dict[str, Any]:
        """Plays the episode again."""
        place = self._places.get(key)
        if place is None:
            raise LookupError(f"group {key!r}")
        path = place.folder.path / EVALUATIONS / f"{place.row.robots}r{place.row.groups}g.zarr"
        stored = load_evaluation(path)
        seeds = stored.seed[stored.stats.outcome == _outcome(outcome)]
        candidate = _candidate(place)
        episode = record_episode(stored.spec, candidate, int(_at(seeds, number)))
        return player_data(episode, stored.spec.world)


def _order(row: ResultRow) -> tuple[object, ...]:
    trained, played = (row.trained_robots, row.trained_groups), (row.robots, row.groups)
    method = in_order([row.method]).index(row.method), row.method
    return row.preset, row.policy != LEARNED, row.policy, method, trained, row.seed, trained != played, played


def _candidate(place: _Place) -> Candidate:
    if place.row.policy != LEARNED:
        return Baseline(place.row.policy)
    return find_policy(place.folder, place.folder.config())


def _group(key: str, row: ResultRow) -> EpisodeGroup:
    return EpisodeGroup(
        key=key,
        preset=row.preset,
        policy=row.policy,
        method=row.method,
        trained=str(Setup(row.trained_robots, row.trained_groups)),
        seed=str(row.seed),
        played=str(Setup(row.robots, row.groups)),
        counts={outcome.name.lower(): row.count(outcome) for outcome in ENDED},
    )


class RunShelf:
    """Episodes of a run's newest policy, of our own environment.

    Args:
      folder: the run.
    """

    def __init__(self, folder: RunFolder) -> None:
        self._config = folder.config()
        self._policy = NewestPolicy(folder, self._config)
        self._weights: WeightsSnapshot | None = None
        self._seeds: dict[str, list[int]] = {}

    def groups(self) -> list[EpisodeGroup]:
        """One group, or none while the run has no policy."""
        try:
            weights = self._policy.get()
        except ConfigError:
            return []
        if weights is not self._weights:
            self._weights, self._seeds = weights, self._play(weights)
        world, counts = self._config.world, {name: len(found) for name, found in self._seeds.items()}
        policy, seed = f"of update {weights.version:,}", str(self._config.seed)
        return [EpisodeGroup(NEWEST, "", policy, world.method_name, world.setup, seed, world.setup, counts)]

    def _play(self, weights: WeightsSnapshot) -> dict[str, list[int]]:
        """Seeds of the episodes by outcome."""
        first = self._config.final_eval_first_seed
        seeds = list(range(first, first + RUN_EPISODES))
        outcomes = evaluate(self._config.env, weights, seeds).outcome
        return {
            outcome.name.lower(): [seed for seed, end in zip(seeds, outcomes, strict=True) if end == outcome]
            for outcome in ENDED
        }

    def episode(self, key: str, outcome: str, number: int) -> dict[str, Any]:
        """Plays the episode."""
        if key != NEWEST or self._weights is None:
            raise LookupError(f"group {key!r}")
        seed = _at(self._seeds.get(outcome, []), number)
        return player_data(record_episode(self._config.env, self._weights, seed), self._config.world)


class RecordedShelf:
    """Episodes that `shoal watch` and `shoal evaluate --record` have written.

    Args:
      folders: where to look for their zarr groups, `episode-SEED.zarr` and `NAME-episodes.zarr`.
    """

    def __init__(self, *folders: Path) -> None:
        self._folders = folders
        self._stores: dict[str, tuple[list[Episode], WorldConfig]] = {}

    def groups(self) -> list[EpisodeGroup]:
        """A group a zarr group."""
        paths = [path for folder in self._folders for path in sorted(folder.glob("episode*.zarr"))]
        paths += [path for folder in self._folders for path in sorted(folder.glob("*-episodes.zarr"))]
        self._stores = {path.stem: load_episodes(path) for path in paths}
        return [_recorded(name, episodes, world) for name, (episodes, world) in self._stores.items()]

    def episode(self, key: str, outcome: str, number: int) -> dict[str, Any]:
        """Reads the episode."""
        if key not in self._stores:
            raise LookupError(f"group {key!r}")
        episodes, world = self._stores[key]
        found = [episode for episode in episodes if OUTCOME_NAMES[episode.outcome] == outcome]
        return player_data(_at(found, number), world)


def _recorded(name: str, episodes: list[Episode], world: WorldConfig) -> EpisodeGroup:
    ends = [OUTCOME_NAMES[episode.outcome] for episode in episodes]
    counts = {end: ends.count(end) for end in dict.fromkeys(ends)}
    return EpisodeGroup(name, "", f"recorded: {name}", world.method_name, NOT_KNOWN, NOT_KNOWN, world.setup, counts)


class Shelves:
    """Several shelves as one.

    Args:
      shelves: asked in turn; their groups' keys differ.
    """

    def __init__(self, *shelves: Shelf) -> None:
        self._shelves = shelves
        self._owner: dict[str, Shelf] = {}

    def groups(self) -> list[EpisodeGroup]:
        """All groups."""
        found = [(shelf, group) for shelf in self._shelves for group in shelf.groups()]
        self._owner = {group.key: shelf for shelf, group in found}
        return [group for _, group in found]

    def episode(self, key: str, outcome: str, number: int) -> dict[str, Any]:
        """The episode of the shelf that has its group."""
        if key not in self._owner:
            raise LookupError(f"group {key!r}")
        return self._owner[key].episode(key, outcome, number)


def _outcome(name: str) -> Outcome:
    if name not in OUTCOME_NAMES:
        raise LookupError(f"outcome {name!r}")
    return Outcome(OUTCOME_NAMES.index(name))


def _at(values: Sequence[Any], number: int) -> Any:
    if not 0 <= number < len(values):
        raise LookupError(f"episode {number}")
    return values[number]


def samples(shelf: Shelf, groups: Sequence[EpisodeGroup], each: int, limit_bytes: float) -> dict[str, dict[str, Any]]:
    """Episodes that travel with a file, by `GROUP|outcome|number`: as many as the limit allows.

    First one of the most frequent outcome of every group, then of the next one, so that what there is no room for is
    the rare. Extrapolations are left out: they are many.
    """
    chosen: dict[str, dict[str, Any]] = {}
    size = 0
    for key, outcome, number in _in_turn(groups, each):
        episode = shelf.episode(key, outcome, number)
        size += len(to_json(episode))
        if size > limit_bytes:
            break
        chosen[f"{key}|{outcome}|{number}"] = episode
    return chosen


def _in_turn(groups: Sequence[EpisodeGroup], each: int) -> Iterator[tuple[str, str, int]]:
    own = [group for group in groups if group.trained in (group.played, NOT_KNOWN)]
    ranked = {group.key: sorted(group.counts, key=lambda name: -group.counts[name]) for group in own}
    for number in range(each):
        for rank in range(len(ENDED)):
            for group in own:
                outcome = ranked[group.key][rank] if rank < len(ranked[group.key]) else None
                if outcome is not None and number < group.counts[outcome]:
                    yield group.key, outcome, number
