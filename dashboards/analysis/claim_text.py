"""Judged claims as Markdown: a table of verdicts, and a table of every claim's checks."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

from dashboards.analysis.claim_checks import NUM_CLAIMS, Check, Claim, Verdict, number_text, with_verdict
from dashboards.analysis.statements import CONTRADICTIONS

SHOWN_WHOLE = 5
"""The table shows all checks of a claim with at most this many."""
NAMED_AT_MOST = 10
"""At most this many checks without data, or undecided, are named; more are counted."""
DETAILS = ("check", "wanted", "measured (95 % interval)", "seeds", "episodes", "verdict")
"""Columns of a table of checks."""
NOTE = """\
Rates with 95 % intervals: Wilson's on counts pooled over training seeds, Newcombe's and Donner and Zou's for
differences and means. Counts of different seeds vary more than those of one policy: the intervals are widened by
how much more, estimated over the cells of one method and as many robots (Pearson's dispersion, whose variances are
proportional to p(1 − p)). With one seed they speak of that policy alone. All play the same start scenes. A check
**holds** where its whole interval is in the wanted range, **does not hold** where none of it is, and is
**undecided** between. Met by the value alone are `≈` and "around" (within 10 points, for failure rates within 2),
"none" and "the only" (up to 0.5 %). "Flat" and "similar" allow 2 points. In claim 11 the value alone decides, both
methods above 95 % tie, and the intervals are those of fifty comparisons together (Bonferroni). A claim holds if all
its checks hold, and does not if any does not. From 16 on these are further statements of the text."""


def table_of(header: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """The lines of a Markdown table."""
    lines = [header, ["---"] * len(header), *rows]
    return ["| " + " | ".join(cell.replace("|", r"\|") for cell in line) + " |" for line in lines]


def verdict_table(claims: Sequence[Claim]) -> list[str]:
    """Lines of the table of claims: number, text, verdict, evidence."""
    rows = [(str(claim.number), claim.text, _strong(claim.verdict), evidence(claim)) for claim in claims]
    return table_of(("#", "claim", "verdict", "evidence"), rows)


def tally(claims: Sequence[Claim]) -> str:
    """The number of claims with each verdict, in one line; further statements apart."""
    further = [claim for claim in claims if claim.number > NUM_CLAIMS]
    first = _counts([claim for claim in claims if claim.number <= NUM_CLAIMS])
    return first + (f"; of {len(further)} further statements {_counts(further)}" if further else "")


def _counts(claims: Sequence[Claim]) -> str:
    counts = {verdict: sum(claim.verdict is verdict for claim in claims) for verdict in Verdict}
    return ", ".join(f"{count} {verdict}" for verdict, count in counts.items() if count)


def evidence(claim: Claim) -> str:
    """The numbers behind a verdict: every check of a short claim; of a long one, the checks that do not hold."""
    if len(claim.checks) <= SHOWN_WHOLE:
        return "; ".join(f"{check.name} {number_text(check)}{_remark(check)}" for check in claim.checks)
    words = [_how_many_hold(claim.checks)]
    failing = with_verdict(claim.checks, Verdict.FAILS)
    if failing:
        named = ", ".join(f"{check.name} {_value_text(check)}" for check in failing)
        words.append(f"not: {named}")
    for verdict in (Verdict.UNDECIDED, Verdict.NO_DATA):
        checks = with_verdict(claim.checks, verdict)
        if checks:
            words.append(f"{verdict}: {_names(checks)}")
    return "; ".join(words)


def _how_many_hold(checks: Sequence[Check]) -> str:
    held = with_verdict(checks, Verdict.HOLDS)
    setups = {check.setup for check in checks if check.setup is not None}
    if not setups:
        return f"{len(held)} of {len(checks)} checks hold"
    short = {check.setup for check in checks if check.verdict is not Verdict.HOLDS}
    others = [check for check in held if check.setup is None]
    kept = ", ".join([f"{check.name} {number_text(check)}" for check in others])
    return f"holds in {len(setups - short)} of {len(setups)} setups" + (f"; {kept}" if kept else "")


def details(claims: Sequence[Claim]) -> list[str]:
    """Lines with every claim's table of checks."""
    lines: list[str] = []
    for claim in claims:
        rows = [detail_row(check) for check in claim.checks]
        lines += [f"### {claim.number}. {claim.text}", "", f"**{claim.verdict}**", "", *table_of(DETAILS, rows), ""]
    return lines


def claims_markdown(judged: dict[str, list[Claim]]) -> str:
    """The page: for each preset the table of claims, and the checks of each."""
    lines = ["# The dissertation's claims, checked", "", NOTE, ""]
    for preset, claims in judged.items():
        lines += [f"## Preset {preset}", "", f"{tally(claims).capitalize()}.", "", *verdict_table(claims), ""]
        lines += details(claims)
    lines += ["## Claims that contradict each other", "", *contradictions(judged)]
    return "\n".join(lines).rstrip("\n") + "\n"


def contradictions(judged: Mapping[str, Sequence[Claim]]) -> list[str]:
    """Lines of a table: claims of which no world has all, why, and their verdicts with each preset."""
    rows = []
    for numbers, why in CONTRADICTIONS:
        verdicts = ["; ".join(f"{n} {claims[n - 1].verdict}" for n in numbers) for claims in judged.values()]
        rows.append((", ".join(map(str, numbers)), why, *verdicts))
    return table_of(("claims", "why no world has all", *judged), rows)


def _strong(verdict: Verdict) -> str:
    return f"**{verdict}**" if verdict is not Verdict.NO_DATA else str(verdict)


def _remark(check: Check) -> str:
    return "" if check.verdict is Verdict.HOLDS else f" ({check.verdict})"


def _value_text(check: Check) -> str:
    """The value without its interval."""
    return number_text(check).partition(" (")[0]


def _names(checks: Sequence[Check]) -> str:
    if len(checks) > NAMED_AT_MOST:
        return f"{len(checks)} checks"
    return ", ".join(check.name for check in checks)


def detail_row(check: Check) -> tuple[str, ...]:
    """A check in the columns DETAILS."""
    measured = check.measured
    seeds = "–" if measured is None else str(measured.seeds)
    if measured is not None and measured.seed_range is not None:
        lowest, highest = (100 * number for number in measured.seed_range)
        seeds += f": {lowest:.1f} … {highest:.1f} %"
    episodes = "–" if measured is None else f"{measured.episodes:,}"
    return check.name, check.wanted, number_text(check), seeds, episodes, str(check.verdict)
