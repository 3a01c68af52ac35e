"""The journal of metrics: truncated to what a checkpoint covers, and refused if it is shorter."""

import json

import pytest

from learner.tracking.journal import Journal, PushedMark, Row, mlflow_metrics, read_rows
from sim_core.checks import ConfigError

ROWS = [Row(100 * i, 1_700_000_000_000 + i, {"a/b": i / 3, "c": float(i)}) for i in range(5)]


@pytest.fixture
def path(tmp_path):
    return tmp_path / "run" / "metrics.jsonl"


def write(path, rows, offset=0):
    """Appends rows; returns the offset after them."""
    journal = Journal(path, offset)
    for row in rows:
        journal.append(row)
    length = journal.sync()
    journal.close()
    return length


def read(path, offset):
    journal = Journal(path, offset)
    rows = journal.rows()
    journal.close()
    return rows


def test_rows_round_trip_exactly(path):
    assert read(path, write(path, ROWS)) == ROWS


def test_offsets_are_lengths_of_the_file_between_rows(path):
    journal = Journal(path, 0)
    offsets = [journal.sync()]
    for row in ROWS:
        journal.append(row)
        offsets.append(journal.sync())
        assert offsets[-1] == path.stat().st_size
    for i, offset in enumerate(offsets):
        assert journal.rows(offset) == ROWS[i:]
        assert journal.rows(0, offset) == ROWS[:i] and journal.rows(offsets[1], offset) == ROWS[1:i]
    journal.close()
    assert offsets[0] == 0 and len(path.read_text().splitlines()) == 5


def test_rows_are_visible_before_they_are_synced(path):
    journal = Journal(path, 0)
    journal.append(ROWS[0])
    assert journal.rows() == ROWS[:1]
    journal.close()


def test_rows_after_the_checkpoint_are_truncated(path):
    offset = write(path, ROWS[:2])
    write(path, ROWS[2:4], offset)
    with path.open("ab") as file:
        file.write(b'[400, 17000, {"half a r')
    assert read(path, offset) == ROWS[:2]
    write(path, ROWS[4:], offset)
    assert [Row(*json.loads(line)) for line in path.read_text().splitlines()] == [*ROWS[:2], ROWS[4]]


def test_a_fresh_start_truncates_everything(path):
    write(path, ROWS)
    assert read(path, 0) == []


def test_a_journal_shorter_than_its_checkpoint_needs_is_refused(path):
    offset = write(path, ROWS)
    with pytest.raises(ConfigError, match=str(offset + 1)):
        Journal(path, offset + 1)
    assert path.stat().st_size == offset


def test_the_mark_survives_a_restart(tmp_path):
    path = tmp_path / "metrics.pushed"
    mark = PushedMark(path, 500)
    assert mark.read() == 0
    mark.write(321)
    assert PushedMark(path, 500).read() == 321
    assert [file.name for file in tmp_path.iterdir()] == ["metrics.pushed"]


def test_a_mark_beyond_the_journal_is_lowered(tmp_path):
    path = tmp_path / "metrics.pushed"
    PushedMark(path, 500).write(321)
    assert PushedMark(path, 100).read() == 100
    assert PushedMark(path, 500).read() == 100  # rows written after the truncation were never pushed


@pytest.mark.parametrize("text", ["", "x", "12 34"])
def test_an_unreadable_mark_pushes_everything_again(tmp_path, text):
    path = tmp_path / "metrics.pushed"
    path.write_text(text)
    assert PushedMark(path, 500).read() == 0


def test_rows_are_read_while_another_process_writes(tmp_path):
    path = tmp_path / "metrics.jsonl"
    assert read_rows(path) == []
    journal = Journal(path, 0)
    journal.append(Row(1, 2, {"a": 0.5}))
    assert read_rows(path) == [Row(1, 2, {"a": 0.5})]
    journal.close()
    with path.open("ab") as file:
        file.write(b'[3, 4, {"a"')  # a half-written row
    assert read_rows(path) == [Row(1, 2, {"a": 0.5})]


@pytest.mark.parametrize("line", ["7", "{}", "[" * 100_000, "[1, 2, 3, 4]"], ids=len)
def test_a_line_that_is_no_row_is_refused(tmp_path, line):
    (tmp_path / "metrics.jsonl").write_text(f"{line}\n")
    with pytest.raises(ConfigError, match="metrics.jsonl cannot be read"):
        read_rows(tmp_path / "metrics.jsonl")


def test_mlflow_gets_no_accounts_and_only_the_intervals_of_the_result():
    kept = {"final/success_rate": 0.5, "final/success_rate_low": 0.4, "final/return_high": 2.0, "eval/lost_rate": 0.1}
    kept |= {"time/worker_waits": 0.1, "time/learner_waits": 0.2, "eval/q_visited": 0.3}
    names = "account/produced replay/size policy/staleness_s eval/success_rate_low eval/return_high final/lost_rate_low"
    names += " time/worker_acts time/learner_samples train/td_error eval/q_start"
    assert mlflow_metrics(kept | dict.fromkeys(names.split(), 1.0)) == kept
