"""Results of presets and of baselines side by side: success by method, averaged over the setups that all have."""

from __future__ import annotations

from collections.abc import Sequence

from actors.evaluation.result_table import LEARNED, ResultRow
from dashboards.analysis.aggregate import SETUPS, Results, Setup, success
from dashboards.analysis.methods import in_order, method_label

BASELINES_NOTE = (
    "`fl-orca` drives the learning robot as the rest of the swarm, with more knowledge than the method's state holds; "
    "`greedy` heads for where the state shows the own group. Means over setups, from the same start scenes."
)


def presets_of(rows: Sequence[ResultRow]) -> list[str]:
    """Names of the presets with a learned policy, sorted; `thesis` comes first, as the reference of the others."""
    return sorted({row.preset for row in rows if row.policy == LEARNED}, key=lambda name: (name != "thesis", name))


def results_of(rows: Sequence[ResultRow]) -> dict[str, Results]:
    """The results of each preset, in the order of `presets_of`; a preset knows those of its variants among them."""
    names, found = presets_of(rows), dict[str, Results]()
    for name in sorted(names, key=len, reverse=True):  # variants have longer names than what they vary
        variants = {other.removeprefix(f"{name}+"): found[other] for other in found if other.startswith(f"{name}+")}
        found[name] = Results((row for row in rows if row.preset == name), variants)
    return {name: found[name] for name in names}


def baselines_of(rows: Sequence[ResultRow]) -> dict[str, Results]:
    """The results of each baseline, by its name."""
    names = sorted({row.policy for row in rows} - {LEARNED})
    return {name: Results(row._replace(policy=LEARNED) for row in rows if row.policy == name) for name in names}


def comparison_rows(rivals: dict[str, Results]) -> tuple[list[str], list[list[str]]]:
    """A table of mean Fixed success over the setups that all rivals have, one row per method.

    Args:
      rivals: results by preset or policy.

    Returns:
      The header, and the rows. `best in` counts the setups in which a rival has a higher rate than all others.
    """
    header = ["method", "setups in all", *rivals, *(f"{name} best in" for name in rivals)]
    methods = in_order(method for results in rivals.values() for method in results.methods())
    return header, [_comparison_row(list(rivals.values()), method) for method in methods]


def _comparison_row(rivals: list[Results], method: str) -> list[str]:
    shared = [setup for setup in SETUPS if all(results.fixed(method, setup) is not None for results in rivals)]
    if not shared:
        return [method_label(method), "0", *["–"] * (2 * len(rivals))]
    rates = [[_success(results, method, setup) for setup in shared] for results in rivals]
    means = [f"{100 * sum(line) / len(line):.1f} %" for line in rates]
    wins = [0] * len(rivals)
    for column in zip(*rates, strict=True):
        best = max(column)
        if column.count(best) == 1:
            wins[column.index(best)] += 1
    return [method_label(method), str(len(shared)), *means, *map(str, wins)]


def _success(results: Results, method: str, setup: Setup) -> float:
    cell = results.fixed(method, setup)
    assert cell is not None
    return success(cell).estimate.value
