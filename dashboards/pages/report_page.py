"""The HTML report: one self-contained page with charts, claims and an episode player, opened from disk or served.

`report_data` turns a report's contents into data; `report_page` embeds them in a page that is the same for all reports.
Plotly's JavaScript is embedded compressed, so that nothing is loaded from elsewhere.
"""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from dashboards.analysis.claim_checks import Claim
from dashboards.analysis.claim_text import DETAILS, NOTE, detail_row, evidence, tally
from dashboards.analysis.methods import in_order, method_label
from dashboards.pages.assets import (
    OFFLINE,
    PLAYER_CSS,
    PLAYER_JS,
    SERVED,
    assets,
    document,
    embedded,
    packed,
    to_json,
)
from dashboards.plotly_charts.chart import Chart, Table, as_json, plotly_js
from dashboards.plotly_charts.result_charts import FAVOURITE

REFRESH_S = 4
"""Interval at which a served page requests newer data."""
SEARCH = ("search", "front", "importances", "slices")
FIRST, LAST = ("running", *SEARCH, "success", "claims"), ("transfer", "failures", "curves", "throughput")
"""First and last sections of a report; other tables come between, and the episodes at the end."""


class EpisodeGroup(NamedTuple):
    """The episodes of one policy in one setup.

    `key` identifies the group. `policy` is `learned` or a baseline's name. `trained` and `played` are the setups of
    the training and of the test, and `seed` is the training's, all as text. `counts` are episodes by outcome.
    """

    key: str
    preset: str
    policy: str
    method: str
    trained: str
    seed: str
    played: str
    counts: dict[str, int]


class TableSection(NamedTuple):
    """A section with a table; it is hidden while the table has no rows."""

    key: str
    title: str
    note: str
    table: Table


class ReportContents(NamedTuple):
    """The contents of a report.

    Fields: its title, the line below it, and how it was made; facts as (name, value); charts; judged claims by preset;
    tables; the groups of episodes, and a note on them.
    """

    title: str
    subtitle: str
    made: str
    facts: list[tuple[str, str]]
    charts: list[Chart]
    claims: Mapping[str, Sequence[Claim]]
    tables: list[TableSection]
    groups: list[EpisodeGroup]
    episodes_note: str


def report_data(contents: ReportContents) -> dict[str, Any]:
    """The contents as the page reads them, ready for JSON; `stamp` changes with any other value."""
    data = {
        "subtitle": contents.subtitle,
        "made": contents.made,
        "facts": contents.facts,
        "order": [*FIRST, *(section.key for section in contents.tables if section.key not in FIRST), *LAST],
        "methods": {name: method_label(name) for name in in_order(group.method for group in contents.groups)},
        "favourite": str(FAVOURITE),
        "charts": [as_json(chart) for chart in contents.charts],
        "claims_note": NOTE.replace("\n", " ").replace("*", "").replace("`", ""),
        "claims": [_judged(preset, claims) for preset, claims in contents.claims.items()],
        "tables": [{**section._asdict(), "table": section.table._asdict()} for section in contents.tables],
        "episodes": {"groups": [group._asdict() for group in contents.groups], "note": contents.episodes_note},
    }
    return {**data, "stamp": hashlib.sha256(to_json(data).encode()).hexdigest()[:16]}


def _judged(preset: str, claims: Sequence[Claim]) -> dict[str, Any]:
    rows = [
        {
            "number": claim.number,
            "text": claim.text,
            "verdict": str(claim.verdict),
            "evidence": evidence(claim),
            "header": DETAILS,
            "checks": [detail_row(check) for check in claim.checks],
        }
        for claim in claims
    ]
    return {"preset": preset, "tally": tally(claims), "claims": rows}


def report_page(title: str, data: Mapping[str, Any], samples: Mapping[str, Any], live: bool) -> str:
    """The document.

    Args:
      title: plain text; it is escaped.
      data: of `report_data`.
      samples: embedded episodes as from `dashboards.pages.player.player_data`, by `GROUP|outcome|number`, numbers
        from 0.
      live: whether the page is served, and requests newer data and episodes; otherwise it may connect to nothing.
    """
    return document(
        title,
        SERVED if live else OFFLINE,
        (*PLAYER_CSS, "report.css"),
        "report.html",
        refresh=str(REFRESH_S if live else 0),
        stage=assets("stage.html"),
        plotly=_plotly(),
        data=packed(to_json(data).encode()),
        samples=embedded(samples),
        js=assets(*PLAYER_JS, "charts.js", "report.js", "episodes.js"),
    )


@functools.cache
def _plotly() -> str:
    return packed(plotly_js().encode())
