"""A search as pictures and pages show it."""

from __future__ import annotations

from typing import NamedTuple


class SearchedTrial(NamedTuple):
    """A trial: number, settings by name, state (complete, pruned, failed, running), objectives, reason, seconds."""

    number: int
    settings: dict[str, float | int | str]
    state: str
    values: tuple[float, ...]
    reason: str = ""
    seconds: float | None = None


class SearchSummary(NamedTuple):
    """A search so far.

    Fields: names of its objectives and whether less of each is better; its trials by number; the numbers of those that
    no other one betters in all objectives; for each objective, the share of its variance that each setting explains;
    the settings that are drawn on a logarithmic scale.
    """

    objectives: list[str]
    minimised: list[bool]
    trials: list[SearchedTrial]
    front: list[int]
    importances: list[dict[str, float]]
    logarithmic: frozenset[str] = frozenset()

    @property
    def complete(self) -> list[SearchedTrial]:
        """The trials that have values."""
        return [trial for trial in self.trials if trial.state == "complete"]

    @property
    def names(self) -> list[str]:
        """The settings that are varied."""
        return list(dict.fromkeys(name for trial in self.trials for name in trial.settings))

    def best_so_far(self, place: int) -> list[tuple[int, float]]:
        """(number, best value up to it) of one objective."""
        better = min if self.minimised[place] else max
        found: list[tuple[int, float]] = []
        for trial in self.complete:
            value = trial.values[place]
            found.append((trial.number, better(value, found[-1][1]) if found else value))
        return found


def value_text(objective: str, value: float) -> str:
    """A value for readers: success in percent, env steps as a whole number, others with four digits."""
    if objective in ("success", "worst"):
        return f"{100 * value:.1f} %"
    return f"{value:,.0f}" if objective.startswith("steps_to") else f"{value:.4g}"


def setting_text(value: float | int | str) -> str:
    """A setting's value for readers."""
    return f"{value:.4g}" if isinstance(value, float) else str(value)
