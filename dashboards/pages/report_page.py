"""The HTML report: one self-contained page with charts, claims and an episode player, from disk or served.

What the page shows is data (`report_data`); the page itself (`report_page`) is the same for every report. Plotly's
JavaScript travels inside, packed, so that nothing is fetched.
"""

from __future__ import annotations

import functools
import hashlib
import html
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from dashboards.analysis.claim_checks import Claim
from dashboards.analysis.claim_text import DETAILS, NOTE, detail_row, evidence, tally
from dashboards.analysis.methods import in_order, method_label
from dashboards.pages.assets import OFFLINE, PLAYER_CSS, PLAYER_JS, SERVED, assets, embedded, fill, packed, to_json
from dashboards.plotly_charts.chart import Chart, Table, as_json, plotly_js
from dashboards.plotly_charts.result_charts import FAVOURITE

REFRESH_S = 4
"""A served page asks for newer data this often."""
FIRST, LAST = ("running", "success", "claims"), ("transfer", "failures", "curves", "throughput")
"""The sections of a report, from top to bottom: tables of other names stand between, the episodes come last."""


class EpisodeGroup(NamedTuple):
    """The episodes of one policy in one setup.

    `key` names the group; `policy` is `learned` or a baseline's name; `trained`, `played` setups and `seed` the
    training's, as text; `counts` the episodes there are by outcome.
    """

    key: str
    preset: str
    policy: str
    method: str
    trained: str
    seed: str
    played: str
    counts: dict[str, int]


class TablePart(NamedTuple):
    """A section that is a table; it is left out while the table has no rows."""

    key: str
    title: str
    note: str
    table: Table


class Contents(NamedTuple):
    """What a report says.

    Fields: its title, a line below it, and how it was made; facts as (name, value); charts; judged claims by preset;
    tables; the episodes to choose from and a note on them.
    """

    title: str
    subtitle: str
    made: str
    facts: list[tuple[str, str]]
    charts: list[Chart]
    claims: Mapping[str, Sequence[Claim]]
    tables: list[TablePart]
    groups: list[EpisodeGroup]
    episodes_note: str


def report_data(contents: Contents) -> dict[str, Any]:
    """The contents as the page takes them; `stamp` changes whenever anything else does."""
    data = {
        "subtitle": contents.subtitle,
        "made": contents.made,
        "facts": contents.facts,
        "order": [*FIRST, *(part.key for part in contents.tables if part.key not in FIRST), *LAST],
        "methods": {name: method_label(name) for name in in_order(group.method for group in contents.groups)},
        "favourite": str(FAVOURITE),
        "charts": [as_json(chart) for chart in contents.charts],
        "claims_note": NOTE.replace("\n", " ").replace("*", "").replace("`", ""),
        "claims": [_judged(preset, claims) for preset, claims in contents.claims.items()],
        "tables": [{**part._asdict(), "table": part.table._asdict()} for part in contents.tables],
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
      samples: episodes that travel with the page, as `dashboards.pages.player.player_data` gives them, by
        `GROUP|outcome|number`, numbers from 0.
      live: whether the page is served, and asks for newer data and episodes; else it can reach nothing.
    """
    fields = {
        "title": html.escape(title),
        "policy": html.escape(SERVED if live else OFFLINE),
        "refresh": str(REFRESH_S if live else 0),
        "css": assets(*PLAYER_CSS, "report.css"),
        "stage": assets("stage.html"),
        "plotly": _plotly(),
        "data": packed(to_json(data).encode()),
        "samples": embedded(samples),
        "js": assets(*PLAYER_JS, "charts.js", "report.js", "episodes.js"),
    }
    return fill("report.html", fields)


@functools.cache
def _plotly() -> str:
    return packed(plotly_js().encode())
