"""The judged claims as Markdown."""

from __future__ import annotations

from actors.evaluation.statistics import as_percent, dispersion, rate
from dashboards.analysis.aggregate import SETUPS, Results, Setup
from dashboards.analysis.claim_checks import Claim, at_least, rises
from dashboards.analysis.claim_text import claims_markdown, details, evidence, tally, verdict_table
from dashboards.analysis.claims import judge
from tests.dashboards.tables import claimed, fixed


def judged(*changed: object, without: tuple[object, ...] = ()) -> list[Claim]:
    return judge(claimed(*changed, without=without))  # type: ignore[arg-type]


def test_the_table_has_one_row_per_claim_with_its_verdict():
    lines = verdict_table(judged(fixed("sensor", Setup(25, 1), success=75), without=(fixed("out", Setup(15, 8)),)))
    assert lines[0] == "| # | claim | verdict | evidence |"
    cells = [line.split(" | ") for line in lines[2:]]
    assert [line[0] for line in cells] == [f"| {number}" for number in range(1, 27)]
    verdicts = {number: line[2] for number, line in enumerate(cells, start=1)}
    assert verdicts[1] == "**does not hold**" and verdicts[2] == "**holds**" and verdicts[14] == "no data"


def test_evidence_of_a_short_claim_has_all_its_numbers():
    claim = judged(fixed("sensor", Setup(25, 2), success=80))[4]
    assert evidence(claim) == (
        "10r×2g 92.0 % (91.0 … 92.9); 25r×2g 80.0 % (78.5 … 81.4) (does not hold); "
        "10r×2g less 25r×2g +12.0 (+10.3 … +13.7) points"
    )


def test_evidence_over_all_setups_counts_them_and_names_those_that_do_not_hold():
    worse = [fixed("out", Setup(20, 3), success=50), fixed("out", Setup(5, 8), success=30)]
    text = evidence(judged(*worse)[10])
    assert text == (
        "holds in 23 of 25 setups; not: 5r×8g M_OUT less M_sensor −22.0, 20r×3g M_OUT less M_sensor −26.0; "
        "undecided: 5r×8g M_OUT less M_IN"
    )


def test_evidence_counts_missing_checks_if_there_are_many():
    claims = judged(without=tuple(fixed("in", setup) for setup in SETUPS))
    assert evidence(claims[10]) == "holds in 0 of 25 setups; no data: 25 checks"


def test_details_show_every_check_with_its_numbers():
    other = fixed("sensor", Setup(5, 1), success=90)._replace(seed=1)
    claims = judged(other)
    lines = details(claims)
    assert sum(line.startswith("| ") for line in lines) == sum(len(claim.checks) + 2 for claim in claims)
    measured = as_percent(rate(5520, 6000, dispersion([[(2820, 3000), (2700, 3000)]])))
    assert f"| 5r×1g | ≈ 100 % (90 … 100 %) | {measured} | 2: 90.0 … 94.0 % | 6,000 | holds |" in lines


def test_the_tally_leaves_out_verdicts_without_claims():
    further = "; of 11 further statements 9 holds, 1 does not hold, 1 no data"
    assert tally(judged()) == f"15 holds{further}"
    assert tally(judged(fixed("in", Setup(10, 1), success=60))) == f"14 holds, 1 does not hold{further}"
    assert tally(judged()[:15]) == "15 holds"


def test_page_has_each_preset():
    page = claims_markdown({"best": judged(), "thesis": judge(Results([]))})
    assert page.index("## Preset best") < page.index("15 holds") < page.index("## Preset thesis")
    assert page.count("### 15. ") == page.count("### 26. ") == 2 and page.endswith("|\n")
    line = (
        "| 7, 21 | 10r×8g is below 80 % (7) and above 80 % (21) | 7 holds; 21 does not hold | 7 no data; 21 no data |"
    )
    assert line in page[page.index("## Claims that contradict each other") :]


def test_a_vertical_bar_in_a_name_breaks_no_table():
    line = verdict_table([Claim(1, "a|b", [at_least("x", None, 0.5), rises("y", None)])])[2]
    assert line.replace(r"\|", "").count("|") == 5
