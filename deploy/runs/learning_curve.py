"""The learning curve in a run's rows of metrics."""

from __future__ import annotations

from dashboards.analysis.trainings import CurvePoint
from learner.tracking.journal import Row
from learner.training.evaluation_summary import outcome_label
from sim_core.outcomes import ENDED, Outcome


def curve_points(rows: list[Row]) -> list[CurvePoint]:
    """The evaluations among a run's rows, in the order of their env steps."""
    points = []
    for row in sorted(rows, key=lambda row: row.env_steps):
        metrics = row.metrics
        name = "success_rate" if "eval/success_rate" in metrics else "return"
        if f"eval/{name}_low" not in metrics:
            continue
        failures = (
            {kind.name.lower(): metrics[f"eval/{outcome_label(kind)}"] for kind in ENDED if kind is not Outcome.GOAL}
            if name == "success_rate"
            else None
        )
        value, low, high = (metrics[f"eval/{name}{suffix}"] for suffix in ("", "_low", "_high"))
        points.append(CurvePoint(row.env_steps, value, low, high, failures))
    return points
