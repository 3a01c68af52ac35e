"""Tables and lines that commands print at their end."""

from __future__ import annotations

import shlex
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from rich.table import Table

from actors.evaluation.statistics import Estimate, paired_comparison, success_rate
from learner.run_folder import RunFolder
from learner.training.evaluation_summary import Evaluation, outcome_label
from sim_core.outcomes import Outcome

if TYPE_CHECKING:  # not otherwise, since it imports MLflow, which evaluations need not wait for
    from learner.run import RunResult


def evaluation_table(evaluation: Evaluation, title: str, kind: str = "greedy episodes") -> Table:
    """The rate of every outcome, the mean return and the mean length of episodes, with 95 % intervals.

    Of worlds in which several robots learn, also what they do together.
    """
    table = Table(title=f"{title}: {evaluation.episodes} {kind}", title_justify="left")
    table.add_column("result")
    table.add_column("value", justify="right")
    table.add_column("95 % interval", justify="right")
    for outcome, estimate in evaluation.rates.items():
        table.add_row(outcome_label(outcome).replace("_", " "), *percent(estimate))
    table.add_row("mean return", *_plain(evaluation.episode_return, 2))
    table.add_row("mean episode length (steps)", *_plain(evaluation.episode_length, 1))
    team = evaluation.team
    if team is not None:
        table.add_section()
        table.add_row("worlds", f"{team.worlds}", "")
        table.add_row("all arrive", *percent(team.all_arrive))
        if team.last_arrival_steps is not None:
            table.add_row("last arrival (steps)", *_plain(team.last_arrival_steps, 1))
        table.add_row("segregated along the way", *percent(team.segregation))
        table.add_row("collision of two learners", *percent(team.learner_collisions))
    return table


def setups_table(by_setup: dict[str, Evaluation]) -> Table:
    """The success rate in every setup, with 95 % intervals."""
    table = Table(title="success rate by setup", title_justify="left")
    for name in ("setup", "success rate", "95 % interval"):
        table.add_column(name, justify="left" if name == "setup" else "right")
    for setup, evaluation in by_setup.items():
        table.add_row(setup, *percent(evaluation.rates[Outcome.GOAL]))
    return table


def compared(setup: str, name: str, goals: list[NDArray[np.bool_]]) -> tuple[str, ...]:
    """A player's row of a comparison.

    Args:
      setup: name of the setup.
      name: the player's.
      goals: successes `[worlds, learners]` of the players so far, the first one's first and this one's last.

    Returns:
      Setup, name, success rate with interval; difference to the first with interval, and the sign test.
    """
    played = (setup, name, *percent(success_rate(goals[-1])))
    if len(goals) == 1:
        return (*played, "", "", "")
    paired = paired_comparison(goals[0], goals[-1])
    value, low, high = (100 * number for number in paired.difference)
    sign = f"{paired.won} : {paired.lost}, p = {paired.p_value:.2g}"
    return (*played, f"{value:+.1f}", f"{low:+.1f} … {high:+.1f}", sign)


def percent(estimate: Estimate) -> tuple[str, str]:
    """A rate and its interval."""
    value, low, high = (100 * number for number in estimate)
    return f"{value:.1f} %", f"{low:.1f} … {high:.1f} %"


def signed_percent(difference: Estimate | None) -> str:
    """A difference of rates with its interval, in points; empty for none."""
    if difference is None:
        return ""
    value, low, high = (100 * number for number in difference)
    return f"{value:+.1f} ({low:+.1f} … {high:+.1f})"


def _plain(estimate: Estimate, digits: int) -> tuple[str, str]:
    return f"{estimate.value:.{digits}f}", f"{estimate.low:.{digits}f} … {estimate.high:.{digits}f}"


def summary_lines(folder: RunFolder, result: RunResult, tracking_uri: str, is_swarm: bool) -> list[str]:
    """What a finished run has written, and commands to look at it. Lines and no table, so that paths can be copied."""
    animation = folder.artifacts / ("episode.html" if is_swarm else "episode.mp4")
    lines = {
        "trained": f"{result.env_steps:,} env steps, {result.updates:,} updates",
        "checkpoint": str(result.checkpoint or "the final one could not be written"),
        "curve": str(folder.artifacts / "learning_curve.png"),
        "animation": str(animation) if animation.exists() else "none",
        "MLflow UI": tracking_uri,
        "evaluate": f"shoal evaluate {shlex.quote(str(folder.path))}",
    }
    if tracking_uri.startswith("sqlite:"):
        lines["MLflow UI"] = f"mlflow ui --backend-store-uri {shlex.quote(tracking_uri)}"
    return [f"{name:<11}{text}" for name, text in lines.items()]
