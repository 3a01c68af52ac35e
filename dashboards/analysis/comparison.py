"""Results of presets and of baselines side by side: success by method, averaged over the setups that all have."""

from __future__ import annotations

from collections.abc import Sequence

from actors.evaluation.result_table import LEARNED, ResultRow
from actors.evaluation.value_table import ValueRow
from dashboards.analysis.aggregate import SETUPS, Measurement, Results, Setup, difference, success
from dashboards.analysis.methods import in_order, method_label

BASELINES_NOTE = (
    "`fl-orca` drives the learning robot as the rest of the swarm, with more knowledge than the method's state holds; "
    "`greedy` heads for where the state shows the own group, `field` adds M_IN's potential field to it. Means over "
    "setups, from the same start scenes. The best rule is that of each setup, by these very episodes. A policy is not "
    "below it where the 95 % interval of their difference reaches 0."
)


def presets_of(rows: Sequence[ResultRow]) -> list[str]:
    """Names of the presets with a learned policy, sorted; `thesis` comes first, as the reference of the others."""
    return sorted({row.preset for row in rows if row.policy == LEARNED}, key=lambda name: (name != "thesis", name))


def results_of(
    rows: Sequence[ResultRow], beside: Sequence[ResultRow] = (), values: Sequence[ValueRow] = ()
) -> dict[str, Results]:
    """The results of each preset, in the order of `presets_of`; a preset knows those of its variants.

    Args:
      rows: of all presets to show; some may be variants of others.
      beside: rows of further variants, which are compared with and not shown.
      values: what trainings of the presets expected beside what they got.
    """
    names, found = presets_of(rows), dict[str, Results]()
    known = [*rows, *(row for row in beside if row.preset not in names)]
    for name in sorted(presets_of(known), key=len, reverse=True):  # variants have longer names than what they vary
        variants = {other.removeprefix(f"{name}+"): found[other] for other in found if other.startswith(f"{name}+")}
        expected = [row for row in values if row.preset == name]
        found[name] = Results((row for row in known if row.preset == name), variants, expected)
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


def _shared_setups(rivals: Sequence[Results], method: str) -> list[Setup]:
    """The setups in which all rivals have Fixed results of a method."""
    return [setup for setup in SETUPS if all(results.fixed(method, setup) is not None for results in rivals)]


def _comparison_row(rivals: list[Results], method: str) -> list[str]:
    shared = _shared_setups(rivals, method)
    if not shared:
        return [method_label(method), "0", *["–"] * (2 * len(rivals))]
    measured = [[_measured(results, method, setup) for setup in shared] for results in rivals]
    means = [_mean(line) for line in measured]
    wins = [0] * len(rivals)
    for column in zip(*([found.estimate.value for found in line] for line in measured), strict=True):
        best = max(column)
        if column.count(best) == 1:
            wins[column.index(best)] += 1
    return [method_label(method), str(len(shared)), *means, *map(str, wins)]


def rule_rows(learned: Results, rules: dict[str, Results]) -> tuple[list[str], list[list[str]]]:
    """A table of Fixed success of learned policies beside rules, one row per method.

    Args:
      learned: results of the policies.
      rules: results of the rules by name; a method need not have all of them.

    Returns:
      The header, and the rows, over the setups that the policies and the method's rules all have.
    """
    header = ["method", "setups", "learned", *rules, "best rule", "learned, lowest", "not below the best rule in"]
    return header, [_rule_row(learned, rules, method) for method in in_order(learned.methods())]


def _rule_row(learned: Results, rules: dict[str, Results], method: str) -> list[str]:
    own = {name: rule for name, rule in rules.items() if any(rule.fixed(method, setup) for setup in SETUPS)}
    rivals = [learned, *own.values()]
    shared = _shared_setups(rivals, method)
    if not own or not shared:
        return [method_label(method), "0", *["–"] * (len(rules) + 4)]
    measured = {name: [_measured(rules[name], method, setup) for setup in shared] for name in own}
    policies = [_measured(learned, method, setup) for setup in shared]
    best = [max(column, key=lambda found: found.estimate.value) for column in zip(*measured.values(), strict=True)]
    differences = [difference(policy, rule) for policy, rule in zip(policies, best, strict=True)]
    count = sum(found is not None and found.estimate.high >= 0 for found in differences)
    lowest = 100 * min(found.estimate.value for found in policies)
    cells = [_mean(measured[name]) if name in own else "–" for name in rules]
    return [method_label(method), str(len(shared)), _mean(policies), *cells, _mean(best), f"{lowest:.1f} %", str(count)]


def _mean(found: Sequence[Measurement]) -> str:
    return f"{100 * sum(each.estimate.value for each in found) / len(found):.1f} %"


def _measured(results: Results, method: str, setup: Setup) -> Measurement:
    cell = results.fixed(method, setup)
    assert cell is not None
    return success(cell)
