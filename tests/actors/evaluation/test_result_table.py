"""The table of a sweep's results: round trip, and refusal of impossible counts."""

import pytest

from actors.evaluation.result_table import ResultRow, read_table, write_table
from sim_core.checks import ConfigError
from sim_core.outcomes import ENDED, Outcome

ROW = ResultRow("thesis", "learned", "out", 5, 2, 1, 10, 2, 10, 4, 3, 2, 1, 0, 123.25, "0123456789ab")
FIXED = ROW._replace(robots=5, seed=0)


def test_rows_are_written_in_a_fixed_order_and_read_back(tmp_path):
    path = tmp_path / "new" / "results.csv"
    write_table(path, [ROW, FIXED])
    again = tmp_path / "again.csv"
    write_table(again, [FIXED, ROW])
    assert path.read_bytes() == again.read_bytes()
    assert read_table(path) == [FIXED, ROW]
    assert [file.name for file in path.parent.iterdir()] == ["results.csv"]


def test_an_empty_table_can_be_read(tmp_path):
    write_table(tmp_path / "results.csv", [])
    assert read_table(tmp_path / "results.csv") == []


def test_a_table_that_a_spreadsheet_saved_is_read(tmp_path):
    write_table(tmp_path / "results.csv", [ROW])
    text = (tmp_path / "results.csv").read_text("utf-8")
    (tmp_path / "results.csv").write_text(text.replace("\n", "\r\n"), "utf-8-sig", newline="")
    assert read_table(tmp_path / "results.csv") == [ROW]


def test_counts_by_outcome():
    assert [ROW.count(kind) for kind in ENDED] == [4, 3, 2, 1, 0]
    assert ROW.count(Outcome.CAPTURED) == 2
    assert FIXED.is_fixed and not ROW.is_fixed and not FIXED._replace(groups=3).is_fixed


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ("4,3,2,1,0 -> 5,3,2,1,0", "11 outcomes of 10"),
        ("4,3,2,1,0 -> 9,-2,2,1,0", "outcomes of 10"),
        ("4,3,2,1,0 -> four,3,2,1,0", "no row of results"),
        ("4,3,2,1,0 -> 4,3,2,1", "no row of results"),
        ("goal,lost -> lost,goal", "first line"),
    ],
)
def test_a_table_with_impossible_counts_or_columns_is_refused(tmp_path, change, words):
    path = tmp_path / "results.csv"
    write_table(path, [ROW])
    before, after = change.split(" -> ")
    text = path.read_text()
    assert before in text
    path.write_text(text.replace(before, after))
    with pytest.raises(ConfigError, match=words):
        read_table(path)


@pytest.mark.parametrize("content", [None, b"", b"\xff\xfe\x00", b"what,else\n1,2\n"])
def test_anything_but_a_table_is_refused(tmp_path, content):
    path = tmp_path / "results.csv"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(ConfigError, match=str(path)):
        read_table(path)
