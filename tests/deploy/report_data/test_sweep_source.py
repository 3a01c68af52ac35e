"""The report of a table of results: what stands beside it is read, and noticed when it changes."""

from pathlib import Path

from actors.evaluation.result_table import write_table
from actors.evaluation.value_table import ValueRow, write_values
from dashboards.analysis.aggregate import Setup
from dashboards.analysis.claim_checks import Verdict
from dashboards.analysis.statements import NO_FIELD
from deploy.report_data.sweep_source import SweepSource
from learner.file_names import RESULTS, VALUES, VARIANTS
from tests.dashboards.tables import claimed_table, row


def verdicts(source: SweepSource) -> list[Verdict]:
    """Those of statements 24 and 26."""
    (claims,) = source.contents().claims.values()
    return [claims[number - 1].verdict for number in (24, 26)]


def test_tables_beside_a_table_decide_claims_and_renew_the_page(tmp_path: Path):
    write_table(tmp_path / RESULTS, claimed_table())
    source, seen = SweepSource(tmp_path, tmp_path / RESULTS), []
    assert verdicts(source) == [Verdict.NO_DATA, Verdict.NO_DATA]
    seen.append(source.fingerprint())
    write_table(tmp_path / VARIANTS, [row("out", Setup(5, 1), success=1, preset=f"thesis+{NO_FIELD}")])
    assert verdicts(source) == [Verdict.HOLDS, Verdict.NO_DATA]
    seen.append(source.fingerprint())
    ends = {"dqn": 2.0, "double_dqn": 1.5}
    write_values(
        tmp_path / VALUES,
        [ValueRow("thesis", "sensor", 10, 2, name, 0, 9, 9, 100, 0.0, 0.0, value, 1.0) for name, value in ends.items()],
    )
    assert verdicts(source) == [Verdict.HOLDS, Verdict.HOLDS]
    assert len({*seen, source.fingerprint()}) == 3
