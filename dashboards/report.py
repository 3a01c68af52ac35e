"""The report on a table of results, as Markdown: what was run, the claims, how presets compare, and the pictures."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from actors.evaluation.result_table import LEARNED, ResultRow
from dashboards.analysis.aggregate import CELLS_PER_METHOD, SETUPS, Results, Setup, success
from dashboards.analysis.claim_checks import Claim, Verdict, with_verdict
from dashboards.analysis.claim_text import NOTE, table_of, tally, verdict_table
from dashboards.analysis.methods import in_order, method_label
from dashboards.figures.diagrams import DIAGRAMS
from dashboards.figures.example_episodes import EXAMPLES
from dashboards.figures.result_figures import PICTURES

DRAWINGS = (*EXAMPLES, *DIAGRAMS)
"""What is drawn from live worlds, beside the pictures of results."""
BASELINES_NOTE = (
    "`fl-orca` drives the learning robot as the rest of the swarm, with more knowledge than the method's state holds; "
    "`greedy` heads for where the state shows the own group. Means over setups, from the same start scenes."
)


class PresetPart(NamedTuple):
    """What the report says of one preset: its name, results, judged claims, where its pictures lie, and baselines."""

    name: str
    results: Results
    claims: list[Claim]
    folder: str
    baselines: dict[str, Results]


def presets_of(rows: Sequence[ResultRow]) -> list[str]:
    """The presets with a learned policy in the table, by name; `thesis` first, since others are measured against it."""
    return sorted({row.preset for row in rows if row.policy == LEARNED}, key=lambda name: (name != "thesis", name))


def baselines_of(rows: Sequence[ResultRow]) -> dict[str, Results]:
    """The results of each baseline in the table, by its name."""
    names = sorted({row.policy for row in rows} - {LEARNED})
    return {name: Results(row._replace(policy=LEARNED) for row in rows if row.policy == name) for name in names}


def report_markdown(
    sources: Sequence[str], parts: Sequence[PresetPart], sittings: Sequence[tuple[str, str]] = ()
) -> str:
    """The page.

    Args:
      sources: names of the files with the results.
      parts: one a preset, in the order in which they are printed.
      sittings: the command and the commit of each start of the sweep, where they are known.
    """
    lines = ["# Results", "", "Made by `shoal report` from " + ", ".join(f"`{name}`" for name in sources) + ".", ""]
    lines += [*_coverage(parts), ""]
    if sittings:
        lines += [*table_of(("trained by", "commit"), [(f"`{line}`", commit[:12]) for line, commit in sittings]), ""]
    if len(parts) > 1:
        lines += ["## Presets side by side", "", *comparison({part.name: part.results for part in parts}), ""]
        lines += [*verdicts_side_by_side(parts), ""]
    lines += [NOTE, "", "Every check with its numbers: [claims.md](claims.md).", ""]
    for part in parts:
        lines += _preset_part(part)
    where = f"Drawn from worlds of preset {parts[0].name}, where its settings fit the drawn method and setup."
    lines += ["## How it works", "", where, ""]
    for drawing in DRAWINGS:
        lines += [f"![{drawing.alt}]({drawing.file})", ""]
    return "\n".join(lines).rstrip("\n") + "\n"


def verdicts_side_by_side(parts: Sequence[PresetPart]) -> list[str]:
    """A row a claim, a column a preset: the verdict, and how many of the claim's checks hold; lines of a table."""
    header = ("#", "claim", *(part.name for part in parts))
    rows = []
    for claims in zip(*(part.claims for part in parts), strict=True):
        rows.append((str(claims[0].number), claims[0].text, *map(_verdict_in_short, claims)))
    return table_of(header, rows)


def _verdict_in_short(claim: Claim) -> str:
    return f"{claim.verdict} ({len(with_verdict(claim.checks, Verdict.HOLDS))} of {len(claim.checks)})"


def _coverage(parts: Sequence[PresetPart]) -> list[str]:
    methods = in_order(method for part in parts for method in part.results.methods())
    header = (
        "preset",
        f"Fixed cells of {CELLS_PER_METHOD * len(methods)}",
        "Extrapolation cells",
        "training seeds a cell",
        "episodes",
    )
    return table_of(header, [_coverage_row(part) for part in parts])


def _coverage_row(part: PresetPart) -> tuple[str, ...]:
    cells = part.results.cells()
    seeds = sorted({len(cell.rows) for cell in cells})
    span = f"{seeds[0]}" if len(seeds) == 1 else f"{seeds[0]} … {seeds[-1]}"
    fixed = sum(len(part.results.fixed_present(method)) for method in part.results.methods())
    transferred = sum(not cell.rows[0].is_fixed for cell in cells)
    episodes = sum(cell.episodes for cell in cells)
    return part.name, str(fixed), str(transferred), span, f"{episodes:,}"


def _preset_part(part: PresetPart) -> list[str]:
    lines = [f"## Preset {part.name}", "", f"### Claims: {tally(part.claims)}", "", *verdict_table(part.claims), ""]
    if part.baselines:
        lines += ["### Learned policies beside rules that learn nothing", "", BASELINES_NOTE, ""]
        lines += [*comparison({"learned": part.results} | part.baselines), ""]
    lines += ["### Figures", ""]
    for picture in PICTURES:
        lines += [f"![{picture.alt}, preset {part.name}]({part.folder}{picture.file})", ""]
    return lines


def comparison(rivals: dict[str, Results]) -> list[str]:
    """`comparison_rows` as the lines of a Markdown table."""
    return table_of(*comparison_rows(rivals))


def comparison_rows(rivals: dict[str, Results]) -> tuple[list[str], list[list[str]]]:
    """Mean Fixed success of each rival over the setups that all have, a row a method; the header, and the rows.

    `best in` counts the setups in which a rival has a higher rate than every other.
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
