"""What charts show of a training: its evaluations and its speed."""

from __future__ import annotations

from typing import NamedTuple

from dashboards.analysis.aggregate import Setup


class CurvePoint(NamedTuple):
    """One evaluation during training: its value after `env_steps`, with the 95 % interval [low, high].

    `failures` is each failure's share of the episodes in [0, 1], by the outcome's name; None if it was not measured.
    """

    env_steps: int
    value: float
    low: float
    high: float
    failures: dict[str, float] | None


class Speed(NamedTuple):
    """Mean speed up to `env_steps`, since the row before."""

    env_steps: int
    env_steps_per_s: float
    updates_per_s: float


class Training(NamedTuple):
    """One training: its name, method, setup and seed, and what it has measured so far.

    `method` is empty and `setup` None if the environment is not ours. `is_share` says whether the curve's values are
    rates in [0, 1].
    """

    name: str
    method: str
    setup: Setup | None
    seed: int
    curve: list[CurvePoint]
    speeds: list[Speed]
    is_share: bool = True
