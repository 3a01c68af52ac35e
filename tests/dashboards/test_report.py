"""The report's page: its coverage, and how it compares presets."""

from __future__ import annotations

import re
from collections.abc import Sequence

from actors.evaluation.result_table import ResultRow
from dashboards.analysis.aggregate import Results, Setup
from dashboards.analysis.claims import judge
from dashboards.analysis.comparison import baselines_of, presets_of, rule_rows
from dashboards.figures.result_figures import PICTURES
from dashboards.report import DRAWINGS, PresetSection, comparison, report_markdown
from tests.dashboards.tables import claimed_table, fixed, row


def section(name: str, rows: Sequence[ResultRow], folder: str = "") -> PresetSection:
    results = Results(rows)
    return PresetSection(name, results, judge(results), folder, baselines_of(rows))


def test_presets_are_those_with_a_learned_policy_and_thesis_comes_first():
    rows = [row("sensor", Setup(5, 1), success=50, preset=name) for name in ("best", "thesis", "arena")]
    rows.append(row("sensor", Setup(5, 1), success=50, preset="baselines")._replace(policy="orca"))
    assert presets_of(rows) == ["thesis", "arena", "best"]


def test_the_page_states_its_sources_and_coverage():
    rows = [*claimed_table(), fixed("sensor", Setup(5, 1))._replace(seed=1, episodes=3000)]
    page = report_markdown(["results.csv"], [section("thesis", rows)])
    assert "| 7, 21 | 10r×8g is below 80 % (7) and above 80 % (21) | 7 holds; 21 does not hold |" in page
    assert "`results.csv`" in page and "Presets side by side" not in page
    assert "| thesis | 75 | 29 | 1 … 2 | 315,000 |" in page


def test_partial_tables_are_counted():
    page = report_markdown(["half.csv"], [section("best", [fixed("out", Setup(5, 1)), fixed("in", Setup(5, 1))])])
    assert "| best | 2 | 0 | 1 | 6,000 |" in page and "15 no data" in page


def test_the_page_embeds_every_picture_with_a_description():
    parts = [section("thesis", claimed_table(), "thesis/"), section("best", claimed_table(), "best/")]
    links = re.findall(r"!\[([^\]]+)\]\(([^)]+)\)", report_markdown(["r.csv"], parts))
    wanted = [f"{name}/{picture.file}" for name in ("thesis", "best") for picture in PICTURES]
    assert [link for _, link in links] == wanted + [drawing.file for drawing in DRAWINGS]
    assert len({words for words, _ in links}) == len(links)


def test_presets_are_compared_in_setups_that_all_have():
    small, middle, large = Setup(5, 1), Setup(10, 2), Setup(25, 8)
    first = [row("sensor", setup, success=share) for setup, share in ((small, 90), (middle, 80), (large, 10))]
    first.append(row("out", small, success=70))
    second = [row("sensor", setup, success=share) for setup, share in ((small, 95), (middle, 60))]
    second.append(row("in", small, success=70))
    lines = comparison({"thesis": Results(first), "best": Results(second)})
    assert lines[0] == "| method | setups in all | thesis | best | thesis best in | best best in |"
    assert lines[2:] == [
        "| M_sensor | 2 | 85.0 % | 77.5 % | 1 | 1 |",
        "| M_IN | 0 | – | – | – | – |",
        "| M_OUT | 0 | – | – | – | – |",
    ]


def test_a_tie_counts_for_nobody():
    rows = [row("out", Setup(5, 1), success=70)]
    assert "| M_OUT | 1 | 70.0 % | 70.0 % | 0 | 0 |" in comparison({"a": Results(rows), "b": Results(rows)})


def test_baselines_are_shown_beside_the_learned_policies_of_the_same_setups():
    learned = [row("sensor", Setup(5, 1), success=90), row("sensor", Setup(10, 2), success=80)]
    greedy = [
        row("sensor", Setup(5, 1), success=95)._replace(policy="greedy"),
        row("sensor", Setup(25, 8), success=5)._replace(policy="greedy"),
    ]
    page = report_markdown(["r.csv"], [section("thesis", [*learned, *greedy])])
    assert "| method | setups | learned | greedy | best rule | learned, lowest | not below the best rule in |" in page
    assert "| M_sensor | 1 | 90.0 % | 95.0 % | 95.0 % | 90.0 % | 0 |" in page
    assert "rules that learn nothing" not in report_markdown(["r.csv"], [section("thesis", learned)])


def test_the_best_rule_is_that_of_each_setup_and_a_method_need_not_have_all_rules():
    setups = (Setup(5, 1), Setup(10, 2), Setup(25, 8))

    def rows_of(method, *shares):
        return [row(method, setup, success=share) for setup, share in zip(setups, shares, strict=True)]

    learned = Results([*rows_of("in", 99, 90, 80), *rows_of("sensor", 90, 90, 92.5)])
    rules = {
        "field": Results(rows_of("in", 90, 92, 99)),
        "greedy": Results([*rows_of("in", 98, 20, 10), *rows_of("sensor", 80, 80, 93)]),
    }
    header, rows = rule_rows(learned, rules)
    assert header[2:5] == ["learned", "field", "greedy"]
    assert rows == [
        ["M_sensor", "3", "90.8 %", "–", "84.3 %", "84.3 %", "90.0 %", "3"],
        ["M_IN", "3", "89.7 %", "93.7 %", "42.7 %", "96.3 %", "80.0 %", "1"],
        ["M_OUT", "0", "–", "–", "–", "–", "–", "–"],
    ]
