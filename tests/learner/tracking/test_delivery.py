"""Delivery to MLflow: rows are kept while it is away and arrive in order and once; training never waits for it."""

import threading
from contextlib import closing

import pytest

from learner.tracking import delivery as delivery_module
from learner.tracking.delivery import Delivery, retry
from learner.tracking.journal import Journal, PushedMark, Row
from learner.tracking.tracked_run import TrackingError

ROWS = [Row(100 * i, 1_700_000_000_000 + i, {"a": float(i)}) for i in range(12)]


class Server:
    """Takes rows while it is up; implements the methods of Tracker that Delivery calls."""

    def __init__(self):
        self.rows, self.up, self.calls = [], True, 0
        self.busy = threading.Event()
        self.busy.set()

    def push(self, rows):
        self.calls += 1
        assert self.busy.wait(30)
        if not self.up:
            raise TrackingError("connection refused")
        self.rows += rows


@pytest.fixture(autouse=True)
def no_pauses(monkeypatch):
    monkeypatch.setattr(delivery_module, "FIRST_PAUSE_S", 0.01)
    monkeypatch.setattr(delivery_module, "LONGEST_PAUSE_S", 0.02)


@pytest.fixture
def server():
    return Server()


@pytest.fixture
def journal(tmp_path):
    with closing(Journal(tmp_path / "metrics.jsonl", 0)) as made:
        yield made


@pytest.fixture
def mark(tmp_path):
    return PushedMark(tmp_path / "metrics.pushed", 0)


@pytest.fixture
def said():
    return []


@pytest.fixture
def delivery(server, journal, mark, said):
    with closing(Delivery(server, journal, mark, said.append)) as made:
        yield made


def write(journal, rows):
    for row in rows:
        journal.append(row)
    return journal.sync()


def test_rows_are_delivered_once_a_checkpoint_covers_them(delivery, server, journal, mark):
    offset = write(journal, ROWS[:3])
    write(journal, ROWS[3:5])  # not covered by a checkpoint yet
    delivery.deliver_up_to(offset)
    assert delivery.flush(30) is None
    assert server.rows == ROWS[:3] and mark.read() == offset
    delivery.deliver_up_to(journal.sync())
    assert delivery.flush(30) is None
    assert server.rows == ROWS[:5]


def test_rows_of_an_outage_are_delivered_after_it_in_order_and_once(delivery, server, journal, said):
    server.up = False
    for i in range(0, 12, 3):
        delivery.deliver_up_to(write(journal, ROWS[i : i + 3]))
    assert delivery.flush(0.2) == "connection refused"
    assert server.rows == [] and server.calls >= 2
    server.up = True
    assert delivery.flush(30) is None
    assert server.rows == ROWS
    assert len(said) == 2 and "kept and sent again: connection refused" in said[0] and "none is missing" in said[1]


def test_a_request_does_not_wait_for_a_server_that_hangs(delivery, server, journal):
    server.busy.clear()
    for row in ROWS:
        delivery.deliver_up_to(write(journal, [row]))  # returns, or the test times out
    server.busy.set()
    assert delivery.flush(30) is None
    assert server.rows == ROWS


def test_rows_of_a_request_in_flight_at_the_close_do_not_count(server, journal, mark, said, monkeypatch):
    monkeypatch.setattr(delivery_module, "CLOSE_TIMEOUT_S", 0.01)
    delivery = Delivery(server, journal, mark, said.append)
    server.busy.clear()
    delivery.deliver_up_to(write(journal, ROWS[:2]))
    while not server.calls:
        threading.Event().wait(0.01)
    delivery.close()
    server.busy.set()
    delivery._thread.join(30)
    assert mark.read() == 0
    with closing(Delivery(server, journal, mark, said.append)) as successor:
        successor.deliver_up_to(journal.sync())
        assert successor.flush(30) is None
    assert server.rows == ROWS[:2] * 2  # the same rows with the same times, which MLflow stores once


def test_a_call_is_retried_until_it_works(said):
    failures = iter([TrackingError("away"), TrackingError("away")])

    def call():
        for failure in failures:
            raise failure

    retry(call, "the results", 30, said.append)
    assert said == ["MLflow did not take the results, trying again: away"] * 2


def test_with_no_time_left_the_error_is_raised(said):
    def call():
        raise TrackingError("away")

    with pytest.raises(TrackingError):
        retry(call, "the results", 0, said.append)
    assert said == []


def test_errors_of_other_kinds_are_raised_at_once(said):
    def call():
        raise IsADirectoryError("ours")

    with pytest.raises(IsADirectoryError):
        retry(call, "the artifacts", 30, said.append)
