"""The report on tables of results as Markdown: coverage, claims, presets side by side, and figures."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from dashboards.analysis.aggregate import CELLS_PER_METHOD, Results
from dashboards.analysis.claim_checks import Claim, Verdict, with_verdict
from dashboards.analysis.claim_text import NOTE, contradictions, table_of, tally, verdict_table
from dashboards.analysis.comparison import BASELINES_NOTE, comparison_rows, rule_rows
from dashboards.analysis.methods import in_order
from dashboards.figures.diagrams import DIAGRAMS
from dashboards.figures.example_episodes import EXAMPLES
from dashboards.figures.result_figures import pictures_of

DRAWINGS = (*EXAMPLES, *DIAGRAMS)
"""Figures drawn from simulated worlds, in addition to those of results."""


class PresetSection(NamedTuple):
    """The report's section on one preset: its name, results, judged claims, folder of figures, and baselines."""

    name: str
    results: Results
    claims: list[Claim]
    folder: str
    baselines: dict[str, Results]


def report_markdown(
    sources: Sequence[str], sections: Sequence[PresetSection], provenance: Sequence[tuple[str, str]] = ()
) -> str:
    """The page.

    Args:
      sources: names of the tables of results.
      sections: one per preset, in the order of printing.
      provenance: the commands and commits that trained the results, if they are known.
    """
    lines = ["# Results", "", "Made by `shoal report` from " + ", ".join(f"`{name}`" for name in sources) + ".", ""]
    lines += [*_coverage(sections), ""]
    if provenance:
        lines += [*table_of(("trained by", "commit"), [(f"`{line}`", commit[:12]) for line, commit in provenance]), ""]
    if len(sections) > 1:
        lines += [
            "## Presets side by side",
            "",
            *comparison({section.name: section.results for section in sections}),
            "",
        ]
        lines += [*verdicts_side_by_side(sections), ""]
    lines += [NOTE, "", "Every check with its numbers: [claims.md](claims.md).", ""]
    for section in sections:
        lines += _preset_section(section)
    lines += ["## Claims that contradict each other", ""]
    lines += [*contradictions({section.name: section.claims for section in sections}), ""]
    where = f"Drawn from worlds of preset {sections[0].name}, where its settings fit the drawn method and setup."
    lines += ["## How it works", "", where, ""]
    for drawing in DRAWINGS:
        lines += [f"![{drawing.alt}]({drawing.file})", ""]
    return "\n".join(lines).rstrip("\n") + "\n"


def verdicts_side_by_side(sections: Sequence[PresetSection]) -> list[str]:
    """Lines of a table with a row per claim and a column per preset: the verdict, and how many checks hold."""
    header = ("#", "claim", *(section.name for section in sections))
    rows = []
    for claims in zip(*(section.claims for section in sections), strict=True):
        rows.append((str(claims[0].number), claims[0].text, *map(_verdict_in_short, claims)))
    return table_of(header, rows)


def _verdict_in_short(claim: Claim) -> str:
    return f"{claim.verdict} ({len(with_verdict(claim.checks, Verdict.HOLDS))} of {len(claim.checks)})"


def _coverage(sections: Sequence[PresetSection]) -> list[str]:
    methods = in_order(method for section in sections for method in section.results.methods())
    fixed = f"Fixed cells of {CELLS_PER_METHOD * len(methods)}"
    header = ("preset", fixed, "Extrapolation cells", "training seeds a cell", "episodes")
    return table_of(header, [_coverage_row(section) for section in sections])


def _coverage_row(section: PresetSection) -> tuple[str, ...]:
    cells = section.results.cells()
    seeds = sorted({len(cell.rows) for cell in cells})
    span = f"{seeds[0]}" if len(seeds) == 1 else f"{seeds[0]} … {seeds[-1]}"
    fixed = sum(len(section.results.fixed_present(method)) for method in section.results.methods())
    transferred = sum(not cell.rows[0].is_fixed for cell in cells)
    episodes = sum(cell.episodes for cell in cells)
    return section.name, str(fixed), str(transferred), span, f"{episodes:,}"


def _preset_section(section: PresetSection) -> list[str]:
    lines = [
        f"## Preset {section.name}",
        "",
        f"### Claims: {tally(section.claims)}",
        "",
        *verdict_table(section.claims),
        "",
    ]
    if section.baselines:
        lines += ["### Learned policies beside rules that learn nothing", "", BASELINES_NOTE, ""]
        lines += [*table_of(*rule_rows(section.results, section.baselines)), ""]
    lines += ["### Figures", ""]
    for picture in pictures_of(section.results):
        lines += [f"![{picture.alt}, preset {section.name}]({section.folder}{picture.file})", ""]
    return lines


def comparison(rivals: dict[str, Results]) -> list[str]:
    """`comparison_rows` as the lines of a Markdown table."""
    return table_of(*comparison_rows(rivals))
